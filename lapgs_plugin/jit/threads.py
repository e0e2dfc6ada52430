"""Run kernels on a thread pool of our own, beside PyTorch's.

`parallel(kernel, ...)` runs one kernel on several threads at once. Each thread takes tasks from a shared counter until
none is left, so that the result does not depend on the number of threads. The calling thread works too and waits only
for threads that have started. If the pool is busy with another caller's kernel or gone after a fork, the kernel is
slower and its result the same. Any number of Python threads may render at the same time.

PyTorch's OpenMP threads slow kernels down: on Linux, GNU OpenMP lets them spin for about ten milliseconds after each
parallel operation, on the cores that the next kernel needs. There are two remedies:

- before torch is imported, set OMP_WAIT_POLICY=PASSIVE in the environment, as the command line of this package does;
- later, put `with one_pool():` around the training loop. PyTorch's operations then run on the calling thread alone, and
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
    """Run one kernel call that several threads join."""

    def __init__(self, kernel: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        self._kernel = kernel
        self._arguments = arguments
        self._state = threading.Condition()
        self._closed = False
        self._joined = 0
        self._error: BaseException | None = None

    def join_in(self) -> None:
        """Work on the job unless it is finished."""
        with self._state:
            if self._closed:
                return
            self._joined += 1
        try:
            self._kernel(*self._arguments)
        except BaseException as error:  # raised by the thread that waits in `run`
            self._error = error
        with self._state:
            self._joined -= 1
            self._state.notify()

    def run(self) -> None:
        """Work on the job and return when every thread has finished."""
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
    """Keep daemon threads that wait for jobs without spinning."""

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
    """Return the number of threads of a kernel: `torch.get_num_threads()`, inside `one_pool` its value outside."""
    return torch.get_num_threads() if _fixed_threads is None else _fixed_threads


def parallel(kernel: Callable[..., None], *arguments: Any) -> None:
    """Run kernel(counter, *arguments) on `num_threads()` threads at once.

    Args:
        kernel: compiled function that takes the numbers of its tasks from `lanes.fetch_add(counter, 1)` until they
            exceed the number of tasks.
        arguments: its other arguments, the same for each thread.
    """
    job = _Job(kernel, (np.zeros(1, dtype=np.int64), *arguments))
    helpers = num_threads() - 1
    if helpers > 0:
        _pool.offer(job, helpers)
    job.run()


@contextmanager
def one_pool() -> Iterator[None]:
    """Run PyTorch's operations on one thread inside the block, and kernels on as many threads as before."""
    global _fixed_threads  # noqa: PLW0603  # mirrors torch's own number of threads, which is global as well
    before, torch_threads = _fixed_threads, torch.get_num_threads()
    _fixed_threads = num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _fixed_threads = before
        torch.set_num_threads(torch_threads)
