"""What a run spends beside the optimization: seconds by what they were spent on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager


class Overhead(dict[str, float]):
    """Seconds by purpose, such as "pyramid" or "cache".

    Args:
        seconds: spent so far.
        settle: called when a timed block ends, before the clock is read: waits for a GPU that is still busy with it.
    """

    def __init__(self, seconds: Mapping[str, float] | None = None, settle: Callable[[], None] | None = None) -> None:
        super().__init__(seconds or {})
        self._settle = settle

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """Add the time spent inside to `what`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            if self._settle is not None:
                self._settle()
            self[what] = self.get(what, 0.0) + time.perf_counter() - start
