"""gsplat's CUDA rasterizer behind the one interface `fields.rasterizer.Rasterizer`.

gsplat passes colours through as they are, so signed colour needs nothing from it: SH are evaluated by its own kernel,
and nothing is added or clamped. Ordinary colour is evaluated here, too: where gsplat does it, it inverts the camera's
pose, and PyTorch waits for the GPU to learn whether that worked.

A call waits for the GPU once, inside of gsplat, which asks how many pairs of Gaussian and tile there are; a packed one
also asks how many Gaussians are visible.
"""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.environment import gsplat_built
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack, RenderResult, Semantics
from lapgs_plugin.rasterizers import gsplat_direct
from lapgs_plugin.reference_raster.oracle import MIN_ROOT, NEAR_DEPTH, PIXEL_VARIANCE, RADIUS_SIGMAS

NAME = "gsplat"

LIMIT = "the limit of the projection's Jacobian is another, or its gradient is"
SEMANTICS = Semantics(
    three_sigma_cut=False,
    expanded_conic_gradient=True,
    rebuilt_transmittance=True,
    departures={
        "saturated": "alpha is capped at 0.999, without a gradient there",
        **dict.fromkeys(("off_centre", "outside_frustum", "same_plane"), LIMIT),
    },
    note="alpha is capped at 0.999 instead of 0.99, and where it is, there is no gradient by opacity and position; the "
    "Jacobian's limit counts from the border of the image instead of 1.3 half sides from its centre, which differs for "
    "principal points off the centre, and beyond it depth has another gradient; footprints end where alpha = 1/255 "
    "instead of at three sigma; a depth of exactly 0.2 is not culled; gradients of needles are right to a few "
    "thousandths, and by way of pixels that are nearly opaque to 3e-4",
)


def missing() -> str:
    """Why gsplat cannot render on this machine, as a clause; empty where it can. Imports and compiles nothing."""
    if not torch.cuda.is_available():
        return "PyTorch sees no CUDA device"
    built = gsplat_built()
    if built is None:
        return "gsplat is not installed"
    from torch.utils.cpp_extension import CUDA_HOME

    return "" if built or CUDA_HOME else "gsplat's CUDA part is not built, and there is no nvcc to build it"


class GsplatRasterizer:
    """`gsplat.rasterization` with the conventions of the 3DGS family; float32 fields on a CUDA device.

    Where it is not built yet, gsplat compiles its CUDA part with the first call, for some minutes.

    Args:
        device: where it renders; what takes gsplat's place on a CPU renders there.
        antialiasing: dim Gaussians that are smaller than a pixel, as graphdeco's option of that name does.
        packed: keep what is computed of visible Gaussians alone: less memory, a little slower.
        absgrad: offer `RenderResult.absgrad2d`, which costs a little of the backward pass.
        own_radii: let `RenderResult.radii` be gsplat's, which bound where alpha reaches 1/255, instead of computing
            those of three sigma; training looks at which are above 0 alone.
        direct: call gsplat's kernels directly, which takes half of the launches (`gsplat_direct`). None: where that is
            found to be right. Not while packing or antialiasing.

    Raises:
        MissingExtraError: gsplat cannot render on this machine.
    """

    def __init__(
        self,
        device: torch.device | str = "cuda",
        *,
        antialiasing: bool = False,
        packed: bool = False,
        absgrad: bool = True,
        own_radii: bool = False,
        direct: bool | None = None,
    ) -> None:
        self._device = torch.device(device)
        if self._device.type == "cuda" and (reason := missing()):
            raise MissingExtraError(f"--rasterizer {NAME}: {reason}; `lapgs doctor` says what to install")
        self._mode = "antialiased" if antialiasing else "classic"
        self._packed, self._absgrad, self._own_radii = packed, absgrad, own_radii
        self._may_be_direct = self._device.type == "cuda" and not (packed or antialiasing) and direct is not False
        self._must_be_direct = bool(direct)
        self._shots = _Shots()

    @property
    def name(self) -> str:
        return NAME

    @property
    def semantics(self) -> Semantics:
        """Where it departs from the oracle."""
        return SEMANTICS

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`; see `fields.rasterizer.Rasterizer`.

        Raises:
            UserInputError: the field is not float32 on `device`.
        """
        means = field.means
        if means.device.type != self._device.type or means.dtype != torch.float32:
            raise UserInputError(
                f"means is {means.dtype} on {means.device}, expected float32 on {self._device}; use .to()"
            )
        n, width, height = len(field), camera.width, camera.height
        differentiated = torch.is_grad_enabled() and any(value.requires_grad for value in field.parameters.values())
        degree = field.sh_degree if sh_degree is None else sh_degree
        if n and self._direct:
            return self._call_directly(field, camera, background, degree, differentiated)
        means2d = means.new_zeros(n, 2).requires_grad_(differentiated)  # (n, 2)
        absgrad2d = means.new_zeros(n, 2) if differentiated and self._absgrad else None
        if n == 0:
            # Zero, and in the graph: a loss of the image can be differentiated by everything that is not there.
            nothing = torch.cat([value.flatten() for value in (means2d, *field.parameters.values())]).sum()
            image = (background.to(means) + nothing)[:, None, None].expand(3, height, width)
            return RenderResult(
                image, means.new_ones(height, width), torch.zeros(0, dtype=torch.int32, device=means.device), means2d
            )
        images, alphas, found = self._rasterize(field, [camera], background, degree, absgrad2d is not None)
        if differentiated:
            _hand_over_gradients(found, means2d, absgrad2d)
        with torch.no_grad():
            radii = self._describe(found, means2d)
        return RenderResult(_planes(images), 1 - alphas[0, ..., 0], radii, means2d, absgrad2d)

    @property
    def can_batch(self) -> bool:
        """See `fields.rasterizer.BatchRasterizer`. What is packed has no row for each camera and Gaussian."""
        return self._device.type == "cuda" and not self._packed

    def render_batch(
        self,
        field: GaussianField,
        cameras: Sequence[Camera],
        *,
        background: Tensor,
        sh_degree: int | None = None,
        describes: bool = True,
    ) -> RenderResult:
        """Several cameras in one set of launches; see `lapgs_plugin.fields.rasterizer.BatchRasterizer`."""
        n, means, camera = len(field), field.means, cameras[0]
        degree = field.sh_degree if sh_degree is None else sh_degree
        differentiated = torch.is_grad_enabled() and any(value.requires_grad for value in field.parameters.values())
        absgrad = describes and differentiated and self._absgrad
        if n and self._direct:
            shot = self._shots.of_several(cameras, means)
            image, seen, listeners = gsplat_direct.render(
                field, shot, background.to(means), degree, describes=describes, absgrad=absgrad
            )
            if not describes:
                return RenderResult(image, None, seen.shown_radii, seen.centres)
            return self._described(image, seen, listeners, differentiated, absgrad)
        means2d = means.new_zeros(len(cameras), n, 2).requires_grad_(differentiated)
        absgrad2d = torch.zeros_like(means2d, requires_grad=False) if absgrad else None
        if n == 0:
            nothing = torch.cat([value.flatten() for value in (means2d, *field.parameters.values())]).sum()
            image = (background.to(means) + nothing)[:, None, None].expand(len(cameras), 3, camera.height, camera.width)
            return RenderResult(image, None, means2d.detach()[..., 0].int(), means2d, absgrad2d)
        images, _, info = self._rasterize(field, cameras, background, degree, absgrad)
        image = images.permute(0, 3, 1, 2).contiguous()
        if not describes:
            return RenderResult(image, None, means2d.detach()[:, :0, 0].int(), means2d.detach()[:, :0])
        if differentiated:
            _hand_over_gradients(info, means2d, absgrad2d)
        with torch.no_grad():
            radii = self._describe(info, means2d)
        return RenderResult(image, None, radii, means2d, absgrad2d)

    def render_image(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> Tensor:
        """The image alone, with gradients; see `fields.rasterizer.PlainRasterizer`.

        A dozen operations fewer than a call: radii, centres and transmittance.
        """
        if len(field) == 0:
            return self(field, camera, background=background, sh_degree=sh_degree).image
        degree = field.sh_degree if sh_degree is None else sh_degree
        if self._direct:
            shot = self._shots.of(camera, field.means)
            return gsplat_direct.render(field, shot, background.to(field.means), degree, describes=False)[0]
        return _planes(self._rasterize(field, [camera], background, degree, absgrad=False)[0])

    @torch.no_grad()
    def render_images(self, field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        """Images alone, of several cameras at once; see `fields.rasterizer.ImageRasterizer`."""
        if len(field) == 0:
            shape = len(cameras), 3, cameras[0].height, cameras[0].width
            return background.to(field.means)[:, None, None].expand(shape)
        if self._direct and len(cameras) == 1:
            return self.render_image(field, cameras[0], background=background)[None]
        images, _, _ = self._rasterize(field, cameras, background, field.sh_degree, absgrad=False)
        return images.permute(0, 3, 1, 2)

    @property
    def can_stack(self) -> bool:
        """See `fields.rasterizer.StackingRasterizer`. Parts of gsplat's are called, which are those of 1.5.3."""
        from gsplat import spherical_harmonics

        return self._device.type == "cuda" and not self._packed and not _takes_cameras(spherical_harmonics)

    def stack(self, fields: Sequence[GaussianField]) -> FieldStack:
        """Several fields, to be rendered together; see `fields.rasterizer.StackingRasterizer`."""
        from lapgs_plugin.rasterizers.gsplat_stack import GsplatStack

        return GsplatStack(fields, self._device, antialiased=self._mode == "antialiased")

    @property
    def _direct(self) -> bool:
        return self._may_be_direct and (self._must_be_direct or gsplat_direct.works())

    def _call_directly(
        self, field: GaussianField, camera: Camera, background: Tensor, degree: int, differentiated: bool
    ) -> RenderResult:
        absgrad, shot = differentiated and self._absgrad, self._shots.of(camera, field.means)
        image, seen, listeners = gsplat_direct.render(
            field, shot, background.to(field.means), degree, describes=True, absgrad=absgrad
        )
        one = seen._replace(shown_radii=seen.shown_radii[0], centres=seen.centres[0], conics=seen.conics[0])
        return self._described(image, one, listeners, differentiated, absgrad)

    def _described(
        self,
        image: Tensor,
        seen: gsplat_direct.Seen,
        listeners: gsplat_direct.Listeners,
        differentiated: bool,
        absgrad: bool,
    ) -> RenderResult:
        """What was seen as a result that the backward pass will leave its gradients in."""
        with torch.no_grad():
            radii = seen.shown_radii
            if not self._own_radii:
                radii = torch.where(radii > 0, _three_sigma_radii(seen.conics), 0).to(torch.int32)
        means2d = seen.centres.requires_grad_(differentiated)
        absgrad2d = means2d.new_zeros(means2d.shape) if absgrad else None
        listeners += [weakref.ref(tensor) for tensor in (means2d, absgrad2d) if tensor is not None]
        return RenderResult(image, None, radii, means2d, absgrad2d)

    def _rasterize(
        self, field: GaussianField, cameras: Sequence[Camera], background: Tensor, degree: int, absgrad: bool
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Images (b, h, w, 3), opacities (b, h, w, 1) and what gsplat found on the way; cameras of one size."""
        from gsplat import rasterization

        means = field.means
        viewmats, intrinsics, positions = cameras_on_device(cameras, means)
        colors = _harmonics(field, degree, viewmats, positions)
        if not field.signed:
            colors = torch.clamp_min(colors + 0.5, 0.0)
        found: tuple[Tensor, Tensor, dict[str, Any]] = rasterization(
            means,
            field.quaternions,
            torch.exp(field.log_scales),
            torch.sigmoid(field.opacity_logits),
            colors,
            viewmats,
            intrinsics,
            cameras[0].width,
            cameras[0].height,
            near_plane=NEAR_DEPTH,
            eps2d=PIXEL_VARIANCE,
            radius_clip=0.0,
            packed=self._packed,
            # 1.5.3 refuses every background where it packs.
            backgrounds=None if self._packed else background.to(means).expand(len(cameras), 3),
            rasterize_mode=self._mode,
            absgrad=absgrad,
        )
        images, alphas, info = found
        return images + (1 - alphas) * background.to(means) if self._packed else images, alphas, info

    def _describe(self, found: dict[str, Any], means2d: Tensor) -> Tensor:
        """Fill in `means2d` (n, 2) and return the radii (n,) from what gsplat found; of several cameras (b, n, ...)."""
        rows = found["gaussian_ids"] if self._packed else slice(None)

        def of(name: str) -> Tensor:
            values: Tensor = found[name]
            return values if self._packed or means2d.ndim == 3 else values[0]  # (v, ...)

        theirs = of("radii")  # (v, 2)
        shown = (theirs > 0).all(-1)  # (v,)
        # What gsplat leaves for culled Gaussians is memory as it was; its pixels have their centre at 0.5.
        means2d[rows] = torch.where(shown[..., None], of("means2d") - 0.5, 0.0)
        found_radii = theirs.amax(-1) if self._own_radii else _three_sigma_radii(of("conics"))
        radii = torch.zeros(means2d.shape[:-1], dtype=torch.int32, device=means2d.device)  # (n,)
        radii[rows] = torch.where(shown, found_radii, 0).to(torch.int32)
        return radii


def _planes(images: Tensor) -> Tensor:
    """The one of (1, h, w, 3) as (3, h, w).

    What follows in training reads it plane by plane beside others that lie so: turned once instead of in each.
    """
    return images[0].permute(2, 0, 1).contiguous()


def _harmonics(field: GaussianField, degree: int, viewmats: Tensor, positions: Tensor) -> Tensor:
    """The raw SH values from each camera: (n, 3) for one, (b, n, 3) for several."""
    from gsplat import spherical_harmonics

    if _takes_cameras(spherical_harmonics):
        values: Tensor = spherical_harmonics(degree, field.means, viewmats, field.sh)  # (b, n, 3)
        return values
    each = [spherical_harmonics(degree, field.means - position, field.sh) for position in positions]  # (n, 3)
    return each[0] if len(each) == 1 else torch.stack(each)


@lru_cache(maxsize=4)
def _takes_cameras(spherical_harmonics: Callable[..., Tensor]) -> bool:
    """Whether it is gsplat's from 1.6.0 on, which wants means and poses where earlier ones want directions."""
    return "viewmats" in inspect.signature(spherical_harmonics).parameters


class _Shots:
    """Cameras as a GPU wants them, sent there once: a training view comes back some hundred times."""

    def __init__(self) -> None:
        self._sent: dict[int, tuple[weakref.ref[Camera], gsplat_direct.Shot]] = {}

    def of(self, camera: Camera, like: Tensor) -> gsplat_direct.Shot:
        """The camera beside `like`."""
        known, shot = self._sent.get(id(camera), (None, None))
        if known is None or shot is None or known() is not camera or shot.pose.device != like.device:
            poses, intrinsics, centres = cameras_on_device([camera], like)
            intrinsics, poses = intrinsics.contiguous(), poses.contiguous()
            shot = gsplat_direct.Shot(poses, intrinsics, centres.contiguous(), camera.width, camera.height)
            place, sent = id(camera), self._sent
            sent[place] = (weakref.ref(camera, lambda _: sent.pop(place, None)), shot)
        return shot

    def of_several(self, cameras: Sequence[Camera], like: Tensor) -> gsplat_direct.Shot:
        """Cameras of one size beside `like`, put together in one launch."""
        shots, count = [self.of(camera, like) for camera in cameras], len(cameras)
        # Centres first: Triton compiles anew for what does not begin at a multiple of 16 bytes.
        parts = [getattr(shot, kind).view(-1) for kind in ("centre", "pose", "intrinsics") for shot in shots]
        numbers = torch.cat(parts)
        centres, poses, intrinsics = numbers[: 3 * count], numbers[3 * count : 19 * count], numbers[19 * count :]
        return gsplat_direct.Shot(
            poses.view(-1, 4, 4), intrinsics.view(-1, 3, 3), centres.view(-1, 3), shots[0].width, shots[0].height
        )


def cameras_on_device(cameras: Sequence[Camera], like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (b, 4, 4), intrinsics (b, 3, 3) and centres (b, 3) beside `like`, without waiting for its GPU."""
    poses = [camera.world_to_camera for camera in cameras]
    elsewhere = any(pose.device.type != "cpu" for pose in poses)
    # Python's numbers in one tensor: each small tensor costs some microseconds of every frame.
    rows = [[c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0] for c in cameras]
    if not elsewhere:
        rows = [[*row, *_pose_numbers(pose)] for row, pose in zip(rows, poses, strict=True)]
    # From page-locked memory, since a copy from any other is waited for.
    numbers = torch.tensor(rows, dtype=like.dtype, pin_memory=like.device.type == "cuda")
    numbers = numbers.to(like.device, non_blocking=True)  # (b, 28) or (b, 9)
    intrinsics = numbers[:, :9].reshape(-1, 3, 3)
    if elsewhere:
        return torch.stack(poses).to(like), intrinsics, torch.stack([camera.position for camera in cameras]).to(like)
    return numbers[:, 9:25].reshape(-1, 4, 4), intrinsics, numbers[:, 25:]


def _pose_numbers(pose: Tensor) -> list[float]:
    """The 16 numbers of a pose on the CPU, row by row, and the 3 of the camera's centre, -R^T t."""
    rows: list[list[float]] = pose.tolist()
    centre = [-sum(rows[j][i] * rows[j][3] for j in range(3)) for i in range(3)]
    return [*rows[0], *rows[1], *rows[2], *rows[3], *centre]


def _hand_over_gradients(found: dict[str, Any], means2d: Tensor, absgrad2d: Tensor | None) -> None:
    """Let the backward pass leave what it finds for gsplat's centres, (b, n, 2) or packed (v, 2), in ours."""
    theirs: Any = found["means2d"]
    ids: Tensor | None = found["gaussian_ids"] if theirs.ndim == 2 else None  # (v,)
    # The backward pass leaves absolute gradients with the tensor that gsplat made, which has to live as long as ours.
    ours: Any = means2d
    ours.found = theirs
    # A hook that held one of them would hold itself, and with it everything that a backward pass needs: on bonsai
    # 93 GB had gathered before Python looked for such circles.
    weak_theirs, weak_ours = weakref.ref(theirs), weakref.ref(means2d)

    def hand_over(gradient: Tensor) -> None:
        centres, held = weak_theirs(), weak_ours()
        if centres is None or held is None:
            return  # nobody has kept what they would be handed to

        def unpacked(values: Tensor) -> Tensor:
            if ids is None:
                return values.reshape(held.shape)
            return torch.zeros_like(held).index_copy_(0, ids, values)

        held.grad = unpacked(gradient).clone()
        if absgrad2d is not None:
            absgrad2d.copy_(unpacked(centres.absgrad))

    theirs.register_hook(hand_over)


def _three_sigma_radii(conics: Tensor) -> Tensor:
    """(n,) radii in whole pixels from the entries xx, xy, yy of the inverse 2D covariances, (n, 3)."""
    xx, xy, yy = conics.unbind(-1)  # (n,) each
    determinants = 1 / (xx * yy - xy * xy)  # of the covariances
    middles = 0.5 * (xx + yy) * determinants
    roots = torch.sqrt(torch.clamp_min(middles * middles - determinants, MIN_ROOT))
    return torch.ceil(RADIUS_SIGMAS * torch.sqrt(middles + roots))
