"""Test that levels that lost their Gaussians, or that hardly change held-out images, are named, and no others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.training_figures import finest_gains, last_view_psnrs, smaller_gains, weak_levels
from lapgs_plugin.scenes.scene import View
from lapgs_plugin.training.evaluation import StageEvaluation, ViewPsnr
from lapgs_plugin.training.quality import set_aside
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.strategies import Mcmc
from tests.training_runs import Said, rendered_gains, train
from tests.training_scene import ring_scene

INSTEAD = "--hierarchy nested, --levels 1 or more photos"


def record(level: int, start: int | None = 100, end: int = 100, **changed: Any) -> LevelRecord:
    values = {"signed": level == 0, "iterations": 1000, **changed}
    return LevelRecord(
        level=level,
        num_gaussians=end,
        peak_gaussians=500,
        train_seconds=1.0,
        overhead_seconds={},
        image_size=(8, 6),
        start_gaussians=start,
        **values,
    )


DEAD = record(0, 500_000, 2)
ALIVE = record(0)


@pytest.mark.parametrize(
    ("finest", "gains", "settings", "named"),
    [
        (DEAD, [], {}, ["level 0 ended with 2 of the 500,000 Gaussians that it started with"]),
        (DEAD, 6 * [0.0], {}, ["level 0 ended with"]),  # once is enough
        (DEAD, [], {"prune": 0.01}, []),
        (record(0, 100, 10), [], {}, []),
        (record(0, None, 1), [], {}, []),  # the start was not recorded
        (ALIVE, 6 * [0.09], {}, ["level 0 changes the PSNR of 6 held-out images by +0.09 dB"]),
        (ALIVE, [-0.2, -0.3, 0.1, 0.0, -0.1, 0.2], {"prune": 0.01}, ["images by -0.05 dB"]),
        (ALIVE, 6 * [0.11], {}, []),
        (ALIVE, [0.9, -0.8, 0.9, -0.8], {}, []),  # +0.05 dB, give or take half a decibel
        (ALIVE, 3 * [0.0], {}, []),  # too few views
        (ALIVE, [], {}, []),
        (record(0, iterations=499), 6 * [0.0], {}, []),  # it had no time
    ],
)
def test_levels_that_matter_little_are_named(
    finest: LevelRecord, gains: list[float], settings: dict[str, Any], named: list[str]
) -> None:
    lines = weak_levels([record(1), finest], gains, settings)
    assert len(lines) == len(named)
    for line, part in zip(lines, named, strict=True):
        assert part in line
        assert line.endswith(INSTEAD)


def test_advice_fits_the_level() -> None:
    nested = record(0, signed=False)
    (line,) = weak_levels([record(1), nested], 4 * [0.0], {})
    assert line.endswith("with --levels 1 or more photos")
    (line,) = weak_levels([record(1, 100, 9)], 4 * [0.0], {})  # a base, of which nothing else is trained yet
    assert line.startswith("level 1 ended with 9 of the 100")
    assert "points and the cameras" in line
    for finest, gains in ((DEAD, []), (nested, 4 * [0.0])):
        (line,) = weak_levels([record(1), finest], gains, {}, advised=False)
        assert "--" not in line


def test_gains_are_those_of_the_last_measurement() -> None:
    history = [
        {"level": 1, "iteration": 9, "view_psnr": [20.0, 30.0]},
        {"level": 0, "iteration": 4, "psnr": 25.0},
        {"level": 0, "iteration": 9, "view_psnr": [21.0, 33.0], "coarser_view_psnr": [20.5, 30.5]},
    ]
    at_end, since = (finest_gains(last_view_psnrs(history, along=along)) for along in (True, False))
    assert (at_end, since) == ([0.5, 2.5], [1.0, 3.0])
    assert smaller_gains(since, [], at_end) == at_end
    assert smaller_gains([]) == ()
    del history[2]["coarser_view_psnr"]  # of nested levels
    assert finest_gains(last_view_psnrs(history, along=True)) == [1.0, 3.0]
    assert finest_gains(last_view_psnrs(history[:2], along=True)) == []


@pytest.mark.parametrize(
    "changed", [{"joint": 0.5}, {"joint": 0.0}, {"hierarchy": "nested"}, {"keep": "best"}], ids=str
)
def test_measured_gains_are_those_of_the_archived_fields(changed: dict[str, Any], tmp_path: Path) -> None:
    """Of the base as joint training left it, and of the state that `--keep best` chose."""
    scene = ring_scene(train=12, test=4)
    settings = TrainSettings(iterations=60, levels=2, sh_degree=0, appearance="none", **changed)
    archive = train(tmp_path / "run", scene, settings)
    gains = finest_gains(last_view_psnrs(archive.history(), along=True))
    assert gains == pytest.approx(rendered_gains(archive, scene.test), abs=1e-3)  # 3e-8 seen


def test_gains_beside_a_state_from_before_joint_training_are_those_of_the_archived_fields(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By invented figures of the views set aside, the residual is best before its base is trained along."""
    scene = ring_scene(train=12, test=4)
    aside, psnr_of = {view.name for view in set_aside(scene.train)}, StageEvaluation._psnr

    def invented(evaluation: StageEvaluation, view: View, exposure: Tensor | None = None) -> ViewPsnr:
        if view.name not in aside:
            return psnr_of(evaluation, view, exposure)
        moment = evaluation.run.stage.level, evaluation.run.counts.iteration
        return ViewPsnr(20.0 + (moment == (0, 12)), 20.0, None)

    monkeypatch.setattr(StageEvaluation, "_psnr", invented)
    settings = TrainSettings(iterations=120, levels=2, sh_degree=0, appearance="none", keep="best", joint=0.75)
    archive = train(tmp_path / "run", scene, settings)
    gains = finest_gains(last_view_psnrs(archive.history(), along=True))
    assert gains == pytest.approx(rendered_gains(archive, scene.test), abs=1e-3)  # 0.026 with the base trained along


def test_a_test_every_few_iterations_does_not_replace_the_last_one(tmp_path: Path) -> None:
    scene = ring_scene(train=5, test=4)
    settings = TrainSettings(iterations=40, levels=2, sh_degree=0, appearance="none")
    archive = train(tmp_path / "run", scene, settings, test_every=15)
    gains = finest_gains(last_view_psnrs(archive.history(), along=True))
    assert gains == pytest.approx(rendered_gains(archive, scene.test), abs=1e-3)  # 3e-8 seen


def test_a_residual_that_dies_is_a_line_of_its_training(tmp_path: Path) -> None:
    density = Densification("mcmc", start=1, every=10, options=Mcmc(cap_max=600, opacity_regularization=1.0))
    settings = TrainSettings(iterations=300, levels=2, sh_degree=0, appearance="none", densification=density)
    said = Said()
    residual = train(tmp_path / "run", ring_scene(), settings, monitor=said).manifest.records[-1]
    assert residual.num_gaussians < 60
    named = [line for line in said.lines if line.startswith("level 0 ended with")]
    assert named == [line for line in said.lines if line.endswith(INSTEAD)]
    assert len(named) == 1
    assert f"{residual.num_gaussians} of the 600" in named[0]


def test_a_residual_that_learns_nothing_is_a_line_of_its_training(tmp_path: Path) -> None:
    """A colour rate of almost 0 leaves it transparent; all of its Gaussians stay."""
    settings = TrainSettings(
        iterations=1000, levels=2, split="1/2,1/2", sh_degree=0, appearance="none", joint=0.0, residual_color_rate=1e-6
    )
    said = Said()
    train(tmp_path / "run", ring_scene(train=5, test=4), settings, monitor=said)
    (line,) = (line for line in said.lines if line.startswith("level "))
    assert line.startswith("level 0 changes the PSNR of 4 held-out images by ")
    assert line.endswith(INSTEAD)
