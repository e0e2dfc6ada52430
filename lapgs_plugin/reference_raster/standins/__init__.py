"""CPU stand-ins for the CUDA modules that backbones import: same names, same signatures, same outputs.

    with install("fastgs"):
        import train  # an unmodified checkout's

`install` puts them into `sys.modules`, where `import diff_gaussian_rasterization` finds them; importing this package
does not. Where the tensors go is not its business: a checkout's `.cuda()` calls have to be redirected by who runs it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType

from lapgs_plugin.errors import UserInputError

__all__ = ["VARIANTS", "install", "stand_ins"]

VARIANTS = {
    "graphdeco": ("diff_gaussian_rasterization", "graphdeco"),
    "graphdeco-aa": ("diff_gaussian_rasterization", "graphdeco_aa"),
    "graphdeco-accel": ("diff_gaussian_rasterization", "graphdeco_accel"),
    "taming": ("diff_gaussian_rasterization", "taming"),
    "taming-rasterizer": ("diff_gaussian_rasterization", "taming_rasterizer"),
    "fastgs": ("diff_gaussian_rasterization_fastgs", "fastgs"),
}
"""Rasterizers by the names that patches go by: what a checkout imports, and the module here that stands in for it."""

_WITH_SSIM = {"graphdeco-accel", "taming-rasterizer"}


def stand_ins(variant: str) -> dict[str, ModuleType]:
    """The modules that a checkout of `variant` finds under their CUDA names: its rasterizer, simple_knn and fused_ssim.

    Raises:
        UserInputError: there is no such variant.
    """
    if variant not in VARIANTS:
        raise UserInputError(f"stand-in for the rasterizer {variant!r}: expected one of {', '.join(VARIANTS)}")
    name, source = VARIANTS[variant]
    ssim = import_module(f"{__name__}.fused_ssim")
    binding = {"fusedssim": ssim.fusedssim, "fusedssim_backward": ssim.fusedssim_backward}
    found = {
        name: _module(name, vars(import_module(f"{__name__}.{source}")), package=True),
        f"{name}._C": _module(f"{name}._C", binding if variant in _WITH_SSIM else {}),
        "simple_knn": _module("simple_knn", {}, package=True),
        "simple_knn._C": _module("simple_knn._C", vars(import_module(f"{__name__}.simple_knn"))),
        "fused_ssim": _module("fused_ssim", {"fused_ssim": ssim.fused_ssim, "fused_ssim_": ssim.fused_ssim_}),
    }
    for full, module in found.items():
        parent, _, child = full.rpartition(".")
        if parent:
            setattr(found[parent], child, module)
    return found


@contextmanager
def install(variant: str) -> Iterator[dict[str, ModuleType]]:
    """Let imports of the CUDA modules find the stand-ins while inside; afterwards, what was there before.

    Modules that imported them keep them.

    Raises:
        UserInputError: there is no such variant, or a CUDA module of the same name is already imported.
    """
    found = stand_ins(variant)
    taken = sorted(found.keys() & sys.modules.keys())
    if taken:
        raise UserInputError(f"{taken[0]} is already imported; install stand-ins before the checkout's modules")
    sys.modules.update(found)
    try:
        yield found
    finally:
        for name, module in found.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]


def _module(name: str, contents: dict[str, object], package: bool = False) -> ModuleType:
    """A module of that name with the public names of `contents`."""
    module = ModuleType(name, contents.get("__doc__") if isinstance(contents.get("__doc__"), str) else None)  # type: ignore[arg-type]  # checked in the same line
    module.__spec__ = ModuleSpec(name, None, is_package=package)
    if package:
        module.__path__ = []
    public = contents.get("__all__", [key for key in contents if not key.startswith("_")])
    assert isinstance(public, list)
    for key in public:
        setattr(module, key, contents[key])
    return module
