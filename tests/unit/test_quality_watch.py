"""Held-out views measured during stages: when, which, and when a run says that it gets worse."""

from __future__ import annotations

from pathlib import Path

import pytest

from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.quality import FALL, SAMPLES_OF_A_STAGE, QualityWatch, spread_views
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import TrainSettings
from lapgs_plugin.training.trainer import Trainer
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
    settings = TrainSettings(iterations=7000)
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
    reference = SceneReference("ring", "full", True, (0.0, 0.0, 0.0), kind="colmap")
    manifest = Manifest(scene=reference, rasterizer="cpu", **settings.for_manifest())
    with RunArchive.create(tmp_path / "run", manifest) as archive:
        Trainer(scene, settings, archive, CpuRasterizer()).run()
    history = archive.history()
    sampled = [entry for entry in history if "sampled_psnr" in entry]
    assert [entry["iteration"] for entry in sampled] == 2 * [4, 8, 12, 16, 20]
    ends = [entry for entry in history if "psnr" in entry]
    assert [entry["iteration"] for entry in ends] == [20, 20]
    for entry in ends:  # so few views that some are all
        assert entry["sampled_psnr"] == pytest.approx(entry["psnr"])


class Said(Monitor):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)


def test_a_run_that_gets_worse_says_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = iter([30.0 - step for step in range(100)])
    monkeypatch.setattr(Trainer, "_psnr", lambda *_: (next(values),) * 2)
    scene, settings = ring_scene(train=5, test=1), TrainSettings(iterations=60, levels=1, sh_degree=0, exposure="off")
    reference = SceneReference("ring", "full", True, (0.0, 0.0, 0.0), kind="colmap")
    manifest = Manifest(scene=reference, rasterizer="cpu", **settings.for_manifest())
    monitor = Said()
    with RunArchive.create(tmp_path / "run", manifest) as archive:
        Trainer(scene, settings, archive, CpuRasterizer(), monitor=monitor).run()
    (line,) = monitor.lines
    assert line.startswith("level 0, iteration ")
    assert "held-out PSNR fell to 2" in line
    assert "--exposure on" in line


def test_spread_views_are_the_same_and_evenly_spread() -> None:
    assert spread_views(range(100), 4) == [12, 37, 62, 87]
    assert spread_views(range(3), 8) == [0, 1, 2]
    assert SAMPLES_OF_A_STAGE >= 3  # two in a row, and a first
