"""Show progress, and work on many images in threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from lapgs_plugin.limits import usable_processors, use_one_torch_thread
from lapgs_plugin.progress import item_progress

ProgressCallback = Callable[[int, int], None]
"""Called with the number of finished items and their total."""

MOST_READERS = 16
"""Most threads that read images."""
READING_BYTES = 4 << 30
"""Most bytes of images that are decoded at once."""
DECODING = 2 * 3 * 4
"""Bytes that decoding a pixel takes at most: the image as float32, and the same while it is resized."""

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
    pool = _pool(min(usable, most or usable))
    with bar(title, unit, progress, len(items)) as seen:
        try:
            for done, future in enumerate([pool.submit(work, item) for item in items], start=1):
                results.append(future.result())
                seen(done, len(items))
        finally:
            pool.shutdown(cancel_futures=True)
    return results


def ahead(work: Callable[[_Item], _Result], items: Iterable[_Item], *, most: int) -> Iterator[_Result]:
    """Yield the results of `work` for all items in order, while threads work on the items that follow.

    Args:
        work: function of an item.
        items: its arguments.
        most: number of threads, and of results that are being made or wait. Memory holds one more: the last yielded.

    Raises:
        Exception: that of the first item whose `work` raised; items after it may have been worked on.
    """
    threads = max(1, min(most, usable_processors()))
    pool, coming = _pool(threads), deque[Future[_Result]]()
    try:
        for item in items:
            if len(coming) == threads:
                yield coming.popleft().result()
            coming.append(pool.submit(work, item))
        while coming:
            yield coming.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def readers_of(sizes: Iterable[tuple[int, int]]) -> int:
    """Return how many threads may read images of these (width, height) at once, so that memory stays bounded."""
    most_pixels = max((width * height for width, height in sizes), default=1)
    return max(1, min(MOST_READERS, READING_BYTES // (DECODING * most_pixels)))


def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, initializer=use_one_torch_thread)
