"""Stand-ins for the CUDA modules that backbones import, on a CPU and a GPU: same names, signatures and outputs.

    with install("fastgs"):
        import train  # an unmodified checkout's

`install` puts them into `sys.modules`, where `import diff_gaussian_rasterization` finds them; importing this package
does not. Where there is no GPU, a checkout's `.cuda()` calls have to be redirected by the caller.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family import fused_ssim
from lapgs_plugin.family.neighbours import distances_and_neighbours
from lapgs_plugin.family.variants import BACKBONES, FORKS, VARIANTS, Variant, rasterizer_module
from lapgs_plugin.hierarchy.inheritance import mean_squared_distance

__all__ = ["BACKBONES", "FORKS", "VARIANTS", "install", "stand_ins", "unavailable"]


def stand_ins(variant: str, *, neighbours: bool = False) -> dict[str, ModuleType]:
    """Return the modules of a checkout of `variant` by their CUDA names: its rasterizer, simple_knn and fused_ssim.

    Args:
        variant: a key of `VARIANTS`.
        neighbours: whether simple_knn is the one that returns neighbours beside their distances.

    Raises:
        UserInputError: there is no such variant.
    """
    names = variant, *_known(variant).beside
    ssim = {"fusedssim": fused_ssim.fusedssim, "fusedssim_backward": fused_ssim.fusedssim_backward}
    knn = distances_and_neighbours if neighbours else mean_squared_distance
    modules = {}
    for member in names:
        name = VARIANTS[member].module
        for parent in _parents(name):
            modules[parent] = _module(parent, {}, package=True)
        modules[name] = _module(name, rasterizer_module(member), package=True)
        modules[f"{name}._C"] = _module(f"{name}._C", ssim if VARIANTS[member].fused_ssim else {})
    modules |= {
        "simple_knn": _module("simple_knn", {}, package=True),
        # With fewer than four points the mean is over those that exist, where the CUDA code returns infinity.
        "simple_knn._C": _module("simple_knn._C", {"distCUDA2": knn}),
        "fused_ssim": _module("fused_ssim", {name: vars(fused_ssim)[name] for name in ("fused_ssim", "fused_ssim_")}),
    }
    for full, module in modules.items():
        parent, _, child = full.rpartition(".")
        if parent:
            setattr(modules[parent], child, module)
    return modules


def unavailable(variant: str) -> str:
    """Return what our version of a variant's rasterizer cannot do, in words; empty if it does all.

    Raises:
        UserInputError: there is no such variant.
    """
    return _known(variant).unavailable


def _known(variant: str) -> Variant:
    if variant not in VARIANTS:
        raise UserInputError(f"stand-in for the rasterizer {variant!r}: expected one of {', '.join(VARIANTS)}")
    return VARIANTS[variant]


def _parents(name: str) -> list[str]:
    """Return the packages that a module is in, outermost first."""
    parts = name.split(".")
    return [".".join(parts[:i]) for i in range(1, len(parts))]


@contextmanager
def install(variant: str, *, neighbours: bool = False) -> Iterator[dict[str, ModuleType]]:
    """Let imports of the CUDA modules find the stand-ins inside the block.

    Modules that imported them keep them. Arguments are those of `stand_ins`.

    Raises:
        UserInputError: there is no such variant, or a CUDA module of the same name is already imported.
    """
    modules = stand_ins(variant, neighbours=neighbours)
    taken = sorted(modules.keys() & sys.modules.keys())
    if taken:
        raise UserInputError(f"{taken[0]} is already imported; install stand-ins before the checkout's modules")
    sys.modules.update(modules)
    try:
        yield modules
    finally:
        for name, module in modules.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]


def _module(name: str, contents: Mapping[str, Any], package: bool = False) -> ModuleType:
    """Make a module of that name with these attributes."""
    module = ModuleType(name)
    module.__spec__ = ModuleSpec(name, None, is_package=package)
    if package:
        module.__path__ = []
    vars(module).update(contents)
    return module
