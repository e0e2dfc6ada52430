"""Test nested levels in a run of each stub: a level's first field, its renders and its archived field."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.adapters.base import PARAMETERS
from lapgs_plugin.errors import LapgsError, MissingExtraError, RunFolderError, UserInputError
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.rasterizers.choice import rasterizer_for
from lapgs_plugin.rendering.run import run_scene
from lapgs_plugin.runner.dry_run import DryRun
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import OPTIMIZER
from lapgs_plugin.scenes import load_scene
from tests.contract.stub_runs import (
    CHECKOUTS,
    KINDS,
    NAMES,
    SHORT,
    STUBS,
    THIRDS,
    WHITE,
    StopAt,
    captured,
    drive,
    loaded,
    run_hierarchy,
    run_residuals,
    without,
)

DEGREE = 2
"""SH degree of the base at its end: the checkouts raise it every 1,000 iterations, which no stage here has."""


@dataclass
class State:
    """Hold the state of a checkout's model at the start of an iteration."""

    parameters: dict[str, Tensor]
    moments: dict[tuple[str, str], Tensor]
    degree: int

    @classmethod
    def of(cls, model: Any) -> State:
        optimizers = [model.optimizer, *([model.shoptimizer] if getattr(model, "shoptimizer", None) else [])]
        moments = {
            (group["name"], name): value.clone()
            for optimizer in optimizers
            for group in optimizer.param_groups
            for name, value in optimizer.state.get(group["params"][0], {}).items()
        }
        parameters = {name: getattr(model, name).detach().clone() for name in PARAMETERS}
        return cls(parameters, moments, model.active_sh_degree)


@dataclass
class Seen(StageHook):
    """Hold states and calls of a run.

    Attributes:
        starts: state at the first iteration of each level.
        iterations: what the checkout calls the iterations of the run.
        contexts: contexts of hooks in the second stage.
        rendered: width, sum of the background and SH degree of every call of the rasterizer in an iteration or later.
    """

    starts: list[State] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    contexts: list[StageContext] = field(default_factory=list)
    rendered: set[tuple[int, float, int]] = field(default_factory=set)

    def loss(self, context: StageContext, image: Tensor) -> None:
        if context.stage.level == 0:
            self.contexts.append(context)


def watch(adapter: Any, seen: Seen) -> None:
    model = adapter.train.GaussianModel
    renderer: Any = sys.modules["gaussian_renderer"]
    update, rasterizer = model.update_learning_rate, renderer.GaussianRasterizer

    def update_learning_rate(self: Any, iteration: int) -> Any:
        seen.iterations.append(iteration)
        if iteration in (1, 31):
            seen.starts.append(State.of(self))
        self.active_sh_degree = DEGREE
        return update(self, iteration)

    def make_rasterizer(raster_settings: Any) -> Any:
        background = float(raster_settings.bg.sum())
        if seen.iterations:  # one render comes before
            seen.rendered.add((raster_settings.image_width, background, raster_settings.sh_degree))
        return rasterizer(raster_settings=raster_settings)

    model.update_learning_rate = update_learning_rate
    renderer.GaussianRasterizer = make_rasterizer


def run_watched(name: str, scene: Path, folder: Path, *more: Any, stop: bool = False, resume: bool = False) -> Seen:
    seen = Seen()
    with captured(folder, []), loaded(STUBS[name], scene, folder, *more) as adapter:
        watch(adapter, seen)
        drive(adapter, hooks=(seen, *([StopAt(0)] if stop else [])), resume=resume, **THIRDS)
    return seen


@pytest.fixture(scope="module")
def run_of(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[RunArchive, Seen]]:
    """Run nested levels of a stub over white once, on a rasterizer without signed colour."""
    runs: dict[str, tuple[RunArchive, Seen]] = {}

    def unasked(*_: Any, **__: Any) -> None:
        raise AssertionError("nothing is signed")

    def run(name: str) -> tuple[RunArchive, Seen]:
        if name not in runs:
            folder = tmp_path_factory.mktemp(name) / "run"
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(DryRun, "color_path", unasked)
                seen = run_watched(name, scene, folder, *WHITE)
            runs[name] = RunArchive.open(folder), seen
        return runs[name]

    return run


@pytest.mark.parametrize("name", NAMES)
def test_no_level_is_a_residual(name: str, run_of: Callable[[str], tuple[RunArchive, Seen]]) -> None:
    archive, seen = run_of(name)
    coarse, fine = archive.manifest.records
    assert (coarse.level, coarse.signed, coarse.image_size) == (1, False, (32, 24))
    assert (fine.level, fine.signed, fine.image_size) == (0, False, (64, 48))
    assert not any(archive.field(level).signed for level in (1, 0))
    assert "cache" not in {*coarse.overhead_seconds, *fine.overhead_seconds}, "nothing predicts"
    assert archive.manifest.settings["hierarchy"] == "nested"
    assert seen.rendered == {(32, 3.0, DEGREE), (64, 3.0, DEGREE)}, "over white, and in clamped colours"


@pytest.mark.parametrize("name", NAMES)
def test_one_call_trains_all_levels(name: str, run_of: Callable[[str], tuple[RunArchive, Seen]]) -> None:
    """The checkout counts through, and its optimizers keep their state from one level to the next."""
    archive, seen = run_of(name)
    assert seen.iterations == list(range(1, 91))
    _, start = seen.starts
    coarse = archive.field(1)
    for part, of in PARAMETERS.items():
        assert torch.equal(start.parameters[part], of(coarse)), part
    assert {group for group, _ in start.moments} >= {"xyz", "f_dc", "opacity", "scaling", "rotation"}
    assert 20 < float(start.moments["opacity", "step"]) <= 30  # 24 seen: where Gaussians change, nothing steps
    assert start.degree == DEGREE
    assert not archive.path("level_1", OPTIMIZER).exists(), "of no use once the finest level is there"
    assert not archive.path("level_1", "cfg_args").exists()
    assert archive.path("level_0", "cfg_args").exists(), "one call has one output folder"


@pytest.mark.parametrize("name", NAMES)
def test_images_are_compared_whole(name: str, run_of: Callable[[str], tuple[RunArchive, Seen]], scene: Path) -> None:
    """The second stage's targets are the photos, and its renders are not composed."""
    photos = {Path(view.name).stem: view.image for view in load_scene(scene, progress=False).train}
    told = run_of(name)[1].contexts
    assert len(told) == 60
    for context in told:
        assert context.accumulated is None
        assert (context.target - photos[Path(context.view).stem]).abs().max() < 1e-6  # 6e-8 seen


@pytest.mark.parametrize("name", NAMES)
def test_the_finest_field_alone_makes_the_held_out_views(
    name: str, run_of: Callable[[str], tuple[RunArchive, Seen]]
) -> None:
    """The final PLY, rendered without the checkout's code, has the PSNR of the history."""
    archive, _ = run_of(name)
    *_, noted = (entry for entry in archive.history() if "psnr" in entry)
    alone = GaussianField.load_ply(archive.field_path(0))
    rasterizer = rasterizer_for(archive.manifest, "cpu", archive.manifest.rasterizer).rasterizer
    white = torch.ones(3)
    with torch.no_grad():
        values = [
            psnr(rasterizer(alone, view.camera, background=white).image, view.image) for view in run_scene(archive).test
        ]
    # 4e-9 seen; cameras differ by rounding, and a pixel at 1/255 that differs on another processor makes 5e-5.
    assert sum(values) / len(values) == pytest.approx(noted["psnr"], abs=1e-3)


@pytest.mark.parametrize("name", ["fastgs", "graphdeco"])
def test_a_stopped_run_starts_its_finest_level_the_same(
    name: str, run_of: Callable[[str], tuple[RunArchive, Seen]], scene: Path, tmp_path: Path
) -> None:
    """It is continued by the checkout's own way to start in the middle, and counts on."""
    with pytest.raises(KeyboardInterrupt):
        run_watched(name, scene, tmp_path / "run", *WHITE, stop=True)
    seen = run_watched(name, scene, tmp_path / "run", *WHITE, resume=True)
    assert seen.iterations == list(range(31, 91))
    (again,) = seen.starts
    _, start = run_of(name)[1].starts
    for part, value in start.parameters.items():
        assert torch.equal(again.parameters[part], value), part
    assert again.moments.keys() == start.moments.keys()
    for key, moment in start.moments.items():
        assert torch.equal(again.moments[key], moment), key
    assert again.degree == start.degree
    assert RunArchive.open(tmp_path / "run").manifest.complete


def test_a_stopped_taming_run_continues_once_its_budget_is_spent(scene: Path, tmp_path: Path) -> None:
    """Before, its budget would count anew. Opacities that were released before the stop are released again."""
    for until, folder in ((60, tmp_path / "early"), (30, tmp_path / "late")):
        more = (*WHITE, "--densify_until_iter", until, "--ho_iteration", 25)
        with pytest.raises(KeyboardInterrupt):
            run_watched("taming", scene, folder, *more, stop=True)
        if until == 60:
            with pytest.raises(UserInputError, match=r"the budget of Taming-3DGS counts .* again at iteration 31"):
                run_watched("taming", scene, folder, *more, resume=True)
            continue
        coarse = RunArchive.open(folder).field(1)
        (start,) = run_watched("taming", scene, folder, *more, resume=True).starts
        # Released opacities are the values themselves. 1.2e-7 seen.
        assert (start.parameters["_opacity"][:, 0] - torch.sigmoid(coarse.opacity_logits)).abs().max() < 1e-5


def test_a_script_that_cannot_start_in_the_middle_says_so(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run_watched("graphdeco", scene, folder, stop=True)
    with captured(folder, []), loaded(STUBS["graphdeco"], scene, folder) as adapter:
        without(adapter.profile.model, "restore")
        with pytest.raises(UserInputError, match=r"--resume: training.* of train.py continues from no checkpoint"):
            drive(adapter, resume=True, **THIRDS)


WARMING_UP = "if iteration > 14: gaussians.update_learning_rate(iteration)"
"""As in RAIN-GS, whose learning rates stay as they are while it warms up."""


@pytest.mark.parametrize(("hierarchy", "instead"), [("nested", "pass"), ("laplacian", "pass"), ("nested", WARMING_UP)])
def test_iterations_are_steps_where_nothing_says_when_they_begin(
    hierarchy: str, instead: str, scene: Path, tmp_path: Path
) -> None:
    """The loop leaves out the last step, and its densification replaces positions between a step and the next."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "checkouts", ignore=shutil.ignore_patterns("__pycache__")))
    script = checkouts / "graphdeco" / "train.py"
    text = script.read_text(encoding="utf-8")
    call = "gaussians.update_learning_rate(iteration)"
    assert text.count(call) == 1
    script.write_text(text.replace(call, instead), encoding="utf-8")
    contexts: list[tuple[int, int]] = []

    class Noting(StageHook):
        def before_render(self, context: StageContext) -> None:
            contexts.append((context.stage.level, context.iteration))

    folder = tmp_path / "run"
    with captured(folder, []), loaded(STUBS["graphdeco"], scene, folder, *SHORT, script=script) as adapter:
        if instead == "pass":
            without(adapter.profile.model, "update_learning_rate")
        drive(adapter, hooks=(Noting(),), hierarchy=hierarchy, dry_run=True, **THIRDS)
    archive = RunArchive.open(folder)
    assert [record.image_size for record in archive.manifest.records] == [(32, 24), (64, 48)]
    # A call's first iteration begins with its first step, after its render, for which hooks are called.
    assert contexts == [*((1, i) for i in range(1, 11)), *((0, i) for i in range(1, 21))]


@pytest.mark.parametrize("hierarchy", KINDS)
def test_a_loop_that_trains_a_second_model_and_sets_learning_rates_at_its_end(
    hierarchy: str, scene: Path, tmp_path: Path
) -> None:
    """As CoR-GS: the calls of a second model are no iterations, and neither is the last one's an iteration's begin."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "checkouts", ignore=shutil.ignore_patterns("__pycache__")))
    script = checkouts / "graphdeco" / "train.py"
    text = script.read_text(encoding="utf-8")
    for old, new in (
        ("        gaussians.update_learning_rate(iteration)\n", ""),
        (
            "    gaussians.training_setup(opt)\n",
            "    gaussians.training_setup(opt)\n    import copy\n    other = copy.deepcopy(gaussians)\n"
            "    other.training_setup(opt)\n",
        ),
        (
            "            if iteration < opt.iterations:\n",
            "            for each in (gaussians, other):\n                each.update_learning_rate(iteration)\n"
            "            other.optimizer.step()\n            if iteration < opt.iterations:\n",
        ),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    script.write_text(text, encoding="utf-8")
    levels: list[int] = []

    class Noting(StageHook):
        def before_render(self, context: StageContext) -> None:
            levels.append(context.stage.level)

    several = pytest.raises(UserInputError, match=r"more than one model, and a residual is one, .*--hierarchy nested")
    more = ("--iterations", 30)
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *more, script=script) as adapter,
        several if hierarchy == "laplacian" else nullcontext(),
    ):
        drive(adapter, hooks=(Noting(),), hierarchy=hierarchy, dry_run=True, **THIRDS)
    assert levels == ([] if hierarchy == "laplacian" else [1] * 10 + [0] * 20)
    assert (tmp_path / "run").exists() == (hierarchy == "nested")


def test_a_loop_that_keeps_images_from_before_it_is_told_why_it_fails(
    scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The checkout's own error stays; a line before it says what is different in one call."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "checkouts", ignore=shutil.ignore_patterns("__pycache__")))
    script = checkouts / "graphdeco" / "train.py"
    text, loop = script.read_text(encoding="utf-8"), "    for iteration in range(first_iter, opt.iterations + 1):\n"
    keeps = "    view = scene.getTrainCameras()[0]\n    kept = view.original_image\n"
    script.write_text(text.replace(loop, f"{keeps}{loop}        kept + view.original_image\n"), encoding="utf-8")
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", script=script) as adapter,
        pytest.raises(RuntimeError, match="size of tensor"),
    ):
        drive(adapter, **THIRDS)
    assert "failed 1 iterations after its views got the size of level 0" in caplog.text
    assert RunArchive.open(tmp_path / "run").available_levels == (1,)


@pytest.mark.parametrize(("hierarchy", "levels"), [("nested", (1, 0)), ("laplacian", (1,))])
@pytest.mark.parametrize("kind", [AttributeError, MissingExtraError])
def test_what_a_script_does_last_costs_no_level(
    kind: type[Exception],
    hierarchy: str,
    levels: tuple[int, ...],
    scene: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """As of forks that measure or compress after the last iteration, with packages that have changed since."""
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", "--iterations", 15) as adapter:
        training = adapter.train.training

        @wraps(training)
        def broken(**values: Any) -> None:
            training(**values)
            raise kind("np.cast was removed")

        adapter.train.training = broken
        with pytest.raises(kind, match=r"np\.cast"):
            drive(adapter, hierarchy=hierarchy)
    archive, level = RunArchive.open(tmp_path / "run"), levels[-1]
    assert (archive.available_levels, archive.manifest.complete) == (levels, hierarchy == "nested")
    assert f"failed after it had trained level {level}, which is in the run folder (" in caplog.text


@pytest.mark.parametrize(("hierarchy", "iterations"), [("nested", 20), ("laplacian", 0), ("laplacian", 8)])
def test_a_loop_that_ends_early_says_where(
    hierarchy: str, iterations: int, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run") as adapter:
        training = adapter.train.training

        @wraps(training)
        def short(**values: Any) -> None:
            values["opt"].iterations = iterations
            training(**values)

        adapter.train.training = short
        if iterations == 8:
            drive(adapter, hierarchy=hierarchy, joint=0.0)
            warned = [each.getMessage() for each in caplog.records if "expected" in each.getMessage()]
            assert warned == [f"training() ran 8 iterations, expected {n} as --iterations says" for n in (30, 60)]
            return
        of = 90 if hierarchy == "nested" else 30
        with pytest.raises(LapgsError, match=rf"ended after {iterations} of {of} iterations, in level 1; expected"):
            drive(adapter, hierarchy=hierarchy, **THIRDS)


def test_tamings_budget_is_the_whole_runs(run_of: Callable[[str], tuple[RunArchive, Seen]]) -> None:
    """The budget is 300 points times 4. Densification ends at iteration 60, in the finest level. Seen: 974 and 1189."""
    coarse, fine = (record.num_gaussians for record in run_of("taming")[0].manifest.records)
    assert 600 < coarse < fine <= 1200


def test_three_levels(big: Path, tmp_path: Path) -> None:
    archive, _ = run_hierarchy(STUBS["fastgs"], big, tmp_path / "run", "--iterations", 12, levels=3)
    assert [(r.level, r.signed) for r in archive.manifest.records] == [(2, False), (1, False), (0, False)]


def test_backgrounds_may_be_random(scene: Path, tmp_path: Path) -> None:
    """Renders over another background would not compose."""
    more = ("--random_background", "--iterations", 30)
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *more)
    assert archive.manifest.complete


def test_a_run_goes_on_with_its_own_hierarchy_alone(scene: Path, tmp_path: Path) -> None:
    folder, short = tmp_path / "run", ("--iterations", 30)
    with pytest.raises(KeyboardInterrupt):
        run_residuals(STUBS["graphdeco"], scene, folder, *short, hooks=(StopAt(0),))
    with pytest.raises(RunFolderError, match=r"another hierarchy \('laplacian', now 'nested'\).*--hierarchy laplacian"):
        run_hierarchy(STUBS["graphdeco"], scene, folder, *short, resume=True, **THIRDS)
    archive, _ = run_residuals(STUBS["graphdeco"], scene, folder, *short, resume=True)
    assert [record.signed for record in archive.manifest.records] == [False, True]
