"""Write videos with the ffmpeg program of imageio-ffmpeg, which gets pixels through a pipe.

The alternative, PyAV, links FFmpeg and x264, which is GPL, into this process. A separate program does not affect our
licence, and its crash is an error that we can report. gsplat and nerfstudio use it as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from torch import Tensor

from lapgs_plugin.errors import require_extra
from lapgs_plugin.files import whole_file
from lapgs_plugin.scenes.images import as_bytes

QUALITY = 8
"""Quality from 0 to 10 for imageio-ffmpeg, at a variable bit rate."""


FrameSink = Callable[[Tensor], None]
"""Adds a frame to a clip: an image (3, h, w), clamped to [0, 1]."""


@contextmanager
def video_writer(path: Path, size: tuple[int, int], fps: float) -> Iterator[FrameSink]:
    """Write an H.264 video (yuv420p), which every player supports; the file appears when it is complete.

    Args:
        path: an .mp4 file; missing folders are created.
        size: (width, height) of every frame, both even.
        fps: frames a second.

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
