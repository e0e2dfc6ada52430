"""GPU-busy seconds: profiles lie in every fifth of a stage, and their mean counts for all of its iterations."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from torch.autograd import DeviceType
from torch.autograd.profiler_util import Interval

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runs.gpu_busy import GpuBusy, kernel_seconds, profile_kernels, require_cuda


class Gpu:
    """Count the seconds of kernels that were executed, and profile them."""

    def __init__(self) -> None:
        self.busy = self.profiled = 0.0
        self.profiles = 0

    def start(self) -> Callable[[], float]:
        began = self.busy
        self.profiles += 1

        def stop() -> float:
            self.profiled += self.busy - began
            return self.busy - began

        return stop


def run(iterations: int, cost: Callable[[int], float], views: int = 1, first: int = 0) -> tuple[Gpu, float | None]:
    gpu, done = Gpu(), first
    busy = GpuBusy(iterations, gpu.start)
    while done < iterations:
        if busy.due(done):
            busy.step(done)
        taken = min(views, iterations - done)
        gpu.busy += sum(cost(done + view) for view in range(taken))
        done += taken
    if busy.due(done):
        busy.step(done)
    return gpu, busy.seconds()


@pytest.mark.parametrize(("iterations", "views"), [(5, 1), (12, 1), (499, 8), (500, 1), (10_000, 1), (10_000, 8)])
def test_growing_cost(iterations: int, views: int) -> None:
    """A cost that grows evenly is found from the middles of the fifths."""
    gpu, seconds = run(iterations, lambda iteration: 1.0 + iteration / iterations, views)
    assert seconds is not None
    assert seconds == pytest.approx(gpu.busy, rel=0.15 if iterations < 20 else 0.02)  # seen: 0.09, 0.008
    assert gpu.profiled <= gpu.busy
    assert gpu.profiles == 5


def test_rare_work_counts() -> None:
    """What every hundredth iteration does is in each profile once."""
    gpu, seconds = run(15_000, lambda iteration: 50.0 if iteration % 100 == 0 else 1.0)
    assert seconds == pytest.approx(gpu.busy)
    assert gpu.profiled == pytest.approx(gpu.busy / 30)


def test_no_figure() -> None:
    """A stage that was resumed, or is too short, or is not measured has none."""
    assert run(10_000, lambda _: 1.0, first=2_000)[1] is None
    assert run(4, lambda _: 1.0)[1] is None
    assert GpuBusy().seconds() is None
    assert not GpuBusy().due(0)


def test_which_events_count() -> None:
    def event(name: str, device: DeviceType, microseconds: float, annotation: bool = False) -> SimpleNamespace:
        interval = Interval(10, 10 + microseconds)
        return SimpleNamespace(name=name, device_type=device, time_range=interval, is_user_annotation=annotation)

    events = [
        event("adam_kernel", DeviceType.CUDA, 1000),
        event("Memset (Device)", DeviceType.CUDA, 20),
        event("Memcpy DtoD (Device -> Device)", DeviceType.CUDA, 3),
        event("Memcpy HtoD (Pinned -> Device)", DeviceType.CUDA, 5000),
        event("Memcpy DtoH (Device -> Pinned)", DeviceType.CUDA, 5000),
        event("Optimizer.step", DeviceType.CUDA, 5000, annotation=True),
        event("cudaLaunchKernel", DeviceType.CPU, 5000),
    ]
    assert kernel_seconds(events) == pytest.approx(1.023e-3)


def test_a_cpu_is_refused() -> None:
    with pytest.raises(UserInputError, match="--gpu-busy: expected a CUDA device"):
        require_cuda("cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="profiles kernels")
def test_on_a_gpu() -> None:
    stop = profile_kernels()
    torch.ones(1000, 1000, device="cuda").sum().item()
    assert 0 < stop() < 0.1
