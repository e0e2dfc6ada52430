"""gsplat's CUDA kernels on the CPU: its own PyTorch code of them, or plain tiles and blending.

They take and return what those of gsplat 1.5.3 do, as far as we ask for it, and refuse what those cannot bear. gsplat's
functions are its own. Backward passes are autograd's, through the forward ones; absolute gradients are those of sums.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import gsplat
import pytest
import torch
from gsplat.cuda import _torch_impl, _wrapper
from torch import Tensor

from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.gpu_raster.cameras import DeviceCameras
from lapgs_plugin.gpu_raster.records import Parameters, Projected, grid_of
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from tests.gaussian_records import records_of

FAINTEST, OPAQUEST, LAST = 1 / 255, 0.999, 1e-4
"""Alpha that is blended at least and at most, and the transmittance that no pixel goes below."""


def _spherical_harmonics(degree: int, directions: Tensor, coefficients: Tensor, masks: None) -> Tensor:
    values: Tensor = _torch_impl._spherical_harmonics(degree, directions, coefficients)
    return values


def _project(
    means: Tensor, covariances: None, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, eps2d: float, near: float, far: float, clip: float, compensates: bool, camera_model: str,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    assert len(means) > 0, "the kernel's launch divides by it"
    assert str(camera_model) == "CameraModelType.PINHOLE"
    covariances_3d, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, dimmed = _torch_impl._fully_fused_projection(
        means, covariances_3d, viewmats, Ks, width, height,
        eps2d=eps2d, near_plane=near, far_plane=far, calc_compensations=compensates,
    )  # fmt: skip
    faint = opacities * (1 if dimmed is None else dimmed) < FAINTEST  # (n,) or (c, n)
    radii[faint.expand(len(radii), -1)] = 0
    culled = ~(radii > clip).all(-1)  # (c, n)
    for values in (means2d, depths, conics):
        values[culled] = torch.nan  # the kernel leaves memory as it was
    return radii.contiguous(), means2d.contiguous(), depths.contiguous(), conics.contiguous(), dimmed


def _intersect(
    means2d: Tensor, radii: Tensor, depths: Tensor, image_ids: Tensor | None, gaussian_ids: Tensor | None, images: int,
    tile: int, columns: int, rows: int, sort: bool, segmented: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """How many tiles each has; and sorted, which tile over all images it is, and which Gaussian over all images.

    Of a packed list, or of as many Gaussians in every image, (i, n, ...).
    """
    if means2d.ndim == 3:
        assert image_ids is gaussian_ids is None
        assert len(means2d) == images
        image_ids = gaussian_ids = torch.arange(images).repeat_interleave(means2d.shape[1])
        means2d, radii, depths = means2d.flatten(0, 1), radii.flatten(0, 1), depths.flatten()
    assert image_ids is not None
    assert gaussian_ids is not None
    assert sort
    assert len(means2d) == len(image_ids) == len(gaussian_ids)
    assert image_ids.dtype == gaussian_ids.dtype == torch.int64
    most = torch.tensor([columns, rows])
    first = ((means2d - radii) / tile).floor().clamp_min(0).minimum(most).nan_to_num().int().tolist()
    past = ((means2d + radii) / tile).ceil().clamp_min(0).minimum(most).nan_to_num().int().tolist()
    pairs, counts = [], [0] * len(depths)
    for i in (radii > 0).all(-1).nonzero()[:, 0].tolist():
        assert image_ids[i] < images
        for y in range(first[i][1], past[i][1]):
            for x in range(first[i][0], past[i][0]):
                pairs.append(((int(image_ids[i]) * rows + y) * columns + x, float(depths[i]), i))
                counts[i] += 1
    pairs.sort()
    keys, _, order = zip(*pairs, strict=True) if pairs else ((), (), ())
    return torch.tensor(counts), torch.tensor(keys, dtype=torch.int64), torch.tensor(order, dtype=torch.int32)


def _offsets(keys: Tensor, images: int, columns: int, rows: int) -> Tensor:
    return torch.searchsorted(keys, torch.arange(images * rows * columns)).view(images, rows, columns)


def _blend(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None, masks: None,
    width: int, height: int, tile_size: int, offsets: Tensor, order: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    assert means2d.shape[:-1] == conics.shape[:-1] == colors.shape[:-1] == opacities.shape
    assert masks is None
    count, rows, columns = offsets.shape
    if means2d.ndim == 3:
        assert len(means2d) == count
        means2d, conics, colors, opacities = (part.flatten(0, 1) for part in (means2d, conics, colors, opacities))
    else:
        assert backgrounds is None
    images = torch.zeros(count, rows * tile_size, columns * tile_size, 4)  # with opacities
    ends = [*offsets.flatten().tolist(), len(order)]
    within = torch.arange(tile_size) + 0.5
    for tile in range(count * rows * columns):
        ids = order[ends[tile] : ends[tile + 1]]  # (m,)
        image, row, column = tile // (rows * columns), tile // columns % rows * tile_size, tile % columns * tile_size
        down, across = torch.meshgrid(row + within, column + within, indexing="ij")
        pixels = torch.stack([across, down], -1)  # (t, t, 2)
        dx, dy = (means2d[ids][:, None, None] - pixels).unbind(-1)  # (m, t, t)
        xx, xy, yy = conics[ids][:, :, None, None].unbind(1)
        powers = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
        alphas = (opacities[ids][:, None, None] * torch.exp(-powers)).clamp_max(OPAQUEST)
        alphas = torch.where((alphas < FAINTEST) | (powers < 0), 0.0, alphas)
        after = torch.cumprod(1 - alphas, 0)
        alphas = torch.where(after > LAST, alphas, 0.0)
        after = torch.cumprod(1 - alphas, 0)
        before = torch.cat([torch.ones_like(after[:1]), after])[: len(ids)]
        there = images[image, row : row + tile_size, column : column + tile_size]
        there[..., :3] = torch.einsum("mij,mc->ijc", alphas * before, colors[ids])
        there[..., 3] = 1 - torch.prod(1 - alphas, 0)
    images = images[:, :height, :width]
    colored, alphas = images[..., :3], images[..., 3:]
    if backgrounds is not None:
        assert backgrounds.shape == (count, 3)
        colored = colored + (1 - alphas) * backgrounds[:, None, None]
    return colored.contiguous(), alphas.contiguous(), torch.empty(0)


def _back(kernel: Callable[..., Any], given: list[Any], outputs: list[int], gradients: list[Tensor]) -> list[Tensor]:
    """The gradients by the tensors in `given` that are of floats, from those of some of a kernel's outputs."""
    leaves = [
        each.detach().clone().requires_grad_() if isinstance(each, Tensor) and each.is_floating_point() else each
        for each in given
    ]
    with torch.enable_grad():
        results = kernel(*leaves)
        total = sum(
            torch.where(results[index].isnan(), 0.0, results[index] * gradient.nan_to_num()).sum()
            for index, gradient in zip(outputs, gradients, strict=True)
        )
    wanted = [each for each in leaves if isinstance(each, Tensor) and each.requires_grad]
    found_gradients = torch.autograd.grad(total, wanted, allow_unused=True)
    filled = (
        torch.zeros_like(x) if g is None else g.nan_to_num() for x, g in zip(wanted, found_gradients, strict=True)
    )
    return [each.contiguous() for each in filled]


def _spherical_harmonics_back(
    bases: int, degree: int, directions: Tensor, coefficients: Tensor, masks: None, by_color: Tensor, wants: bool
) -> tuple[Tensor, Tensor]:
    by_direction, by_coefficient = _back(
        lambda *given: [_spherical_harmonics(*given)], [degree, directions, coefficients, masks], [0], [by_color]
    )
    return by_coefficient, by_direction


def _project_back(
    means: Tensor, covariances: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int,
    height: int, eps2d: float, camera_model: str, radii: Tensor, conics: Tensor, dimmed: None, by_means2d: Tensor,
    by_depths: Tensor, by_conics: Tensor, by_dimmed: None, wants_pose: bool,
) -> tuple[Tensor, None, Tensor, Tensor, Tensor]:  # fmt: skip
    shown = (radii > 0).all(-1)

    def project(means: Tensor, quats: Tensor, scales: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        covariances_3d, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        _, means2d, depths, conics, _ = _torch_impl._fully_fused_projection(
            means, covariances_3d, viewmats, Ks, width, height, eps2d=eps2d, near_plane=0.2
        )
        return means2d[shown], depths[shown], conics[shown]

    gradients = [part[shown] for part in (by_means2d, by_depths, by_conics)]
    by_means, by_quats, by_scales = _back(project, [means, quats, scales], [0, 1, 2], gradients)
    return by_means, None, by_quats, by_scales, torch.zeros_like(viewmats)


def _blend_back(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None, masks: None,
    width: int, height: int, tile_size: int, offsets: Tensor, order: Tensor, alphas: Tensor, last: Tensor,
    by_image: Tensor, by_alpha: Tensor, absolute: bool,
) -> tuple[Tensor | None, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    def blend(*given: Tensor) -> Any:
        return _blend(*given, backgrounds, masks, width, height, tile_size, offsets, order)  # type: ignore[arg-type]

    given = [part.nan_to_num() for part in (means2d, conics, colors, opacities)]
    gradients = _back(blend, given, [0, 1], [by_image, by_alpha])
    return gradients[0].abs() if absolute else None, gradients[0], gradients[1], gradients[2], gradients[3]


KERNELS: dict[str, Callable[..., Any]] = {
    "spherical_harmonics_fwd": _spherical_harmonics,
    "projection_ewa_3dgs_fused_fwd": _project,
    "intersect_tile": _intersect,
    "intersect_offset": _offsets,
    "rasterize_to_pixels_3dgs_fwd": _blend,
    "spherical_harmonics_bwd": _spherical_harmonics_back,
    "projection_ewa_3dgs_fused_bwd": _project_back,
    "rasterize_to_pixels_3dgs_bwd": _blend_back,
}


def _checked(name: str) -> Callable[..., Any]:
    def kernel(*args: Any) -> Any:
        assert all(value.is_contiguous() for value in args if isinstance(value, Tensor)), name
        return KERNELS[name](*args)

    return kernel


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """Let gsplat find these kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_wrapper, "_make_lazy_cuda_func", _checked)
        patch.setattr(_wrapper, "_make_lazy_cuda_obj", lambda name: name)
        yield


def _harmonics_160(degrees_to_use: int, means: Tensor, viewmats: Tensor, coeffs: Tensor) -> Tensor:
    """As gsplat's `spherical_harmonics` from 1.6.0 on: (c, n, 3) of means, seen by c poses."""
    centres = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]  # (c, 3)
    colors = [_torch_impl._spherical_harmonics(degrees_to_use, means - centre, coeffs) for centre in centres]
    return torch.stack(colors)


def _isect_tiles_160(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int, *,
    conics: Tensor | None = None, opacities: Tensor | None = None, **options: Any,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """As gsplat's `isect_tiles` from 1.6.0 on: without tiles in which no pixel has alpha of at least 1/255."""
    counts, keys, order = _wrapper.isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, **options)
    assert conics is not None
    assert opacities is not None
    within, tiles, ids = torch.arange(tile_size) + 0.5, keys % (tile_width * tile_height), order.long()
    corners = torch.stack([tiles % tile_width, tiles // tile_width], -1) * tile_size  # (p, 2)
    pixels = torch.stack(torch.meshgrid(within, within, indexing="xy"), -1)  # (t, t, 2)
    dx, dy = (means2d[ids, None, None] - corners[:, None, None] - pixels).unbind(-1)  # (p, t, t)
    xx, xy, yy = conics[ids, :, None, None].unbind(1)
    alphas = opacities[ids, None, None] * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
    kept = (alphas >= FAINTEST).flatten(1).any(1)
    assert bool(kept.any())
    assert not bool(kept.all()), "nothing is left out here: the test shows nothing"
    return torch.bincount(ids[kept], minlength=len(counts)), keys[kept], order[kept]


@contextmanager
def gsplat_160_on_cpu() -> Iterator[None]:
    """Let gsplat find these kernels, by the functions of 1.6.0 that have other signatures."""
    with gsplat_on_cpu(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(gsplat, "spherical_harmonics", _harmonics_160)
        patch.setattr(gsplat, "isect_tiles", _isect_tiles_160)
        yield


def _looks(given: Parameters, cameras: DeviceCameras, degree: int, signed: bool) -> tuple[Tensor, Tensor]:
    """Colours (c, n, 3) and opacities (c, n)."""
    away = [torch.nn.functional.normalize(given.means - centre, dim=-1) for centre in cameras.centres]
    colors = torch.stack([sh_to_color(given.sh, each, degree, signed=signed) for each in away])
    return colors, given.logits.sigmoid().expand(len(away), -1)


def _alone(cameras: DeviceCameras) -> list[DeviceCameras]:
    """Each camera with its own size."""
    assert cameras.sizes is not None
    rows = zip(*(part.split(1) for part in cameras[:3]), cameras.sizes.tolist(), strict=True)
    return [DeviceCameras(*parts, *size) for *parts, size in rows]


def project(
    given: Parameters, cameras: DeviceCameras, degree: int, signed: bool, with_geometry: bool = False
) -> Projected:
    """As `kernels.project`, in PyTorch's operations."""
    if cameras.sizes is not None:
        views = [project(given, one, degree, signed, with_geometry) for one in _alone(cameras)]
        return Projected(*map(torch.cat, zip(*views, strict=True)))
    radii, means2d, depths, conics, _ = _project(
        given.means, None, given.quaternions, given.log_scales.exp(), given.logits.sigmoid(),
        *cameras[:2], cameras.width, cameras.height, 0.3, 0.2, 1e10, 0.0, False, "CameraModelType.PINHOLE",
    )  # fmt: skip
    assert radii is not None
    assert means2d is not None
    assert depths is not None
    assert conics is not None
    records, shown = records_of(means2d, conics, *_looks(given, cameras, degree, signed)), (radii > 0).all(-1)
    if not with_geometry:
        return Projected(radii, means2d, depths, records, radii.new_empty(0), means2d.new_empty(0))
    largest, centres = torch.where(shown, radii.amax(-1), 0), torch.where(shown[..., None], means2d - 0.5, 0.0)
    return Projected(radii, means2d, depths, records, largest, centres)


def project_into(
    stacked: Sequence[Tensor], start: int, given: Parameters, cameras: DeviceCameras, camera: int, signed: bool
) -> None:
    """As `kernels.project_into`."""
    one = DeviceCameras(*(part[camera : camera + 1] for part in cameras[:3]), *cameras[3:])
    seen = project(given, one, math.isqrt(given.sh.shape[1]) - 1, signed)
    for into, part in zip(stacked, seen[:4], strict=True):
        into[start : start + len(given.means)] = part[0]


def project_backward(
    given: Parameters, cameras: DeviceCameras, degree: int, signed: bool, radii: Tensor, records: Tensor,
    found: Tensor, others: Tensor,
) -> Parameters:  # fmt: skip
    """As `kernels.project_backward`, by autograd."""
    if cameras.sizes is not None:
        parts = zip(_alone(cameras), *(values[:, None] for values in (radii, records, found, others)), strict=True)
        views = [project_backward(given, one, degree, signed, *values) for one, *values in parts]
        return Parameters(*(sum(values) for values in zip(*views, strict=True)))  # type: ignore[misc]
    leaves = Parameters(*(value.detach().clone().requires_grad_() for value in given))
    shown = (radii > 0).all(-1)
    with torch.enable_grad():
        colors, opacities = _looks(leaves, cameras, degree, signed)
        scales = leaves.log_scales.exp()
        covariances, _ = _torch_impl._quat_scale_to_covar_preci(leaves.quaternions, scales, compute_preci=False)
        _, means2d, _, conics, _ = _torch_impl._fully_fused_projection(
            leaves.means, covariances, *cameras[:2], cameras.width, cameras.height, eps2d=0.3, near_plane=0.2
        )
        seen = torch.cat([colors, opacities[..., None], means2d, conics], -1)[shown]
        total = (seen * torch.cat([found, others[..., :1]], -1)[shown]).sum()
    return Parameters(*torch.autograd.grad(total, leaves))


def sort_by_depth(radii: Tensor, means2d: Tensor, depths: Tensor, grid: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """As `tile_kernels.sort_by_depth`; Gaussians stay in their order, of which `sort_by_tile` makes no use."""
    images = torch.zeros(depths.numel(), dtype=torch.int64)
    counts, *_ = _intersect(
        means2d.view(-1, 2), radii.view(-1, 2), depths.view(-1), images, images, 1, 16, *grid, True, False
    )
    return depths.view(-1), counts.cumsum(0)


def sort_by_tile(
    radii: Tensor, means2d: Tensor, depths: Tensor, ends: Tensor, images: Tensor | None, count: int,
    grid: tuple[int, int], room: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As `tile_kernels.sort_by_tile`; takes depths in the place of their order."""
    if images is None:
        images = torch.arange(count).repeat_interleave(len(depths) // count)
    _, keys, flat = _intersect(
        means2d.view(-1, 2), radii.view(-1, 2), depths, images, images, count, 16, *grid, True, False
    )
    offsets = torch.cat([_offsets(keys, count, *grid).flatten(), torch.tensor([len(keys)])])
    return offsets.clamp_max(room), torch.nn.functional.pad(flat[:room], (0, max(0, room - len(flat))))


def _parts(records: Tensor) -> list[Tensor]:
    return [records[..., part].contiguous() for part in (slice(2), slice(2, 5), slice(8, 11), 5)]


def _pairs(offsets: Tensor, flat: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Offsets and Gaussians as gsplat's kernels take them."""
    across, down = grid_of(size)
    return offsets[:-1].view(-1, down, across), flat[: int(offsets[-1])]


def blend_forward(
    records: Tensor, background: Tensor, offsets: Tensor, flat: Tensor, size: tuple[int, int], count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """As `blend_kernels.blend_forward`; what it keeps for the backward pass is another thing."""
    images, alphas, _ = _blend(*_parts(records), None, None, *size, 16, *_pairs(offsets, flat, size))
    backgrounds = background.expand(len(images), -1).contiguous()
    return images + (1 - alphas) * backgrounds[:, None, None], alphas, backgrounds


def blend_backward(
    records: Tensor, offsets: Tensor, flat: Tensor, images: Tensor, alphas: Tensor, backgrounds: Tensor,
    by_images: Tensor, absolute: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As `blend_kernels.blend_backward`; absolute gradients are those of sums."""
    size = images.shape[2], images.shape[1]
    rest = (
        None,
        *size,
        16,
        *_pairs(offsets, flat, size),
        alphas,
        torch.empty(0),
        by_images,
        torch.zeros_like(alphas),
        absolute,
    )
    whole, means2d, conics, colors, opacities = _blend_back(*_parts(records), backgrounds, *rest)
    gradients = torch.cat([colors, opacities[..., None], means2d, conics[..., :2]], -1)
    return gradients, torch.cat([conics[..., 2:], *([] if whole is None else [whole])], -1)


KERNEL_MODULES = {
    "kernels": {"project": project, "project_into": project_into, "project_backward": project_backward},
    "tile_kernels": {"sort_by_depth": sort_by_depth, "sort_by_tile": sort_by_tile},
    "blend_kernels": {"blend_forward": blend_forward, "blend_backward": blend_backward},
}
"""Functions by the modules of Triton kernels that they replace."""


@contextmanager
def direct_on_cpu(**others: Callable[..., Any]) -> Iterator[None]:
    """Let `gsplat.direct` find these kernels, and these functions in place of our kernels, or others by their names."""
    with pytest.MonkeyPatch.context() as patch:
        for name, functions in KERNEL_MODULES.items():
            chosen = {key: others.get(key, function) for key, function in functions.items()}
            patch.setitem(sys.modules, f"lapgs_plugin.gpu_raster.{name}", SimpleNamespace(**chosen))
        yield


class GsplatOnCpu(GsplatRasterizer):
    """Call gsplat's functions or, `direct`, its kernels."""

    can_batch = True

    def __init__(self, direct: bool, **options: Any) -> None:
        super().__init__("cpu", **options)
        self._may_be_direct = self._must_be_direct = direct
