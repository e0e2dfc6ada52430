"""Work on many images in threads, with a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import TypeVar

import torch

from lapgs_plugin.limits import usable_processors
from lapgs_plugin.progress import item_progress

ProgressCallback = Callable[[int, int], None]
"""Called with the number of finished items and their total."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


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
        work: what to do.
        items: what to do it with.
        most: number of threads; None for one a processor that this process may use.
        progress: True shows a bar on stderr, False nothing; a function is called after each item.
    """
    bar = item_progress(unit) if progress is True else None
    task = bar.add_task(title, total=len(items)) if bar else None
    results = []
    usable = usable_processors()
    # One thread an item: torch's own threads would compete with these.
    pool = ThreadPoolExecutor(min(usable, most or usable), initializer=torch.set_num_threads, initargs=(1,))
    with bar or nullcontext():
        try:
            for done, future in enumerate([pool.submit(work, item) for item in items], start=1):
                results.append(future.result())
                if bar and task is not None:
                    bar.update(task, completed=done)
                elif callable(progress):
                    progress(done, len(items))
        finally:
            pool.shutdown(cancel_futures=True)
    return results
