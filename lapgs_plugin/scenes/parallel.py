"""Show progress, and work on many images in threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from lapgs_plugin.limits import usable_processors
from lapgs_plugin.progress import item_progress

ProgressCallback = Callable[[int, int], None]
"""Called with the number of finished items and their total."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@contextmanager
def bar(
    title: str, unit: str, progress: bool | ProgressCallback, total: int | None = None
) -> Iterator[ProgressCallback]:
    """Show a bar on stderr if `progress` is True; yield the callback for finished items and their total."""
    if progress is not True:
        yield progress or (lambda done, total: None)
        return
    with item_progress(unit) as shown:
        task = shown.add_task(title, total=total)
        yield lambda done, total: shown.update(task, completed=done, total=total)


def in_threads(
    title: str,
    unit: str,
    work: Callable[[_Item], _Result],
    items: Sequence[_Item],
    *,
    most: int | None = None,
    progress: bool | ProgressCallback,
) -> list[_Result]:
    """Apply `work` to all items in threads and return the results in order; raise the first error in order.

    Args:
        title, unit: of the progress bar.
        work: function of an item.
        items: its arguments.
        most: number of threads. Default: usable processors.
        progress: True shows a bar on stderr, False nothing; a function is called after each item.
    """
    results = []
    usable = usable_processors()
    # One thread an item: torch's own threads would compete with these.
    pool = ThreadPoolExecutor(min(usable, most or usable), initializer=torch.set_num_threads, initargs=(1,))
    with bar(title, unit, progress, len(items)) as seen:
        try:
            for done, future in enumerate([pool.submit(work, item) for item in items], start=1):
                results.append(future.result())
                seen(done, len(items))
        finally:
            pool.shutdown(cancel_futures=True)
    return results
