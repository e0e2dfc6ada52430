"""Save and read the preview that `lapgs view` shows until it can render: the run from the initial view.

It is a small JPEG in the run folder, saved when a run is complete or was viewed. Its comment identifies the run's
state. Reading it does not import torch, which takes longer than loading a page.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image

from lapgs_plugin.files import MANIFEST, PREVIEW, atomic_write
from lapgs_plugin.untrusted import read_json, require_regular

if TYPE_CHECKING:
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.viewer.pictures import ShownRun
    from lapgs_plugin.viewer.poses import InitialView

logger = logging.getLogger(__name__)

SIZE = (1200, 600)
"""Width and height in pixels, with the clients' vertical field of view; windows are up to twice as wide as high."""

QUALITY = 85


def read_preview(run: Path) -> Image.Image | None:
    """Read the preview in a run folder; None when it is missing, damaged, or older than the last training."""
    try:
        manifest = read_json(run / MANIFEST, dict[str, Any])
        require_regular(run / PREVIEW)
        image = Image.open(io.BytesIO((run / PREVIEW).read_bytes()), formats=("JPEG",))
        if image.info.get("comment") != _state(manifest["created"], len(manifest["records"])):
            return None
        image.load()
    except Exception:  # Pillow raises OSError, SyntaxError, ValueError and others for damaged files
        return None
    return image


def crop_to_aspect(image: Image.Image, aspect: float) -> Image.Image:
    """Crop the middle of a picture at full height to another width / height, with black where it is too narrow."""
    half = 0.5 * aspect * image.height
    left, right = round(0.5 * image.width - half), round(0.5 * image.width + half)
    return image.crop((left, 0, max(right, left + 1), image.height))


def save_preview(archive: RunArchive, shown: ShownRun, start: InitialView) -> None:
    """Render all finished levels of a run from the initial view, and save the picture in its folder; log errors."""
    with _logged(archive.path()):
        from lapgs_plugin.scenes.images import as_bytes
        from lapgs_plugin.viewer.pictures import PictureSettings, draw

        picture = draw(shown, None, start.camera(*SIZE), PictureSettings(), distance=1.0, zoom=1.0)
        manifest = archive.manifest
        with atomic_write(archive.path(PREVIEW)) as stream:
            Image.fromarray(as_bytes(picture.image)).save(
                stream, "JPEG", quality=QUALITY, comment=_state(manifest.created, len(manifest.records))
            )


def save_run_preview(run: Path, device: str = "auto", moved_to: Path | None = None) -> None:
    """Save the preview of a run that was just trained, rendered on `device` from a scene that may have been moved."""
    with _logged(run):
        # Imported here, because a backbone's environment may lack such packages as OpenImageIO.
        from lapgs_plugin.jit.threads import one_pool
        from lapgs_plugin.rendering.run import run_renderer
        from lapgs_plugin.runs.archive import RunArchive
        from lapgs_plugin.viewer.pictures import ShownRun
        from lapgs_plugin.viewer.poses import SceneCameras

        with one_pool():
            archive = RunArchive.open(run)
            cameras = SceneCameras.of(archive, moved_to)
            save_preview(archive, ShownRun.of(archive.name, run_renderer(archive, device), cameras.rig), cameras.start)


@contextmanager
def _logged(run: Path) -> Iterator[None]:
    """Log any error of the block, because a run is complete without a preview."""
    try:
        yield
    except Exception as error:
        logger.warning("no preview of %s is saved for the viewer: %s", run, error)


def _state(created: str, finished: int) -> bytes:
    """Identify the state of a run: its training and the number of finished levels."""
    return f"{created}, {finished} levels".encode()
