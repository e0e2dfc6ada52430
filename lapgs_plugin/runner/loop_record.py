"""Measure the optimization in a checkout's training loop: seconds, Gaussians and GPU memory."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from lapgs_plugin.runs.gpu_busy import GpuBusy
from lapgs_plugin.runs.profiling import Overhead, PeakMemory


class LoopRecord:
    """Measure a loop from its first iteration to its end, without what is beside optimization.

    Args:
        device: device that the checkout renders on.
        profiled: number of iterations of which some are profiled; 0 profiles none.

    Attributes:
        overhead: seconds beside optimization, by purpose.
        iteration: running iteration, from 1; 0 before the first.
        first, peak: Gaussians at the start of the first iteration, and most at that of any.
        seconds: of optimization, once the loop has ended.
        memory_bytes: see `PeakMemory.note`.
    """

    def __init__(self, device: torch.device, profiled: int = 0) -> None:
        self._device, self._busy = device, GpuBusy(profiled)
        self.overhead = Overhead(settle=self._synchronize)
        self.iteration = self.first = self.peak = 0
        self.seconds = 0.0
        self.memory_bytes: dict[str, int] = {}
        self._gaussian_steps = 0  # Gaussians, summed over the iterations
        self._began: float | None = None
        self._excluded = 0.0  # seconds since `_began` that are not optimization
        self._memory: PeakMemory  # set by `start`

    def start(self) -> None:
        """Start measuring GPU memory."""
        self._memory = PeakMemory(self._device)

    def start_clock(self) -> None:
        """Start the clock of optimization, unless it runs already."""
        if self._began is None:
            self._synchronize()
            self._began = time.perf_counter()

    def count(self, iteration: int, gaussians: int) -> None:
        """Note the number of Gaussians of an iteration that is about to begin."""
        self._profile(iteration - 1)
        self.first = self.first or gaussians
        self.iteration = iteration
        self.peak = max(self.peak, gaussians)
        self._gaussian_steps += gaussians

    @contextmanager
    def outside(self, purpose: str) -> Iterator[None]:
        """Stop the clock of optimization inside, and count the time as overhead."""
        self._synchronize()
        start = time.perf_counter()
        with self.overhead.timed(purpose):
            yield
        self._excluded += time.perf_counter() - start

    def note_memory(self, image_bytes: int) -> None:
        """Note the GPU memory in use and the bytes of images in it."""
        self.memory_bytes = self._memory.note(image_bytes)

    def elapsed(self) -> float:
        """Return the seconds of optimization so far."""
        assert self._began is not None, "training() without an iteration"
        return time.perf_counter() - self._began - self._excluded

    def stop(self, image_bytes: int) -> None:
        """Stop the clock of optimization and measure the memory."""
        self._profile(self.iteration)
        self._synchronize()
        self.seconds = self.elapsed()
        self.note_memory(image_bytes)

    @property
    def mean_gaussians(self) -> float:
        """Mean number of Gaussians over the iterations."""
        return self._gaussian_steps / self.iteration

    @property
    def gpu_busy_seconds(self) -> float | None:
        """Estimated seconds in which the GPU executed kernels; None if nothing was profiled."""
        return self._busy.seconds()

    def _profile(self, done: int) -> None:
        """Start or end a profile if it is due after so many iterations."""
        if self._busy.due(done):
            with self.outside("profile"):
                self._busy.step(done)

    def _synchronize(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize()
