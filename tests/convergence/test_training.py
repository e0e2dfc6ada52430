"""Runs of the built-in trainer learn, repeat to the same bits, and continue where they stopped."""

from __future__ import annotations

import math
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin import hooks
from lapgs_plugin.errors import RunFolderError, TrainingDivergedError, TrainingStoppedError
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.interrupt import stop_request
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CHECKPOINT
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.monitor import Monitor, Tick
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.settings import Densification, TrainSettings
from tests.folders import files_in
from tests.mishaps import FailAfterStage, FailingWrites, Killed, disk_full
from tests.training_runs import StopAt, plys, resume, train
from tests.training_scene import ring_scene

SETTINGS = TrainSettings(
    iterations=60,
    hierarchy="laplacian",
    sh_degree=1,
    sh_every=10,
    densification=Densification(start=3, until=45, every=5, reset_every=12),
    prune=0.02,
    split="1/2,1/2",
    joint=0.25,
)
SHORT = replace(SETTINGS, levels=3, iterations=24, split=None)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene()


def test_a_hierarchy_learns_and_its_residual_adds_detail(scene: Scene, tmp_path: Path) -> None:
    calm = Densification(start=20, until=150, every=20, reset_every=10_000)
    archive = train(tmp_path / "run", scene, replace(SETTINGS, iterations=300, densification=calm))
    base, composed = [], []
    renderer = HierarchyRenderer.from_archive(archive, CpuRasterizer())
    for view in scene.train:
        levels = renderer.render(view.camera).composed
        base.append(psnr(to_full_size(levels[1], view.camera.size, 1, renderer.pyramid), view.image))
        composed.append(psnr(levels[0], view.image))
    assert sum(composed) / len(composed) > sum(base) / len(base) + 1.0  # the gain was 2.1 dB
    assert [record.level for record in archive.manifest.records] == [1, 0]
    assert archive.manifest.complete
    assert not archive.field(1).signed
    assert archive.field(0).signed
    assert not archive.path(CHECKPOINT).exists()


def test_one_level_is_an_unsigned_field_at_full_size(scene: Scene, tmp_path: Path) -> None:
    """The same field in every hierarchy."""
    archive = train(tmp_path / "run", scene, replace(SETTINGS, levels=1, split=None))
    assert plys(archive) == plys(train(tmp_path / "nested", scene, replace(nested(), levels=1, split=None)))
    (record,) = archive.manifest.records
    assert (record.level, record.signed, record.iterations) == (0, False, 60)
    assert record.num_gaussians == len(archive.field(0)) <= record.peak_gaussians


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(scene: Scene, tmp_path: Path) -> None:
    first = plys(train(tmp_path / "a", scene, SETTINGS))
    assert first == plys(train(tmp_path / "b", scene, SETTINGS))
    assert first != plys(train(tmp_path / "c", scene, replace(SETTINGS, seed=1)))


@pytest.fixture(scope="module", params=["geometry", "full"])
def whole(request: pytest.FixtureRequest, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> RunArchive:
    """Return an uninterrupted run; from iteration 23 of level 0 on the base is trained jointly."""
    settings = replace(SETTINGS, inherit=request.param)
    return train(tmp_path_factory.mktemp("whole") / "run", scene, settings)


@pytest.mark.parametrize(("level", "iteration"), [(1, 7), (1, 20), (0, 1), (0, 22), (0, 27)])
def test_a_stopped_run_ends_where_an_uninterrupted_one_does(
    scene: Scene, tmp_path: Path, whole: RunArchive, level: int, iteration: int
) -> None:
    settings = settings_from_manifest(whole.manifest)
    with pytest.raises(TrainingStoppedError, match=f"level {level}, iteration {iteration}"):
        train(tmp_path / "parts", scene, settings, monitor=StopAt(level, iteration))
    archive = resume(tmp_path / "parts", scene, settings)
    assert plys(archive) == plys(whole)
    places = [(entry["level"], entry["iteration"], entry["loss"]) for entry in archive.history()]
    assert places == [(entry["level"], entry["iteration"], entry["loss"]) for entry in whole.history()]


def test_history_after_the_checkpoint_of_a_killed_run_is_not_kept_twice(
    scene: Scene, tmp_path: Path, whole: RunArchive
) -> None:
    class Kill(Monitor):
        def tick(self, stage: Stage, tick: Tick) -> None:
            if (tick.level, tick.iteration) == (0, 17):
                raise Killed

    settings = settings_from_manifest(whole.manifest)
    with pytest.raises(Killed):
        train(tmp_path / "parts", scene, settings, monitor=Kill(), checkpoint_every=10)
    assert RunArchive.open(tmp_path / "parts").history()[-1]["iteration"] == 17
    archive = resume(tmp_path / "parts", scene, settings)
    places = [(entry["level"], entry["iteration"], entry["loss"]) for entry in archive.history()]
    assert places == [(entry["level"], entry["iteration"], entry["loss"]) for entry in whole.history()]
    assert plys(archive) == plys(whole)


@pytest.fixture(scope="module")
def large() -> Scene:
    """Return a scene that is large enough for three levels."""
    return ring_scene(size=(96, 64))


@pytest.fixture(scope="module")
def two_finished(large: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of three levels that was stopped in its last and lost its checkpoint."""
    path = tmp_path_factory.mktemp("two") / "run"
    with pytest.raises(TrainingStoppedError):
        train(path, large, SHORT, monitor=StopAt(0, 1))
    (path / CHECKPOINT).unlink()
    return path


@pytest.fixture(scope="module")
def all_finished(large: Scene, tmp_path_factory: pytest.TempPathFactory) -> RunArchive:
    """Return the run that `two_finished` would have become."""
    return train(tmp_path_factory.mktemp("all") / "run", large, SHORT)


def test_a_run_killed_while_it_archives_jointly_trained_fields_ends_as_others(
    large: Scene, tmp_path: Path, two_finished: Path, all_finished: RunArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is killed before a PLY, between two, before the manifest that counts and after it; `test_archive` kills runs
    at every write."""
    base = [(two_finished / f"level_{level}" / "point_cloud.ply").read_bytes() for level in (2, 1)]
    assert plys(all_finished)[0] != base[0], "the coarser fields were trained along"
    assert plys(all_finished)[1] != base[1]
    writes = FailingWrites(monkeypatch, Killed)
    complete = []
    for left in (0, 8, 13, 14):
        folder = shutil.copytree(two_finished, tmp_path / str(left))
        with pytest.raises(Killed):
            resume(folder, large, SHORT, user_hooks=[FailAfterStage(writes, 0, left)])
        writes.left = sys.maxsize
        killed = RunArchive.open(folder)
        complete.append(killed.manifest.complete)
        assert plys(killed) == (plys(all_finished) if complete[-1] else base)
        again = resume(folder, large, SHORT)
        assert plys(again) == plys(all_finished)
        assert files_in(folder) == files_in(all_finished.path())
    assert set(complete) == {False, True}


def test_a_disk_that_is_full_when_a_stage_ends_keeps_the_fields_before_it(
    large: Scene, tmp_path: Path, two_finished: Path, all_finished: RunArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(two_finished, tmp_path / "run")
    writes = FailingWrites(monkeypatch, disk_full)
    with pytest.raises(RunFolderError, match=r"No space left.*what was finished before is unharmed"):
        resume(folder, large, SHORT, user_hooks=[FailAfterStage(writes, 0, 7)])  # in the second PLY
    writes.left = sys.maxsize
    assert plys(RunArchive.open(folder)) == plys(RunArchive.open(two_finished))
    assert plys(resume(folder, large, SHORT)) == plys(all_finished)


def test_jointly_trained_fields_match_the_photos_better(scene: Scene, tmp_path: Path) -> None:
    """And the run's last PSNR of held-out views is that of the archived fields."""
    calm = Densification(start=20, until=100, every=20, reset_every=10_000)
    fits, fields = {}, {}
    for share in (0.0, 0.5):
        settings = replace(SETTINGS, iterations=240, densification=calm, joint=share)
        archive = train(tmp_path / str(share), scene, settings)
        renderer = HierarchyRenderer.from_archive(archive, CpuRasterizer())
        fits[share], held_out = (
            math.fsum(psnr(renderer.render(view.camera).composed[0], view.image) for view in views) / len(views)
            for views in (scene.train, scene.test)
        )
        assert archive.history()[-1]["psnr"] == pytest.approx(held_out, abs=1e-5)  # 2e-8 seen
        fields[share] = archive.field(1)
    assert fits[0.5] > fits[0.0] + 0.1  # 0.30 dB
    assert len(fields[0.5]) == len(fields[0.0])
    assert not torch.equal(fields[0.5].means, fields[0.0].means)


def test_residuals_supervised_alone_do_not_change_finished_fields(scene: Scene, tmp_path: Path) -> None:
    settings = replace(SETTINGS, supervision="online_residual")
    with_share = train(tmp_path / "a", scene, settings)
    assert plys(with_share) == plys(train(tmp_path / "b", scene, replace(settings, joint=0.0)))


@pytest.mark.parametrize("whole", ["full"], indirect=True)
def test_full_inheritance_survives_the_loss_of_its_checkpoint(scene: Scene, tmp_path: Path, whole: RunArchive) -> None:
    settings, parts = settings_from_manifest(whole.manifest), tmp_path / "parts"
    with pytest.raises(TrainingStoppedError):
        train(parts, scene, settings, monitor=StopAt(0, 10))
    (parts / CHECKPOINT).unlink()
    assert plys(resume(parts, scene, settings)) == plys(whole)


def nested(settings: TrainSettings = SETTINGS) -> TrainSettings:
    return replace(settings, hierarchy="nested", joint=0.0)


class FirstImage(StageHook):
    """Keep the first image of each stage, and the prediction that it is added to."""

    def __init__(self) -> None:
        self.images: dict[int, tuple[str, torch.Tensor, torch.Tensor | None]] = {}

    def compose(self, context: StageContext, image: torch.Tensor) -> torch.Tensor:
        self.images.setdefault(context.stage.level, (context.view, image.detach(), context.accumulated))
        return image


def test_a_nested_level_continues_the_coarser_field(scene: Scene, tmp_path: Path) -> None:
    """Its first image is the archived field's at the finer size; the last PSNR is the last field's."""
    first = FirstImage()
    archive = train(tmp_path / "run", scene, nested(), user_hooks=[first])
    assert [(record.level, record.signed) for record in archive.manifest.records] == [(1, False), (0, False)]
    view, image, accumulated = first.images[0]
    camera = next(each.camera for each in scene.train if each.name == view)
    with torch.no_grad():
        expected = CpuRasterizer()(archive.field(1), camera, background=torch.tensor(scene.background)).image
        held_out = [
            psnr(CpuRasterizer()(archive.field(0), each.camera, background=torch.zeros(3)).image, each.image)
            for each in scene.test
        ]
    assert accumulated is None
    torch.testing.assert_close(image, expected, rtol=0, atol=0)
    assert archive.history()[-1]["psnr"] == pytest.approx(math.fsum(held_out) / len(held_out), abs=1e-9)
    assert not archive.path("cache").exists()


def test_nested_levels_learn(scene: Scene, tmp_path: Path) -> None:
    calm = Densification(start=20, until=150, every=20, reset_every=10_000)
    archive = train(tmp_path / "run", scene, nested(replace(SETTINGS, iterations=300, densification=calm)))
    renderer = HierarchyRenderer.from_archive(archive, CpuRasterizer())
    fits = {
        level: math.fsum(
            psnr(to_full_size(renderer.images([view.camera], level)[0], view.camera.size, level, Pyramid()), view.image)
            for view in scene.train
        )
        / len(scene.train)
        for level in (1, 0)
    }
    assert fits[0] > fits[1] + 1.0  # the gain was 2.8 dB


def test_adam_continues_from_the_coarser_level(scene: Scene, tmp_path: Path) -> None:
    """With its moments and count of steps, also in a run that lost its checkpoint."""
    whole = train(tmp_path / "whole", scene, nested())
    parts = tmp_path / "parts"
    with pytest.raises(TrainingStoppedError):
        train(parts, scene, nested(), monitor=StopAt(0, 10))
    archive = RunArchive.open(parts)
    before, after = archive.optimizer_state(1), archive.load_checkpoint()["model"]["moments"]
    assert before.keys() == after.keys() == {"means", "quats", "scales", "opacities", "sh"}
    for name in before:
        assert int(after[name]["step"]) == int(before[name]["step"]) + 10
    (parts / CHECKPOINT).unlink()
    assert plys(resume(parts, scene, nested())) == plys(whole)


class Below(StageHook):
    """Keep the prediction below each stage's first view, and its stored bytes then and at the stage's end."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.first: dict[int, StageContext] = {}
        self.bytes: dict[int, int] = {}
        self.bytes_at_end: dict[int, int] = {}

    def before_render(self, context: StageContext) -> None:
        if context.iteration == 1 and context.stage.signed:
            self.first[context.stage.level] = context
            self.bytes[context.stage.level] = self._kept()

    def on_stage_end(self, stage: Stage) -> None:
        if stage.signed:
            self.bytes_at_end[stage.level] = self._kept()

    def _kept(self) -> int:
        return sum(path.stat().st_size for path in self._folder.glob("cache/train/*"))


@pytest.mark.parametrize("joint", [0.0, 0.25])
def test_predictions_are_stored_at_their_own_size(joint: float, tmp_path: Path) -> None:
    """Hooks get Up of them. During joint training they are rendered, and none are stored."""
    scene, folder = ring_scene(size=(97, 65)), tmp_path / "run"
    below = Below(folder)
    settings = replace(SETTINGS, levels=3, split=None, images_on="disk", joint=joint)
    archive = train(folder, scene, settings, user_hooks=[below])
    pixels = {1: 25 * 17, 0: 49 * 33}  # of the level below
    assert below.bytes == {level: len(scene.train) * 3 * 4 * pixels[level] for level in (1, 0)}
    assert below.bytes_at_end == ({1: 0, 0: 0} if joint else below.bytes)
    if joint:
        return  # the fields have learned on
    renderer = HierarchyRenderer.from_archive(archive, CpuRasterizer())
    cameras = {view.name: view.camera for view in scene.train}
    for level, context in below.first.items():
        composed = renderer.render(cameras[context.view], level + 1).composed[level + 1]
        expected = renderer.pyramid.up(composed, tuple(context.target.shape[1:]))
        torch.testing.assert_close(context.accumulated, expected, rtol=0, atol=5e-6)


def test_predictions_read_ahead_from_the_disk_change_no_bit(scene: Scene, tmp_path: Path) -> None:
    runs = [train(tmp_path / cache, scene, replace(SETTINGS, images_on=cache)) for cache in ("memory", "disk")]
    assert plys(runs[0]) == plys(runs[1])


def test_a_hook_that_does_nothing_changes_nothing(scene: Scene, tmp_path: Path) -> None:
    """Without hooks the loss takes images as they are stored; a hook gets composed ones."""
    settings = replace(SETTINGS, iterations=8, joint=0.0, prune=0.0, densification=Densification(start=99, until=100))
    runs = [train(tmp_path / str(len(hooks)), scene, settings, user_hooks=hooks) for hooks in ([], [StageHook()])]
    losses = [[entry["loss"] for entry in run.history()] for run in runs]
    assert losses[0] == losses[1]
    assert plys(runs[0]) == plys(runs[1])


@pytest.mark.parametrize(
    "changes",
    [
        {"supervision": "gt_laplacian"},
        {"inherit": "xyz:0.5"},
        {"grid": "even"},
        {"images_on": "disk", "prediction_precision": "float16"},
        {"prediction_precision": "uint8"},
    ],
)
def test_every_option_trains(scene: Scene, tmp_path: Path, changes: dict[str, object]) -> None:
    settings = replace(SETTINGS, iterations=24, **changes)
    archive = train(tmp_path / "run", scene, settings)
    losses = {entry["level"]: entry["loss"] for entry in archive.history()}
    assert all(math.isfinite(loss) for loss in losses.values())
    assert archive.manifest.complete
    assert not archive.path("cache").exists()
    assert settings_from_manifest(archive.manifest).for_manifest() == settings.for_manifest()


def test_the_least_visible_gaussians_are_removed_when_densification_ends(scene: Scene, tmp_path: Path) -> None:
    counts = {}
    for share in (0.0, 0.05):
        settings = replace(SETTINGS, levels=1, split=None, prune=share)
        archive = train(tmp_path / str(share), scene, settings, test_every=1)
        counts[share] = {entry["iteration"]: entry["num_gaussians"] for entry in archive.history()}
    assert counts[0.05][44] == counts[0.0][44] == counts[0.0][60]
    # The 45th iteration is the first after densification; seen: 0.24 of them.
    assert 0.05 < 1 - counts[0.05][45] / counts[0.0][45] < 0.4
    assert counts[0.05][60] == counts[0.05][45]


def test_an_inherited_share_starts_smaller(scene: Scene, tmp_path: Path) -> None:
    quiet = Densification(start=1000, until=1, every=1000, reset_every=1000)
    settings = replace(SETTINGS, iterations=30, inherit="0.25", densification=quiet)
    archive = train(tmp_path / "run", scene, settings)
    base, residual = archive.manifest.records
    assert residual.num_gaussians == round(0.25 * base.num_gaussians)


def test_divergence_names_the_iteration_and_keeps_finished_levels(scene: Scene, tmp_path: Path) -> None:
    class Poison(StageHook):
        def compose(self, context: StageContext, image: torch.Tensor) -> torch.Tensor:
            return image * math.nan if (context.stage.level, context.iteration) == (0, 23) else image

    with pytest.raises(TrainingDivergedError, match="level 0, iteration 23: the loss is nan"):
        train(tmp_path / "run", scene, SETTINGS, user_hooks=[Poison()], checkpoint_every=10)
    archive = RunArchive.open(tmp_path / "run")
    assert archive.available_levels == (1,)
    checkpoint = archive.load_checkpoint()
    assert checkpoint is not None
    assert checkpoint["counts"]["iteration"] == 20


def test_a_hook_by_entry_point_is_one_object_in_all_levels(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[StageHook, int]] = []

    class Noting(StageHook):
        def on_stage_start(self, stage: Stage) -> None:
            calls.append((self, stage.level))

    monkeypatch.setattr(hooks, "entry_point_hooks", lambda _: (Noting(),))
    train(tmp_path / "run", scene, replace(SETTINGS, iterations=24))
    assert [level for _, level in calls] == [1, 0]
    assert len({id(hook) for hook, _ in calls}) == 1


def test_inherited_moments_move_coefficients_above_the_degree_as_adam_does(scene: Scene, tmp_path: Path) -> None:
    seen: list[torch.Tensor] = []
    moments: dict[str, torch.Tensor] = {}

    class Watching(StageHook):
        def on_stage_start(self, stage: Stage) -> None:
            if stage.level == 0:  # they are in the run folder until the level is finished
                moments.update(RunArchive.open(tmp_path / "run").optimizer_state(1)["sh"])

        def loss(self, context: StageContext, image: torch.Tensor) -> None:
            if context.stage.level == 0 and context.iteration <= 2:
                assert context.field is not None
                seen.append(context.field.gaussians.sh[:, 1:].detach().double())

    calm = Densification(start=1000, until=1, every=1000, reset_every=1000)
    settings = replace(SETTINGS, inherit="full", densification=calm, prune=0.0, joint=0.0)
    archive = train(tmp_path / "run", scene, settings, user_hooks=[Watching()])
    first, second = (moments[name][:, 1:].double() for name in ("exp_avg", "exp_avg_sq"))
    step = float(moments["step"]) + 1  # without a gradient
    root = (0.999 * second / (1 - 0.999**step)).sqrt()
    rate = archive.manifest.settings["learning_rates"]["residual_sh"] / 20
    expected = -rate * (0.9 * first / (1 - 0.9**step)) / (root + 1e-15)
    assert expected.abs().max() > 1e-4
    torch.testing.assert_close(seen[1] - seen[0], expected, rtol=0.0, atol=1e-8)  # worst seen 1.9e-10


def test_a_checkpoint_is_kept_that_has_no_nan_although_the_loss_shows_none(scene: Scene, tmp_path: Path) -> None:
    class Steep(StageHook):
        def loss(self, context: StageContext, image: torch.Tensor) -> torch.Tensor | None:
            if (context.stage.level, context.iteration) != (0, 7):
                return None
            return (0.0 * image.mean()).sqrt()  # 0, with a gradient of infinity times 0

    with pytest.raises(TrainingDivergedError, match=r"level 0, iteration 9: .*NaN"):
        train(tmp_path / "run", scene, SETTINGS, user_hooks=[Steep()], checkpoint_every=3)
    checkpoint = RunArchive.open(tmp_path / "run").load_checkpoint()
    assert checkpoint is not None
    assert checkpoint["counts"]["iteration"] == 6


def test_divergence_of_a_field_that_is_trained_jointly_is_named(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = JointFields.step

    def diverge(self: JointFields, *args: Any) -> None:
        step(self, *args)
        self.models[1].params["means"].data[0] = math.nan

    monkeypatch.setattr(JointFields, "step", diverge)
    with pytest.raises(TrainingDivergedError, match=r"level 0, iteration 24: .*NaN.* of level 1, trained jointly"):
        train(tmp_path / "run", scene, SETTINGS, checkpoint_every=3)


def test_a_stop_request_counts_once_and_handlers_are_restored() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with stop_request() as request:
        signal.raise_signal(signal.SIGTERM)
        assert request.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
