"""Compare methods at equal time: check, train what is missing, write the page. Imports more than a help text may."""

from __future__ import annotations

from pathlib import Path

from lapgs_bench.experiments.run import RunsFailedError
from lapgs_bench.pareto.methods import Method, methods_of
from lapgs_bench.pareto.page import CSV, HTML, SVG, Curves, Row, figures, lpips_column, write_results
from lapgs_bench.pareto.running import Bench, MethodFailedError
from lapgs_bench.pareto.settings import ParetoSettings
from lapgs_plugin.cli.output import say
from lapgs_plugin.errors import TrainingStoppedError, UserInputError
from lapgs_plugin.files import is_folder
from lapgs_plugin.runs.layout import require_place, require_utf8
from lapgs_plugin.scenes.scene import load_cameras


def draw_pareto(scene: Path, settings: ParetoSettings) -> None:
    """Run what the help of `lapgs bench pareto` says."""
    _require_scene(scene, settings)
    methods = methods_of(settings)
    folder = settings.out or Path("runs", "pareto", scene.absolute().name)
    require_utf8(folder, "--out")
    require_place(folder)
    bench = Bench(settings, scene, folder, say)
    for method in methods:
        bench.check(method)
    try:
        rows, failures = _measure(bench, methods)
    except KeyboardInterrupt:
        raise TrainingStoppedError("stopped; repeat the command to continue with the remaining runs") from None
    if not rows:
        raise RunsFailedError(f"no method finished a budget; {failures[0]}")
    lpips = lpips_column(rows)
    if settings.lpips_weights and lpips is None:
        say("LPIPS is left out: a run was finished without --lpips-weights; choose another folder with --out")
    curves = Curves(scene.absolute().name, settings.budgets, [figures(row, lpips) for row in rows], lpips, failures)
    write_results(curves, folder)
    _say_readings(curves)
    say(f"{folder} holds {HTML}, {SVG}, {CSV} and the runs")
    if failures:
        raise RunsFailedError(f"{len(failures)} of {len(methods)} methods failed: {failures[0]}")


def _require_scene(scene: Path, settings: ParetoSettings) -> None:
    """Refuse a scene that is missing, cannot be read or has no views to train on besides those to hold out."""
    if not is_folder(scene):
        raise UserInputError(f"{scene} is not a folder; expected a scene, such as `lapgs sample` makes")
    load_cameras(scene, resolution=settings.resolution, images=settings.images, eval=True)


def _measure(bench: Bench, methods: list[Method]) -> tuple[list[Row], list[str]]:
    """Return the rows of all methods that finish, and a line for each other one."""
    rows: list[Row] = []
    failures: list[str] = []
    for method in methods:
        try:
            rows += bench.rows(method)
        except MethodFailedError as error:
            failures.append(" ".join(str(error).split()))
            say(failures[-1], stderr=True)
    return rows, failures


def _say_readings(curves: Curves) -> None:
    for line in curves.ratio_lines():
        say(line)
    for budget, cells in curves.best_lines():
        words = [f"{metric.title} {cell}" for metric, cell in zip(curves.metrics, cells, strict=True)]
        say(f"within {budget:g} s: {'; '.join(words)}")
