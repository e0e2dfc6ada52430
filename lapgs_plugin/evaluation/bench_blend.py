"""Time blending and its gradients on a GPU: gsplat's kernels, and ours in several shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.bench_scene import make_scene
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rasterizers.gsplat import blend_gradients, direct
from lapgs_plugin.rasterizers.gsplat.blend_gradients import Blended, Gradients, ToBlend
from lapgs_plugin.rasterizers.gsplat.cameras import CameraCache
from lapgs_plugin.rendering.rig import looking, unit

if TYPE_CHECKING:
    from lapgs_plugin.rasterizers.gsplat.blend_kernels import Shape


@dataclass(frozen=True)
class BlendTime:
    """Hold the times of one pair of kernels.

    Attributes:
        kernels: "gsplat", or the shape of ours.
        forward, backward: median milliseconds for one view.
        difference: of images and gradients from gsplat's, relative to the largest.
    """

    kernels: str
    forward: float
    backward: float
    difference: float


class Kernels(NamedTuple):
    """Blend with `forward`, and return the gradients with `backward`."""

    forward: Callable[[], Blended]
    backward: Callable[[Blended, Tensor], Gradients]


def parse_shapes(text: str | None) -> dict[str, Shape]:
    """Parse shapes such as "4x2,8x1", in the order of `blend_kernels.Shape`; None for the default one.

    Raises:
        UserInputError: an entry is not one or two powers of 2, or has too many rows or Gaussians, or too few rows.
    """
    from lapgs_plugin.rasterizers.gsplat import bindings, blend_kernels

    if text is None:
        text = "x".join(map(str, blend_kernels.SHAPE))
    shapes = {}
    for entry in text.split(","):
        numbers = [int(number) if number.isdecimal() else 0 for number in entry.strip().split("x")]
        if not 1 <= len(numbers) <= 2 or any(number < 1 or number & (number - 1) for number in numbers):
            raise UserInputError(f"--shapes {entry!r}: expected one or two powers of 2 such as 4x2")
        shape = blend_kernels.Shape(*numbers)
        if not 2 <= shape.rows <= bindings.TILE or shape.splats > 2:
            raise UserInputError(
                f"--shapes {entry!r}: expected ROWS[xSPLATS] with 2 to {bindings.TILE} ROWS and 1 or 2 SPLATS"
            )
        shapes[entry.strip()] = shape
    return shapes


def random_views(width: int, height: int, gaussians: int, views: int) -> tuple[GaussianField, list[Camera]]:
    """Return the random field of `lapgs bench raster`, and cameras that each see it from a little aside."""
    scene = make_scene(width, height, gaussians, torch.float32)
    poses = [torch.eye(4) for _ in range(views)]
    for view, pose in enumerate(poses):
        pose[0, 3] = 0.02 * view
    return scene.field, [replace(scene.camera, world_to_camera=pose) for pose in poses]


def views_around(field: GaussianField, width: int, height: int, views: int) -> list[Camera]:
    """Return cameras on a circle around the middle of a field that look at it from the median distance."""
    means = field.means.double().numpy()
    middle = np.median(means, axis=0)
    distance = float(np.median(np.linalg.norm(means - middle, axis=1)))
    focal = 0.9 * max(width, height)
    lens = Camera(width, height, focal, focal, width / 2, height / 2, torch.eye(4))
    angles = 2 * np.pi * np.arange(views) / views
    ahead = [unit(np.array([-np.sin(angle), 0.3, np.cos(angle)])) for angle in angles]
    return [looking(lens, middle - distance * each, middle, np.array([0.0, -1.0, 0.0])) for each in ahead]


@torch.no_grad()
def sorted_gaussians(field: GaussianField, cameras: Sequence[Camera]) -> ToBlend:
    """Project a field on a GPU for some views, and sort it into tiles."""
    field = field.to("cuda")
    on_device, background = CameraCache().get(cameras, field.means), torch.zeros(len(cameras), 3, device="cuda")
    found = direct.forward(
        field.means.contiguous(), field.quaternions.contiguous(), field.log_scales.contiguous(),
        field.opacity_logits.contiguous(), field.sh.contiguous(), on_device, background, field.sh_degree, field.signed,
        describes=False, ours=False,
    )  # fmt: skip
    return found.given


def contenders(given: ToBlend, size: tuple[int, int], shapes: Mapping[str, Shape]) -> dict[str, Kernels]:
    """Return gsplat's kernels, and ours in several shapes."""
    from lapgs_plugin.rasterizers.gsplat.blend_kernels import blend_backward, blend_forward

    # In training, the kernel that computes colours writes them.
    records = blend_gradients.records_of(given.means2d, given.conics, given.colors, given.opacities)

    def ours(shape: Shape) -> Kernels:
        def forward() -> Blended:
            images, *rest = blend_forward(records, given.background, given.offsets, given.flat, size, shape)
            return Blended(images, images.new_empty(0), *rest)

        def backward(blended: Blended, by_images: Tensor) -> Gradients:
            rest = given.offsets, given.flat, blended.images, blended.last, blended.words, by_images
            return blend_backward(records, *rest, False, shape)

        return Kernels(forward, backward)

    gsplat = Kernels(
        partial(blend_gradients.blend, given, size),
        partial(blend_gradients.gradients, given, absolute=False),
    )
    return {"gsplat": gsplat, **{name: ours(shape) for name, shape in shapes.items()}}


def run_case(
    field: GaussianField, cameras: Sequence[Camera], repeats: int, shapes: Mapping[str, Shape]
) -> Iterator[BlendTime]:
    """Time all kernels for some views of a field, in turns."""
    given, (width, height) = sorted_gaussians(field, cameras), (cameras[0].width, cameras[0].height)
    generator = torch.Generator().manual_seed(0)
    by_images = torch.randn(len(cameras), height, width, 3, generator=generator).cuda()
    kernels = contenders(given, (width, height), shapes)
    results = {}
    for name, one in kernels.items():
        made = one.forward()
        results[name] = made, (made.images, *one.backward(made, by_images)[1:])
    forward: dict[str, list[float]] = {name: [] for name in kernels}
    backward: dict[str, list[float]] = {name: [] for name in kernels}
    for _ in range(repeats):
        for name, one in kernels.items():
            forward[name].append(_milliseconds(one.forward))
            backward[name].append(_milliseconds(partial(one.backward, results[name][0], by_images)))
    count, expected = len(cameras), results["gsplat"][1]
    for name, (_, found) in results.items():
        pairs = zip(found, expected, strict=True)
        difference = max(float((one - other).abs().max() / other.abs().max()) for one, other in pairs)
        yield BlendTime(name, median(forward[name]) / count, median(backward[name]) / count, difference)


def _milliseconds(run: Callable[[], object], calls: int = 5) -> float:
    """Return the GPU's time for one of several calls in a row."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]  # torch's
    start.record()
    for _ in range(calls):
        run()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end)) / calls
