"""Render a camera path to a video or a folder of numbered images.

Videos are written by the ffmpeg program of imageio-ffmpeg, which gets pixels through a pipe. The alternative, PyAV,
links FFmpeg and x264, which is GPL, into this process. A separate program does not affect our licence, and its crash is
an error that we can report. gsplat and nerfstudio use it as well.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError, require_extra
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.files import whole_file
from lapgs_plugin.limits import VIEW_PIXELS
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.images import around_grey
from lapgs_plugin.rendering.trajectory import with_size
from lapgs_plugin.scenes.images import as_bytes, write_image
from lapgs_plugin.scenes.resolution import parse_size

VIDEO = ".mp4"
MIN_SIDE, MAX_SIDE = 16, 16384
MAX_PENDING = 16
"""Most images that wait to be written; more would only take memory."""
QUALITY = 8
"""Quality from 0 to 10 for imageio-ffmpeg, at a variable bit rate."""

FrameSink = Callable[[Tensor], None]
"""Adds a frame to a clip: an image (3, h, w), clamped to [0, 1]."""


def render_size(text: str) -> tuple[int, int]:
    """Parse the size of rendered images, such as "1280x720", into (width, height).

    Raises:
        UserInputError: the text has another form, or the size is out of range.
    """
    size = parse_size(text)
    if not all(MIN_SIDE <= side <= MAX_SIDE for side in size):
        raise UserInputError(f"--size {text}: expected {MIN_SIDE} to {MAX_SIDE} pixels a side, such as 1280x720")
    VIEW_PIXELS.check(size[0] * size[1], f"--size {text} is {size[0] * size[1]:,} pixels", "choose a smaller one")
    return size


def is_video(out: Path) -> bool:
    """Return whether a clip of this name is a video rather than a folder of images."""
    return out.suffix.lower() == VIDEO


def clip_size(camera: Camera, wanted: tuple[int, int] | None, out: Path) -> tuple[int, int]:
    """Return width and height of each view of a clip: as wanted, or the camera's, rounded down to even for a video.

    Raises:
        UserInputError: a video of an odd size was requested.
    """
    width, height = wanted or camera.size
    if not is_video(out) or width % 2 == height % 2 == 0:
        return width, height
    if wanted is not None:
        raise UserInputError(
            f"--size {width}x{height}: a video's sides are even; use {width + width % 2}x{height + height % 2}"
        )
    return width - width % 2, height - height % 2


def render_clip(
    renderer: HierarchyRenderer,
    cameras: Sequence[Camera],
    out: Path,
    *,
    level: int,
    size: tuple[int, int],
    fps: float,
    panels: bool,
    image_format: str = "png",
) -> None:
    """Render a path to a file or a folder.

    Args:
        out: an .mp4 file, or a folder for frame_00000.png and so on.
        level: finest level to add; the image is upsampled to full size.
        size: (width, height) of a view.
        fps: frames a second of a video.
        panels: base, residuals and composition side by side instead of the composition alone.
        image_format: "png" or "exr", of a folder's images; EXR stores residuals with their sign.

    Raises:
        LapgsError: the file or folder cannot be written.
    """
    shown = renderer.levels - level + 1 if panels else 1
    writer = _video_writer(out, (size[0] * shown, size[1]), fps) if is_video(out) else _image_writer(out, image_format)
    raw = not is_video(out) and image_format == "exr"
    with item_progress("frames") as progress, writer as write:
        task = progress.add_task(f"Rendering {out.name}", total=len(cameras))
        for camera in cameras:
            sized = with_size(camera, size)
            write(_panels(renderer, sized, level, raw) if panels else _composed(renderer, sized, level))
            progress.advance(task)


def _composed(renderer: HierarchyRenderer, camera: Camera, level: int) -> Tensor:
    """Render the composition down to `level` at the size of the view, (3, h, w)."""
    return to_full_size(renderer.images([camera], level)[0], camera.size, level, renderer.pyramid)


def _panels(renderer: HierarchyRenderer, camera: Camera, level: int, raw: bool) -> Tensor:
    """Render base, residuals and composition side by side at the size of the view, (3, h, panels * w)."""
    composition = renderer.render(camera, level)
    whole = to_full_size(composition.composed[level], camera.size, level, renderer.pyramid)
    base = to_full_size(composition.base, camera.size, renderer.levels - 1, renderer.pyramid)
    residuals = [
        to_full_size(residual, camera.size, level, renderer.pyramid)
        for level, residual in composition.residuals.items()
    ]
    shown = residuals if raw else [around_grey(residual) for residual in residuals]
    return torch.cat([base, *shown, whole], dim=2)


@contextmanager
def _video_writer(path: Path, size: tuple[int, int], fps: float) -> Iterator[FrameSink]:
    """Write an H.264 video (yuv420p), which every player supports; the file appears when it is complete.

    Raises:
        LapgsError: the file cannot be written.
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    require_extra("imageio_ffmpeg", "video", f"{path}: a video", "write images with --out FOLDER")
    import imageio_ffmpeg

    assert size[0] % 2 == size[1] % 2 == 0, "yuv420p has one colour for 2 x 2 pixels"
    with whole_file(path, "video") as unfinished:
        writer = imageio_ffmpeg.write_frames(
            str(unfinished),
            size,
            fps=fps,
            quality=QUALITY,
            codec="libx264",
            macro_block_size=2,
            ffmpeg_log_level="error",
        )
        writer.send(None)
        frames = 0

        def add(image: Tensor) -> None:
            nonlocal frames
            frames += 1
            writer.send(as_bytes(image.clamp(0.0, 1.0)))

        try:
            yield add
        finally:
            writer.close()
        # On a full disk ffmpeg may end early without an error.
        if _count_frames(unfinished) != frames:
            raise OSError("it is truncated")


def _count_frames(path: Path) -> int:
    """Return the number of frames of a video, 0 if the file is not a video."""
    import imageio_ffmpeg

    try:
        return int(imageio_ffmpeg.count_frames_and_secs(path)[0]) if path.exists() else 0
    except RuntimeError:
        return 0


@contextmanager
def _image_writer(folder: Path, image_format: str) -> Iterator[FrameSink]:
    """Write frames as numbered images in threads, because compressing a PNG takes longer than rendering it."""
    pending: deque[Future[None]] = deque()
    numbers = count()
    with ThreadPoolExecutor() as pool:

        def add(image: Tensor) -> None:
            pending.append(pool.submit(write_image, folder / f"frame_{next(numbers):05d}.{image_format}", image))
            if len(pending) > MAX_PENDING:
                pending.popleft().result()

        yield add
        for written in pending:
            written.result()
