"""Sort Gaussians into tiles by gsplat's compiled functions, where they are built already."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.environment import gsplat_built, installed_version
from lapgs_plugin.environment.probes import extensions_folder
from lapgs_plugin.gpu_raster.records import TILE, grid_of

KNOWN_RELEASES = "1.5."
"""Releases of gsplat whose compiled functions have the signatures that are used here."""


def sort_by_gsplat(
    compiled: Any, radii: Tensor, means2d: Tensor, depths: Tensor, images: Tensor | None, count: int,
    size: tuple[int, int],
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Sort Gaussians into tiles, front to back. This waits for the GPU, for the number of pairs with tiles.

    Args:
        compiled: gsplat's module.
        radii, means2d, depths, images, count, size: as `tiles.blend_in_tiles` takes them.

    Returns:
        Offsets (tiles of all images,) and Gaussians of pairs as `blend_forward` takes them.
    """
    across, down = grid_of(size)
    with torch.cuda.device(radii.device):  # gsplat's functions launch on the current one
        # gsplat also takes the index of each Gaussian, but does not use it.
        _, pairs, flat = compiled.intersect_tile(
            means2d, radii, depths, images, images, count, TILE, across, down, True, False
        )
        return compiled.intersect_offset(pairs, count, across, down).view(-1), flat


def is_compiled() -> bool:
    """Return whether gsplat's CUDA part is built already, by its installation or an earlier use; builds nothing."""
    from torch.utils.cpp_extension import CUDA_HOME

    built = gsplat_built()
    # gsplat loads what it compiled at an earlier use only where it finds nvcc.
    compiled = built is not None and CUDA_HOME and any(Path(extensions_folder()).glob("gsplat_cuda/gsplat_cuda*.so"))
    return bool(built or compiled)


@lru_cache(maxsize=1)
def compiled_functions() -> Any | None:
    """Return gsplat's module of compiled functions; None if it would have to be compiled, or is of another release."""
    version = installed_version("gsplat")
    if version is None or not version.startswith(KNOWN_RELEASES) or not is_compiled():
        return None
    from gsplat.cuda._backend import _C

    return _C
