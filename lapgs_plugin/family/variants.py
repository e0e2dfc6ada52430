"""List the rasterizers of the 3DGS family: the settings that each takes and the tensors that it returns.

Matrices are transposed, as in the CUDA bindings. Settings beside those of the view:

    mult            FastGS: factor on the ellipse alpha = 1/255 that tiles are chosen by
    get_flag        FastGS: count, for each Gaussian, the marked pixels it is blended in
    metric_map      FastGS: (height * width,) int32, 1 marks a pixel
    antialiasing    graphdeco: dim Gaussians that are smaller than a pixel
    pixel_weights   Taming-3DGS: (height, width) float32 to sum up for each Gaussian, or None
    kernel_size     Mip-Splatting: variance of the blur, in px^2
    subpixel_offset Mip-Splatting: (height, width, 2) added to the pixels' positions
    depth_threshold Pixel-GS: depth under which screen-space gradients are scaled down
    confidence      FSGS, CoR-GS: (n, 1) factors on each Gaussian's gradients
    use_train_speedup, ignored_rate, lambda_dssim, use_hwc
                    EfficientGS: skip tiles in the backward pass; image as (height, width, 3)
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from torch import Tensor
from torch.nn.functional import interpolate

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family import forks
from lapgs_plugin.family.binding import DcApart, Rasterizer, WholeSh
from lapgs_plugin.family.call import SUMS, Options, Output
from lapgs_plugin.family.sparse_adam import SparseGaussianAdam

_VIEW = (
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
    "sh_degree", "campos",
)  # fmt: skip
_FAMILY = (*_VIEW, "prefiltered", "debug")
_TWO = ("image", "radii")


def _always(options: Options) -> Callable[[Any], Options]:
    """Return the same options for all settings."""
    return lambda settings: options


_ALONE = _always(Options())
"""Ask for nothing but an image."""


def _image_and_radii(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image (3, h, w) and the radii (n,) int32."""
    return output.image, output.radii


@dataclass(frozen=True)
class Variant:
    """Describe one CUDA rasterizer.

    Attributes:
        description: of its module.
        settings: fields of its `GaussianRasterizationSettings`, in their order.
        options: from the settings of a call to its options of the engine.
        outputs: from these settings and the engine's output to the result of `forward`.
        returned: kinds of the outputs of `forward`, where they are always the same; empty if they are not compared.
        module: name that checkouts import.
        binding: `GaussianRasterizer` without its `variant`; its `forward` has the arguments of the CUDA module's.
        sparse_adam: whether the module has `SparseGaussianAdam`.
        fused_ssim: whether its binding `_C` has SSIM.
        functions: other functions and classes of its module.
        beside: variants of other modules that the same checkouts import.
        needs_logs: whether these checkouts cannot do without TensorBoard.
        unavailable: what ours cannot do, in words; empty if it does all that the CUDA module does.
        renders_gaussians: whether its image is that of the Gaussians that it is given.
    """

    description: str
    settings: tuple[str, ...] = _FAMILY
    options: Callable[[Any], Options] = _ALONE
    outputs: Callable[[Any, Output], tuple[Tensor, ...]] = _image_and_radii
    returned: tuple[str, ...] = ()
    module: str = "diff_gaussian_rasterization"
    binding: type[Rasterizer] = WholeSh
    sparse_adam: bool = False
    fused_ssim: bool = False
    functions: tuple[Any, ...] = ()
    beside: tuple[str, ...] = ()
    needs_logs: bool = False
    unavailable: str = ""
    renders_gaussians: bool = True


def _with_inverse_depths(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image, the radii, and 1 / depth blended over black (1, h, w)."""
    assert output.inverse_depths is not None
    return output.image, output.radii, output.inverse_depths


def _with_marked_pixels(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image, the radii, and with `get_flag` in how many marked pixels each Gaussian is blended, (n,) int32.

    Without the flag the last tensor is empty.
    """
    counts = output.radii.new_empty(0) if output.contributions is None else output.sum("weights").int()
    return output.image, output.radii, counts


def _with_sums(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the 13 tensors of Taming-3DGS, by which it scores Gaussians.

    They are image (3, h, w), radii (n,), counts (h, w) that the CUDA code leaves at zero, three empty lists, centres
    (n, 2), depths (n,), radii again; then, with two rows of pixel weights or more, sums over the pixels that a Gaussian
    is blended in: of their weights, of 1, of its share in the pixel, of the distance from its centre in pixels. With
    fewer rows these are four empty tensors.
    """
    size = settings.image_height, settings.image_width
    empty, whole = output.image.new_empty(0), output.radii.new_empty(0)
    assert output.centres is not None
    assert output.depths is not None
    counts = output.radii.new_zeros(size) if _weight_rows(settings) else whole
    sums: tuple[Tensor, ...] = empty, whole, empty, empty
    if output.contributions is not None:
        sums = tuple(output.sum(name) for name in SUMS)
    return (
        output.image, output.radii, counts, whole, empty, empty, output.centres, output.depths, output.radii.clone(),
        *sums,
    )  # fmt: skip


def _with_total_share(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image, the radii, and the sum of each Gaussian's shares (n,)."""
    return output.image, output.radii, output.sum("blending")


def _with_blended(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image, the radii, and whether each Gaussian is blended in some pixel, (n,) int32."""
    return output.image, output.radii, (output.sum("counts") > 0).int()


def _with_pixels(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return the image, the radii, and the number of pixels in which each Gaussian is blended, (n, 1) float32."""
    return output.image, output.radii, output.sum("counts").float()[:, None]


def _weight_rows(settings: Any) -> int:
    return 0 if settings.pixel_weights is None else len(settings.pixel_weights)


def _weights(settings: Any) -> Tensor:
    """Return the weights of the image's pixels, (height * width,).

    DEPARTURE: those of an image of another size are resized, where the CUDA code reads whatever lies behind them. A
    script that makes them once, at its start, has them of a coarser level.
    """
    weights: Tensor = settings.pixel_weights
    size = int(settings.image_height), int(settings.image_width)
    if weights.numel() == size[0] * size[1]:
        return weights.reshape(-1)
    if weights.ndim != 2:
        raise UserInputError(f"pixel_weights is {tuple(weights.shape)}, expected {size}")
    return interpolate(weights[None, None].float(), size, mode="bilinear").reshape(-1)


_ANTIALIASED = Variant(
    "Stand in for graphdeco's rasterizer, branch dr_aa: with antialiasing and inverse depths.",
    (*_FAMILY, "antialiasing"),
    options=lambda settings: Options(antialiasing=settings.antialiasing, inverse_depth=True),
    outputs=_with_inverse_depths,
    returned=(*_TWO, "depth"),
)
BACKBONES = {
    "graphdeco": Variant("Stand in for graphdeco's rasterizer, branch main.", returned=_TWO),
    "graphdeco-aa": _ANTIALIASED,
    # Two faults of the copies in circulation are left out: their backward pass counts a background that is not black
    # twice, and skips Gaussians at random after a reduction over the wrong number of threads.
    "graphdeco-accel": replace(
        _ANTIALIASED,
        description="Stand in for graphdeco's accelerated rasterizer: as branch dr_aa, with DC apart and sparse Adam.",
        binding=DcApart,
        sparse_adam=True,
        fused_ssim=True,
    ),
    "taming": Variant(
        "Stand in for the rasterizer of Taming-3DGS, branch main: with the sums that Gaussians are scored by.",
        (*_FAMILY, "pixel_weights"),
        # The CUDA code looks at the number of rows, not of pixels.
        options=lambda settings: (
            Options(sums=SUMS, pixel_weights=_weights(settings), positions=True)
            if _weight_rows(settings) > 1
            else Options(positions=True)
        ),
        outputs=_with_sums,
        binding=DcApart,
        sparse_adam=True,
    ),
    "taming-rasterizer": Variant(
        "Stand in for the rasterizer of Taming-3DGS, branch rasterizer: with DC apart and sparse Adam.",
        returned=_TWO,
        binding=DcApart,
        sparse_adam=True,
        fused_ssim=True,
    ),
    "fastgs": Variant(
        "Stand in for the rasterizer of FastGS: with the compact box and the count of marked pixels.",
        (*_VIEW, "mult", "prefiltered", "debug", "get_flag", "metric_map"),
        options=lambda settings: (
            Options(mult=settings.mult, sums=("weights",), pixel_weights=(settings.metric_map == 1).float())
            if settings.get_flag
            else Options(mult=settings.mult)
        ),
        outputs=_with_marked_pixels,
        module="diff_gaussian_rasterization_fastgs",
        binding=DcApart,
        sparse_adam=True,
    ),
}
"""By name, as `BackboneInfo.stand_in` gives it; most are also names of recipes in patches/."""

_MINI_SPLATTING = Variant(
    "Stand in for the rasterizer of Mini-Splatting: with shares, and points at the depth of Gaussians.",
    options=_always(forks.SHARES),
    outputs=forks.with_shares,
    module="diff_gaussian_rasterization_ms",
    binding=forks.MiniSplatting,
    beside=("graphdeco",),
)
FORKS = {
    "speedy-splat": Variant(
        "Stand in for the rasterizer of Speedy-Splat: with the scores that it prunes by.", binding=forks.SpeedySplat
    ),
    "mini-splatting": _MINI_SPLATTING,
    "mini-splatting2": replace(
        _MINI_SPLATTING,
        description="Stand in for the rasterizer of Mini-Splatting2: as Mini-Splatting's, with culling.",
        binding=forks.MiniSplatting2,
        sparse_adam=True,
        fused_ssim=True,
    ),
    "3dgs-mcmc": Variant(
        "Stand in for the rasterizer of 3dgs-mcmc: with the relocation of Gaussians.",
        options=_always(Options(sums=("counts",))),
        outputs=_with_blended,
        functions=(forks.compute_relocation,),
    ),
    "absgs": Variant(
        "Stand in for the rasterizer of AbsGS: with absolute gradients and the sum of shares.",
        options=_always(Options(sums=("blending",))),
        outputs=_with_total_share,
        module="diff_gaussian_rasterization_abs",
    ),
    "mip-splatting": Variant(
        "Stand in for the rasterizer of Mip-Splatting: with antialiasing, of any variance.",
        (*_VIEW[:4], "kernel_size", "subpixel_offset", *_VIEW[4:], "prefiltered", "debug"),
        options=lambda settings: Options(antialiasing=True, exact_antialiasing=True, blur=settings.kernel_size),
        returned=_TWO,
        binding=forks.MipSplatting,
        unavailable="pixels that are moved by subpixel_offset (--ray_jitter)",
    ),
    "efficientgs": Variant(
        "Stand in for the rasterizer of EfficientGS: with the largest shares, and SH degrees of each Gaussian.",
        (*_FAMILY, "use_train_speedup", "ignored_rate", "lambda_dssim", "use_hwc"),
        binding=forks.EfficientGS,
        needs_logs=True,
        unavailable="regularisation, counts of rays, radii other than three sigma, --use_train_speedup",
    ),
    "pixel-gs": Variant(
        "Stand in for the rasterizer of Pixel-GS: with the pixels of each Gaussian, and gradients scaled by depth.",
        (*_VIEW[:6], "depth_threshold", *_VIEW[6:], "prefiltered", "debug"),
        options=_always(Options(sums=("counts",))),
        outputs=_with_pixels,
        binding=forks.PixelGS,
    ),
    "depth-and-alpha": Variant(
        "Stand in for the rasterizers that return depth and alpha, too, as that of DreamGaussian and DNGaussian.",
        returned=(*_TWO, "depth", "alpha"),
        binding=forks.WithDepths,
    ),
    "depth-acc": Variant(
        "Stand in for the rasterizer of DepthRegularizedGS: with depth and alpha, before the radii.",
        returned=("image", "depth", "alpha", "radii"),
        module="diff_gaussian_rasterization_depth_acc",
        binding=forks.DepthsBeforeRadii,
    ),
    "confidence": Variant(
        "Stand in for the rasterizer of FSGS and CoR-GS: with depth and alpha, and a factor on gradients.",
        (*_FAMILY, "confidence"),
        returned=(*_TWO, "depth", "alpha"),
        binding=forks.Confident,
    ),
    "2dgs": Variant(
        "Stand in for the rasterizer of 2DGS: flat Gaussians, with depths and normals.",
        module="diff_surfel_rasterization",
        binding=forks.Surfels,
        renders_gaussians=False,
        unavailable="intersections of rays with surfels, median depths, distortion; it renders very flat Gaussians",
    ),
    "faster-gs": Variant(
        "Stand in for the rasterizer of Faster-GS: a function of raw parameters, and its Adam.",
        (),
        module="FasterGSCudaBackend.torch_bindings",
        functions=(forks.diff_rasterize, forks.RasterizerSettings, forks.FusedAdam),
        beside=("graphdeco-aa",),
    ),
}
"""Rasterizers of forks, whose modules or arguments are their own."""

VARIANTS = {**BACKBONES, **FORKS}
"""All variants by name."""


@lru_cache
def rasterizer_module(name: str) -> dict[str, Any]:
    """Return the public names of the stand-in for a variant's module; always the same classes."""
    variant = VARIANTS[name]
    contents: dict[str, Any] = {"__doc__": variant.description}
    contents |= {function.__name__: function for function in variant.functions}
    if not variant.settings:
        return contents
    contents |= {
        "GaussianRasterizationSettings": namedtuple("GaussianRasterizationSettings", variant.settings),
        "GaussianRasterizer": type(
            "GaussianRasterizer", (variant.binding,), {"variant": variant, "__doc__": Rasterizer.__doc__}
        ),
    }
    if variant.sparse_adam:
        contents["SparseGaussianAdam"] = SparseGaussianAdam
    return contents
