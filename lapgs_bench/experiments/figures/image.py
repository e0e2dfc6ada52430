"""Draw charts, bars and pictures as SVG images, and write them as SVG and PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from lapgs_plugin.errors import MissingExtraError, require_extra
from lapgs_plugin.files import atomic_write, one_line_errors, write_text
from lapgs_plugin.reports.charts import BarChart, Chart
from lapgs_plugin.reports.pictures import Layer, cut_out, shrink
from lapgs_plugin.reports.report import render_page

CHARTS, BARS, PICTURES = (Path(__file__).with_name(f"{name}.svg.jinja") for name in ("charts", "bars", "pictures"))
HEADING, LEGEND_ROW, MARGIN = 30, 16, 8
"""Height of an image's title, height of a row of its legend, and room at its edges, in chart units."""
CHART_TITLE = 20
"""Height of a chart's title."""
COLUMN, GAP, CAPTION = 220, 6, 18
"""Width of a column of pictures, room between two of them, and height of a caption."""
PIXELS = 3
"""Pixels of the PNG for a chart unit of the SVG: 420 units are 10 cm at 320 dpi."""


@dataclass(frozen=True)
class PlacedPicture:
    """A picture in chart units; an enlarged one shows its pixels."""

    x: float
    y: float
    width: float
    height: float
    data: str
    enlarged: bool


@dataclass(frozen=True)
class Caption:
    """A line of text; `x` is its start and `y` its baseline."""

    x: float
    y: float
    text: str
    heading: bool = False


@dataclass(frozen=True)
class Box:
    """The outline of an enlarged part in a whole picture."""

    x: float
    y: float
    width: float
    height: float


def draw_charts(charts: Sequence[Chart], styles: Mapping[str, str], label: str, title: str, columns: int) -> str:
    """Return an SVG image of charts, row by row.

    Args:
        charts: of one size.
        styles: of lines, by what they stand for.
        label: says what the image shows.
        title: written above.
        columns: charts beside each other.
    """
    top, frame = HEADING + LEGEND_ROW * len(styles), charts[0].frame
    rows = -(-len(charts) // columns)
    size = {"width": columns * frame.width, "height": top + rows * (frame.height + CHART_TITLE)}
    return _drawn(CHARTS, size, styles, label, title, charts=charts, columns=columns, top=top, frame=frame)


def draw_bar_image(chart: BarChart, label: str) -> str:
    """Return an SVG image of bars, with the chart's title above."""
    size = {"width": chart.frame.width + 2 * MARGIN, "height": HEADING + chart.frame.height + MARGIN}
    return _drawn(BARS, size, {}, label, chart.title, chart=chart, top=HEADING)


def draw_pictures(layers: Sequence[Layer], squares: Sequence[tuple[int, int, int]], label: str, title: str) -> str:
    """Return an SVG image of pictures beside each other, and below each of them its enlarged parts.

    Args:
        layers: of one size, each with its caption and a detail below.
        squares: left, top and side in pixels of the parts to enlarge.
        label: says what the image shows.
        title: written above.
    """
    height, width = layers[0].image.shape[-2:]
    scale = COLUMN / width
    whole = height * scale
    xs = [MARGIN + column * (COLUMN + GAP) for column in range(len(layers))]
    top = HEADING + 2 * CAPTION
    captions = [
        caption
        for x, layer in zip(xs, layers, strict=True)
        for caption in (Caption(x, HEADING + 12, layer.caption, True), Caption(x, HEADING + CAPTION + 10, layer.detail))
    ]
    pictures = [
        PlacedPicture(x, top, COLUMN, whole, shrink(layer).data, False) for x, layer in zip(xs, layers, strict=True)
    ]
    boxes = [
        Box(x + left * scale, top + upper * scale, side * scale, side * scale)
        for x in xs
        for left, upper, side in squares
    ]
    below = top + whole + GAP
    for square in squares:
        cutout = cut_out(layers, square)
        pictures += [
            PlacedPicture(x, below, COLUMN, COLUMN, picture.data, True)
            for x, picture in zip(xs, cutout.pictures, strict=True)
        ]
        below += COLUMN + GAP
    size = {"width": xs[-1] + COLUMN + MARGIN, "height": below - GAP + MARGIN}
    return _drawn(PICTURES, size, {}, label, title, pictures=pictures, captions=captions, boxes=boxes)


def _drawn(
    template: Path, size: Mapping[str, float], styles: Mapping[str, str], label: str, title: str, **values: Any
) -> str:
    return render_page(template, **size, styles=styles, label=label, title=title, **values)


def write_image(path: Path, svg: str) -> None:
    """Write an image as `path` with the suffix .svg, and as PNG beside it.

    Raises:
        MissingExtraError: the SVG is written, but resvg_py is not installed, or there are no fonts.
        RunFolderError: a file cannot be written.
    """
    with one_line_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path.with_suffix(".svg"), svg)
    png = png_of(svg)
    with one_line_errors(path), atomic_write(path.with_suffix(".png")) as stream:
        stream.write(png)


def png_of(svg: str) -> bytes:
    """Return an SVG image as the bytes of a PNG file.

    Raises:
        MissingExtraError: resvg_py is not installed, or this machine has no font for the image's text.
    """
    subject = "a figure as PNG"
    require_extra("resvg_py", "figures", subject)
    import resvg_py

    if not _draws_text():
        raise MissingExtraError(
            f"{subject} needs a font, and this machine has none: install one, such as Debian's fonts-dejavu-core"
        )
    return bytes(resvg_py.svg_to_bytes(svg_string=svg, zoom=PIXELS))


def _draws_text() -> bool:
    """Return whether text leaves a mark: without a font of the system it is left out silently."""
    import resvg_py
    from PIL import Image

    text = '<svg xmlns="http://www.w3.org/2000/svg" width="20" height="20"><text y="18" font-size="18">M</text></svg>'
    image = Image.open(BytesIO(bytes(resvg_py.svg_to_bytes(svg_string=text))))
    return image.getbbox() is not None
