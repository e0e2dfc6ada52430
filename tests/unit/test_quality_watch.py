"""Held-out views measured during stages: when, which, and when a run says that it gets worse."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from lapgs_plugin.errors import TrainingStoppedError, UserInputError
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.scenes.scene import View
from lapgs_plugin.stages.appearance import ViewColors
from lapgs_plugin.training.evaluation import StageEvaluation, ViewPsnr
from lapgs_plugin.training.planning import make_plan
from lapgs_plugin.training.quality import (
    FALL,
    SAMPLES_OF_A_STAGE,
    QualityWatch,
    few_views_line,
    set_aside,
    spread_views,
)
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.strategies import Gradients
from tests.training_runs import Said, StopAt, plys, resume, train
from tests.training_scene import ring_scene


def test_two_worse_measurements_in_a_row_with_a_falling_loss_are_a_fall() -> None:
    watch = QualityWatch()
    measured = [(1, 20.0, 0.2), (1, 22.0, 0.1), (0, 20.0, 0.3), (0, 19.0, 0.2), (0, 18.0, 0.1), (0, 17.0, 0.05)]
    assert [watch.falls(*each) for each in measured] == [False] * 4 + [True, False]  # a level's first is never judged
    assert watch.best == 22.0


@pytest.mark.parametrize(
    "then",
    [
        [(22.0 - FALL + 0.01, 0.09), (22.0 - FALL + 0.01, 0.08)],  # about as good
        [(19.0, 0.12), (18.0, 0.13)],  # the loss rises as well: training, not overfitting, went wrong
        [(9.0, 0.09), (22.0, 0.08), (9.0, 0.07)],  # passing
    ],
)
def test_no_fall(then: list[tuple[float, float]]) -> None:
    watch = QualityWatch()
    assert not any(watch.falls(0, *each) for each in [(22.0, 0.1), *then])


def test_samples_are_spread_and_avoid_resets() -> None:
    settings = TrainSettings(iterations=7000, densification=Densification(strategy="3dgs"))
    stage = Stage(1, (100, 100), 3500, signed=False)
    schedule = StageSchedule.create(settings, stage, views=8)
    assert schedule.reset_every == 700
    assert schedule.sampled(5) == {700 - 8, 1400 - 8, 2100, 2800, 3500}  # densification ends at 1750
    done, ends = 0, []
    while done < 3500:
        done += schedule.views_of_step(done)
        ends.append(done)
    for sample in (692, 1392):
        assert min(end for end in ends if end >= sample) % 700 != 0  # measured before the reset, not after it


def test_a_run_measures_some_held_out_views_during_its_stages(tmp_path: Path) -> None:
    scene, settings = ring_scene(train=5, test=3), TrainSettings(iterations=40, sh_degree=0)
    archive = train(tmp_path / "run", scene, settings)
    history = archive.history()
    sampled = [entry for entry in history if "sampled_psnr" in entry]
    assert [entry["iteration"] for entry in sampled] == 2 * [4, 8, 12, 16, 20]
    ends = [entry for entry in history if "psnr" in entry]
    assert [entry["iteration"] for entry in ends] == [20, 20]
    for entry in ends:  # so few views that some are all
        assert entry["sampled_psnr"] == pytest.approx(entry["psnr"])


def measured(psnr: float) -> ViewPsnr:
    return ViewPsnr(psnr, psnr, None)


def test_a_run_that_gets_worse_says_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = iter([30.0 - step for step in range(100)])
    monkeypatch.setattr(StageEvaluation, "_psnr", lambda *_: measured(next(values)))
    scene, settings = (
        ring_scene(train=5, test=1),
        TrainSettings(iterations=60, levels=1, sh_degree=0, appearance="none"),
    )
    monitor = Said()
    train(tmp_path / "run", scene, settings, monitor=monitor)
    (line,) = (said for said in monitor.lines if said != "density control: --strategy 3dgs")
    assert line.startswith("level 0, iteration ")
    assert "held-out PSNR fell to 2" in line
    assert "--appearance affine" in line


def test_colors_are_read_for_measurements_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Reading them waits for a GPU, and between steps no clock runs.
    reads = []
    archived = ViewColors.archived

    def read(colors: ViewColors) -> Any:
        reads.append(None)
        return archived(colors)

    monkeypatch.setattr(ViewColors, "archived", read)
    settings = TrainSettings(iterations=200, levels=1, sh_degree=0, appearance="affine", keep="last")
    train(tmp_path / "run", ring_scene(train=5, test=1), settings)
    assert 1 <= len(reads) <= 10  # eight measurements at most, and the archive


def test_keep_best_keeps_the_last_state_unless_another_one_is_visibly_better(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples = iter([20.0, 20.001] + [20.0 - 0.001 * step for step in range(8)])  # the second of ten is best by 0.008 dB
    values = (value for value in samples for _ in range(2))
    monkeypatch.setattr(StageEvaluation, "_psnr", lambda *_: measured(next(values)))
    scene = ring_scene(train=12, test=0)
    settings = TrainSettings(iterations=40, levels=1, sh_degree=0, appearance="none", keep="best")
    monitor = Said()
    train(tmp_path / "run", scene, settings, monitor=monitor)
    assert next(values, None) is None
    assert not [line for line in monitor.lines if "better than the last one" in line]


class Names(StageHook):
    def __init__(self) -> None:
        self.seen: set[str] = set()

    def before_render(self, context: StageContext) -> None:
        self.seen.add(context.view)


def test_keep_best_archives_the_best_state_by_views_that_are_not_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By invented measurements the base is best at its fourth sample, the residual, in joint training, at its ninth."""
    scene = ring_scene(train=12, test=0)
    settings = TrainSettings(iterations=80, sh_degree=0, keep="best", appearance="affine", joint=0.5)
    aside = [view.name for view in set_aside(scene.train)]
    assert len(aside) == 2
    fields: dict[tuple[int, int], Tensor] = {}
    along: dict[tuple[int, int], Tensor] = {}
    colors: dict[tuple[int, int], Any] = {}

    def invented(evaluation: StageEvaluation, view: View, exposure: Tensor | None) -> ViewPsnr:
        run = evaluation.run
        assert view.name in aside
        assert run.appearance is not None
        moment = run.stage.level, run.counts.iteration
        fields[moment], colors[moment] = run.model.field.means.detach().clone(), run.appearance.archived()
        if run.joint is not None:
            along[moment] = run.joint.fields[1].means.clone()
        return ViewPsnr(0.0, 20.0 + (moment in {(1, 16), (0, 36)}), None)

    monkeypatch.setattr(StageEvaluation, "_psnr", invented)
    names, monitor = Names(), Said()
    whole = train(tmp_path / "whole", scene, settings, monitor=monitor, user_hooks=[names])
    assert names.seen == {view.name for view in scene.train} - set(aside)
    assert (whole.field(1).means == along[0, 36]).all()
    assert (whole.field(0).means == fields[0, 36]).all()
    assert sum("1.00 dB better than the last one on 2 training views" in line for line in monitor.lines) == 2
    exposure = whole.exposure(0)
    assert exposure is not None
    assert exposure == colors[0, 36] != colors[0, 40]
    assert set(exposure) == names.seen
    for level, iteration in ((1, 20), (0, 38)):
        folder = tmp_path / f"stopped_{level}"
        with pytest.raises(TrainingStoppedError):
            train(folder, scene, settings, monitor=StopAt(level, iteration))
        again = resume(folder, scene, settings)
        assert [(again.field(each).means == whole.field(each).means).all() for each in (1, 0)] == [True, True]
        assert again.exposure(0) == exposure


def test_an_extension_that_gains_nothing_leaves_the_fields_of_the_finished_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = ring_scene(train=12, test=0)
    settings = TrainSettings(iterations=40, sh_degree=0, keep="best", appearance="none", joint=0.5)
    monkeypatch.setattr(
        StageEvaluation, "_psnr", lambda evaluation, *_: measured(20.0 + evaluation.run.counts.iteration)
    )
    finished = plys(train(tmp_path / "run", scene, settings))
    monkeypatch.setattr(
        StageEvaluation, "_psnr", lambda evaluation, *_: measured(40.0 - evaluation.run.counts.iteration)
    )
    longer = replace(settings, iterations=60, extended=20)
    archive = resume(tmp_path / "run", scene, longer)
    assert archive.manifest.record(0).iterations == 40
    assert plys(archive) == finished


def test_few_views_for_many_iterations_are_named() -> None:
    assert few_views_line(24, 30_000, True) is few_views_line(12, 5000, True) is None
    line = few_views_line(15, 7000, held_out=False)
    assert line is not None
    assert line.startswith("15 training views are few for 7,000 iterations, 466 passes over them")
    assert "--keep best" in line
    assert "--eval shows it" in line
    assert "the held-out PSNR shows it" in str(few_views_line(15, 7000, held_out=True))
    assert "--keep best" not in str(few_views_line(8, 7000, held_out=True))  # too few to set some aside


def test_few_photos_get_fewer_iterations_unless_something_says_when_things_happen() -> None:
    defaults = TrainSettings()
    lengths = [defaults.for_photos(count).iterations for count in (3, 38, 39, 43, 230)]
    assert lengths == [5000, 5000, 5070, 5590, 29_900]
    assert defaults.for_photos(231) is defaults
    assert TrainSettings(iterations=3000).for_photos(43).iterations == 3000
    assert TrainSettings(protocol="paper").for_photos(43).iterations == 30_000
    assert TrainSettings(densification=Densification(until=9000)).for_photos(43).iterations == 30_000
    assert TrainSettings(densification=Densification(reset_every=0)).for_photos(43).iterations == 5590
    assert defaults.for_photos(43).densification.strategy == defaults.densification.strategy == "mcmc"


def test_residuals_of_large_photos_have_a_longer_base_unless_something_says_otherwise() -> None:
    defaults, large = TrainSettings(), (3093, 2312)
    assert defaults.for_size(large).shares == (Fraction(2, 3), Fraction(1, 3))
    assert defaults.for_size((1280, 1080)) is defaults
    assert defaults.shares == (Fraction(1, 2), Fraction(1, 2))
    for other in (
        TrainSettings(split="1/2,1/2"),
        TrainSettings(levels=3),
        TrainSettings(hierarchy="nested"),
        TrainSettings(protocol="paper"),
        TrainSettings(densification=Densification(strategy="3dgs", options=Gradients())),
    ):
        assert other.for_size(large) is other


def test_keep_best_needs_views_to_set_aside(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"--keep best: .* the scene has 6 of them, expected at least 12"):
        make_plan((56, 40), TrainSettings(keep="best"), 6)
    with pytest.raises(UserInputError, match=r"--keep best: .* the scene has 1 of them, expected at least 12"):
        train(tmp_path / "run", ring_scene(train=1, test=0), TrainSettings(keep="best"))
    with pytest.raises(UserInputError, match="--keep first: expected last or best"):
        TrainSettings(keep="first")


def test_spread_views_are_the_same_and_evenly_spread() -> None:
    assert spread_views(range(100), 4) == [12, 37, 62, 87]
    assert spread_views(range(3), 8) == [0, 1, 2]
    assert SAMPLES_OF_A_STAGE >= 3  # two in a row, and a first
