"""Time blending and its gradients on a GPU: gsplat's kernels, and ours in several shapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.bench_scene import make_scene
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rasterizers.gsplat import blend_gradients, direct
from lapgs_plugin.rasterizers.gsplat.blend_gradients import Blending, Gradients
from lapgs_plugin.rasterizers.gsplat.cameras import CameraCache

Kernel = Callable[[Blending, Tensor], Gradients]


@dataclass(frozen=True)
class BlendTime:
    """Hold the times of one kernel.

    Attributes:
        kernel: "gsplat", or the shape of ours.
        forward, backward: median milliseconds for one view; forward is gsplat's always.
        difference: of the gradients from gsplat's, relative to the largest.
    """

    kernel: str
    forward: float
    backward: float
    difference: float


def parse_shapes(text: str | None) -> dict[str, Kernel]:
    """Parse shapes such as "8x8x4x2,8x4x4x4x1", in the order of `blend_kernels.Shape`; None for the default one.

    Raises:
        UserInputError: an entry is not 4 or 5 powers of 2, or does not fill a tile's regions and a warp's threads.
    """
    from lapgs_plugin.rasterizers.gsplat import blend_kernels

    def bound(shape: blend_kernels.Shape) -> Kernel:
        def run(given: Blending, by_images: Tensor) -> Gradients:
            tensors = (*given[:4], given.offsets, given.flat, given.last, given.images, by_images)
            return blend_kernels.blend_backward(*tensors, False, shape)

        return run

    kernels = {}
    for entry in (text or "x".join(map(str, blend_kernels.SHAPE))).split(","):
        numbers = [int(number) if number.isdigit() else 0 for number in entry.strip().split("x")]
        if not 4 <= len(numbers) <= 5 or any(number < 1 or number & (number - 1) for number in numbers):
            raise UserInputError(f"--shapes {entry!r}: expected 4 or 5 powers of 2 such as 8x8x4x2")
        shape = blend_kernels.Shape(*numbers)
        if max(shape.lanes, shape.rows) > blend_kernels.TILE or shape.lanes * shape.splat_lanes != 32 * shape.warps:
            raise UserInputError(
                f"--shapes {entry!r}: expected LANESxROWSxSPLAT_LANESxSPLATS[xWARPS] with LANES and ROWS up to "
                f"{blend_kernels.TILE} and LANES times SPLAT_LANES = 32 times WARPS"
            )
        kernels[entry.strip()] = bound(shape)
    return kernels


def random_views(width: int, height: int, gaussians: int, views: int) -> tuple[GaussianField, list[Camera]]:
    """Return the random field of `lapgs bench raster`, and cameras that each see it from a little aside."""
    scene = make_scene(width, height, gaussians, torch.float32)
    cameras = []
    for view in range(views):
        pose = torch.eye(4)
        pose[0, 3] = 0.02 * view
        focal = scene.camera.fx
        cameras.append(Camera(width, height, focal, focal, width / 2, height / 2, pose))
    return scene.field, cameras


def views_around(field: GaussianField, width: int, height: int, views: int) -> list[Camera]:
    """Return cameras on a circle around the middle of a field that look at it from the median distance."""
    middle = field.means.median(0).values
    distance = float((field.means - middle).norm(dim=-1).median())
    cameras = []
    for view in range(views):
        angle = 2 * math.pi * view / views
        forward = torch.tensor([-math.sin(angle), 0.3, math.cos(angle)])
        forward = forward / forward.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward)
        right = right / right.norm()
        pose = torch.eye(4)
        pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ (middle - distance * forward)
        focal = 0.9 * max(width, height)
        cameras.append(Camera(width, height, focal, focal, width / 2, height / 2, pose))
    return cameras


@torch.no_grad()
def blended(
    field: GaussianField, cameras: Sequence[Camera], device: torch.device
) -> tuple[Blending, Callable[[], object]]:
    """Render views on a GPU; return what blending took and made, and a function that blends again."""
    from lapgs_plugin.rasterizers.gsplat.kernels import activate, visible_colors

    field = field.to(device)
    there = CameraCache().get(cameras, field.means)
    count, size = len(cameras), (there.width, there.height)
    means = field.means.contiguous()
    scales, opacities = activate(field.log_scales.contiguous(), field.opacity_logits.contiguous())
    projected = direct.project(
        means, field.quaternions.contiguous(), scales, opacities, there.poses, there.intrinsics, size
    )
    radii, means2d, _, conics = projected
    colors, _, _ = visible_colors(
        means, there.centres, field.sh.contiguous(), field.sh_degree, field.signed, radii, None
    )
    opacities = opacities.expand(count, -1).contiguous()
    background = torch.zeros(count, 3, device=device)
    images, alphas, last, offsets, flat = direct.blend(projected, colors, opacities, background, size, count)
    planes = images.permute(0, 3, 1, 2).contiguous()
    given = Blending(means2d, conics, colors, opacities, background, offsets, flat, alphas, last, planes)
    forward = direct.compiled_functions().rasterize_to_pixels_3dgs_fwd
    tensors = means2d, conics, colors, opacities, background, None, *size, direct.TILE, offsets, flat
    return given, lambda: forward(*tensors)


def run_case(
    field: GaussianField, cameras: Sequence[Camera], repeats: int, shapes: str | None, device: torch.device
) -> Iterator[BlendTime]:
    """Time all kernels for some views of a field, in turns."""
    given, forward = blended(field, cameras, device)
    by_images = torch.randn(given.images.shape, generator=torch.Generator().manual_seed(0)).to(device)
    kernels: dict[str, Kernel] = {"gsplat": partial(blend_gradients.by_gsplat, absolute=False), **parse_shapes(shapes)}
    expected = kernels["gsplat"](given, by_images)[1:]
    differences = {}
    for name, kernel in kernels.items():
        pairs = zip(kernel(given, by_images)[1:], expected, strict=True)
        differences[name] = max(float((one - other).abs().max() / other.abs().max()) for one, other in pairs)
    found: dict[str, list[float]] = {name: [] for name in kernels}
    forwards = []
    for _ in range(repeats):
        forwards.append(_milliseconds(forward))
        for name, kernel in kernels.items():
            found[name].append(_milliseconds(partial(kernel, given, by_images)))
    count = len(cameras)
    for name, each in found.items():
        yield BlendTime(name, median(forwards) / count, median(each) / count, differences[name])


def _milliseconds(run: Callable[[], object], calls: int = 5) -> float:
    """Return the GPU's time for one of several calls in a row."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]  # torch's
    start.record()
    for _ in range(calls):
        run()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end)) / calls
