"""Write the figures that an experiment asks for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from lapgs_bench.experiments.exports import Row
from lapgs_bench.experiments.figures.curves import draw_peak_memory, draw_time_against_gaussians, draw_training
from lapgs_bench.experiments.figures.image import write_image
from lapgs_bench.experiments.figures.pictures import draw_crops, draw_edges
from lapgs_bench.experiments.results import Results
from lapgs_bench.experiments.schema import Experiment, Figure
from lapgs_plugin.errors import LapgsError

FOLDER = "figures"
"""Folder of the figures in an experiment's folder."""


def write_figures(experiment: Experiment, rows: Sequence[Row], folder: Path) -> list[str]:
    """Write an experiment's figures into its folder, as SVG and PNG.

    Args:
        experiment: says which.
        rows: the results, as in results.csv.
        folder: the experiment's folder.

    Returns:
        A line for each figure that is left out.
    """
    results, problems = Results(folder, rows), dict[str, None]()
    for figure in experiment.figures if rows else ():
        for name, draw in _images(experiment, figure, results):
            try:
                image = draw()
            except LapgsError as error:
                problems[f"{name} is left out: {error}"] = None
                continue
            try:
                write_image(folder / FOLDER / name, image)
            except LapgsError as error:
                problems[str(error)] = None
    return list(problems)


def _images(experiment: Experiment, figure: Figure, results: Results) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield the images of a figure: a name, and a function that draws the SVG."""
    measured = list(dict.fromkeys(row["scene"] for row in results.rows))
    scenes = [scene for scene in measured if scene in (figure.scenes or measured)]
    for name, shown in figure.images(scenes).items():
        yield name, _drawing(experiment, figure, results, shown)


def _drawing(experiment: Experiment, figure: Figure, results: Results, scenes: Sequence[str]) -> Callable[[], str]:
    """Return what draws an image of these scenes; most images are of one."""
    scene = next(iter(scenes), "")
    match figure.kind:
        case "seconds_over_gaussians":
            return lambda: draw_time_against_gaussians(experiment, results, scenes)
        case "peak_memory":
            return lambda: draw_peak_memory(experiment, results, scenes)
        case "psnr_over_seconds":
            advice = "give its runs options = { test_every = 1000 }"
            return lambda: draw_training(
                experiment, results, scene, figure="psnr", x="time", title="Held-out PSNR (dB)", advice=advice
            )
        case "gaussians_over_iterations":
            return lambda: draw_training(
                experiment,
                results,
                scene,
                figure="num_gaussians",
                x="iterations",
                title="Gaussians in training",
                advice="run it again",
            )
        case "crops":
            return lambda: draw_crops(experiment, results, scene, figure.view)
        case _:
            return lambda: draw_edges(experiment, results, scene)
