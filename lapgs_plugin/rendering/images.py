"""Name the image files of rendered views and convert images for viewing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain, count
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.ops.composition import Composition

if TYPE_CHECKING:
    from lapgs_plugin.scenes.scene import View


def around_grey(signed: Tensor) -> Tensor:
    """Map a signed image to [0, 1]: zero is mid-grey, -1 black, 1 white."""
    return 0.5 + 0.5 * signed


def view_images(composition: Composition, photo: Tensor | None, raw: bool, nested: bool = False) -> dict[str, Tensor]:
    """Return the images of a rendered view by file suffix, (3, h, w) each, at their level's size.

    Args:
        composition: of one or more levels.
        photo: at the finest composed level's size; adds "compare": photo, composition and difference `side_by_side`.
        raw: keep the sign of residuals and differences, for formats with negative values; otherwise around mid-grey.
        nested: whether levels are nested, which have differences instead of residuals.

    Returns:
        "base", "residual_<l>" or "difference_<l>" for each finer level, and "composed", or "composed_<l>" if l is not
        0. No image is returned twice: a hierarchy of one level gives "composed" alone, the coarsest level of several
        "base" alone.
    """
    finest = min(composition.composed)
    composed = composition.composed[finest]
    images = {}
    if composition.residuals or finest > 0:
        images["base"] = composition.base
    for level, residual in composition.residuals.items():
        images[f"{'difference' if nested else 'residual'}_{level}"] = residual if raw else around_grey(residual)
    if composition.residuals or finest == 0:
        images["composed" if finest == 0 else f"composed_{finest}"] = composed
    if photo is not None:
        difference = composed.clamp(0.0, 1.0) - photo
        shown = difference if raw else around_grey(difference)
        images["compare"] = side_by_side({"photo": photo, "composition": composed, "difference": shown})
    return images


def side_by_side(panels: Mapping[str, Tensor]) -> Tensor:
    """Return panels (3, h, w) of one size beside each other, each under its name: (3, caption + h, panels * w).

    The caption's height is `caption_height(h)`.
    """
    from PIL import Image, ImageDraw, ImageFont

    _, height, width = next(iter(panels.values())).shape
    strip = caption_height(height)
    captions = Image.new("L", (len(panels) * width, strip), 255)
    draw, font = ImageDraw.Draw(captions), ImageFont.load_default(size=round(0.7 * strip))
    for index, name in enumerate(panels):
        draw.text(((index + 0.5) * width, strip / 2), name, fill=0, font=font, anchor="mm")
    images = torch.cat([panel.cpu() for panel in panels.values()], dim=2)
    drawn = torch.from_numpy(np.array(captions)).to(images) / 255.0  # (strip, panels * w)
    return torch.cat([drawn.expand(3, -1, -1), images], dim=1)


def caption_height(height: int) -> int:
    """Return the height in pixels of the captions above panels of a height."""
    return max(16, height // 20)


def file_stems(views: Sequence[View]) -> dict[str, str]:
    """Return the file stem of each view: its name without extension, unless two views would share that.

    Folders in a name are kept, except steps upwards, so that no file is written outside the output folder. A number is
    added where even whole names would share a file.
    """
    names = [view.name for view in views]
    paths = {name: PurePosixPath(*(p for p in PurePosixPath(name).parts if p not in ("/", ".."))) for name in names}
    users = Counter(path.with_suffix("") for path in paths.values())
    stems: dict[str, str] = {}
    taken: set[str] = set()
    for name, path in paths.items():
        short = [str(path.with_suffix(""))] if users[path.with_suffix("")] == 1 else []
        numbered = (f"{path}_{number}" for number in count(2))
        stems[name] = next(stem for stem in chain(short, [str(path)], numbered) if stem not in taken)
        taken.add(stems[name])
    return stems
