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

from lapgs_bench.kernels.random_scene import make_scene
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.gpu_raster.cameras import CameraCache
from lapgs_plugin.gpu_raster.records import COLOR_IN_RECORD, TILE, Parameters, grid_of
from lapgs_plugin.rasterizers.gsplat import direct
from lapgs_plugin.rendering.rig import looking, unit

if TYPE_CHECKING:
    from lapgs_plugin.gpu_raster.walk_kernels import Shape


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
    """Blend with `forward`, whose first result is images (c, h, w, 3), and return gradients with `backward`.

    It takes all results of `forward`, and a gradient by the images. `parts` makes gradients by centres, conics, colours
    and opacities of its results.
    """

    forward: Callable[[], Sequence[Tensor]]
    backward: Callable[[Sequence[Tensor], Tensor], Sequence[Tensor]]
    parts: Callable[[Sequence[Tensor]], Sequence[Tensor]]


class Sorted(NamedTuple):
    """Hold Gaussians of some views as `blend_kernels.blend_forward` takes them."""

    records: Tensor
    background: Tensor
    offsets: Tensor
    flat: Tensor


def parse_shapes(text: str | None) -> dict[str, Shape]:
    """Parse shapes such as "4x2,8x1", in the order of `walk_kernels.Shape`; None for the default one.

    Raises:
        UserInputError: an entry is not one or two powers of 2, or has too many rows or Gaussians, or too few rows.
    """
    from lapgs_plugin.gpu_raster import walk_kernels

    if text is None:
        text = "x".join(map(str, walk_kernels.SHAPE))
    shapes = {}
    for entry in text.split(","):
        numbers = [int(number) if number.isdecimal() else 0 for number in entry.strip().split("x")]
        if not 1 <= len(numbers) <= 2 or any(number < 1 or number & (number - 1) for number in numbers):
            raise UserInputError(f"--shapes {entry!r}: expected one or two powers of 2 such as 4x2")
        shape = walk_kernels.Shape(*numbers)
        if not 2 <= shape.rows <= TILE or shape.splats > 2:
            raise UserInputError(f"--shapes {entry!r}: expected ROWS[xSPLATS] with 2 to {TILE} ROWS and 1 or 2 SPLATS")
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
    return [looking(lens, middle - distance * direction, middle, np.array([0.0, -1.0, 0.0])) for direction in ahead]


@torch.no_grad()
def sorted_gaussians(field: GaussianField, cameras: Sequence[Camera]) -> Sorted:
    """Project a field on a GPU for some views, and sort it into tiles."""
    field = field.to("cuda")
    on_device, background = CameraCache().get(cameras, field.means), torch.zeros(3, device="cuda")
    seen, tiles, _ = direct.forward(
        Parameters.of(field), on_device, background, field.sh_degree, field.signed, with_geometry=False
    )
    return Sorted(seen.records, background, *tiles)


def gsplats_kernels(tiles: Sorted, size: tuple[int, int]) -> Kernels:
    """Return gsplat's, which take the numbers of a Gaussian one by one."""
    from gsplat.cuda._backend import _C as compiled

    none = tiles.records.new_zeros(len(tiles.records), size[1], size[0], 1)
    color = slice(COLOR_IN_RECORD, COLOR_IN_RECORD + 3)
    parts = [tiles.records[..., part].contiguous() for part in (slice(2), slice(2, 5), color, 5)]
    background = tiles.background.expand(len(tiles.records), -1).contiguous()
    across, down = grid_of(size)
    all_tiles = len(tiles.records) * down * across
    flat = tiles.flat[: int(tiles.offsets[all_tiles])] if len(tiles.offsets) > all_tiles else tiles.flat
    offsets = tiles.offsets[:all_tiles].view(-1, down, across)
    taken = *parts, background, None, *size, TILE, offsets, flat

    def backward(blended: Sequence[Tensor], by_images: Tensor) -> Sequence[Tensor]:
        gradients: Sequence[Tensor] = compiled.rasterize_to_pixels_3dgs_bwd(
            *taken, *blended[1:], by_images, none, False
        )
        return gradients

    return Kernels(partial(compiled.rasterize_to_pixels_3dgs_fwd, *taken), backward, lambda gradients: gradients[1:])


def our_kernels(tiles: Sorted, size: tuple[int, int], shape: Shape) -> Kernels:
    """Return ours, in one shape."""
    from lapgs_plugin.gpu_raster.blend_kernels import blend_backward, blend_forward

    def backward(blended: Sequence[Tensor], by_images: Tensor) -> Sequence[Tensor]:
        images, counts, words = blended
        rest = tiles.offsets, tiles.flat, images, counts, words, by_images
        return blend_backward(tiles.records, *rest, False, shape)

    def parts(gradients: Sequence[Tensor]) -> Sequence[Tensor]:
        first, rest = gradients
        return first[..., 4:6], torch.cat([first[..., 6:], rest[..., :1]], -1), first[..., :3], first[..., 3]

    return Kernels(partial(blend_forward, *tiles, size, len(tiles.records), shape), backward, parts)


def time_kernels(
    field: GaussianField, cameras: Sequence[Camera], repeats: int, shapes: Mapping[str, Shape]
) -> Iterator[BlendTime]:
    """Time all kernels for some views of a field, in turns."""
    tiles, (width, height) = sorted_gaussians(field, cameras), (cameras[0].width, cameras[0].height)
    generator = torch.Generator().manual_seed(0)
    by_images = torch.randn(len(cameras), height, width, 3, generator=generator).cuda()
    kernels = {"gsplat": gsplats_kernels(tiles, (width, height))}
    kernels |= {name: our_kernels(tiles, (width, height), shape) for name, shape in shapes.items()}
    results = {}
    for name, one in kernels.items():
        blended = one.forward()
        results[name] = blended, (blended[0], *one.parts(one.backward(blended, by_images)))
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in kernels}
    for name, one in [*kernels.items()] * repeats:
        back = partial(one.backward, results[name][0], by_images)
        times[name].append((_milliseconds(one.forward), _milliseconds(back)))
    count, expected = len(cameras), results["gsplat"][1]
    for name, (_, tensors) in results.items():
        pairs = zip(tensors, expected, strict=True)
        difference = max(float((one - other).abs().max() / other.abs().max()) for one, other in pairs)
        forward, backward = (median(turns) / count for turns in zip(*times[name], strict=True))
        yield BlendTime(name, forward, backward, difference)


def _milliseconds(run: Callable[[], object], calls: int = 5) -> float:
    """Return the GPU's time for one of several calls in a row."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]  # torch's
    start.record()
    for _ in range(calls):
        run()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end)) / calls
