"""Scores of several views, against images of single Gaussians, and density control by them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.multiview import (
    LATE_OPACITY,
    MultiviewDensifier,
    ScoredView,
    ViewScores,
    large_errors,
    pixels_and_blame,
    view_scores,
)
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.scoring import FieldScoring
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.strategies import Multiview
from tests.training_runs import train
from tests.training_scene import blob_field, ring_camera, ring_scene

EXTENT = 2.0
SETTINGS = TrainSettings(
    iterations=100,
    levels=1,
    densification=Densification(start=2, until=60, every=10, reset_every=1000, strategy="multiview"),
)
CAMERA = ring_camera(0.0)


def schedule(settings: TrainSettings = SETTINGS) -> StageSchedule:
    (stage,) = StagePlan.create((64, 48), settings.iterations, 1)
    return StageSchedule.create(settings, stage)


def test_large_errors_are_above_a_share_of_the_range() -> None:
    target = torch.zeros(3, 1, 4)
    image = torch.tensor([[[0.2, 0.3, 0.6, 1.2]], [[0.2, 0.3, 0.6, 1.2]], [[-0.2, 0.3, 0.6, 1.2]]])
    assert large_errors(image, target, 0.3).tolist() == [[False, False, True, True]]
    assert large_errors(image, target, 0.0).tolist() == [[False, True, True, True]]
    assert not large_errors(target, target, 0.1).any()


@pytest.mark.parametrize("signed", [False, True])
def test_scores_are_the_pixels_of_an_image_of_one_white_gaussian_where_errors_are_large(signed: bool) -> None:
    field = replace(blob_field(30), signed=signed)
    cameras = [ring_camera(angle) for angle in (0.0, 0.8, 2.5)]
    oracle, rasterizer = OracleRasterizer(), CpuRasterizer()
    generator = torch.Generator().manual_seed(3)
    target = [torch.rand((3, 40, 56), generator=generator) for _ in cameras]
    predicted = [torch.rand((3, 40, 56), generator=generator) for _ in cameras]
    losses = [torch.tensor(0.5), torch.tensor(0.1), torch.tensor(0.3)]
    grey = torch.zeros(30, 1, 3, requires_grad=True)
    plain = replace(field, sh=grey, signed=True)
    views = (
        ScoredView(rasterizer(plain, camera, background=torch.zeros(3)).image, *pair, loss)
        for camera, *pair, loss in zip(cameras, predicted, target, losses, strict=True)
    )
    scores = view_scores(*pixels_and_blame(views, grey, 0.5), len(cameras))
    made_up = torch.zeros(len(cameras), 30, dtype=torch.float64)
    for index in range(30):
        white = torch.zeros(30, 1, 3)
        white[index] = 1 / SH_C0
        alone = replace(field, sh=white, signed=True).to(dtype=torch.float64)
        for i, camera in enumerate(cameras):
            black = torch.zeros(3, dtype=torch.float64)
            image = oracle(alone, camera.to(dtype=torch.float64), background=black).image[0]
            error = (predicted[i] - target[i]).abs().mean(0)
            marked = (error - error.min()) / (error.max() - error.min()) > 0.5
            made_up[i, index] = image[marked].sum()
    # Sums of up to some dozen pixels, worst seen 4e-7.
    torch.testing.assert_close(scores.pixels.double(), made_up.mean(0), rtol=2e-6, atol=1e-6)
    blame = (made_up * torch.tensor([0.5, 0.1, 0.3])[:, None]).sum(0)
    expected = (blame - blame.min()) / (blame.max() - blame.min())
    torch.testing.assert_close(scores.blame.double(), expected, rtol=2e-5, atol=1e-6)


def test_a_field_without_gaussians_has_no_scores() -> None:
    scores = view_scores(*pixels_and_blame(iter(()), torch.zeros(0, 1, 3, requires_grad=True), 0.1), 1)
    assert scores.pixels.shape == scores.blame.shape == (0,)


def rendered(by_centre: Tensor, by_absolute: Tensor) -> RenderResult:
    """Return a render after `backward()`, its gradients in normalised device coordinates along x."""
    scale = torch.tensor([2 / CAMERA.width, 0.0])
    means2d = torch.zeros(len(by_centre), 2, requires_grad=True)
    means2d.grad = by_centre[:, None] * scale
    image = torch.zeros(3, 4, 4)
    return RenderResult(image, image[0], torch.ones(len(by_centre)).int(), means2d, by_absolute[:, None] * scale)


def refined(edit: Callable[[GaussianField], GaussianField], scores: ViewScores) -> tuple[TrainableField, bool]:
    """A field of eight: 0 to 3 have a gradient, 4 to 7 an absolute one; every second has large errors."""
    field = edit(blob_field(8))
    model = TrainableField.create(field, SETTINGS.learning_rates, EXTENT)
    control = MultiviewDensifier(schedule(), Multiview(grow_grad2d=2e-4), EXTENT)
    by_centre, by_absolute = torch.zeros(8), torch.zeros(8)
    by_centre[:4], by_absolute[4:] = 3e-4, 1e-3
    changed = False
    for iteration in range(1, 11):
        assert control.score_threshold(iteration) == (0.1 if iteration == 10 else None)
        scores_now = scores if iteration == 10 else None
        changed = control.after_step(model, iteration, rendered(by_centre, by_absolute), CAMERA, scores_now)
        assert changed == (iteration == 10)
    for name in ("grad2d", "count", "absgrad2d", "shown"):
        assert control.state[name].tolist() == [0] * len(model)
    return model, changed


def with_sizes(size: float) -> Callable[[GaussianField], GaussianField]:
    def edit(field: GaussianField) -> GaussianField:
        values = {"log_scales": torch.full((8, 3), size).log(), "opacity_logits": torch.full((8,), 3.0)}
        return field.with_parameters(values)

    return edit


BAD = ViewScores(torch.tensor([0.3, 0.05] * 4), torch.zeros(8))


def test_small_ones_are_cloned_by_gradient_and_large_ones_split_by_absolute_gradient() -> None:
    small, _ = refined(with_sizes(0.001 * EXTENT), BAD)  # clones of 0 and 2
    assert len(small) == 10
    assert torch.equal(small.params["means"][8:], small.params["means"][[0, 2]])
    large, _ = refined(with_sizes(0.05 * EXTENT), BAD)  # 4 and 6 become two each, and are gone themselves
    assert len(large) == 10
    before = with_sizes(0.05 * EXTENT)(blob_field(8))
    assert torch.equal(large.params["means"][:6], before.means[[0, 1, 2, 3, 5, 7]])
    sizes = large.params["scales"].exp()[:, 0]
    assert (sizes[6:] < sizes[:6].min()).all()


def test_nothing_grows_without_large_errors_and_opacities_are_lowered() -> None:
    model, _ = refined(with_sizes(0.001 * EXTENT), ViewScores(torch.zeros(8), torch.zeros(8)))
    assert len(model) == 8
    torch.testing.assert_close(model.params["opacities"].sigmoid(), torch.full((8,), 0.8))


@pytest.mark.parametrize(("reset_every", "left"), [(5, 6), (1000, 8)])
def test_gaussians_as_large_as_the_scene_are_removed_once_opacities_were_reset(reset_every: int, left: int) -> None:
    field = with_sizes(0.001 * EXTENT)(blob_field(8))
    field.log_scales[:2, 1] = math.log(0.2 * EXTENT)
    model = TrainableField.create(field, SETTINGS.learning_rates, EXTENT)
    resets = replace(SETTINGS.densification, reset_every=reset_every)
    control = MultiviewDensifier(schedule(replace(SETTINGS, densification=resets)), Multiview(grow_grad2d=2e-4), EXTENT)
    nothing = ViewScores(torch.zeros(8), torch.zeros(8))
    control.after_step(model, 10, rendered(torch.zeros(8), torch.zeros(8)), CAMERA, nothing)
    assert torch.equal(model.params["means"].detach(), field.means[8 - left :])


def test_faint_and_harmful_gaussians_are_removed_late() -> None:
    opacities = torch.tensor([0.05, 0.2, 0.9, 0.09, 0.11, 0.5, 0.5, 0.5])
    field = blob_field(8).with_parameters({"opacity_logits": torch.logit(opacities)})
    model = TrainableField.create(field, SETTINGS.learning_rates, EXTENT)
    control = MultiviewDensifier(schedule(), Multiview(grow_grad2d=2e-4), EXTENT)
    assert [i for i in range(61, 101) if control.score_threshold(i) is not None] == [61, 70, 80, 90]
    blame = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.95, 1.0, 0.85])
    assert not control.after_step(model, 75, None, CAMERA)
    assert control.after_step(model, 80, None, CAMERA, ViewScores(torch.ones(8), blame))
    assert torch.equal(model.params["means"], field.means[[1, 2, 4, 7]])
    assert (model.params["opacities"].sigmoid() >= LATE_OPACITY).all()


def test_late_pruning_waits_for_a_step() -> None:
    settings = replace(SETTINGS, iterations=30_000, densification=Densification(strategy="multiview"))
    iterations = schedule(settings)
    ends, done = set(), 0
    while done < iterations.iterations:
        done += iterations.views_of_step(done)
        ends.add(done)
    assert iterations.late_prunes <= ends
    assert sorted(iterations.late_prunes) == [18_000, 21_000, 24_004, 27_004]
    assert not schedule(replace(settings, densification=Densification(until=30_000))).late_prunes


@pytest.mark.parametrize(
    "hierarchy", [{"levels": 1}, {"hierarchy": "laplacian", "joint": 0.5}, {"hierarchy": "nested"}]
)
def test_runs_grow_learn_and_score_the_same_views_again(
    hierarchy: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    density = Densification(
        start=3,
        until=80,
        every=5,
        strategy="multiview",
        options=Multiview(error_pixels=0.2, split_absgrad2d=1e-4),
    )
    settings = TrainSettings(iterations=160, sh_degree=1, sh_every=10, densification=density, **hierarchy)
    scored: list[tuple[int, int]] = []
    ask = FieldScoring.scores

    def scores(
        scoring: FieldScoring, field: GaussianField, iteration: int, degree: int, threshold: float
    ) -> ViewScores:
        asked = ask(scoring, field, iteration, degree, threshold)
        again = ask(scoring, field, iteration, degree, threshold)
        assert torch.equal(asked.pixels, again.pixels), "the same views"
        assert len(asked.pixels) == len(field)
        assert float(asked.blame.max()) <= 1.0
        scored.append((scoring.losses.stage.level, iteration))
        return asked

    monkeypatch.setattr(FieldScoring, "scores", scores)
    archive = train(tmp_path / "run", ring_scene(), settings)
    for record in archive.manifest.records:
        assert record.peak_gaussians > 100, "it grew"
        assert any(level == record.level for level, _ in scored)
    first, last = (archive.history()[i]["loss"] for i in (0, -1))
    assert last < first


def test_scores_of_a_residual_are_of_the_composed_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A residual of zero colour, scored before anything is learned, predicts what the base does."""
    seen: list[Tensor] = []
    import lapgs_plugin.training.scoring as module

    def noted(views: Any, grey: Tensor, threshold: float) -> list[Tensor]:
        listed = list(views)
        seen.extend(view.prediction - view.target for view in listed)
        return pixels_and_blame(listed, grey, threshold)

    density = Densification(start=0, until=80, every=1, strategy="multiview", options=Multiview(error_pixels=1e6))
    settings = TrainSettings(iterations=40, split="39/40,1/40", hierarchy="laplacian", densification=density)
    monkeypatch.setattr(module, "pixels_and_blame", noted)
    monkeypatch.setattr(StageSchedule, "late_prunes", frozenset())
    train(tmp_path / "run", ring_scene(), settings)
    errors = [float(difference.abs().mean()) for difference in seen if difference.shape[-1] == 56]
    assert errors
    assert max(errors) < 0.2  # without the base it would be the image itself, 0.35 on average; worst seen 0.13
