"""Draw figures of rendered views: one view by all methods, and how well each level keeps the strongest edges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from kornia.filters import spatial_gradient
from torch import Tensor

from lapgs_bench.experiments.figures.curves import Methods, NothingToDrawError
from lapgs_bench.experiments.figures.image import draw_bar_image, draw_pictures
from lapgs_bench.experiments.results import Results
from lapgs_bench.experiments.schema import Experiment
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.reports.charts import Bar, draw_bars
from lapgs_plugin.reports.pictures import CUTOUTS, Layer, edge_squares
from lapgs_plugin.scenes.scene import View

STRONGEST = 0.05
"""Share of a photo's pixels whose gradients are its strong edges."""


@dataclass(frozen=True)
class _Rendered:
    """A method's run, ready to render its held-out views."""

    label: str
    renderer: HierarchyRenderer
    views: Sequence[View]

    def image(self, view: View) -> Tensor:
        """Render the whole image (3, h, w) of a view."""
        return self.renderer.render(view.camera).composed[0].clamp(0.0, 1.0).cpu()


def _rendered(experiment: Experiment, results: Results, scene: str) -> Iterator[_Rendered]:
    """Open the runs of a scene, the first seed of each method."""
    for pair, label in Methods.of(experiment, results).labels.items():
        for row in results.of(scene, *pair)[:1]:
            archive = results.run(row).archive
            views = run_scene(archive).test
            if views:
                yield _Rendered(label, run_renderer(archive), views)


@torch.no_grad()
def draw_crops(experiment: Experiment, results: Results, scene: str, view: str | None) -> str:
    """Return one held-out view of a scene as photo and by each method, with the parts whose edges are strongest.

    Args:
        experiment, results, scene: which runs; of those that differ in image size, those like the first.
        view: its name; None for the view whose PSNR by the first method is the median.

    Raises:
        NothingToDrawError: there is no run with held-out views, or no such view.
        LapgsError: a run cannot be rendered here.
    """
    with one_pool():
        methods = list(_rendered(experiment, results, scene))
        if not methods:
            raise NothingToDrawError(f"no run of {scene} held out views; run it with held-out views")
        shown = _chosen(methods[0], view)
        layers = [Layer("Photo", shown.name, shown.image)]
        for method in methods:
            own = next((each for each in method.views if each.name == shown.name), None)
            if own is not None and own.camera.size == shown.camera.size:
                image = method.image(own)
                layers.append(Layer(method.label, f"{psnr(image, shown.image):.2f} dB", image))
    return draw_pictures(layers, edge_squares(shown.image, CUTOUTS), f"{scene} by method", scene)


def _chosen(method: _Rendered, name: str | None) -> View:
    if name is None:
        ranked = sorted(method.views, key=lambda view: psnr(method.image(view), view.image))
        return ranked[(len(ranked) - 1) // 2]
    for view in method.views:
        if view.name == name:
            return view
    known = ", ".join(view.name for view in method.views[:3])
    raise NothingToDrawError(f"view {name!r} is not held out; expected one such as {known}")


@torch.no_grad()
def draw_edges(experiment: Experiment, results: Results, scene: str) -> str:
    """Return bars of the gradient error at strong edges, one for each level of each method, means over held-out views.

    Raises:
        NothingToDrawError: there is no run with held-out views.
        LapgsError: a run cannot be rendered here.
    """
    bars = []
    with one_pool():
        for method in _rendered(experiment, results, scene):
            errors: dict[int, list[float]] = {}
            for view in method.views:
                composed = method.renderer.render(view.camera).composed
                for level, image in composed.items():
                    whole = to_full_size(image, view.camera.size, level, method.renderer.pyramid).clamp(0.0, 1.0).cpu()
                    errors.setdefault(level, []).append(edge_error(whole, view.image))
            for level, values in errors.items():
                name = f"{method.label}, level {level}" if len(errors) > 1 else method.label
                bars.append(Bar(name, [("gradient error", 100 * fmean(values))]))
    if not bars:
        raise NothingToDrawError(f"no run of {scene} held out views; run it with held-out views")
    chart = draw_bars(f"{scene}: gradient error at strong edges", bars, lambda value: f"{value:.1f} %")
    return draw_bar_image(chart, f"{scene}: gradient error at strong edges, in shares of the photo's gradient")


def edge_error(image: Tensor, photo: Tensor) -> float:
    """Return how much the gradients of an image differ from those of its photo at the photo's strong edges.

    Args:
        image, photo: (3, h, w).

    Returns:
        Mean length of the difference of the Sobel gradients of both luminances, as a share of the mean length of the
        photo's gradients, over the `STRONGEST` pixels of the photo. 0 is a perfect image, 1 one without any gradients.
        0 for a photo without gradients.
    """
    wanted, got = _gradients(photo), _gradients(image)
    strength = wanted.norm(dim=0)  # (h, w)
    count = max(1, round(STRONGEST * strength.numel()))
    strongest = strength.flatten().topk(count).indices
    error = (got - wanted).norm(dim=0).flatten()[strongest].mean()
    length = strength.flatten()[strongest].mean()
    return float(error / length) if length > 0 else 0.0


def _gradients(image: Tensor) -> Tensor:
    """Return the Sobel gradients (2, h, w) of an image's mean over colours (3, h, w)."""
    return spatial_gradient(image.mean(0)[None, None].float())[0, 0]
