"""Test joint training of finished fields: their gradients, their learning rates, and their archived fields."""

from __future__ import annotations

import contextlib
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import view_name
from lapgs_plugin.errors import TrainingDivergedError
from lapgs_plugin.hierarchy import settings
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runner import joint
from lapgs_plugin.runner.context import CheckoutContext, RunRequest
from lapgs_plugin.runner.joint import JointModels
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.training_figures import finest_gains, last_view_psnrs
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.stages.joint import RenderedPredictions
from tests.contract.stub_runs import (
    HALF,
    NAMES,
    SHORT,
    STUBS,
    Seeded,
    StopAt,
    captured,
    composed_psnr,
    drive_residuals,
    loaded,
    run_residuals,
)
from tests.mishaps import FailAfterStage, FailingWrites, Killed
from tests.training_runs import plys, rendered_gains


class FieldsAt(StageHook):
    """Keep the archived fields at the start of the finest stage."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.fields: dict[int, dict[str, Tensor]] = {}

    def on_stage_start(self, stage: Stage) -> None:
        if stage.level == 0:
            archive = RunArchive.open(self.folder)
            self.fields = {level: archive.field(level).parameters for level in archive.available_levels}


def test_renders_of_one_colour_share_their_background() -> None:
    backgrounds: list[Tensor] = []
    rendering = SimpleNamespace(captured=torch.zeros(3, 2, 2))

    def render(call: Any, view: Any, gaussians: Any, background: Tensor) -> None:
        backgrounds.append(background)
        rendering.captured = torch.zeros(3, 2, 2)

    adapter: Any = SimpleNamespace(render=render)
    context: Any = CheckoutContext(RunRequest(adapter, device="cpu"))
    for white, black in ((True, False), (False, False), (True, True), (True, False)):
        with torch.inference_mode(not backgrounds):
            context.render(rendering, SimpleNamespace(white_background=white), None, None, black=black)
    assert [background.tolist() for background in backgrounds] == [[1.0] * 3, [0.0] * 3, [0.0] * 3, [1.0] * 3]
    assert backgrounds[0] is backgrounds[3]
    assert backgrounds[1] is backgrounds[2]
    assert not backgrounds[0].is_inference(), "later renders may need gradients"


@pytest.mark.parametrize("name", NAMES)
def test_finished_fields_learn_and_the_archive_renders_what_was_reported(
    name: str, scene: Path, tmp_path: Path
) -> None:
    """The checkout's own report is about the composed hierarchy of the last iteration."""
    before = FieldsAt(tmp_path / "run")
    more: tuple[Any, ...] = (*HALF, "--test_iterations", HALF[1]) if name != "fastgs" else HALF
    if name == "taming":
        more += (
            "--ho_iteration",
            20,
        )  # afterwards its optimizer has opacities that its model has not
    archive, result = run_residuals(STUBS[name], scene, tmp_path / "run", *more, hooks=(before,), joint=0.3)
    after = archive.field(1).parameters
    assert before.fields.keys() == {1}
    for part, value in before.fields[1].items():
        assert after[part].shape == value.shape, "nobody adds or removes Gaussians of a finished field"
        assert not torch.equal(after[part], value), part
    gains, rendered = (
        finest_gains(last_view_psnrs(archive.history(), along=True)),
        rendered_gains(archive, run_scene(archive).test),
    )
    # 6e-4 seen, of a pixel at 1/255; Taming's opacities above 1 are archived as 1, which shows: 0.02 seen.
    assert gains == pytest.approx(rendered, abs=0.1 if name == "taming" else 0.01)
    if name != "fastgs":  # it reports no held-out views
        (reported,) = [float(line.split()[-1]) for line in result.lines if "Evaluating test" in line]
        # 5e-7 seen; a pixel at 1/255: 5e-5. Taming's opacities above 1 are archived as 1, which shows: 9e-3 seen.
        assert composed_psnr(archive) == pytest.approx(reported, abs=0.1 if name == "taming" else 1e-3)


@pytest.mark.parametrize("options", [{"joint": 0.0}, {"supervision": "online_residual"}, {"joint": 0.001}])
def test_without_a_share_they_stay_as_they_are(options: dict[str, Any], scene: Path, tmp_path: Path) -> None:
    """There is no joint training for less than an iteration, or where residuals are supervised alone."""
    before = FieldsAt(tmp_path / "run")
    archive, _ = run_residuals(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, hooks=(before,), **options)
    for part, value in archive.field(1).parameters.items():
        assert torch.equal(before.fields[1][part], value)


def test_finished_fields_follow_optimizers_that_a_loop_makes_in_the_middle(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []
    step, folder = joint._follow, tmp_path / "run"
    monkeypatch.setattr(joint, "_follow", lambda *given: (step(*given), steps.append(1)))
    with captured(folder, []), loaded(STUBS["graphdeco"], scene, folder, "--iterations", 30) as adapter:
        model = adapter.train.GaussianModel
        update, setup = model.update_learning_rate, model.training_setup

        def training_setup(self: Any, training_args: Any) -> None:
            self.training_args = training_args
            setup(self, training_args)

        def update_learning_rate(self: Any, iteration: int) -> Any:
            if iteration == 15:
                self.training_setup(self.training_args)
            return update(self, iteration)

        model.training_setup, model.update_learning_rate = training_setup, update_learning_rate
        drive_residuals(adapter, joint=0.5)
    assert len(steps) == 9, "in iterations 11 to 19; after its last the checkout does not step"


@pytest.mark.parametrize(("large", "share", "count"), [(100 * 100, 0.5, 9), (10 * 10, 0.25, 4)])
def test_the_default_share_follows_from_the_photos_size(
    large: int, share: float, count: int, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []
    step = joint._follow
    monkeypatch.setattr(joint, "_follow", lambda *given: (step(*given), steps.append(1)))
    monkeypatch.setattr(settings, "LARGE_IMAGE", large)  # photos have 64 x 48 pixels
    archive, _ = run_residuals(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT)
    assert (archive.manifest.settings["joint"], len(steps)) == (share, count)  # of 20 iterations, without the last


class Inspected:
    """Inspect joint models when they begin to follow a stage, in place of `JointModels.follow`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, inspect: Any) -> None:
        self.results: list[Any] = []
        original = JointModels.follow

        def follow(models: JointModels, gaussians: Any, residual_color_rate: float) -> None:
            original(models, gaussians, residual_color_rate)
            self.results.append(inspect(models))

        monkeypatch.setattr(JointModels, "follow", follow)


def test_predictions_are_up_of_the_archived_levels(big: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Predictions before the first joint step are those of the archived fields, rendered by our own rasterizer."""

    def differences(models: JointModels) -> list[float]:
        predictions = models.predictions()
        renderer = run_renderer(RunArchive.open(tmp_path / "run"), device="cpu", rasterizer="cpu")
        quantiles = []
        for view in load_scene(big, progress=False).train[:3]:
            (key,) = [key for key in predictions.sizes if Path(view_name(key)).stem == Path(view.name).stem]
            image = predictions.get(key)
            level = min(renderer.fields)
            composed = renderer.render(view.camera, level).composed[level]
            difference = (image - Pyramid("camera").up(composed, image.shape[1:])).detach().abs()
            # On another processor a pixel of a coarse level may differ, which Up spreads over some of 16.
            quantiles.append(float(difference.flatten().quantile(0.98)))
            assert difference.max() < 0.02
        return quantiles

    inspected = Inspected(monkeypatch, differences)
    run_residuals(STUBS["graphdeco"], big, tmp_path / "run", "--iterations", 12, levels=3, joint=0.5)
    assert [len(quantiles) for quantiles in inspected.results] == [3, 3], "two residual stages"
    assert max(max(quantiles) for quantiles in inspected.results) < 5e-6  # 1.8e-7 seen


def test_scores_render_the_finished_field_of_a_view_once(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until it steps: a score function renders each view twice, and both images are those of the present field."""
    predict, render = RenderedPredictions.get, CheckoutContext.render
    renders: list[Any] = []
    scored: list[int] = []  # renders of finished fields for each image of a score
    differences: list[float] = []

    def counted(*args: Any, **options: Any) -> Any:
        renders.append(args)
        return render(*args, **options)

    def compared(predictions: RenderedPredictions, *names: str) -> Tensor:
        before = len(renders)
        image = predict(predictions, *names)
        if not torch.is_grad_enabled():
            scored.append(len(renders) - before)
            with torch.enable_grad():
                differences.append(float((predict(predictions, *names) - image).detach().abs().max()))
        return image

    monkeypatch.setattr(CheckoutContext, "render", counted)
    monkeypatch.setattr(RenderedPredictions, "get", compared)
    run_residuals(STUBS["fastgs"], scene, tmp_path / "run", joint=1.0)
    assert scored[:20] == [1, 0] * 10, "ten views of the first score"
    assert max(differences) < 1e-6  # 1.8e-7 seen: Up has other kernels with gradients


def test_images_are_those_after_steps_that_pytorch_does_not_see(
    big: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Our kernels of Adam leave the versions of what they step as they are."""
    step, images = joint._follow, list[Tensor]()
    inspected = Inspected(monkeypatch, lambda models: models.predictions())

    def followed(following: torch.optim.Optimizer, leading: torch.optim.Optimizer) -> None:
        (predictions,) = inspected.results
        key = next(iter(predictions.sizes))
        with torch.no_grad():
            images.append(predictions.get(key))
        with torch.enable_grad():
            expected = predictions.get(key).detach()
        assert float((images[-1] - expected).abs().max()) < 1e-6  # 1.8e-7 seen: Up has other kernels with gradients
        with contextlib.ExitStack() as unseen:
            for group in following.param_groups:
                for parameter in group["params"]:
                    unseen.enter_context(torch.autograd._unsafe_preserve_version_counter(parameter))
            step(following, leading)

    monkeypatch.setattr(joint, "_follow", followed)
    run_residuals(STUBS["graphdeco"], big, tmp_path / "run", "--iterations", 12, joint=0.5)
    assert len(images) > 2
    assert not torch.equal(images[0], images[1])


def test_scores_list_no_visible_gaussians(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They use no indices, neither of the residual nor of the finished fields that are rendered in its renders."""
    listed: list[str] = []  # functions in which indices were listed
    nonzero = Tensor.nonzero

    def counted(tensor: Tensor, *args: Any, **options: Any) -> Any:
        frame = sys._getframe()
        while frame is not None:
            listed.append(frame.f_code.co_name)
            frame = frame.f_back
        return nonzero(tensor, *args, **options)

    monkeypatch.setattr(Tensor, "nonzero", counted)
    run_residuals(STUBS["fastgs"], scene, tmp_path / "run", joint=1.0)
    assert "render_fastgs" in listed, "reports of the loop's renders"
    assert "compute_gaussian_score_fastgs" not in listed


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_every_finished_field(
    name: str, big: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gradients by colour of a weighted sum of the composed image, linear in colours, equal differences."""

    def relative_errors(models: JointModels) -> list[float]:
        generator, predictions = torch.Generator().manual_seed(0), models.predictions()
        key = next(iter(predictions.sizes))
        weights = torch.randn(predictions.get(key).shape, generator=generator)
        errors = []
        for gaussians in models.fields(lambda gaussians, _: gaussians).values():
            colors = gaussians._features_dc
            direction = torch.randn(colors.shape, generator=generator)
            (gradient,) = torch.autograd.grad((weights * predictions.get(key)).sum(), colors)
            with torch.no_grad():
                colors += 0.05 * direction
                above = (weights * predictions.get(key)).sum()
                colors -= 0.1 * direction
                below = (weights * predictions.get(key)).sum()
                colors += 0.05 * direction
            measured = float((above - below) / 0.1)
            errors.append(abs(float((gradient * direction).sum()) / measured - 1))
        return errors

    inspected = Inspected(monkeypatch, relative_errors)
    options = ("--iterations", 60) if name == "taming" else ("--iterations", 12)
    run_residuals(STUBS[name], big, tmp_path / "run", *options, levels=3, joint=0.5)
    assert [len(errors) for errors in inspected.results] == [1, 2]
    assert max(max(errors) for errors in inspected.results) < 2e-3  # 1.9e-4 seen: dark colours of the base are clamped


def test_fields_follow_at_their_own_rates(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The base's colours are not optimized at the higher rate of residuals."""
    rates: list[dict[str, float]] = []
    original = joint._follow

    def follow(following: torch.optim.Optimizer, *args: Any) -> None:
        original(following, *args)
        names = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")
        rates.append(dict(zip(names, (group["lr"] for group in following.param_groups), strict=True)))

    monkeypatch.setattr(joint, "_follow", follow)
    run_residuals(STUBS["graphdeco"], scene, tmp_path / "run", joint=0.25, residual_color_rate=4.0)
    assert len(rates) == 14, "a quarter of the stage's 60 iterations; after its last the checkout does not step"
    for rate in rates:
        assert rate.pop("xyz") > 0
        assert rate == pytest.approx(
            {"f_dc": 0.0025, "f_rest": 0.0025 / 20, "opacity": 0.025, "scaling": 0.005, "rotation": 0.001}
        )


def test_parameters_of_a_forks_own_are_not_followed(scene: Path, tmp_path: Path) -> None:
    """A parameter group without a name, or of another name, belongs to no archived field."""
    folder, rates = tmp_path / "run", []
    with captured(folder, []), loaded(STUBS["graphdeco"], scene, folder, "--densify_from_iter", 500) as adapter:
        model = adapter.train.GaussianModel
        setup = model.training_setup

        def training_setup(self: Any, training_args: Any) -> None:
            setup(self, training_args)
            own = torch.nn.Parameter(torch.zeros(3))
            self.optimizer.param_groups.insert(0, {**self.optimizer.param_groups[0], "params": [own], "name": "tone"})
            self.shoptimizer = torch.optim.Adam([own])
            rates.append(self.optimizer.param_groups[1]["name"])

        model.training_setup = training_setup
        drive_residuals(adapter, joint=0.1, inherit="full")
    assert rates == ["xyz", "xyz"]
    assert RunArchive.open(folder).manifest.complete


def test_photos_are_matched_better(scene: Path, tmp_path: Path) -> None:
    """Joint training reduces the error of the training views."""
    errors = {}
    for share in (0.0, 0.5):
        archive, _ = run_residuals(STUBS["graphdeco"], scene, tmp_path / str(share), joint=share)
        renderer = run_renderer(archive, device="cpu", rasterizer="cpu")
        views = load_scene(scene, eval=True, progress=False).train
        squares = [(renderer.render(view.camera).composed[0] - view.image).square().mean() for view in views]
        errors[share] = float(torch.stack(squares).mean())
    assert errors[0.5] < 0.97 * errors[0.0]  # 0.80 seen


def test_a_stop_in_between_leaves_finished_fields_as_they_were(scene: Path, tmp_path: Path) -> None:
    """Fields that are trained jointly are archived with their residual or not at all."""

    class StopLate(StopAt):
        def before_render(self, context: StageContext) -> None:
            if context.stage.level == 0 and context.iteration == 30:
                raise KeyboardInterrupt

    before = FieldsAt(tmp_path / "run")
    with captured(tmp_path, []), pytest.raises(KeyboardInterrupt):
        run_residuals(STUBS["graphdeco"], scene, tmp_path / "run", *HALF, hooks=(before, StopLate(-1)), joint=0.5)
    stopped = RunArchive.open(tmp_path / "run")
    assert stopped.available_levels == (1,)
    for part, value in stopped.field(1).parameters.items():
        assert torch.equal(before.fields[1][part], value)


def three_levels(scene: Path, folder: Path, *hooks: StageHook, resume: bool = True) -> RunArchive:
    """Run three short stages, half of the last two joint.

    Predictions are float32: a resumed run makes them again level by level, which would round once more in float16.
    """
    archive, _ = run_residuals(
        STUBS["graphdeco"],
        scene,
        folder,
        *("--iterations", 12),
        levels=3,
        joint=0.5,
        prediction_precision="float32",
        hooks=(Seeded(), *hooks),
        resume=resume,
    )
    return archive


def two_finished(scene: Path, folder: Path) -> Path:
    """Run it without its last stage."""
    with captured(folder, []), pytest.raises(KeyboardInterrupt):
        three_levels(scene, folder, StopAt(0), resume=False)
    return folder


@pytest.mark.slow
def test_a_run_killed_while_it_archives_them_ends_as_others(
    big: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run is killed at any write after the last stage, and resumed."""
    whole = three_levels(big, tmp_path / "whole", resume=False)
    begun = two_finished(big, tmp_path / "begun")
    base = plys(RunArchive.open(begun))
    assert all(before != after for before, after in zip(base, plys(whole)[:2], strict=True)), "they were trained along"
    writes = FailingWrites(monkeypatch, Killed)
    left, done = 0, False
    while not done:
        folder = shutil.copytree(begun, tmp_path / str(left))
        with contextlib.suppress(Killed), captured(folder, []):
            three_levels(big, folder, FailAfterStage(writes, 0, left))
            done = True
        writes.left = sys.maxsize
        killed = RunArchive.open(folder)
        assert plys(killed) == (plys(whole) if killed.manifest.complete else base)
        assert plys(three_levels(big, folder)) == plys(whole)
        assert {path.name for path in folder.glob("level_*/*.ply")} == {"input.ply", "point_cloud.ply"}
        left += 1
    # The manifest is written again when the held-out views are measured.
    assert left == 18, "three PLYs and two manifests in three steps each, two renamings, and a run that went well"


def test_nan_in_one_of_them_leaves_all_as_they_were(big: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = two_finished(big, tmp_path / "run")
    before = plys(RunArchive.open(folder))
    original = JointModels.fields

    def poisoned(models: JointModels, read: Any) -> Any:
        fields = original(models, read)
        fields[1].means[0, 0] = torch.nan
        return fields

    monkeypatch.setattr(JointModels, "fields", poisoned)
    with captured(folder, []), pytest.raises(TrainingDivergedError, match="x is NaN or inf for 1 of") as caught:
        three_levels(big, folder)
    assert " of level 1, trained jointly; " in str(caught.value)
    assert plys(RunArchive.open(folder)) == before
