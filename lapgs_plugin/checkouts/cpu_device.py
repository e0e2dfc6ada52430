"""Run an unmodified checkout on a machine without CUDA: "cuda" means the CPU inside `cuda_on_cpu`.

    with cuda_on_cpu(variant):
        runpy.run_path("train.py", run_name="__main__")

A checkout can notice two differences from a GPU: `Tensor.cuda()` and `.cpu()` return the tensor itself, not a copy, and
tensors say that they are on "cpu".
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import wraps
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from lapgs_plugin.checkouts.absent_modules import absent_modules
from lapgs_plugin.checkouts.attachment import replaced
from lapgs_plugin.family import VARIANTS, install

__all__ = ["cuda_on_cpu"]


@contextmanager
def cuda_on_cpu(variant: str | None, *, neighbours: bool = False) -> Iterator[None]:
    """Let a checkout run without CUDA inside a `with` block, and restore everything at its end.

    Symbols are replaced in the whole process; devices in calls of torch functions are redirected in this thread and in
    those that are started inside.

    Args:
        variant: stand-in for the checkout's rasterizer, a key of `family.VARIANTS`; None for a script without one.
        neighbours: as of `family.install`.

    Raises:
        UserInputError: there is no such variant, or a CUDA module of the same name is already imported.
        MissingExtraError: inside, when the checkout calls a package that is not installed.
    """
    import_module("torch._dynamo")  # it has tables of torch.cuda's functions, and optimizers import it later
    with ExitStack() as stack:
        if variant is not None:
            stack.enter_context(install(variant, neighbours=neighbours))
        needs_logs = variant is not None and VARIANTS[variant].needs_logs
        stack.enter_context(replaced(sys.modules, absent_modules(needs_logs)))
        stack.enter_context(replaced(vars(torch.cuda), _WITHOUT_CUDA))
        on_cpu = {"load": _loading_to_cpu(torch.load), "Generator": _Generator}
        stack.enter_context(replaced(vars(torch), on_cpu))
        mode = _CudaMeansCpu()
        stack.enter_context(replaced(vars(torch.autograd), _engine_within(mode)))
        stack.enter_context(_threads_within(mode))
        stack.enter_context(mode)
        yield


class _CudaMeansCpu(TorchFunctionMode):
    """Redirect CUDA devices in the arguments of torch functions to the CPU."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: object,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        instead = _INSTEAD.get(func)
        if instead is not None:
            return instead(*args, **(kwargs or {}))
        if not kwargs:
            return func(*args)
        if "device" in kwargs:
            kwargs = {**kwargs, "device": _redirected(kwargs["device"])}
        return func(*args, **kwargs)


def _redirected(device: Any) -> Any:
    """Return the CPU for a CUDA device (`torch.device`, name or number), and any other value unchanged."""
    if isinstance(device, torch.device):
        return _CPU if device.type == "cuda" else device
    is_cuda = device.startswith("cuda") if isinstance(device, str) else type(device) is int
    return _CPU if is_cuda else device


def _engine_within(mode: _CudaMeansCpu) -> dict[str, Callable[..., Any]]:
    """Return a replacement of torch's entry to its autograd engine that keeps the mode.

    torch disables modes during `backward` and `grad`, but hooks and backward passes of a checkout's functions name
    devices, too.
    """
    run_backward = torch.autograd.graph._engine_run_backward

    @wraps(run_backward)
    def running(*args: Any, **kwargs: Any) -> Any:
        with mode:
            return run_backward(*args, **kwargs)

    return {"_engine_run_backward": running}


@contextmanager
def _threads_within(mode: _CudaMeansCpu) -> Iterator[None]:
    """Let threads that are started inside run with the mode, which torch keeps for each thread."""
    run = threading.Thread.run

    @wraps(run)
    def running(thread: threading.Thread) -> None:
        with mode:
            run(thread)

    threading.Thread.run = running  # type: ignore[method-assign,assignment]
    try:
        yield
    finally:
        threading.Thread.run = run  # type: ignore[method-assign]


def _cuda(tensor: Tensor, device: object = None, non_blocking: bool = False, **layout: Any) -> Tensor:
    return tensor.cpu(**layout)


def _to(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    if args:
        args = (_redirected(args[0]), *args[1:])
    if "device" in kwargs:
        kwargs["device"] = _redirected(kwargs["device"])
    return tensor.to(*args, **kwargs)


def _itself(tensor: Tensor, *_: object) -> Tensor:
    return tensor


def _loading_to_cpu(load: Callable[..., Any]) -> Callable[..., Any]:
    """Return a replacement of `torch.load` that also reads checkpoints written on a GPU."""

    @wraps(load)
    def loading(file: Any, map_location: Any = None, *args: Any, **kwargs: Any) -> Any:
        return load(file, _CPU if map_location is None else _redirected(map_location), *args, **kwargs)

    return loading


class _Generator(torch.Generator):
    """Stand in for `torch.Generator`, a class, which `_CudaMeansCpu` does not see."""

    def __new__(cls, device: Any = "cpu") -> _Generator:
        return super().__new__(cls, _redirected(device))  # type: ignore[call-arg]  # as the class takes it


class _Event:
    """Stand in for `torch.cuda.Event`: on the CPU all work before an event is done when it is recorded."""

    def __init__(self, enable_timing: bool = False, blocking: bool = False, interprocess: bool = False) -> None:
        self._recorded: float | None = None

    def record(self, stream: object = None) -> None:
        self._recorded = time.perf_counter()

    def elapsed_time(self, end_event: _Event) -> float:
        """Return the milliseconds from this event to the other."""
        if self._recorded is None or end_event._recorded is None:
            raise RuntimeError("elapsed_time: both events must be recorded first")  # as torch
        return (end_event._recorded - self._recorded) * 1e3

    def query(self) -> bool:
        return True

    def wait(self, stream: object = None) -> None:
        """Do nothing."""

    synchronize = wait


class _Stream:
    """Stand in for `torch.cuda.Stream`, also as a context manager: work on the CPU is done in order."""

    def __init__(self, device: object = None, priority: int = 0) -> None:
        """Take the arguments of the CUDA class."""

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def record_event(self, event: _Event | None = None) -> _Event:
        event = _Event() if event is None else event
        event.record()
        return event

    def query(self) -> bool:
        return True

    def synchronize(self) -> None:
        """Do nothing."""

    def wait_event(self, event: object) -> None:
        """Do nothing."""

    wait_stream = wait_event


def _returns(value: object) -> Callable[..., Any]:
    """Return a new function of any arguments that returns `value`; torch tells functions apart by identity."""
    return lambda *_, **__: value


_CPU = torch.device("cpu")

_INSTEAD: dict[Callable[..., Any], Callable[..., Any]] = {
    Tensor.cuda: _cuda,
    Tensor.to: _to,
    Tensor.pin_memory: _itself,
}

_WITHOUT_CUDA: dict[str, object] = {
    "Event": _Event,
    "Stream": _Stream,
    "current_device": _returns(0),
    "current_stream": lambda device=None: _Stream(device),
    "default_stream": lambda device=None: _Stream(device),
    "device": nullcontext,
    "device_count": _returns(0),
    "empty_cache": _returns(None),
    "is_available": _returns(False),  # LPIPS chooses the device of its weights by it
    "ipc_collect": _returns(None),
    "manual_seed": _returns(None),
    "manual_seed_all": _returns(None),
    "max_memory_allocated": _returns(0),
    "max_memory_reserved": _returns(0),
    "memory_allocated": _returns(0),
    "memory_reserved": _returns(0),
    "reset_peak_memory_stats": _returns(None),
    "set_device": _returns(None),
    "stream": nullcontext,
    "synchronize": _returns(None),
}
"""Replacements of names in `torch.cuda`, also on a machine with CUDA."""
