"""Estimate the seconds that a GPU executes kernels in a stage, from profiles of some of its iterations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch

from lapgs_plugin.errors import UserInputError

WINDOWS = 5
"""Profiles of a stage."""
WINDOW_ITERATIONS = 100
"""Iterations of a profile: one interval of densification at its default, so that each has one."""
HOST_COPIES = ("Memcpy HtoD", "Memcpy DtoH")
"""Beginnings of the profiler's names of copies between host and device: copy engines make them beside kernels."""

StopProfile = Callable[[], float]
"""End a profile and return the seconds of kernels in it."""


class GpuBusy:
    """Profile iterations in the middle of each fifth of a stage. Call `step` where `due`, outside of the clock.

    None are profiled for 0 iterations.
    """

    def __init__(self, iterations: int = 0, start: Callable[[], StopProfile] | None = None) -> None:
        length = min(WINDOW_ITERATIONS, max(1, iterations // WINDOWS))
        middles = ((2 * part + 1) * iterations // (2 * WINDOWS) for part in range(WINDOWS))
        firsts = [max(0, middle - length // 2) for middle in middles] if iterations >= WINDOWS else []
        self._iterations, self._planned = iterations, len(firsts)
        self._windows = [(first, first + length) for first in firsts]  # still to come
        self._start = start or profile_kernels
        self._stop: StopProfile | None = None
        self._began = 0
        self._samples: list[float] = []  # seconds an iteration

    def due(self, done: int) -> bool:
        """Return whether a profile starts or ends after `done` iterations."""
        return bool(self._windows) and done >= self._windows[0][self._stop is not None]

    def step(self, done: int) -> None:
        """Start or end profiles after `done` iterations. Waits for the GPU."""
        if self._stop is not None and self.due(done):
            self._samples.append(self._stop() / (done - self._began))
            self._stop = None
            self._windows.pop(0)
        while self._windows and done >= self._windows[0][1]:  # passed before a resumed stage began
            self._windows.pop(0)
        if self._stop is None and self.due(done):
            self._stop, self._began = self._start(), done

    def seconds(self) -> float | None:
        """Return the seconds of the whole stage; None unless it was profiled from its beginning to its end."""
        if not self._samples or len(self._samples) < self._planned:
            return None
        return self._iterations * sum(self._samples) / len(self._samples)


def profile_kernels() -> StopProfile:
    """Start a profile of the current CUDA device."""
    torch.cuda.synchronize()
    profile = torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA])
    profile.start()

    def stop() -> float:
        torch.cuda.synchronize()
        profile.stop()
        return kernel_seconds(profile.events() or ())  # type: ignore[no-untyped-call]  # torch's

    return stop


def kernel_seconds(events: Iterable[Any]) -> float:
    """Return the time of kernels, and of copies and fills within the device, from events of PyTorch's profiler."""
    return 1e-6 * math.fsum(
        event.time_range.elapsed_us()
        for event in events
        if event.device_type.name == "CUDA"
        and not getattr(event, "is_user_annotation", False)  # PyTorch 2.4 has none
        and not event.name.startswith(HOST_COPIES)
    )


def require_cuda(device: torch.device | str) -> None:
    """Check that a device has kernels to profile.

    Raises:
        UserInputError: it is a CPU.
    """
    if torch.device(device).type != "cuda":
        raise UserInputError("--gpu-busy: expected a CUDA device, but the CPU trains this run; leave it out")
