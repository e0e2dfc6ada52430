"""Load and store three or four numbers of each thread."""

from __future__ import annotations

import os

import torch
import triton
import triton.language as tl

ON_AMD = torch.version.hip is not None
"""Whether this PyTorch is built for AMD's GPUs."""
PLAIN = tl.constexpr(ON_AMD or os.environ.get("TRITON_INTERPRET") == "1")
"""Do without NVIDIA's assembly, which neither Triton's interpreter nor AMD's GPUs know."""


def at_most(registers: int) -> dict[str, int]:
    """Return the option of a launch that limits a thread's registers; AMD's compiler knows none."""
    return {} if ON_AMD else {"maxnreg": registers}


@triton.jit
def load_four(start: tl.tensor) -> tl.tensor:
    """Load four numbers that begin at a multiple of 16 bytes; on NVIDIA's, in one instruction."""
    if PLAIN:
        return tl.load(start), tl.load(start + 1), tl.load(start + 2), tl.load(start + 3)
    return tl.inline_asm_elementwise(
        "ld.global.nc.v4.f32 {$0, $1, $2, $3}, [$4];", "=f,=f,=f,=f,l", [start],
        (tl.float32, tl.float32, tl.float32, tl.float32), True, 1,
    )  # fmt: skip


@triton.jit
def store_four(start: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, d: tl.tensor, wanted: tl.tensor) -> None:
    """Store four numbers from a multiple of 16 bytes on where wanted; on NVIDIA's, in one instruction."""
    if PLAIN:
        tl.store(start, a, wanted)
        tl.store(start + 1, b, wanted)
        tl.store(start + 2, c, wanted)
        tl.store(start + 3, d, wanted)
    else:
        tl.inline_asm_elementwise(
            "{ .reg .pred p; setp.ne.b32 p, $6, 0; @p st.global.v4.f32 [$1], {$2, $3, $4, $5}; mov.b32 $0, 0; }",
            "=r,l,f,f,f,f,r", [start.to(tl.int64), a, b, c, d, wanted.to(tl.int32)], tl.int32, False, 1,
        )  # fmt: skip


@triton.jit
def load_three(start: tl.tensor) -> tl.tensor:
    return tl.load(start), tl.load(start + 1), tl.load(start + 2)


@triton.jit
def store_three(start: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, wanted: tl.tensor) -> None:
    tl.store(start, a, wanted)
    tl.store(start + 1, b, wanted)
    tl.store(start + 2, c, wanted)
