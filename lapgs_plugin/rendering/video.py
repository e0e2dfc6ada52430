"""Video files, by the ffmpeg that imageio-ffmpeg brings: a program of its own, fed with pixels through a pipe.

The other well-kept way, PyAV, links FFmpeg's libraries (and x264, which is GPL) into this process; a program beside it
leaves our licence alone, is what gsplat and nerfstudio use, and a crash of the encoder is an error we can report.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from lapgs_plugin.errors import LapgsError, MissingExtraError

QUALITY = 8
"""Of imageio-ffmpeg's 0 to 10, variable bit rate."""


class FrameSink(Protocol):
    """Takes the frames of a clip, one after the other."""

    def __call__(self, image: Tensor) -> None:
        """Add a frame.

        Args:
            image: (3, h, w) in [0, 1]; values outside are clamped.
        """
        ...


def require_video() -> None:
    """Check that videos can be written.

    Raises:
        MissingExtraError: they cannot.
    """
    if find_spec("imageio_ffmpeg") is None:
        raise MissingExtraError(
            "a video needs imageio-ffmpeg, which is not installed; pip install 'lapgs_plugin[video]' brings it, or "
            "write images with --out FOLDER"
        )


@contextmanager
def video_writer(path: Path, size: tuple[int, int], fps: float) -> Iterator[FrameSink]:
    """Write an H.264 video that every player knows (yuv420p); the file appears under its name when it is complete.

    Args:
        path: an .mp4 file; missing folders are made.
        size: (width, height) of every frame, both even.
        fps: frames a second.

    Raises:
        LapgsError: the file cannot be written.
        MissingExtraError: as `require_video`.
    """
    require_video()
    import imageio_ffmpeg

    assert size[0] % 2 == size[1] % 2 == 0, "yuv420p has one colour for two by two pixels"
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.unfinished{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
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
            levels = (image.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).permute(1, 2, 0)
            writer.send(levels.contiguous().cpu().numpy())

        try:
            yield add
        finally:
            writer.close()
        # Where the disk is full ffmpeg may end early, and nothing says so.
        if _count_frames(unfinished) != frames:
            raise OSError("it was cut short")
        unfinished.replace(path)
    except OSError as error:
        reason = " ".join(str(error).split())[-300:]
        raise LapgsError(f"{path}: the video cannot be written ({reason}); check free space and permissions") from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def _count_frames(path: Path) -> int:
    """Frames of a video; 0 where it is none."""
    import imageio_ffmpeg

    try:
        return int(imageio_ffmpeg.count_frames_and_secs(path)[0]) if path.exists() else 0
    except RuntimeError:
        return 0
