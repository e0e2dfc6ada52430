"""An unmodified checkout on a machine without CUDA: inside of `cuda_on_cpu`, its "cuda" is the CPU.

    with cuda_on_cpu("fastgs"):
        runpy.run_path("train.py", run_name="__main__")

Two things differ from a GPU that a checkout could notice: `Tensor.cuda()` and `.cpu()` give the tensor itself, no copy
(as they do on a GPU for a tensor that is there already), and tensors say that they are on "cpu".
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from functools import wraps
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from lapgs_plugin.checkouts.absent_modules import absent_modules
from lapgs_plugin.reference_raster.standins import install

__all__ = ["cuda_on_cpu"]


@contextmanager
def cuda_on_cpu(variant: str) -> Iterator[None]:
    """Let a checkout run without CUDA while inside; afterwards, everything that was replaced is what it was.

    Holds for the whole process, but devices named in torch functions are redirected in this thread only.

    Args:
        variant: the rasterizer that the checkout wants, a key of `standins.VARIANTS`.

    Raises:
        UserInputError: there is no such variant, or a CUDA module of the same name is already imported.
        MissingExtraError: from inside, when the checkout calls into a package that is not installed; that it imports
            the package is no error.
    """
    import_module("torch._dynamo")  # keeps tables of torch.cuda's functions; optimizers import it
    with ExitStack() as stack:
        stack.enter_context(install(variant))
        stack.enter_context(_replaced(sys.modules, absent_modules()))
        stack.enter_context(_replaced(vars(torch.cuda), _WITHOUT_CUDA))
        stack.enter_context(_replaced(vars(torch), {"load": _loading_to_cpu(torch.load)}))
        mode = _CudaMeansCpu()
        stack.enter_context(_replaced(vars(torch.autograd), _engine_within(mode)))
        stack.enter_context(mode)
        yield


class _CudaMeansCpu(TorchFunctionMode):
    """Torch functions see the CPU where "cuda" was said. About a microsecond a call."""

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
    """The CPU for a device that is a CUDA one, as `torch.device`, name or number; anything else as it is."""
    if isinstance(device, torch.device):
        return _CPU if device.type == "cuda" else device
    is_cuda = device.startswith("cuda") if isinstance(device, str) else type(device) is int
    return _CPU if is_cuda else device


def _engine_within(mode: _CudaMeansCpu) -> dict[str, Callable[..., Any]]:
    """torch's way into its autograd engine, with the mode.

    torch leaves a mode for as long as `backward` or `grad` runs, but hooks and the backward passes of a checkout's own
    functions name devices too.
    """
    run_backward = torch.autograd.graph._engine_run_backward

    @wraps(run_backward)
    def running(*args: Any, **kwargs: Any) -> Any:
        with mode:
            return run_backward(*args, **kwargs)

    return {"_engine_run_backward": running}


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
    """`torch.load`, for checkpoints that were written on a GPU too."""

    @wraps(load)
    def loading(file: Any, map_location: Any = None, *args: Any, **kwargs: Any) -> Any:
        return load(file, _CPU if map_location is None else _redirected(map_location), *args, **kwargs)

    return loading


class _Event:
    """`torch.cuda.Event`: on the CPU all work before an event is done when it is recorded."""

    def __init__(self, enable_timing: bool = False, blocking: bool = False, interprocess: bool = False) -> None:
        self._recorded: float | None = None

    def record(self, stream: object = None) -> None:
        self._recorded = time.perf_counter()

    def elapsed_time(self, end_event: _Event) -> float:
        """Milliseconds from this event to the other."""
        if self._recorded is None or end_event._recorded is None:
            raise RuntimeError("elapsed_time: both events must be recorded first")  # as torch
        return (end_event._recorded - self._recorded) * 1e3

    def query(self) -> bool:
        return True

    def synchronize(self) -> None:
        """Nothing to wait for."""

    def wait(self, stream: object = None) -> None:
        """Nothing to wait for."""


class _Stream:
    """`torch.cuda.Stream`, also as a context: there is one order of work on the CPU."""

    def __init__(self, device: object = None, priority: int = 0) -> None:
        """Arguments as of the CUDA class."""

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        """Back to the one order."""

    def record_event(self, event: _Event | None = None) -> _Event:
        event = _Event() if event is None else event
        event.record()
        return event

    def query(self) -> bool:
        return True

    def synchronize(self) -> None:
        """Nothing to wait for."""

    def wait_event(self, event: object) -> None:
        """Nothing to wait for."""

    def wait_stream(self, stream: object) -> None:
        """Nothing to wait for."""


def _returns(value: object) -> Callable[..., Any]:
    """A function of anything that gives `value`; one for each name, as torch tells functions apart by identity."""
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
    "is_available": _returns(False),  # LPIPS asks, to know where its weights go
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
"""Names in `torch.cuda`; on a machine that has CUDA, it is not used either."""

_NOT_THERE = object()


@contextmanager
def _replaced(namespace: dict[str, Any], values: Mapping[str, object]) -> Iterator[None]:
    """Other values under some names while inside; afterwards the former ones, or none."""
    former = {name: namespace.get(name, _NOT_THERE) for name in values}
    namespace.update(values)
    try:
        yield
    finally:
        for name, value in former.items():
            if value is _NOT_THERE:
                namespace.pop(name, None)
            else:
                namespace[name] = value
