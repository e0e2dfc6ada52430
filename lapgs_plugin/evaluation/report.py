"""report.html: one page about a run, beside its baseline if there is one, that needs no other file and no network."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from torch import Tensor

from lapgs_plugin.archive import REPORT, RunArchive
from lapgs_plugin.evaluation.charts import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Chart, Mark, Series, draw
from lapgs_plugin.evaluation.comparison import Metrics, comparison_rows, unlike
from lapgs_plugin.files import atomic_write, one_line_errors
from lapgs_plugin.progress import item_progress
from lapgs_plugin.reference_raster.threads import one_pool
from lapgs_plugin.rendering.compose import HierarchyRenderer
from lapgs_plugin.rendering.images import around_grey
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.scenes.images import resize_image, write_image
from lapgs_plugin.scenes.scene import View

TEMPLATE = "report.html.jinja"
IMAGE_SIDE = 800
"""Longest side in pixels of an image on the page."""
MOST_COLUMNS = 5
MINUTES_FROM = 300.0
"""Runs at least this many seconds long are charted in minutes."""


@dataclass(frozen=True)
class MeasuredRun:
    """A complete run with its figures.

    Attributes:
        archive: the run folder.
        metrics: what its metrics.json holds.
    """

    archive: RunArchive
    metrics: Metrics


@dataclass(frozen=True)
class Picture:
    """One image of the page.

    Attributes:
        caption, detail: what it is, in words.
        width, height: in pixels, of what is embedded.
        data: a data URI.
    """

    caption: str
    detail: str
    width: int
    height: int
    data: str


@dataclass(frozen=True)
class Strip:
    """The pictures of one view, from the photo to the composition, and why this view is shown."""

    name: str
    why: str
    figures: str
    pictures: tuple[Picture, ...]

    @property
    def columns(self) -> int:
        """Pictures in a row of a wide page: all of them, or half when they would get too small."""
        count = len(self.pictures)
        return count if count <= MOST_COLUMNS else (count + 1) // 2


def write_report(
    run: MeasuredRun,
    baseline: MeasuredRun | None = None,
    moved_to: Path | None = None,
    *,
    device: str = "auto",
    rasterizer: str = "auto",
) -> Path:
    """Write RUN/report.html.

    Args:
        run: what the page is about.
        baseline: what it is compared with.
        moved_to: where the run's scene is now; None when it did not move.
        device, rasterizer: what renders the pictures, see `rendering.run.run_renderer`.

    Returns:
        The file.

    Raises:
        RunFolderError: the scene is not where it was, or the file cannot be written.
    """
    runs = [run] if baseline is None else [run, baseline]
    renderers = [run_renderer(each.archive, device, rasterizer) for each in runs]
    page = _render(
        name=run.archive.path().name,
        scene=Path(run.archive.manifest.scene.path).name,
        manifest=run.archive.manifest,
        metrics=run.metrics,
        baseline_name=baseline.archive.path().name if baseline else None,
        unlike=unlike(run.archive.manifest, baseline.archive.manifest) if baseline else [],
        rows=comparison_rows([each.metrics for each in runs]),
        charts=_charts(runs),
        strips=_strips(runs, renderers, moved_to),
        settings=_settings(run),
    )
    path = run.archive.path(REPORT)
    with one_line_errors(path), atomic_write(path) as stream:
        stream.write(page.encode())
    return path


def _render(**values: Any) -> str:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    size = {"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": RIGHT, "top": TOP, "bottom": BOTTOM}
    return environment.get_template(TEMPLATE).render(values, size=size)


def _charts(runs: Sequence[MeasuredRun]) -> dict[str, list[Chart]]:
    """Loss, held-out PSNR and number of Gaussians, over seconds and over iterations; without what was not recorded."""
    longest = max(run.metrics["train_seconds"] for run in runs)
    unit, scale = ("minutes", 60.0) if longest >= MINUTES_FROM else ("seconds", 1.0)
    return {
        "time": _chart_row(runs, f"{unit} of optimization", lambda run, entry: entry["elapsed"] / scale),
        "iterations": _chart_row(runs, "iterations, all stages", _iteration),
    }


def _iteration(run: MeasuredRun, entry: dict[str, Any]) -> float:
    """Iterations since the start of the run; the history counts within a stage."""
    before = sum(record.iterations for record in run.archive.manifest.records if record.level > entry["level"])
    return float(before + entry["iteration"])


def _chart_row(
    runs: Sequence[MeasuredRun], x_label: str, x_of: Callable[[MeasuredRun, dict[str, Any]], float]
) -> list[Chart]:
    marks = _stage_marks(runs[0], x_of)
    charts = []
    for key, title, from_zero, by_stage, format_y in (
        ("loss", "Loss", True, True, "{:g}".format),
        ("psnr", "Held-out PSNR (dB)", False, False, "{:g}".format),
        ("num_gaussians", "Gaussians in training", True, True, _count),
    ):
        series = [
            Series(kind, points)
            for run, kind in reversed(list(zip(runs, ("run", "baseline"), strict=False)))  # ours on top
            for points in _lines(run, key, by_stage, x_of)
        ]
        if series:
            charts.append(
                draw(title, x_label, series, marks=marks, from_zero=from_zero, format_x=_count, format_y=format_y)
            )
    return charts


def _lines(
    run: MeasuredRun, key: str, by_stage: bool, x_of: Callable[[MeasuredRun, dict[str, Any]], float]
) -> list[list[tuple[float, float]]]:
    """What the history says about `key`: one line, or one a stage where stages do not continue each other."""
    lines: dict[int, list[tuple[float, float]]] = {}
    for entry in run.archive.history():
        if key in entry:
            lines.setdefault(entry["level"] if by_stage else 0, []).append((x_of(run, entry), entry[key]))
    return list(lines.values())


def _stage_marks(run: MeasuredRun, x_of: Callable[[MeasuredRun, dict[str, Any]], float]) -> list[Mark]:
    """Where each stage of a hierarchy begins; nothing for a single field."""
    begins: dict[int, float] = {}
    end = 0.0
    for entry in run.archive.history():
        begins.setdefault(entry["level"], end)
        end = x_of(run, entry)
    return [Mark(x, f"level {level}") for level, x in begins.items()] if len(begins) > 1 else []


def _count(value: float) -> str:
    """A number short enough for an axis: 1.5k, 20k, 1.2M."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{suffix}"
    return f"{value:g}"


def _strips(runs: Sequence[MeasuredRun], renderers: Sequence[HierarchyRenderer], moved_to: Path | None) -> list[Strip]:
    """The worst, the median and the best view of the run, in pictures."""
    shown = _shown_views(runs[0].metrics)
    with one_pool():
        scene = run_scene(runs[0].archive, moved_to)
        views = {view.name: view for view in (*scene.train, *scene.test)}
        with item_progress("views") as progress:
            return [
                Strip(name, why, _view_figures(runs, name), _pictures(views[name], renderers))
                for name, why in progress.track(list(shown.items()), description="Rendering views for the report")
            ]


def _shown_views(metrics: Metrics) -> dict[str, str]:
    """Names of the views to show, with the reason."""
    ranked = [view["name"] for view in sorted(metrics["views"], key=lambda view: float(view["psnr"]))]
    chosen = {"worst": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "best": ranked[-1]}
    reasons: dict[str, str] = {}
    for why, name in chosen.items():
        reasons.setdefault(name, f"{why} of {len(ranked)} by PSNR")
    return reasons


def _view_figures(runs: Sequence[MeasuredRun], name: str) -> str:
    texts = []
    for run, label in zip(runs, ("", "baseline "), strict=False):
        texts += [
            f"{label}{view['psnr']:.2f} dB, SSIM {view['ssim']:.4f}"
            for view in run.metrics["views"]
            if view["name"] == name
        ]
    return "; ".join(texts)


def _pictures(view: View, renderers: Sequence[HierarchyRenderer]) -> tuple[Picture, ...]:
    renderer = renderers[0]
    composition = renderer.render(view.camera)
    pictures = [_picture(view.image, "Photo", "ground truth")]
    if composition.residuals:
        pictures.append(_picture(composition.base, "Base", f"level {renderer.levels - 1}"))
    for level, residual in composition.residuals.items():
        pictures.append(_picture(around_grey(residual), "Residual", f"level {level}, zero is grey"))
    pictures.append(_picture(composition.composed[0], "Composition", "what the run renders"))
    for baseline in renderers[1:]:
        pictures.append(_picture(baseline.render(view.camera).composed[0], "Baseline", "what it renders"))
    return tuple(pictures)


def _picture(image: Tensor, caption: str, detail: str) -> Picture:
    height, width = image.shape[-2:]
    scale = min(1.0, IMAGE_SIDE / max(height, width))
    small = resize_image(image.clamp(0.0, 1.0), (max(1, round(width * scale)), max(1, round(height * scale))))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.jpg"
        write_image(file, small)
        data = base64.b64encode(file.read_bytes()).decode()
    return Picture(
        caption, f"{detail}, {width}x{height}", small.shape[-1], small.shape[-2], f"data:image/jpeg;base64,{data}"
    )


def _settings(run: MeasuredRun) -> dict[str, str]:
    """What decides a run's result, by name, flat; and the versions it was measured with."""
    manifest = run.archive.manifest
    values: dict[str, Any] = {
        "scene": manifest.scene.path,
        "resolution": manifest.scene.resolution,
        "every eighth view held out": manifest.scene.eval,
        "background": ", ".join(f"{value:g}" for value in manifest.scene.background),
        "levels": manifest.levels,
        "grid": manifest.grid,
        "supervision": manifest.supervision,
        "inherit": manifest.inherit,
        "SH degree": manifest.sh_degree,
        "seed": manifest.seed,
        "rasterizer": manifest.rasterizer,
        "measured with rasterizer": run.metrics["rasterizer"],
        **_flat(manifest.settings),
        "trained": f"{manifest.created} by {manifest.created_by}",
        **{f"measured with {name}": version for name, version in run.metrics["versions"].items()},
    }
    return {name: "default" if value is None else str(value) for name, value in values.items()}


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        label = prefix + name.replace("_", " ")
        flat.update(_flat(value, f"{label}: ") if isinstance(value, dict) else {label: value})
    return flat
