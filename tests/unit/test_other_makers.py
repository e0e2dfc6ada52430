"""Kernels with NVIDIA's assembly compile for an AMD GPU by their plain path; none is started."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHECKS = """
import torch

torch.version.hip = "6.4"  # as a PyTorch for ROCm says
import triton
from triton.backends.amd.compiler import HIPBackend
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from lapgs_plugin.gpu_raster import blend_kernels
from lapgs_plugin.gpu_raster.records import RECORD

TARGET = GPUTarget("hip", "gfx942", 64)
TYPES = {torch.float32: "*fp32", torch.int32: "*i32", int: "i32", float: "fp32"}
add_stages, compiled = HIPBackend.add_stages, []


def up_to_assembly(self, stages, *others, **options):
    add_stages(self, stages, *others, **options)
    stages["hsaco"] = lambda source, metadata: b""  # linking takes a program of ROCm


def compile_for_amd(kernel, programs, *arguments, **constants):
    options = {"num_warps": constants.pop("num_warps")}
    names = kernel.arg_names
    types = [TYPES[each.dtype if isinstance(each, torch.Tensor) else type(each)] for each in arguments]
    signature = {**dict(zip(names, types)), **dict.fromkeys(constants, "constexpr")}
    assert set(signature) == set(names), "an option that AMD's compiler does not know"
    source = ASTSource(
        kernel, {name: signature[name] for name in names},
        constexprs={(names.index(name),): value for name, value in constants.items()},
        attrs={(i,): [["tt.divisibility", 16]] for i, name in enumerate(names) if signature[name][0] == "*"},
    )
    assembly = triton.compile(source, target=TARGET, options=options).asm["amdgcn"]
    assert "s_endpgm" in assembly
    compiled.append(kernel.__name__)


HIPBackend.add_stages = up_to_assembly
blend_kernels.launch = compile_for_amd
records, size = torch.zeros(1, 5, RECORD), (64, 48)
offsets, flat = torch.zeros(13, dtype=torch.int32), torch.zeros(64, dtype=torch.int32)
images, counts, words = blend_kernels.blend_forward(records, torch.zeros(3), offsets, flat, size, 1)
blend_kernels.blend_backward(records, offsets, flat, images, counts, words, torch.zeros_like(images), True)
assert compiled == ["reach_kernel", "_forward_kernel", "_backward_kernel"], compiled
"""


def test_blending_and_its_gradients_compile_for_amd(tmp_path: Path) -> None:
    if importlib.util.find_spec("triton") is None or importlib.util.find_spec("triton.backends.amd") is None:
        pytest.skip("needs Triton, with its compiler for AMD's GPUs")
    environment = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path)}
    environment.pop("TRITON_INTERPRET", None)
    script = tmp_path / "checks.py"
    script.write_text(CHECKS)
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
