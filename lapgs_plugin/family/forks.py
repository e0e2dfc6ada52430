"""Bind forks' rasterizers whose `forward` takes other arguments than graphdeco's, or that have other methods.

Each class is the `GaussianRasterizer` of a variant; see `variants.Variant.binding`.
"""

from __future__ import annotations

import math
import weakref
from collections import deque
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import normalize

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family.binding import Rasterizer, WholeSh, gather
from lapgs_plugin.family.call import Blending, Inputs, Options, Output, ShParts, depths_of
from lapgs_plugin.family.engine import rasterize
from lapgs_plugin.gpu_raster.arriving_number import ArrivingNumber
from lapgs_plugin.gpu_raster.records import state_of
from lapgs_plugin.reference_raster.covariance import covariances_of, matrices
from lapgs_plugin.reference_raster.oracle import rotation_matrices

THIN = 1e-4
"""Third standard deviation of a surfel, over its larger one."""
SHARES = Options(sums=("counts", "blending"), blending=True)
"""Ask for each Gaussian's pixels and shares, and how each pixel is blended."""


class SpeedySplat(Rasterizer):
    """Return image, radii, seconds; the gradient of `scores` (n, 1) is a sum of squared derivatives over pixels."""

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        scores: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        inputs = gather(means3D, means2D, opacities, None, shs, colors_precomp, scales, rotations, cov3D_precomp)
        output = rasterize(self.raster_settings, inputs, Options(blending=scores.requires_grad))
        image = output.image
        if output.blending is not None:
            image = _Scored.apply(image, scores, output.blending)  # type: ignore[no-untyped-call]  # torch's
        return image, output.radii, image.new_zeros(1)


class _Scored(torch.autograd.Function):
    """Pass an image (3, h, w) through; the gradient of the scores (n, 1) is that of `squared_gradients`."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, scores: Tensor, blending: Blending) -> Tensor:
        ctx.blending = blending
        return image.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor) -> tuple[Tensor | None, ...]:
        squared: Tensor = ctx.blending.squared_gradients(grad_image.reshape(3, -1))
        return grad_image, squared[:, None], None


class MiniSplatting(WholeSh):
    """Return image, radii, and each Gaussian's shares, pixels, and pixels that it has the largest share of."""

    def render_depth(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **more: Tensor | None
    ) -> dict[str, Any]:
        """Return the points (3, h, w) at which rays come nearest to the Gaussian of the largest share, and their depth.

        `accum_alpha` (1, h, w) is the transmittance behind all Gaussians, as in the CUDA code.
        """
        inputs = gather(means3D, means2D, opacities, **more)
        return _depths_of_leaders(self.raster_settings, inputs)


class MiniSplatting2(MiniSplatting):
    """Take the first SH coefficient apart, and leave out the Gaussians marked in `culling` (n,) bool."""

    def forward(  # type: ignore[override]  # as the CUDA binding
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        culling: Tensor,
        dc: Tensor | None = None,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        flag_max_count: bool = False,
    ) -> tuple[Tensor, ...]:
        opacities = torch.where(culling[:, None], 0.0, opacities)
        inputs = gather(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
        output = rasterize(self.raster_settings, inputs, Options(blending=flag_max_count))
        leads = means3D.new_zeros(len(means3D)) if output.blending is None else _pixels_led(output.blending)
        return output.image, torch.where(culling, 0, output.radii), leads

    def render_simp(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, culling: Tensor, **more: Tensor | None
    ) -> tuple[Tensor, ...]:
        """Return what Mini-Splatting's `forward` returns."""
        inputs = gather(means3D, means2D, torch.where(culling[:, None], 0.0, opacities), **more)
        return with_shares(self.raster_settings, rasterize(self.raster_settings, inputs, SHARES))

    def render_depth(  # type: ignore[override]  # as the CUDA binding
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, culling: Tensor, **more: Tensor | None
    ) -> dict[str, Any]:
        return super().render_depth(means3D, means2D, torch.where(culling[:, None], 0.0, opacities), **more)


def with_shares(settings: Any, output: Output) -> tuple[Tensor, ...]:
    """Return image, radii, and each Gaussian's shares, pixels, and pixels that it has the largest share of."""
    assert output.blending is not None
    return output.image, output.radii, output.sum("blending"), output.sum("counts"), _pixels_led(output.blending)


def _pixels_led(blending: Blending) -> Tensor:
    """Return the number of pixels that each Gaussian has the largest share of, (n,) float32."""
    return _times_named(blending.leaders(), blending.n)


def _times_named(indices: Tensor, n: int) -> Tensor:
    """Return how often each of the numbers 0 to n - 1 is among int64 ones, (n,) float32; -1 is left out.

    A GPU is not waited for, as `bincount` and selections by a mask would.
    """
    flat = indices.reshape(-1)
    counts = torch.zeros(n + 1, device=flat.device)
    return counts.index_add_(0, flat + 1, torch.ones_like(flat, dtype=torch.float32))[1:]


@torch.no_grad()
def _depths_of_leaders(settings: Any, inputs: Inputs) -> dict[str, Any]:
    height, width = int(settings.image_height), int(settings.image_width)
    output = rasterize(settings, inputs, Options(blending=True))
    assert output.blending is not None
    assert inputs.scales is not None, "render_depth takes scales and rotations"
    assert inputs.quats is not None
    if not len(inputs.means):
        return _depths_of_nothing(output)
    (leaders,) = output.blending.leaders()
    rows, columns = (torch.arange(size, device=leaders.device) for size in (height, width))
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    across = ((2 * column + 1) / width - 1) * settings.tanfovx
    down = ((2 * row + 1) / height - 1) * settings.tanfovy
    in_camera = torch.stack([across, down, torch.ones_like(across)], -1).reshape(-1, 3)
    rays = normalize(in_camera @ settings.viewmatrix[:3, :3].T, dim=1)  # (pixels, 3) in world coordinates
    at = leaders.clamp_min(0)
    covariances = matrices(covariances_of(inputs.scales * 3, inputs.quats))[at]
    inverse = torch.linalg.inv(covariances.double()).float()
    origin = settings.campos - inputs.means[at]
    along = (inverse @ rays[:, :, None])[:, :, 0]
    a, b = (rays * along).sum(1), 2 * (origin * along).sum(1)
    c = (origin * (inverse @ origin[:, :, None])[:, :, 0]).sum(1) - 1
    distance = torch.where(leaders >= 0, -b / (2 * a), 0.0)
    points = torch.where(leaders[:, None] >= 0, settings.campos + distance[:, None] * rays, 0.0)
    # The ray of the CUDA code ends near depth 1, where its length is 1 / cos.
    depth = distance / in_camera.norm(dim=1)
    shape = (1, height, width)
    return {
        "render": output.image,
        "out_pts": points.T.reshape(3, height, width),
        "rendered_depth": depth.reshape(shape),
        "discriminants": torch.where(leaders >= 0, b * b - 4 * a * c, 0.0).reshape(shape),
        "gidx": at.int().reshape(shape),
        "accum_alpha": output.blending.transmittance.reshape(shape),
    }


def _depths_of_nothing(output: Output) -> dict[str, Any]:
    """Return what `_depths_of_leaders` does, of a call without Gaussians."""
    assert output.blending is not None
    image, left = output.image, output.blending.transmittance[None]
    none = torch.zeros_like(left)
    return {
        "render": image,
        "out_pts": torch.zeros_like(image),
        "rendered_depth": none,
        "discriminants": none.clone(),
        "gidx": none.int(),
        "accum_alpha": left,
    }


class MipSplatting(WholeSh):
    """Render with antialiasing; the third column of the gradient by `means2D` sums absolute values."""

    def _render(self, inputs: Inputs) -> tuple[Tensor, ...]:
        _require_no_offset(self.raster_settings)
        four = _Padded.apply(inputs.means2d)  # type: ignore[no-untyped-call]  # torch's
        return super()._render(inputs._replace(means2d=four))


_State = tuple[int, int]
_arriving: deque[tuple[ArrivingNumber, weakref.ref[Tensor], _State]] = deque()
"""Whether pixels were moved in calls on a GPU, on its way to the processor; their offsets, and the state of these."""
_zeros: dict[int, tuple[weakref.ref[Tensor], _State]] = {}
"""Offsets that are zero, by their `id`, with their state then. Many calls have the same ones."""


def _require_no_offset(settings: Any) -> None:
    """Refuse pixels that are moved; on a GPU a few calls later, because asking it at once would wait for it."""
    offset: Tensor = settings.subpixel_offset
    state = (0, 0) if offset.is_inference() else state_of(offset)
    known = _zeros.get(id(offset))
    if known is None or known[0]() is not offset or known[1] != state:
        _arriving.append((ArrivingNumber.of(offset.any()), weakref.ref(offset), state))
    moved = 0
    while _arriving and _arriving[0][0].has_arrived():
        number, asked, state = _arriving.popleft()
        moved |= number.read()
        if not moved and (zeros := asked()) is not None and not zeros.is_inference():
            _note_zeros(zeros, state)
    if moved:
        raise UserInputError(
            "our version of Mip-Splatting's rasterizer has no subpixel_offset, expected all zeros; leave out "
            "--ray_jitter, or train with its own CUDA extension"
        )


def _note_zeros(offset: Tensor, state: _State) -> None:
    key = id(offset)
    _zeros[key] = weakref.ref(offset, lambda _: _zeros.pop(key, None)), state


class _Padded(torch.autograd.Function):
    """Map (n, 3) to (n, 4) of which only the gradient is used; its last two columns are added up."""

    @staticmethod
    def forward(ctx: Any, points: Tensor) -> Tensor:
        return points.new_empty(len(points), 4)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return torch.cat([gradient[:, :2], gradient[:, 2:].sum(1, keepdim=True)], 1)


class PixelGS(WholeSh):
    """Scale the gradient by `means2D` by the square of depth over `depth_threshold`, where that is less than 1."""

    def _render(self, inputs: Inputs) -> tuple[Tensor, ...]:
        settings = self.raster_settings
        points = inputs.means2d
        if settings.depth_threshold is not None and points.requires_grad:
            depths = depths_of(inputs.means.detach(), settings.viewmatrix)
            factors = (depths / settings.depth_threshold).square().clamp(max=1)[:, None]
            points = _Scaled.apply(points, factors)  # type: ignore[no-untyped-call]  # torch's
        return super()._render(inputs._replace(means2d=points))


class WithDepths(WholeSh):
    """Return image, radii, and camera-space depth and alpha (1, h, w), which are blended as colours, over black."""

    def _render(self, inputs: Inputs) -> tuple[Tensor, ...]:
        output = rasterize(self.raster_settings, inputs, Options())
        depth, alpha = _depth_and_alpha(self.raster_settings, inputs)
        return output.image, output.radii, depth, alpha


class DepthsBeforeRadii(WithDepths):
    """Return the same in another order: image, depth, alpha, radii."""

    def _render(self, inputs: Inputs) -> tuple[Tensor, ...]:
        image, radii, depth, alpha = super()._render(inputs)
        return image, depth, alpha, radii


class Confident(WithDepths):
    """Scale the gradients of each Gaussian by `confidence` (n, 1), but for that by `means2D`.

    The third column of that gradient sums absolute values, as in one of the CUDA modules with this setting.
    """

    def _render(self, inputs: Inputs) -> tuple[Tensor, ...]:
        confidence = self.raster_settings.confidence.detach()
        scaled = (None if t is None else _Scaled.apply(t, confidence) for t in inputs)  # type: ignore[no-untyped-call]  # torch's
        four = _Padded.apply(inputs.means2d)  # type: ignore[no-untyped-call]  # torch's
        return super()._render(Inputs._make(scaled)._replace(means2d=four))


class _Scaled(torch.autograd.Function):
    """Pass a tensor (n, ...) through; its gradient is multiplied by factors (n, 1), or (1, 1) for all."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, factors: Tensor) -> Tensor:
        ctx.save_for_backward(factors)
        return tensor.view_as(tensor)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (factors,) = ctx.saved_tensors
        return gradient * factors.reshape(-1, *(1,) * (gradient.ndim - 1)), None


def _depth_and_alpha(settings: Any, inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Return camera-space depth and alpha (1, h, w) each, blended over black, with gradients by all of `inputs`."""
    depths = depths_of(inputs.means, settings.viewmatrix)
    colors = torch.stack([depths, torch.ones_like(depths), torch.zeros_like(depths)], 1)
    image = _blended_over_black(settings, inputs, colors)
    return image[:1], image[1:2]


def _blended_over_black(settings: Any, inputs: Inputs, colors: Tensor) -> Tensor:
    """Return values (n, 3) blended as colours, (3, h, w)."""
    black = settings._replace(bg=torch.zeros_like(settings.bg))
    return rasterize(black, inputs._replace(dc=None, sh=None, colors=colors), Options()).image


class EfficientGS(Rasterizer):
    """Return image, radii and six tensors, of which those that the options ask for here are filled.

    They are: whether a Gaussian is among the `top_k` largest shares of a pixel (n,) int32, three that are empty,
    sums of pixel losses times shares (n,), and two that are empty.
    """

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        gt_image: Tensor | None,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        top_k: int = 1,
        pix_loss: Tensor | None = None,
        sparse_shs_degree: Tensor | None = None,
        extract_gs_info: bool = False,
        reg_loss_k: int = -1,
        in_gs_info: Tensor | None = None,
        extract_gs_rays_num: bool = False,
        max_gs_num: int = -1,
        gs_radius: float = 3.0,
    ) -> tuple[Tensor, ...]:
        if extract_gs_info or reg_loss_k >= 0 or extract_gs_rays_num or max_gs_num > 0 or gs_radius != 3:
            raise UserInputError(
                "our version of EfficientGS's rasterizer has no regularisation, rays or other radius; leave these "
                "options out, or train with its own CUDA extension"
            )
        settings = self.raster_settings
        if settings.use_train_speedup:
            raise UserInputError("our version of EfficientGS's rasterizer has no --use_train_speedup; leave it out")
        if shs is not None and sparse_shs_degree is not None and len(sparse_shs_degree):
            if isinstance(shs, ShParts):
                shs = shs.whole
            degrees = torch.arange(shs.shape[1], device=shs.device).sqrt().floor()  # of each coefficient
            shs = shs * (degrees <= sparse_shs_degree[:, None])[:, :, None]
        inputs = gather(means3D, means2D, opacities, None, shs, colors_precomp, scales, rotations, cov3D_precomp)
        output = rasterize(settings, inputs, Options(blending=top_k > 0 or pix_loss is not None))
        empty = means3D.new_empty(0)
        largest, losses = torch.zeros_like(output.radii), empty
        if output.blending is not None and top_k > 0:
            largest = (_times_named(output.blending.leaders(top_k), len(means3D)) > 0).int()
        if output.blending is not None and pix_loss is not None:
            if pix_loss.shape[-2:] != output.image.shape[-2:]:
                shape, expected = tuple(pix_loss.shape), tuple(output.image.shape)
                raise UserInputError(f"pix_loss is {shape}: expected {expected}, of the image that is rendered")
            losses = output.blending.weighted_shares(pix_loss.detach().sum(0).reshape(-1))
        image = output.image.permute(1, 2, 0) if settings.use_hwc else output.image
        return image, output.radii, largest, empty, empty, losses, empty, empty


class Surfels(WholeSh):
    """Render 2DGS's surfels as very flat Gaussians; return image, radii, and seven maps (7, h, w).

    The maps are depth times alpha, alpha, normals times alpha, depth, distortion.

    DEPARTURE: rays are not intersected with surfels, the second depth is the first over alpha, distortion is zero.
    """

    def _render(self, inputs: Inputs) -> tuple[Tensor, ...]:
        settings = self.raster_settings
        assert inputs.scales is not None, "2DGS without precomputed transformations"
        assert inputs.quats is not None
        rotations = rotation_matrices(inputs.quats)
        third = inputs.scales.detach().max(1, keepdim=True).values * THIN
        inputs = inputs._replace(scales=torch.cat([inputs.scales, third], 1))
        output = rasterize(settings, inputs, Options())
        normals = rotations[:, :, 2] @ settings.viewmatrix[:3, :3]
        centres = inputs.means @ settings.viewmatrix[:3, :3] + settings.viewmatrix[3, :3]
        normals = torch.where((normals * centres).sum(1, keepdim=True) > 0, -normals, normals)
        unmoved = inputs._replace(means2d=torch.zeros_like(inputs.means2d))
        depth, alpha = _depth_and_alpha(settings, unmoved)
        middle = (depth / alpha.clamp_min(1e-6)).detach()
        maps = torch.cat(
            [depth, alpha, _blended_over_black(settings, unmoved, normals), middle, torch.zeros_like(depth)]
        )
        if maps.requires_grad:
            # Where nothing is blended, checkouts divide by an alpha of zero; the CUDA code reads no gradient there.
            maps.register_hook(torch.nan_to_num)  # type: ignore[no-untyped-call]  # torch's
        return output.image, output.radii, maps


def compute_relocation(
    opacity: Tensor, scale: Tensor, copies: Tensor, binoms: Tensor, n_max: int
) -> tuple[Tensor, Tensor]:
    """Return opacity (n,) and scale (n, 3) of copies that together look like one Gaussian.

    See equation 9 of "3D Gaussian Splatting as Markov Chain Monte Carlo". `binoms` (n_max, n_max) are the binomial
    coefficients.
    """
    new = 1 - (1 - opacity) ** (1 / copies)
    powers = torch.arange(n_max, device=opacity.device)
    signs = (-1.0) ** powers / (powers + 1.0).sqrt()
    terms = signs * new.reshape(-1, 1) ** (powers + 1)  # (n, n_max) by k
    sums = terms @ binoms.T  # (n, n_max) by i - 1; binoms[i, k] is 0 for k > i
    total = (sums * (powers < copies.reshape(-1, 1))).sum(1).reshape(opacity.shape)
    return new, (opacity / total).reshape(-1, 1) * scale


class RasterizerSettings(NamedTuple):
    """Declare the settings of Faster-GS: matrices by rows, the number of SH coefficients instead of the degree."""

    w2c: Tensor
    cam_position: Tensor
    bg_color: Tensor
    active_sh_bases: int
    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    near_plane: float
    far_plane: float
    proper_antialiasing: bool


def diff_rasterize(
    means: Tensor,
    scales: Tensor,
    rotations: Tensor,
    opacities: Tensor,
    sh_coefficients_0: Tensor,
    sh_coefficients_rest: Tensor,
    densification_info: Tensor,
    rasterizer_settings: RasterizerSettings,
) -> Tensor:
    """Return the image (3, h, w) of raw parameters, and add visits and screen gradients to `densification_info`.

    Args:
        scales: (n, 3) logarithms.
        opacities: (n, 1) logits.
        densification_info: (2, n), changed by the backward pass.
    """
    camera = rasterizer_settings
    tan_x, tan_y = camera.width / (2 * camera.focal_x), camera.height / (2 * camera.focal_y)
    projection = _matrix(
        means.device,
        (1 / tan_x, 0.0, 2 * camera.center_x / camera.width - 1, 0.0),
        (0.0, 1 / tan_y, 2 * camera.center_y / camera.height - 1, 0.0),
        (0.0, 0.0, 1.0, -camera.near_plane),
        (0.0, 0.0, 1.0, 0.0),
    )
    last = _matrix(means.device, (0.0, 0.0, 0.0, 1.0))
    pose = camera.w2c if len(camera.w2c) == 4 else torch.cat([camera.w2c, last])
    settings: Any = SimpleNamespace(
        image_height=camera.height, image_width=camera.width, tanfovx=tan_x, tanfovy=tan_y, bg=camera.bg_color,
        scale_modifier=1.0, viewmatrix=pose.T, projmatrix=(projection @ pose).T,
        sh_degree=math.isqrt(camera.active_sh_bases) - 1, campos=camera.cam_position,
    )  # fmt: skip
    points = torch.zeros_like(means, requires_grad=True)
    inputs = Inputs(
        means, points, opacities.sigmoid(), sh_coefficients_0, sh_coefficients_rest, None, scales.exp(),
        normalize(rotations), None,
    )  # fmt: skip
    output = rasterize(settings, inputs, Options(antialiasing=camera.proper_antialiasing))
    image, radii = output.image, output.radii

    def note(gradient: Tensor) -> None:  # without the image, whose graph has the points and so this hook
        if len(densification_info):
            densification_info[0] += radii > 0
            densification_info[1] += gradient[:, :2].norm(dim=1)

    if points.requires_grad and image.requires_grad:
        points.register_hook(note)  # type: ignore[no-untyped-call]  # torch's
    return image


@lru_cache(maxsize=64)
def _matrix(device: torch.device, *rows: tuple[float, ...]) -> Tensor:
    """Return a matrix on a device, copied there once: a GPU is waited for at every copy."""
    return torch.tensor(rows, device=device)


class FusedAdam(torch.optim.Adam):
    """Step as torch.optim.Adam does, with the arguments of Faster-GS."""

    def __init__(self, params: Any, lr: float, eps: float) -> None:
        super().__init__(params=params, lr=lr, eps=eps)
