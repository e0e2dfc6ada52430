"""List the CUDA rasterizers that have a stand-in: the settings that each takes and the tensors that it returns.

Matrices are transposed, as in the CUDA bindings. Settings beside those of the view:

    mult            FastGS: factor on the ellipse alpha = 1/255 that tiles are chosen by
    get_flag        FastGS: count, for each Gaussian, the marked pixels it is blended in
    metric_map      FastGS: (height * width,) int32, 1 marks a pixel
    antialiasing    graphdeco: dim Gaussians that are smaller than a pixel
    pixel_weights   Taming-3DGS: (height, width) float32 to sum up for each Gaussian, or None
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.reference_raster.standins.engine import Options, Output

_VIEW = (
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
    "sh_degree", "campos",
)  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """Describe one CUDA rasterizer.

    Attributes:
        description: of its module.
        settings: fields of its `GaussianRasterizationSettings`, in their order.
        options: from the settings of a call to what it asks of the engine.
        outputs: from these settings and the engine's output to what `forward` returns.
        module: name that checkouts import.
        dc_apart: whether `forward` takes the first SH coefficient as an argument of its own.
        sparse_adam: whether the module has `SparseGaussianAdam`.
        fused_ssim: whether its binding `_C` has SSIM.
    """

    description: str
    settings: tuple[str, ...]
    options: Callable[[Any], Options]
    outputs: Callable[[Any, Output], tuple[Tensor, ...]]
    module: str = "diff_gaussian_rasterization"
    dc_apart: bool = False
    sparse_adam: bool = False
    fused_ssim: bool = False


def _image_and_radii(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image (3, h, w) and the radii (n,) int32."""
    return output.image, output.radii


def _with_inverse_depths(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image, the radii, and 1 / depth blended over black (1, h, w)."""
    assert output.inverse_depths is not None
    return output.image, output.radii, output.inverse_depths


def _with_marked_pixels(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image, the radii, and with `get_flag` in how many marked pixels each Gaussian is blended, (n,) int32.

    Without the flag the last tensor is empty.
    """
    counts = torch.empty(0, dtype=torch.int32)
    if output.contributions is not None:
        counts = torch.from_numpy(output.contributions.weights).int()
    return output.image, output.radii, counts


def _with_sums(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the 13 tensors of Taming-3DGS, by which it scores Gaussians.

    They are image (3, h, w), radii (n,), counts (h, w) that the CUDA code leaves at zero, three empty lists, centres
    (n, 2), depths (n,), radii again; then, with two rows of pixel weights or more, sums over the pixels that a Gaussian
    is blended in: of their weights, of 1, of its share in the pixel, of the distance from its centre in pixels. With
    fewer rows these are four empty tensors.
    """
    size = settings.image_height, settings.image_width
    counts = torch.zeros(size if _weight_rows(settings) else 0, dtype=torch.int32)
    lists = torch.empty(0, dtype=torch.int32), torch.empty(0), torch.empty(0)
    sums = torch.empty(0), torch.empty(0, dtype=torch.int32), torch.empty(0), torch.empty(0)
    if output.contributions is not None:
        found = output.contributions
        sums = (
            torch.from_numpy(found.weights).float(), torch.from_numpy(found.counts),
            torch.from_numpy(found.blending).float(), torch.from_numpy(found.distances).float(),
        )  # fmt: skip
    return output.image, output.radii, counts, *lists, output.centres, output.depths, output.radii.clone(), *sums


def _weight_rows(settings: Any) -> int:
    return 0 if settings.pixel_weights is None else len(settings.pixel_weights)


VARIANTS = {
    "graphdeco": Variant(
        "Stand in for graphdeco's rasterizer, branch main.",
        (*_VIEW, "prefiltered", "debug"),
        lambda settings: Options(),
        _image_and_radii,
    ),
    "graphdeco-aa": Variant(
        "Stand in for graphdeco's rasterizer, branch dr_aa: with antialiasing and inverse depths.",
        (*_VIEW, "prefiltered", "debug", "antialiasing"),
        lambda settings: Options(antialiasing=settings.antialiasing, inverse_depth=True),
        _with_inverse_depths,
    ),
    # Two faults of the copies in circulation are left out: their backward pass counts a background that is not black
    # twice, and skips Gaussians at random after a reduction over the wrong number of threads.
    "graphdeco-accel": Variant(
        "Stand in for graphdeco's accelerated rasterizer: as branch dr_aa, with DC apart and sparse Adam.",
        (*_VIEW, "prefiltered", "debug", "antialiasing"),
        lambda settings: Options(antialiasing=settings.antialiasing, inverse_depth=True),
        _with_inverse_depths,
        dc_apart=True,
        sparse_adam=True,
        fused_ssim=True,
    ),
    "taming": Variant(
        "Stand in for the rasterizer of Taming-3DGS, branch main: with the sums that Gaussians are scored by.",
        (*_VIEW, "prefiltered", "debug", "pixel_weights"),
        # The CUDA code looks at the number of rows, not of pixels.
        lambda settings: Options(pixel_weights=settings.pixel_weights if _weight_rows(settings) > 1 else None),
        _with_sums,
        dc_apart=True,
        sparse_adam=True,
    ),
    "taming-rasterizer": Variant(
        "Stand in for the rasterizer of Taming-3DGS, branch rasterizer: with DC apart and sparse Adam.",
        (*_VIEW, "prefiltered", "debug"),
        lambda settings: Options(),
        _image_and_radii,
        dc_apart=True,
        sparse_adam=True,
        fused_ssim=True,
    ),
    "fastgs": Variant(
        "Stand in for the rasterizer of FastGS: with the compact box and the count of marked pixels.",
        (*_VIEW, "mult", "prefiltered", "debug", "get_flag", "metric_map"),
        lambda settings: Options(
            mult=settings.mult, pixel_weights=(settings.metric_map == 1).float() if settings.get_flag else None
        ),
        _with_marked_pixels,
        module="diff_gaussian_rasterization_fastgs",
        dc_apart=True,
        sparse_adam=True,
    ),
}
"""By name, as `BackboneInfo.stand_in` gives it; most are also names of recipes in patches/."""
