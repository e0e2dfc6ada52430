"""Render views of runs as pictures for a page: photo, levels, composition, baseline; whole and in detail."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lapgs_plugin.evaluation.figures import PhotoLook
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.images import around_grey
from lapgs_plugin.scenes.images import encode_image, resize_image
from lapgs_plugin.scenes.scene import View

IMAGE_SIDE = 800
"""Longest side of a whole image on a page, in pixels."""
MOST_COLUMNS = 5
CUTOUTS = 2
"""Number of enlarged parts of a view."""
CUTOUT_SHARE = 1 / 6
"""Side of a cut-out as a share of the image's shorter side."""
CUTOUT_LEAST, CUTOUT_MOST = 16, 96  # limits of this side in pixels


@dataclass(frozen=True)
class Picture:
    """An image on the page.

    Attributes:
        caption, detail: description.
        width, height: of the embedded image, in pixels.
        data: data URI.
    """

    caption: str
    detail: str
    width: int
    height: int
    data: str


@dataclass(frozen=True)
class Cutout:
    """A part of a view with strong edges, cut out of every picture of the view.

    Attributes:
        left, top, width, height: in percent of the image.
        side: of the square in pixels, at full resolution.
        pictures: in the order of the view's pictures, at full resolution.
    """

    left: float
    top: float
    width: float
    height: float
    side: int
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Strip:
    """The pictures of one view, from the photo to the composition.

    Attributes:
        name: of the view.
        why, figures: the reason for showing the view, and its metrics.
        pictures: whole, all of the same size.
        cutouts: enlarged parts.
    """

    name: str
    why: str
    figures: str
    pictures: tuple[Picture, ...]
    cutouts: tuple[Cutout, ...]

    @property
    def columns(self) -> int:
        """Pictures in a row of a wide page: all, or half of them when they would get too small."""
        count = len(self.pictures)
        return count if count <= MOST_COLUMNS else (count + 1) // 2

    @property
    def narrow_columns(self) -> int:
        """Cut-outs in a row of a narrow page: two to four, so that none is alone in the last row."""
        count = len(self.pictures)
        return next((columns for columns in (3, 2, 4) if count % columns != 1), 3)

    @property
    def compared(self) -> tuple[int, int]:
        """Indices of the pictures that are compared first: the baseline, or else the photo, and the composition."""
        captions = [picture.caption for picture in self.pictures]
        return captions.index("Baseline") if "Baseline" in captions else 0, captions.index("Composition")


@dataclass(frozen=True)
class Layer:
    """Content of a picture: (3, h, w) at full resolution."""

    caption: str
    detail: str
    image: Tensor


@torch.no_grad()
def make_strip(
    view: View,
    why: str,
    figures: str,
    renderers: Sequence[HierarchyRenderer],
    looks: Sequence[PhotoLook],
) -> Strip:
    """Render a view with a run, and with its baseline if there is one.

    Args:
        view: a view with its photo.
        why, figures: see `Strip`.
        renderers: of the run, then of its baseline.
        looks: the photo's looks with which these were measured; renders get them, too.
    """
    layers = _layers(view, renderers, looks)
    cutouts = tuple(cut_out(layers, square) for square in edge_squares(view.image, CUTOUTS))
    return Strip(view.name, why, figures, tuple(shrink(layer) for layer in layers), cutouts)


def _layers(view: View, renderers: Sequence[HierarchyRenderer], looks: Sequence[PhotoLook]) -> list[Layer]:
    """Render the layers of a view, upsampled to full resolution, with the looks of `make_strip`."""
    renderer, look = renderers[0], looks[0]
    composition = renderer.render(view.camera)
    layers = [Layer("Photo", "ground truth", view.image)]

    def whole(image: Tensor, level: int) -> Tensor:
        return to_full_size(image, view.camera.size, level, renderer.pyramid).cpu()

    coarsest = renderer.levels - 1
    if composition.residuals:
        base = look.of(whole(composition.base, coarsest))
        layers.append(Layer("Base", _level_label(coarsest, composition.base), base))
    for level, residual in composition.residuals.items():
        detail = f"{_level_label(level, residual)}, zero is grey"
        added = whole(residual, level)
        added = look.of(added) - look.of(torch.zeros_like(added))  # a look's constant is in the base already
        layers.append(Layer("Difference" if renderer.nested else "Residual", detail, around_grey(added)))
    layers.append(Layer("Composition", f"rendered by the run{look.remark}", look.of(composition.composed[0].cpu())))
    for baseline, its_look in zip(renderers[1:], looks[1:], strict=True):
        image = its_look.of(baseline.render(view.camera).composed[0].cpu())
        layers.append(Layer("Baseline", f"rendered by the baseline{its_look.remark}", image))
    return layers


def _level_label(level: int, image: Tensor) -> str:
    height, width = image.shape[-2:]
    return f"level {level}, {width}x{height}"


def edge_squares(photo: Tensor, count: int) -> list[tuple[int, int, int]]:
    """Return the squares with the strongest edges, which lose most in one pyramid level.

    Args:
        photo: (3, h, w).
        count: most squares to return; fewer when there is no room.

    Returns:
        Left, top and side in pixels of squares that do not overlap, the strongest first.
    """
    height, width = photo.shape[-2:]
    side = min(height, width, max(CUTOUT_LEAST, min(CUTOUT_MOST, round(min(height, width) * CUTOUT_SHARE))))
    pyramid = Pyramid()
    lost = (photo - pyramid.up(pyramid.down(photo), (height, width))).square().mean(0)  # (h, w)
    strength = torch.nn.functional.avg_pool2d(lost[None, None], side, stride=1)[0, 0]  # (h - side + 1, w - side + 1)
    squares: list[tuple[int, int, int]] = []
    while len(squares) < count and bool((strength >= 0).any()):
        top, left = divmod(int(strength.argmax()), strength.shape[1])
        squares.append((left, top, side))
        strength[max(0, top - side + 1) : top + side, max(0, left - side + 1) : left + side] = -1.0
    return squares


def cut_out(layers: Sequence[Layer], square: tuple[int, int, int]) -> Cutout:
    """Return the part of each layer in a square of `edge_squares`, in its own pixels."""
    left, top, side = square
    height, width = layers[0].image.shape[-2:]
    pictures = []
    for layer in layers:
        part = layer.image[:, top : top + side, left : left + side]
        pictures.append(Picture(layer.caption, "", side, side, _data_uri(part, "png")))
    return Cutout(
        100 * left / width, 100 * top / height, 100 * side / width, 100 * side / height, side, tuple(pictures)
    )


def shrink(layer: Layer) -> Picture:
    """Return a layer as a picture with sides of at most `IMAGE_SIDE` pixels."""
    height, width = layer.image.shape[-2:]
    scale = min(1.0, IMAGE_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = resize_image(layer.image.clamp(0.0, 1.0), size)
    return Picture(layer.caption, layer.detail, *size, _data_uri(small, "jpg"))


def _data_uri(image: Tensor, kind: str) -> str:
    """Encode an image (3, h, w) as the data URI of a JPEG or PNG file."""
    data = base64.b64encode(encode_image(image, f".{kind}")).decode()
    return f"data:image/{'jpeg' if kind == 'jpg' else kind};base64,{data}"
