"""Pick sharp, evenly spread frames from a video."""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_plugin.errors import SceneError, require_extra
from lapgs_plugin.limits import PHOTO_PIXELS
from lapgs_plugin.scenes.images import JPEG

FRAMES_PER_SECOND = 2.0
FEWEST, MOST = 40, 240  # frames that are picked by default
JUDGED_WIDTH = 640
"""Width at which sharpness and motion are judged."""
BLOCK = 8
"""Side of the squares whose means are compared for motion, so that noise does not count."""
SQUARE = "scale='max(1,round(iw*sar))':ih,setsar=1"
"""FFmpeg's filter that makes pixels square, as players show them."""
STILL = 1.5
"""Mean difference, in grey levels of 255, below which the camera has not moved between two frames."""


class Judged(NamedTuple):
    """Hold one frame's sharpness, and its block means for the comparison with others."""

    sharpness: float
    blocks: NDArray[np.float32]


def pick_frames(clip: Path, count: int | None, seen: Callable[[int, int], None]) -> list[int]:
    """Return the numbers of the sharpest frame in each of `count` equal parts of a clip, without repeated ones.

    Args:
        clip: the video.
        count: number of frames. Default: 2 per second, clamped to [40, 240]. Parts without motion give none.
        seen: called with frames read so far and their expected number.

    Raises:
        SceneError: the clip cannot be decoded, or the camera does not move.
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    total, seconds = _length(clip)
    judged = []
    for frame in _frames(clip, "pgm", f"scale='min({JUDGED_WIDTH},iw)':-2"):
        judged.append(judge(frame[..., 0]))
        seen(len(judged), max(len(judged), total))
    wanted = round(FRAMES_PER_SECOND * seconds) if count is None else count
    if count is None:
        wanted = min(max(wanted, FEWEST), MOST)
    picked = sharp_and_moving(judged, min(wanted, len(judged)))
    if len(picked) < 2:
        raise SceneError(
            f"{clip}: {len(judged)} frames show the same view, expected a camera that moves; walk around the scene "
            "while you record"
        )
    return picked


def judge(grey: NDArray[np.uint8]) -> Judged:
    """Return the sharpness of a frame (h, w), the variance of its Laplacian, and its block means."""
    values = grey.astype(np.float32)
    laplacian = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:] - 4 * values[1:-1, 1:-1]
    height, width = (side // BLOCK * BLOCK for side in values.shape)
    blocks = values[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean((1, 3))
    return Judged(float(laplacian.var()), blocks)


def sharp_and_moving(judged: list[Judged], count: int) -> list[int]:
    """Return the sharpest frame of each of `count` parts, without those that show the same view as the frame before."""
    picked: list[int] = []
    for part in np.array_split(np.arange(len(judged)), max(count, 1)):
        best = max(part.tolist(), key=lambda number: judged[number].sharpness, default=None)
        if best is None:
            continue
        if not picked or np.abs(judged[best].blocks - judged[picked[-1]].blocks).mean() >= STILL:
            picked.append(best)
    return picked


def write_frames(clip: Path, numbers: list[int], folder: Path, seen: Callable[[int, int], None]) -> None:
    """Write frames of a clip as JPEG files whose names have their order.

    Raises:
        SceneError, MissingExtraError: as `pick_frames`.
    """
    chosen = "+".join(f"eq(n\\,{number})" for number in numbers)
    written = 0
    for number, frame in zip(numbers, _frames(clip, "ppm", f"select='{chosen}'"), strict=False):
        name = folder / f"frame_{number:06d}.jpg"
        Image.fromarray(frame).save(name, **JPEG)
        written += 1
        seen(written, len(numbers))
    if written < len(numbers):
        raise SceneError(f"{clip}: {written} of {len(numbers)} frames could be read again; copy the clip and try again")


def _frames(clip: Path, pixels: str, filters: str) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames (h, w, c) of a clip after FFmpeg's filters, upright, with square pixels.

    Args:
        clip: the video.
        pixels: "pgm" for grey or "ppm" for RGB.
        filters: of FFmpeg.

    Raises:
        SceneError: no frame can be decoded, or the size changes, which also makes FFmpeg count frames anew.
    """
    import imageio_ffmpeg

    depth = "rgb24" if pixels == "ppm" else "gray"  # else phones' HDR videos of 10 bits become 16-bit images
    chain = f"showinfo=checksum=0,{SQUARE},{filters}"  # showinfo logs the size of each frame
    options = ["-map", "0:v:0", "-vf", chain, "-fps_mode", "passthrough", "-pix_fmt", depth]
    options += ["-f", "image2pipe", "-c:v", pixels, "-"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "info", "-nostats", "-nostdin", "-i", str(clip), *options]
    with tempfile.TemporaryFile() as words, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=words) as ffmpeg:
        assert ffmpeg.stdout is not None
        try:
            while ffmpeg.stdout.readline():  # "P5" or "P6", then the size, then 255
                width, height = map(int, ffmpeg.stdout.readline().split())
                subject = f"{clip}: frames are {width}x{height} pixels"
                PHOTO_PIXELS.check(width * height, subject, "make the video smaller", SceneError)
                ffmpeg.stdout.readline()
                channels = 3 if pixels == "ppm" else 1
                frame = ffmpeg.stdout.read(width * height * channels)
                if len(frame) == width * height * channels:
                    yield np.frombuffer(frame, np.uint8).reshape(height, width, channels)
        finally:
            ffmpeg.kill()
        words.seek(0)
        text = words.read().decode(errors="replace")
    sizes = list(dict.fromkeys(re.findall(r" s:(\d+x\d+) ", text)))
    if len(sizes) > 1:
        raise SceneError(
            f"{clip}: the size of its frames changes from {sizes[0]} to {sizes[1]} pixels, expected one size; cut it "
            "there and give one of the parts"
        )
    if not sizes:
        raise _undecodable(clip, text)


def _length(clip: Path) -> tuple[int, float]:
    """Return the number of frames and the seconds of a clip.

    Raises:
        SceneError: it cannot be decoded.
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    require_extra("imageio_ffmpeg", "video", f"{clip}: reading a video", "give a folder of frames")
    import imageio_ffmpeg

    try:
        frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(clip))
    except RuntimeError as error:
        raise _undecodable(clip, str(error)) from error
    return int(frames), float(seconds)


def _undecodable(clip: Path, text: str) -> SceneError:
    """Return the error about a clip, with the reason from FFmpeg's output."""
    lines = [line.strip() for line in text.splitlines() if line.strip(" =")]
    reason = next((line for line in reversed(lines) if "rror" in line or "nvalid" in line), "no reason given")
    return SceneError(
        f"{clip}: the video cannot be decoded ({reason}); expected a clip that a player shows, copy or convert it again"
    )
