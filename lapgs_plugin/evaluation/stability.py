"""Measure flicker along a camera path: how much frames differ besides the motion of the camera.

Each pixel of a frame is followed to the frame before by its rendered depth. Where both frames see the same surface,
their colours are compared. Detail that is fixed to its surface gives zero; detail that moves over it does not.
Residuals might flicker, because image pyramids know no surfaces. Reflections change in every method, so figures only
compare fields of one scene along one path, followed by the same depth.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.figures import require_complete
from lapgs_plugin.evaluation.metrics import psnr_of
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, render_depths
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.rendering.run import run_renderer
from lapgs_plugin.runs.archive import RunArchive

SAME_DEPTH = 0.01
"""Two depths belong to one surface when they differ by less than this share."""

OPAQUE = 0.9
"""Least opacity of a pixel whose depth is that of a surface."""

SMALLEST_COVER = 1e-6
"""Least cover by which depths are divided."""

COMPOSITION, SINGLE = "composition", "single field"


@dataclass(frozen=True)
class DepthImage:
    """Hold the depth of a view.

    Attributes:
        depth: (h, w) along the optical axis, in world units: the mean depth of the Gaussians with their blending
            weights. Meaningless where nothing covers a pixel.
        cover: (h, w) sum of these weights, in [0, 1].
    """

    depth: Tensor
    cover: Tensor

    def to(self, device: torch.device) -> DepthImage:
        """Return the depth image on a device."""
        return DepthImage(self.depth.to(device), self.cover.to(device))


@torch.no_grad()
def render_depth(rasterizer: Rasterizer, field: GaussianField, camera: Camera) -> DepthImage:
    """Render the depth of an ordinary field or a base; a residual has none. Depths are rendered as colours."""
    weighted, cover = render_depths(rasterizer, field, camera)
    return DepthImage(weighted / cover.clamp(min=SMALLEST_COVER), cover)


@dataclass(frozen=True)
class Frame:
    """Hold a frame of a path: its camera, the depth of its pixels, and images (3, h, w) by name."""

    camera: Camera
    depth: DepthImage
    images: Mapping[str, Tensor]


@dataclass
class Flicker:
    """Add up differences between frames and their predecessors, over all pixels, channels and frames that both show."""

    absolute: float = 0.0
    squared: float = 0.0
    values: int = 0

    def add(self, difference: Tensor) -> None:
        """Add differences, a tensor of any shape."""
        self.absolute += float(difference.abs().double().sum())
        self.squared += float(difference.double().square().sum())
        self.values += difference.numel()

    @property
    def mean(self) -> float:
        """Mean absolute difference of intensities in [0, 1]."""
        return self.absolute / max(self.values, 1)

    @property
    def psnr(self) -> float:
        """PSNR in dB of all differences together, at most 100."""
        return psnr_of(self.squared / max(self.values, 1))


def measure_flicker(frames: Iterable[Frame]) -> tuple[dict[str, Flicker], float]:
    """Compare each frame with the one before it.

    Returns:
        The flicker by image name, and the share of all pixels that were compared.
    """
    flicker: dict[str, Flicker] = {}
    before: Frame | None = None
    compared = pixels = 0
    for frame in frames:
        if before is not None:
            positions, seen = reproject(frame, before)
            compared, pixels = compared + int(seen.sum()), pixels + seen.numel()
            for name, image in frame.images.items():
                carried = _sample(before.images[name], positions)
                flicker.setdefault(name, Flicker()).add((image - carried)[:, seen])
        before = frame
    return flicker, compared / max(pixels, 1)


def reproject(frame: Frame, before: Frame) -> tuple[Tensor, Tensor]:
    """Find the pixels of a frame in the frame before.

    Returns:
        (h, w, 2) positions in the frame before, x then y, in pixels from the corner; and (h, w) bool, whether that
        frame shows the same surface there.
    """
    camera, depth = frame.camera, frame.depth.depth
    height, width = depth.shape
    device = depth.device
    y, x = torch.meshgrid(
        torch.arange(height, device=device) + 0.5, torch.arange(width, device=device) + 0.5, indexing="ij"
    )
    rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], dim=-1)
    # One transform from camera to camera: float32 would lose the small step between two separate poses.
    step = before.camera.world_to_camera.double() @ torch.linalg.inv(camera.world_to_camera.double())
    step = step.to(depth)
    points = (rays * depth[..., None]) @ step[:3, :3].T + step[:3, 3]  # (h, w, 3) in the camera of before
    old = before.camera
    distance = points[..., 2]
    ahead = distance.clamp(min=1e-6)
    u, v = points[..., 0] / ahead * old.fx + old.cx, points[..., 1] / ahead * old.fy + old.cy
    inside = (u > 0) & (u < old.width) & (v > 0) & (v < old.height) & (distance > 0)
    across = torch.stack([u / old.width, v / old.height], dim=-1)
    there = torch.nn.functional.grid_sample(  # (1, 2, h, w)
        torch.stack([before.depth.depth, before.depth.cover])[None], 2.0 * across[None] - 1.0, align_corners=False
    )[0]
    same = (there[0] - distance).abs() < SAME_DEPTH * distance
    return torch.stack([u, v], dim=-1), inside & same & (there[1] > OPAQUE) & (frame.depth.cover > OPAQUE)


def path_frames(
    renderer: HierarchyRenderer, single: HierarchyRenderer | None, cameras: Sequence[Camera]
) -> Iterable[Frame]:
    """Render the frames of a hierarchy along a path: its composition, each of its bands, and a single field.

    All images are at full size. The depth is that of the single field if there is one, otherwise of the finest unsigned
    field.
    """
    surface = renderer if single is None else single
    solid = min(level for level, field in surface.fields.items() if not field.signed)
    for camera in cameras:
        composition = renderer.render(camera)
        finest = composition.composed[renderer.finest]
        composed = to_full_size(finest, camera.size, renderer.finest, renderer.pyramid).clamp(0.0, 1.0)
        images = {COMPOSITION: composed}
        if renderer.levels > 1:
            for level, band in {renderer.levels - 1: composition.base, **composition.residuals}.items():
                images[f"band {level}"] = to_full_size(band, camera.size, level, renderer.pyramid)
        if single is not None:
            images[SINGLE] = single.render(camera).composed[0].to(composed).clamp(0.0, 1.0)
        depth = render_depth(surface.rasterizer, surface.field(solid), camera)
        yield Frame(camera, depth.to(composed.device), images)


def evaluate_stability(
    archive: RunArchive, single: RunArchive | None, path: str, cameras: Sequence[Camera], options: RenderOptions
) -> dict[str, Any]:
    """Measure the flicker of a run along a path, and write it to the run's stability.json.

    Args:
        single: a single field of the same scene, or None.
        path: name of the path in the figures.
        cameras: one for each frame.

    Returns:
        JSON values: "path", "size", "frames", "compared" (share of all pixels), "baseline", and in "flicker", by image,
        the "mean" absolute difference and "psnr" in dB.

    Raises:
        RunFolderError: the run is not complete.
        UserInputError: `single` has several levels, the path has one frame, or its frames show nothing in common.
    """
    require_complete(archive)
    if single is not None and single.manifest.levels != 1:
        raise UserInputError(
            f"--baseline {single.path()} has {single.manifest.levels} levels, expected a single field, trained with "
            "--levels 1"
        )
    if len(cameras) < 2:
        raise UserInputError(f"--trajectory {path} has one camera, expected two or more; give --frames")
    renderer = run_renderer(archive, options.device, options.rasterizer)
    other = None if single is None else run_renderer(single, options.device, options.rasterizer)
    with one_pool(), item_progress("frames") as progress:
        frames = path_frames(renderer, other, cameras)
        tracked = progress.track(frames, total=len(cameras), description=f"Following {path}")
        flicker, compared = measure_flicker(tracked)
    if compared == 0.0:  # its figures would be those of a perfect run
        raise UserInputError(
            f"--trajectory {path}: no two frames after each other show the same surface, expected a path in small "
            "steps; give more --frames, or another path"
        )
    figures = {
        "path": path,
        "size": [cameras[0].width, cameras[0].height],
        "frames": len(cameras),
        "compared": compared,
        "baseline": None if single is None else str(single.path().absolute()),
        "flicker": {name: {"mean": total.mean, "psnr": total.psnr} for name, total in flicker.items()},
    }
    archive.write_stability(figures)
    return figures


def _sample(image: Tensor, positions: Tensor) -> Tensor:
    """Interpolate an image (c, h, w) at (h', w', 2) positions in pixels from the corner: (c, h', w').

    Cubic convolution with Keys' constant a = -1/2 is exact for parabolas; PyTorch's -3/4 is not.
    """
    height, width = image.shape[1:]
    corner = positions - 0.5
    whole = corner.floor()
    weights = _keys_weights(corner - whole)  # 4 x (h', w', 2)
    x, y = whole[..., 0].long(), whole[..., 1].long()
    sampled = image.new_zeros(image.shape[0], *positions.shape[:2])
    for row, by_row in enumerate(weights, start=-1):
        for column, by_column in enumerate(weights, start=-1):
            taken = image[:, (y + row).clamp(0, height - 1), (x + column).clamp(0, width - 1)]
            sampled += by_row[..., 1] * by_column[..., 0] * taken
    return sampled


def _keys_weights(t: Tensor) -> list[Tensor]:
    """Return the weights of pixels -1, 0, 1 and 2 for a position t in [0, 1) between pixels 0 and 1 (Keys 1981)."""
    t2, t3 = t * t, t * t * t
    return [
        0.5 * (-t3 + 2 * t2 - t),
        0.5 * (3 * t3 - 5 * t2 + 2),
        0.5 * (-3 * t3 + 4 * t2 + t),
        0.5 * (t3 - t2),
    ]
