"""A run of the built-in trainer is decided and checked before its folder is made, on the command line and in Python."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError, UserInputError
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.images import PhotoFile
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.training import preparation
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.preparation import TrainRequest, prepare
from lapgs_plugin.training.ranks.group import ALONE, Ranks
from lapgs_plugin.training.settings import Densification, TrainingControl, TrainSettings
from lapgs_plugin.training.time_budget import COARSER_COST
from lapgs_plugin.training.trainer import Trainer
from tests.training_runs import StopAt, plys

SHORT = TrainSettings(iterations=20, levels=1, sh_degree=0, appearance="none")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes") / "sample"
    make_sample_scene(path, width=64, height=48, views=16, points=200, progress=False)
    return path


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail if a photo is read."""

    def read(*_: Any, **__: Any) -> None:
        raise AssertionError("a photo was read")

    for way in ("__call__", "levels"):
        monkeypatch.setattr(PhotoFile, way, read)


def trained(request: TrainRequest, monitor: Monitor | None = None) -> RunArchive:
    with prepare(request) as run:
        Trainer(run, monitor=monitor or Monitor()).run()
    return RunArchive.open(request.out)


@pytest.mark.usefixtures("unread")
@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"settings": replace(SHORT, images_on="gpu")}, "--images-on gpu: expected memory or disk"),
        ({"settings": replace(SHORT, levels=4)}, "level 3 of 4 would be 8x6 pixels"),
        ({"settings": replace(SHORT, prune=0.1, densification=Densification(until=20))}, "--prune 0.1: prunes when"),
        ({"settings": replace(SHORT, packed=True)}, "--packed with --rasterizer cpu"),
        ({"settings": replace(SHORT, views_per_step="17")}, "--views-per-step 17: the scene has 16 training views"),
        ({"photos": SceneOptions(masks="gone")}, "--masks gone: no such folder"),
        ({"photos": SceneOptions(images="gone")}, "gone"),
        ({"control": TrainingControl(rasterizer="none")}, "--rasterizer none: expected auto, gsplat, cpu"),
        ({"control": TrainingControl(rasterizer="cpu", gpu_busy=True)}, "--gpu-busy: expected a CUDA device"),
        (
            {"settings": replace(SHORT, time="9s"), "control": TrainingControl(gpu_busy=True)},
            "--gpu-busy with --time 9s",
        ),
        (
            {"settings": replace(SHORT, stop="auto"), "control": TrainingControl(gpu_busy=True)},
            "--gpu-busy with --stop auto",
        ),
        ({"settings": replace(SHORT, time="9s", levels=4), "chosen": frozenset()}, "level 3 of 4 would be 8x6 pixels"),
        ({"resume": True}, "is not a run, so there is nothing to continue"),
    ],
)
def test_what_needs_no_photos_is_refused_before_they_are_read(
    folder: Path, tmp_path: Path, asked: dict[str, Any], message: str
) -> None:
    cpu = {"settings": SHORT, "control": TrainingControl(rasterizer="cpu")}
    with (
        pytest.raises(UserInputError, match=re.escape(message)),
        prepare(TrainRequest(folder, tmp_path / "run", **{**cpu, **asked})),
    ):
        pass
    assert not (tmp_path / "run" / "manifest.json").exists()


class Two(Ranks):
    """Two ranks of which only the first one is there."""

    size = 2

    @property
    def together(self) -> str:
        return "2 ranks"


def test_a_run_is_not_replaced_by_one_whose_steps_have_fewer_views_than_ranks(folder: Path, tmp_path: Path) -> None:
    control = TrainingControl(rasterizer="cpu")
    before = trained(TrainRequest(folder, tmp_path / "run", SHORT, control=control))
    fields = plys(before)
    single = replace(SHORT, views_per_step="1")
    again = TrainRequest(folder, tmp_path / "run", single, control=control, overwrite=True, ranks=Two())
    with (
        pytest.raises(UserInputError, match="2 ranks: a step of this run has 1 view, fewer than ranks"),
        prepare(again),
    ):
        pass
    after = RunArchive.open(tmp_path / "run")
    assert after.manifest == before.manifest
    assert plys(after) == fields


def test_a_run_is_continued_as_it_was_prepared(folder: Path, tmp_path: Path) -> None:
    """The request of a run that continues has other defaults; the run keeps its own."""
    photos = SceneOptions(resolution="1/2", eval=True)
    first = TrainRequest(folder, tmp_path / "run", replace(SHORT, keep="best", accumulate_views=2), photos)
    whole = trained(replace(first, out=tmp_path / "whole"))
    with pytest.raises(TrainingStoppedError):
        trained(first, StopAt(0, 11))
    again = TrainRequest(folder, tmp_path / "run", TrainSettings(iterations=20), resume=True)
    with pytest.raises(UserInputError, match=r"--iterations asks for 21, but the run in .* was started with 20"):
        trained(replace(again, settings=TrainSettings(iterations=21)))
    with pytest.raises(UserInputError, match=r"--resolution asks for full, but .* was started with 1/2"):
        trained(replace(again, chosen=frozenset({"resolution"})))
    with prepare(again) as run, pytest.raises(RunFolderError, match="is being written by process"), prepare(again):
        pass
    assert (run.resumes, run.settings.accumulate_views, run.plan[0].image_size) == (True, 2, (32, 24))
    assert (len(run.scene.train), len(run.aside), len(run.scene.test)) == (12, 2, 2)
    assert plys(trained(again)) == plys(whole)
    longer = trained(replace(again, settings=TrainSettings(iterations=24)))
    assert (longer.manifest.settings["iterations"], longer.manifest.settings["extended"]) == (24, 4)


@pytest.mark.parametrize(("chosen", "iterations"), [(frozenset(), 5000), (frozenset({"iterations"}), 30_000)])
def test_few_photos_shorten_a_run_whose_iterations_were_not_chosen(
    folder: Path, tmp_path: Path, chosen: frozenset[str], iterations: int
) -> None:
    said: list[str] = []
    with prepare(TrainRequest(folder, tmp_path / "run", chosen=chosen), said.append) as run:
        assert run.settings.iterations == run.plan.iterations == iterations
        assert run.archive.manifest.settings["iterations"] == iterations
    assert any("16 training photos: 5,000 iterations" in line for line in said) is not bool(chosen)


def test_a_time_that_reading_takes_is_refused_before_anything_is_written(folder: Path, tmp_path: Path) -> None:
    settings = replace(SHORT, time="3s")
    late = TrainRequest(folder, tmp_path / "run", settings, chosen=frozenset(), began=time.monotonic() - 4.0)
    with (
        pytest.raises(UserInputError, match=r"--time 3s: reading the scene and compiling took \d+\.\d s"),
        prepare(late),
    ):
        pass
    assert not (tmp_path / "run").exists()


def test_the_machine_decides_how_many_iterations_a_time_has(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And with them the strategy, unless the user chose it."""
    cost = 0.5 * COARSER_COST + 0.5  # of an iteration, by that of one at full size
    for rate, chosen, strategy in ((100.0, {"time"}, "mcmc"), (5.0, {"time"}, "3dgs"), (5.0, {"strategy"}, "mcmc")):
        monkeypatch.setattr(preparation, "views_per_second", lambda *_, rate=rate: rate)
        settings = TrainSettings(time="10m", densification=Densification(strategy="mcmc"))
        said: list[str] = []
        out = tmp_path / f"{rate}-{strategy}"
        with prepare(TrainRequest(folder, out, settings, chosen=frozenset(chosen)), said.append) as run:
            assert run.plan.iterations == run.settings.iterations == pytest.approx(600 * rate / cost, rel=0.1)
            assert run.settings.densification.strategy == strategy
            assert run.archive.manifest.settings["time"] == "10m"
        assert any("--time 10m: " in line and f"{rate:.3g} views a second" in line for line in said)


def test_an_unfinished_run_that_gets_a_time_ends_with_it(folder: Path, tmp_path: Path) -> None:
    """Of a hundred thousand iterations only those of the time are trained, and the run cannot be extended."""
    with pytest.raises(TrainingStoppedError):
        trained(
            TrainRequest(folder, tmp_path / "run", replace(SHORT, iterations=100_000), SceneOptions()), StopAt(0, 500)
        )
    ends = TrainRequest(folder, tmp_path / "run", replace(SHORT, time="4s"), resume=True, chosen=frozenset({"time"}))
    archive = trained(ends)
    assert 500 < archive.manifest.record(0).iterations < 50_000
    assert archive.manifest.settings["time"] == "4s"
    with prepare(replace(ends, began=time.monotonic())) as run:
        assert run.resumes, "the same command does nothing more"
    with pytest.raises(UserInputError, match=r"--time 5s: the run in .* is finished"):
        trained(replace(ends, settings=replace(SHORT, time="5s")))
    with pytest.raises(UserInputError, match=r"--iterations 20: the run in .* was trained for --time 4s"):
        trained(replace(ends, settings=SHORT, chosen=frozenset({"iterations"})))


@pytest.mark.parametrize(("chosen", "most"), [(frozenset({"stop"}), 5000), (frozenset({"iterations"}), 30_000)])
def test_a_run_that_views_end_has_iterations_at_most(
    folder: Path, tmp_path: Path, chosen: frozenset[str], most: int
) -> None:
    said: list[str] = []
    request = TrainRequest(folder, tmp_path / "run", TrainSettings(stop="auto"), chosen=chosen)
    with prepare(request, said.append) as run:
        assert run.planned.iterations == run.archive.manifest.settings["iterations"] == most
        assert (len(run.scene.train), len(run.withheld)) == (16, 3)
    assert any("16 training photos: at most 5,000 iterations" in line for line in said) is (most == 5000)


def test_a_run_that_views_ended_is_over(folder: Path, tmp_path: Path) -> None:
    first = TrainRequest(folder, tmp_path / "run", replace(SHORT, iterations=40, stop="auto"))
    archive = trained(first)
    again, files = replace(first, resume=True, chosen=frozenset()), plys(archive)
    assert plys(trained(again)) == files
    with pytest.raises(UserInputError, match=r"--iterations 50: the run in .* was trained with --stop auto"):
        trained(replace(again, settings=replace(SHORT, iterations=50), chosen=frozenset({"iterations"})))
    with pytest.raises(UserInputError, match=r"--stop asks for planned, but the run in .* was started with auto"):
        trained(replace(again, settings=SHORT, chosen=frozenset({"stop"})))


def test_a_run_that_views_end_is_of_one_process(folder: Path, tmp_path: Path) -> None:
    first = TrainRequest(folder, tmp_path / "run", replace(SHORT, stop="auto"), ranks=Two())
    with pytest.raises(UserInputError, match="2 ranks with --stop auto: ends runs of one process alone"):
        prepare(first)
    with pytest.raises(TrainingStoppedError):
        trained(replace(first, ranks=ALONE), StopAt(0, 11))
    again = replace(first, settings=SHORT, resume=True, chosen=frozenset())
    with pytest.raises(UserInputError, match="2 ranks with --stop auto"), prepare(again):
        pass


def test_the_rasterizer_of_a_run_is_made_once(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rasterizers = []

    def counted(name: str, settings: TrainSettings) -> Any:
        rasterizers.append(name)
        return original(name, settings)

    original = preparation.training_rasterizer
    monkeypatch.setattr(preparation, "training_rasterizer", counted)
    request = TrainRequest(folder, tmp_path / "run", SHORT, control=TrainingControl(rasterizer="cpu", threads=1))
    trained(request)
    assert rasterizers == ["cpu"]


@pytest.mark.parametrize(("chosen", "expected"), [(None, "3dgs"), ({"iterations"}, "mcmc")])
def test_a_strategy_that_a_caller_asked_for_stays_on_large_photos(
    chosen: set[str] | None, expected: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As tiles do, whose settings are those of their base."""
    monkeypatch.setattr("lapgs_plugin.hierarchy.settings.LARGE_IMAGE", 1)
    monkeypatch.setattr("lapgs_plugin.training.settings.LONG_RUN_OF_LARGE", SHORT.iterations)
    asked = {} if chosen is None else {"chosen": frozenset(chosen)}
    assert SHORT.densification.strategy == "3dgs"
    with prepare(TrainRequest(folder, tmp_path / "run", SHORT, **asked)) as run:  # type: ignore[arg-type]
        assert run.settings.densification.strategy == expected
