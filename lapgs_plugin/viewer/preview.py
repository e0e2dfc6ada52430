"""The picture that `lapgs view` shows until it can render one: a run as it is seen from where clients begin.

A small JPEG in the run folder, kept when a run is complete or was looked at. Its comment says of which state of the run
it is. Reading it needs no torch, which takes longer to import than a page to load.
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
from lapgs_plugin.untrusted import read_json

if TYPE_CHECKING:
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.viewer.pictures import ShownRun
    from lapgs_plugin.viewer.start import Start

logger = logging.getLogger(__name__)

SIZE = (1200, 600)
"""In pixels, with the vertical field of view of clients, whose windows may be up to twice as wide as they are high."""

QUALITY = 85


def read_preview(run: Path) -> Image.Image | None:
    """The picture in a run folder; None where there is none, it is damaged, or the run was trained on since."""
    try:
        manifest = read_json(run / MANIFEST, dict[str, Any])
        image = Image.open(io.BytesIO((run / PREVIEW).read_bytes()), formats=("JPEG",))
        if image.info.get("comment") != _state(manifest["created"], len(manifest["records"])):
            return None
        image.load()
    except Exception:  # Pillow raises OSError, SyntaxError, ValueError, ... by damage
        return None
    return image


def fitted(image: Image.Image, aspect: float) -> Image.Image:
    """The middle of a picture at full height and another width / height; black where that is wider than the picture."""
    half = 0.5 * aspect * image.height
    left, right = round(0.5 * image.width - half), round(0.5 * image.width + half)
    return image.crop((left, 0, max(right, left + 1), image.height))


def keep_preview(archive: RunArchive, shown: ShownRun, start: Start) -> None:
    """Render a run from where clients begin, and keep the picture in its folder. Whatever fails is a line of the log.

    Args:
        archive: of the run.
        shown: all of its finished levels.
        start: where clients begin.
    """
    with _logged(archive.path()):
        from lapgs_plugin.viewer.pictures import PictureSettings, as_bytes, draw

        picture = draw(shown, None, start.camera(*SIZE), PictureSettings(), distance=1.0, zoom=1.0)
        manifest = archive.manifest
        with atomic_write(archive.path(PREVIEW)) as stream:
            Image.fromarray(as_bytes(picture.image)).save(
                stream, "JPEG", quality=QUALITY, comment=_state(manifest.created, len(manifest.records))
            )


def keep_preview_of(run: Path, device: str = "auto") -> None:
    """As `keep_preview`, for a run that was just trained where its scene is.

    Args:
        run: its folder.
        device: where to render, as `rasterizer_for` takes it.
    """
    with _logged(run):
        # In here: a backbone's environment may lack OpenImageIO, say, and has trained all the same.
        from lapgs_plugin.rendering.rig import Rig
        from lapgs_plugin.rendering.run import run_cameras, run_renderer
        from lapgs_plugin.runs.archive import RunArchive
        from lapgs_plugin.viewer.pictures import ShownRun
        from lapgs_plugin.viewer.start import start_at

        archive = RunArchive.open(run)
        train, test = run_cameras(archive)
        rig = Rig.of(list(train.values()))
        shown = ShownRun.of(run.name, run_renderer(archive, device), rig)
        keep_preview(archive, shown, start_at(next(iter({**test, **train}.values())), rig))


@contextmanager
def _logged(run: Path) -> Iterator[None]:
    """Whatever fails in here is a line of the log: a run is whole without a picture."""
    try:
        yield
    except Exception as error:
        logger.warning("no picture of %s is kept for the viewer to begin with: %s", run, error)


def _state(created: str, finished: int) -> bytes:
    """What a picture of a run is of: which training, and how many of its levels."""
    return f"{created}, {finished} levels".encode()
