"""What Triton's driver is told by our launches and by Triton's own: compiled for a GPU, started on none."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHECKS = """
from contextlib import contextmanager
from types import SimpleNamespace

import torch
import triton
from triton import language as tl
from triton.backends.compiler import GPUTarget
from triton.runtime import driver

from lapgs_plugin.ops import launch as module
from lapgs_plugin.ops.launch import launch

started, hooks, current = [], [], [1]

class Launcher:
    def __init__(self, source, metadata):
        self.kernel = metadata.name, metadata.num_warps, str(source.signature), str(source.constants)

    def __call__(self, x, y, z, stream, function, metadata, launch_metadata, enter, leave, *arguments):
        hooks.append(enter)
        addresses = [each.data_ptr() if isinstance(each, torch.Tensor) else each for each in arguments]
        started.append((self.kernel, (x, y, z), stream, function, metadata, addresses))

class Utils:
    def load_binary(self, name, binary, shared, device):
        loaded = object(), binary, 32, 0, 1024
        return loaded if module.VERSION >= (3, 4) else loaded[:4]

    def get_device_properties(self, device):
        return {"max_shared_mem": 100_000}

driver.set_active(SimpleNamespace(
    launcher_cls=Launcher, utils=Utils(), get_current_target=lambda: GPUTarget("cuda", 80, 32),
    get_current_device=lambda: current[0], get_current_stream=lambda device: 70 + device,
    get_device_interface=lambda: None,
))
own, launches = triton.JITFunction.run, []

def triton_runs(kernel, *args, **options):
    launches.append(options["warmup"])
    return own(kernel, *args, **options)

triton.JITFunction.run = triton_runs

@triton.jit(do_not_specialize=("n", "factor"))
def scale(values, result, n, factor, block: tl.constexpr, adds: tl.constexpr):
    places = tl.program_id(0) * block + tl.arange(0, block)
    tl.store(result + places, tl.load(values + places, places < n) * factor + adds, places < n)

@triton.jit
def specialized(values, n, block: tl.constexpr):
    tl.store(values + n * tl.arange(0, block), 0.0)

def check(kernel, programs, *arguments, direct, **constants):
    kernel[programs](*arguments, **constants, enable_fp_fusion=True)
    expected = started.pop()
    for _ in range(2):
        launches.clear()
        launch(kernel, programs, *arguments, **constants)
        assert started.pop() == expected, (programs, arguments, constants)
        assert not started
    assert launches == ([] if direct else [False]), (launches, programs, constants)  # the second time

values, result = torch.zeros(64), torch.zeros(64)
for _ in range(2):
    check(scale, (3,), values, result, 50, 0.5, block=32, adds=1, direct=True)
    check(scale, (3, 2), values, result, 1, 2.5, block=32, adds=1, direct=True)
    check(scale, (3, 2, 4), values, result, 16, 2.5, block=64, adds=1, direct=True)
    check(scale, (3,), values, result, 16, 2.5, block=64, adds=2, direct=True)
    check(scale, (3,), values, result, 16, 2.5, block=64, adds=2, num_warps=2, direct=True)
    check(scale, (3,), values.half(), result, 16, 2.5, block=64, adds=2, direct=True)
    check(scale, (3,), values, result, 16, 2, block=64, adds=2, direct=True)
    check(scale, (3,), values[1:], result, 16, 2.5, block=64, adds=2, direct=False)
    check(scale, (3,), values, result, 2**40, 2.5, block=64, adds=2, direct=False)
    check(specialized, (3,), values, 16, block=32, direct=False)
    check(specialized, (3,), values, 17, block=32, direct=False)

from lapgs_plugin.ops.regularization.in_triton import add_regularization_triton

for _ in range(2):
    add_regularization_triton(*(torch.zeros(5, *columns) for columns in ((), (3,), (), (3,))), 0.1, 0.2)

class OnSecond(torch.Tensor):
    def get_device(self):
        return 1

@contextmanager
def second(device):
    current[0] = device
    yield
    current[0] = 0

torch.cuda.current_device, torch.cuda.device = lambda: current[0], second
for at in (0, 1):
    current[0] = at
    launch(scale, (3,), values.as_subclass(OnSecond), result, 50, 0.5, block=32, adds=1)
    assert current[0] == at
    assert started.pop()[2] == 71

def heard(*args):
    pass

assert not any(getattr(hook, "calls", hook) for hook in hooks)
hooks.clear()
old = module.HOOKS.launch_enter_hook
if hasattr(old, "add"):
    old.add(heard)
else:
    module.HOOKS.launch_enter_hook = heard
launch(scale, (3,), values, result, 50, 0.5, block=32, adds=1)
assert hooks[0] is heard or hooks[0].calls == [heard]
"""


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_a_kernel_is_started_as_triton_starts_it(tmp_path: Path) -> None:
    script, notice = tmp_path / "checks.py", "compiling GPU kernels"  # Triton reads the source of kernels
    script.write_text(CHECKS)
    environment = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path / "cache")}
    for compiles in (True, False):
        done = subprocess.run([sys.executable, script], check=False, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        says = importlib.util.find_spec("triton.knobs") is not None  # Triton 3.4 and later tell of compilations
        assert done.stderr.count(notice) == (1 if compiles and says else 0), done.stderr
