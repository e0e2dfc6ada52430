"""Start Triton kernels with less work for the processor than Triton's own launch."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
import triton

from lapgs_plugin.jit.notice import say_compiling


def _say_if_compiled(*, src: Any, cache_hit: bool, **others: Any) -> None:
    """Tell the user that our kernels are being compiled; loading them from the cache is silent."""
    if not cache_hit and getattr(getattr(src, "fn", None), "__module__", "").startswith("lapgs_plugin."):
        say_compiling("GPU")


try:
    from triton import knobs

    HOOKS: Any = knobs.runtime
    knobs.compilation.listener = knobs.compilation.listener or _say_if_compiled
except ImportError:  # before Triton 3.4
    from triton.compiler import CompiledKernel

    HOOKS = CompiledKernel

FUSED = {"enable_fp_fusion": True}
"""Option of every launch of our kernels: a product and a sum are one instruction.

Triton 3.9 warns where it is not said, and announces that later versions will make two, which takes longer.
"""

# Triton does not promise how a compiled kernel is started. These versions do it in the same way, for NVIDIA's GPUs.
VERSION = tuple(map(int, triton.__version__.split(".")[:2]))
STARTS_DIRECTLY = (3, 0) <= VERSION <= (3, 6) and torch.version.hip is None

Start = Callable[..., None]
_starts: dict[tuple[Any, ...], Start | None] = {}  # None where only Triton can


def launch(kernel: Any, programs: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
    """Start a kernel on the device of its tensors, in that device's current stream.

    Triton looks for the compiled kernel by all that it is compiled for, which takes longer than many kernels run. Here
    the types of the arguments suffice, as long as tensors begin at multiples of 16 bytes and integers fit in 32 bits.
    Triton starts all other kernels itself.

    Args:
        kernel: with parameters that are not `tl.constexpr` first. Integers among them are in `do_not_specialize`, else
            Triton starts it.
        programs: their number in one, two or three dimensions.
        arguments: a tensor, and others on its device, and numbers.
        constants: all others, by name, each always of the same type; and Triton's options. `FUSED` is set.
    """
    device = arguments[0].get_device()  # -1 for a CPU's, where kernels are interpreted
    if (device > 0 or (device == 0 and _are_several())) and device != torch.cuda.current_device():
        with torch.cuda.device(device):
            launch(kernel, programs, *arguments, **constants)
        return
    if STARTS_DIRECTLY and _start_directly(kernel, device, programs, arguments, constants):
        return
    kernel[programs](*arguments, **constants, **FUSED)


def current_stream(device: torch.device) -> int:
    """Return the number of a device's current stream; 0 for a CPU, where kernels are interpreted."""
    if device.type == "cpu":
        return 0
    if not STARTS_DIRECTLY:
        return torch.cuda.current_stream(device).cuda_stream
    number: int = triton.runtime.driver.active.get_current_stream(device.index)  # takes a tenth of the time
    return number


@cache
def _are_several() -> bool:
    """Return whether there are several GPUs, so that the current one may be another one than the first."""
    return torch.cuda.device_count() > 1


def _start_directly(
    kernel: Any, device: int, programs: tuple[int, ...], arguments: tuple[Any, ...], constants: dict[str, Any]
) -> bool:
    """Start a kernel past Triton's own launch; return False, and start nothing, if only Triton can."""
    if not isinstance(kernel, triton.JITFunction) or _heard(HOOKS.launch_enter_hook) or _heard(HOOKS.launch_exit_hook):
        return False
    # Of a tensor only the address is passed on. Otherwise Triton asks for it again, and CUDA whether it is one.
    numbers: list[Any] = []
    kinds: list[Any] = []
    addresses = 0
    for argument in arguments:
        kind = type(argument)
        if kind is float:
            numbers.append(argument)
        elif kind is int:
            if not -(2**31) <= argument < 2**31:
                return False
            numbers.append(argument)
        else:
            kind = argument.dtype
            address = argument.data_ptr()
            addresses |= address
            numbers.append(address)
        kinds.append(kind)
    if addresses % 16 != 0:
        return False
    key = (kernel.fn, device, *kinds, *constants, *constants.values())
    try:  # its hash takes a while
        start = _starts[key]
    except KeyError:
        start = _starts[key] = _compiled(kernel, arguments, constants)
    if start is None:
        return False
    start(programs, numbers)
    return True


def _heard(hook: Any) -> bool:
    """Return whether a launch hook is set, such as a profiler's: a function, or several of them."""
    return bool(getattr(hook, "calls", hook))


def _compiled(kernel: Any, arguments: tuple[Any, ...], constants: dict[str, Any]) -> Start | None:
    """Compile a kernel for the current device, and return a function that starts it; None if Triton has to."""
    parameters = kernel.params[: len(arguments)]
    specialized = [
        isinstance(argument, int) and not parameter.do_not_specialize
        for parameter, argument in zip(parameters, arguments, strict=True)
    ]
    if any(specialized) or any(parameter.is_constexpr for parameter in parameters):
        return None
    compiled = kernel.warmup(*arguments, grid=(1,), **constants, **FUSED)
    run, function, metadata = compiled.run, compiled.function, compiled.packed_metadata
    names = kernel.arg_names[len(arguments) :]
    # Before Triton 3.3 constants are not passed on.
    last = [constants[name] for name in names] if len(compiled.src.signature) == len(kernel.params) else []
    driver = triton.runtime.driver.active
    stream_of, device = driver.get_current_stream, driver.get_current_device()

    def start(programs: tuple[int, ...], numbers: list[Any]) -> None:
        x, y, z = (*programs, 1, 1)[:3]
        run(x, y, z, stream_of(device), function, metadata, None, None, None, *numbers, *last)

    return start


MOST_ROWS = 64
"""Most rows of an image that a program takes."""
ENOUGH_PROGRAMS = 1500
"""Programs of an image below which each takes fewer rows."""


def rows_of_program(height: int, beside: int, least: int) -> int:
    """Return the rows of an image that a program takes, `least` or more; `beside` is the number of programs a row."""
    rows = MOST_ROWS
    while rows > least and beside * blocks(height, rows) < ENOUGH_PROGRAMS:
        rows //= 2
    return rows


def blocks(count: int, block: int) -> int:
    """Return how many blocks hold `count` numbers. It takes a fraction of the time of `triton.cdiv`."""
    return -(-count // block)
