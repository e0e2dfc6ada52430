"""Threads for kernels: a pool of our own, beside PyTorch's.

`parallel(kernel, ...)` runs one kernel on several threads at once. Each draws pieces of work from a shared counter
until none is left, so that the result depends neither on the number of threads nor on who did what. The calling thread
works too and waits only for threads that have begun; a pool that is late, busy with another caller's kernel or gone
after a fork costs speed, never a result. Nothing here is bound to an OpenMP or TBB library, and any number of Python
threads may render at the same time.

PyTorch's OpenMP threads are the trouble. GNU OpenMP, on Linux, lets them spin for about ten milliseconds after each
operation that ran in parallel (on a tensor of 32768 elements or more), on the cores that the next kernel needs. On two
cores, rendering 400x300 pixels, an L1 loss in PyTorch and their gradients took 12.6 ms so, 8.9 ms with the first of
these cures and 8.3 ms with the second:

- before torch is imported: set OMP_WAIT_POLICY=PASSIVE in the environment, as the command line of this package does;
- after: `with one_pool():` around the training loop. PyTorch's operations run on the calling thread alone inside, and
  kernels on as many threads as PyTorch had.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch


class _Job:
    """One kernel call that several threads join."""

    def __init__(self, kernel: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        self._kernel = kernel
        self._arguments = arguments
        self._state = threading.Condition()
        self._closed = False
        self._joined = 0
        self._error: BaseException | None = None

    def join_in(self) -> None:
        """Work on the job unless it is over."""
        with self._state:
            if self._closed:
                return
            self._joined += 1
        try:
            self._kernel(*self._arguments)
        except BaseException as error:  # handed to the thread that waits in `run`
            self._error = error
        with self._state:
            self._joined -= 1
            self._state.notify()

    def run(self) -> None:
        """Work on the job and return when it is over on every thread."""
        try:
            self._kernel(*self._arguments)
        finally:
            with self._state:
                self._closed = True
                self._state.wait_for(lambda: self._joined == 0)
                self._arguments = ()
        if self._error is not None:
            raise self._error


class _Pool:
    """Daemon threads that wait for jobs without spinning."""

    def __init__(self) -> None:
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._lock = threading.Lock()
        self._size = 0

    def offer(self, job: _Job, helpers: int) -> None:
        """Let `helpers` threads join the job."""
        with self._lock:
            for _ in range(self._size, helpers):
                threading.Thread(target=self._serve, name="lapgs-raster", daemon=True).start()
            self._size = max(self._size, helpers)
        for _ in range(helpers):
            self._jobs.put(job)

    def _serve(self) -> None:
        while True:
            self._jobs.get().join_in()


_pool = _Pool()
_fixed_threads: int | None = None


def _forget_threads() -> None:
    global _pool  # noqa: PLW0603  # threads do not survive a fork; the child needs new ones
    _pool = _Pool()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)


def num_threads() -> int:
    """Threads a kernel runs on: `torch.get_num_threads()`, or inside `one_pool` what that was outside."""
    return torch.get_num_threads() if _fixed_threads is None else _fixed_threads


def parallel(kernel: Callable[..., None], *arguments: Any) -> None:
    """Run kernel(counter, *arguments) on `num_threads()` threads at once.

    Args:
        kernel: compiled function that draws the numbers of its pieces of work with `lanes.fetch_add(counter, 1)` until
            they exceed what there is to do.
        arguments: whatever else it takes, the same for each thread.
    """
    job = _Job(kernel, (np.zeros(1, dtype=np.int64), *arguments))
    helpers = num_threads() - 1
    if helpers > 0:
        _pool.offer(job, helpers)
    job.run()


@contextmanager
def one_pool() -> Iterator[None]:
    """Keep PyTorch's threads asleep inside the block, and kernels on as many threads as before."""
    global _fixed_threads  # noqa: PLW0603  # mirrors torch's own number of threads, which is global as well
    before, torch_threads = _fixed_threads, torch.get_num_threads()
    _fixed_threads = num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _fixed_threads = before
        torch.set_num_threads(torch_threads)
