"""Render by gsplat's public function `gsplat.rasterization`."""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.lens import Lens
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.gpu_raster.cameras import cameras_on_device
from lapgs_plugin.ops.mixed_sizes import largest_size
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH, PIXEL_VARIANCE
from lapgs_plugin.reference_raster.oracle import footprint_radii
from lapgs_plugin.reference_raster.rays import watched


@dataclass(frozen=True)
class StockRasterization:
    """Render fields of at least one Gaussian.

    Attributes:
        antialiased, packed, own_radii, rays: as in `GsplatRasterizer`.
    """

    antialiased: bool = False
    packed: bool = False
    own_radii: bool = False
    rays: bool = False

    def render(
        self, field: GaussianField, cameras: Sequence[Camera], background: Tensor, degree: int, *, absgrad: bool
    ) -> RenderResult:
        """Render cameras; tensors of the result have a leading dimension for several, not for one.

        Those of several sizes are rendered as large as the largest.

        Args:
            field, cameras, background: as a rasterizer takes them.
            degree: highest SH degree to evaluate.
            absgrad: fill in `RenderResult.absgrad2d` in the backward pass.
        """
        leading, n, means = (len(cameras),) if len(cameras) > 1 else (), len(field), field.means
        differentiated = is_differentiated(field)
        by_centres = differentiated and not self.rays
        means2d = means.new_zeros(*leading, n, 2).requires_grad_(by_centres)  # (n, 2)
        absgrad2d = means.new_zeros(*leading, n, 2) if by_centres and absgrad else None
        centres = watched(means, cameras[0], means2d) if self.rays else means
        images, alphas, info = self._rasterize(field, cameras, background, degree, absgrad2d is not None, centres)
        if by_centres:
            _hand_over_gradients(info, means2d, absgrad2d)
        with torch.no_grad():
            radii = self._fill_centres(info, means2d)
        transmittance = None if leading else 1 - alphas[0, ..., 0]
        images = _channels_first(images)
        return RenderResult((images if leading else images[0]).contiguous(), transmittance, radii, means2d, absgrad2d)

    def images(self, field: GaussianField, cameras: Sequence[Camera], background: Tensor, degree: int) -> Tensor:
        """Render images alone, (b, 3, h, w), with gradients; they are not contiguous."""
        return _channels_first(self._rasterize(field, cameras, background, degree, absgrad=False)[0])

    def _rasterize(
        self,
        field: GaussianField,
        cameras: Sequence[Camera],
        background: Tensor,
        degree: int,
        absgrad: bool,
        centres: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Return images (b, h, w, 3), opacities (b, h, w, 1) and gsplat's intermediate results.

        `centres` are the field's, whose gradient is watched; colours do not depend on them.
        """
        from gsplat import rasterization

        means = field.means
        viewmats, intrinsics, positions = cameras_on_device(cameras, means)
        colors = raw_sh_values(degree, means, field.sh, viewmats, positions)  # (b, n, 3)
        if len(cameras) == 1:
            colors = colors[0]
        if not field.signed:
            colors = torch.clamp_min(colors + 0.5, 0.0)
        result: tuple[Tensor, Tensor, dict[str, Any]] = rasterization(
            means if centres is None else centres,
            field.quaternions,
            torch.exp(field.log_scales),
            torch.sigmoid(field.opacity_logits),
            colors,
            viewmats,
            intrinsics,
            *largest_size([camera.size for camera in cameras]),
            near_plane=NEAR_DEPTH,
            eps2d=PIXEL_VARIANCE,
            radius_clip=0.0,
            packed=self.packed,
            # gsplat 1.5.3 refuses backgrounds if packed.
            backgrounds=None if self.packed else background.to(means).expand(len(cameras), 3),
            rasterize_mode="antialiased" if self.antialiased else "classic",
            absgrad=absgrad,
            **(_along_rays(cameras, means) if self.rays else {}),
        )
        images, alphas, info = result
        return images + (1 - alphas) * background.to(means) if self.packed else images, alphas, info

    def _fill_centres(self, info: dict[str, Any], means2d: Tensor) -> Tensor:
        """Fill in `means2d`, (n, 2) or (b, n, 2) of several cameras, and return the radii, (n,) or (b, n)."""
        rows = info["gaussian_ids"] if self.packed else slice(None)

        def of(name: str) -> Tensor:
            values: Tensor = info[name]
            return values if self.packed or means2d.ndim == 3 else values[0]  # (v, ...)

        radii = of("radii")  # (v, 2)
        visible = (radii > 0).all(-1)  # (v,)
        # gsplat leaves culled Gaussians uninitialized; its pixels have their centre at 0.5.
        means2d[rows] = torch.where(visible[..., None], of("means2d") - 0.5, 0.0)
        sizes = radii.amax(-1) if self.own_radii else three_sigma_radii(of("conics"))
        filled = torch.zeros(means2d.shape[:-1], dtype=torch.int32, device=means2d.device)  # (n,)
        filled[rows] = torch.where(visible, sizes, 0).to(torch.int32)
        return filled


def _along_rays(cameras: Sequence[Camera], like: Tensor) -> dict[str, Any]:
    """Return the arguments by which gsplat evaluates Gaussians along the rays of cameras, whose lenses are of a kind.

    Distortion is not differentiated, and gsplat takes it in the precision of the Gaussians.
    """
    lenses = [camera.lens or Lens() for camera in cameras]
    arguments: dict[str, Any] = {"with_ut": True, "with_eval3d": True}
    if lenses == [Lens()] * len(lenses):
        return arguments
    arguments["radial_coeffs"] = like.new_tensor([lens.radial for lens in lenses])  # (b, 6), (b, 4) of a fisheye
    if lenses[0].fisheye:
        return {**arguments, "camera_model": "fisheye"}
    return {**arguments, "tangential_coeffs": like.new_tensor([lens.tangential for lens in lenses])}  # (b, 2)


def is_differentiated(field: GaussianField) -> bool:
    """Return whether gradients by the field's parameters are recorded."""
    return torch.is_grad_enabled() and any(value.requires_grad for value in field.parameters.values())


def three_sigma_radii(conics: Tensor) -> Tensor:
    """Return radii (n,) in whole pixels from the entries xx, xy, yy of the inverse 2D covariances, (n, 3)."""
    xx, xy, yy = conics.unbind(-1)  # (n,) each
    determinants = 1 / (xx * yy - xy * xy)  # of the covariances
    return footprint_radii(xx * determinants, yy * determinants, determinants)


@lru_cache(maxsize=4)
def takes_viewmats(spherical_harmonics: Callable[..., Tensor]) -> bool:
    """Return whether this is gsplat's function of 1.6.0 and later, which takes means and poses, not directions."""
    return "viewmats" in inspect.signature(spherical_harmonics).parameters


def _channels_first(images: Tensor) -> Tensor:
    """View (b, h, w, 3) as (b, 3, h, w)."""
    return images.permute(0, 3, 1, 2)


def raw_sh_values(degree: int, means: Tensor, sh: Tensor, viewmats: Tensor, positions: Tensor) -> Tensor:
    """Return raw SH values (b, n, 3) by gsplat's `spherical_harmonics`, whichever of its signatures it has.

    Args:
        degree: highest to evaluate.
        means: (n, 3).
        sh: (n, k, 3).
        viewmats, positions: (b, 4, 4) poses of the cameras, and (b, 3) their centres.
    """
    from gsplat import spherical_harmonics

    if takes_viewmats(spherical_harmonics):
        values: Tensor = spherical_harmonics(degree, means, viewmats, sh)
        return values
    colors = [spherical_harmonics(degree, means - position, sh) for position in positions]  # (n, 3)
    return colors[0][None] if len(colors) == 1 else torch.stack(colors)


def _hand_over_gradients(info: dict[str, Any], means2d: Tensor, absgrad2d: Tensor | None) -> None:
    """Copy the backward pass's gradients by gsplat's centres, (b, n, 2) or packed (v, 2), to ours."""
    theirs: Any = info["means2d"]
    ids: Tensor | None = info["gaussian_ids"] if theirs.ndim == 2 else None  # (v,)
    # The backward pass stores absolute gradients on gsplat's tensor, which has to live as long as ours.
    ours: Any = means2d
    ours.of_gsplat = theirs
    # Weak references: a hook that held one of them would be part of a cycle with everything that the backward pass
    # needs, and a GPU's memory would fill up before Python collects cycles.
    weak_theirs, weak_ours = weakref.ref(theirs), weakref.ref(means2d)

    def hand_over(gradient: Tensor) -> None:
        centres, held = weak_theirs(), weak_ours()
        if centres is None or held is None:
            return  # the result was not kept

        def unpacked(values: Tensor) -> Tensor:
            if ids is None:
                return values.reshape(held.shape)
            return torch.zeros_like(held).index_copy_(0, ids, values)

        held.grad = unpacked(gradient).clone()
        if absgrad2d is not None:
            absgrad2d.copy_(unpacked(centres.absgrad))

    theirs.register_hook(hand_over)
