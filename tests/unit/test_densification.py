"""Density control between refinements, against gsplat's own strategy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from gsplat.strategy import DefaultStrategy

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.ops.densification_statistics import add_statistics
from lapgs_plugin.training.densification import Densifier, DensityControl, control_of
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import Densification, LearningRates, TrainSettings
from lapgs_plugin.training.strategies import Gradients, Mcmc, Multiview, Regularized, StagePart, Strategy
from tests.training_scene import blob_field, ring_camera

EXTENT = 2.0


def rendered(n: int, seed: int) -> RenderResult:
    """What a render of n Gaussians might have left after `backward()`; every third one was culled."""
    generator = torch.Generator().manual_seed(seed)
    means2d = torch.zeros(n, 2, requires_grad=True)
    means2d.grad = 1e-4 * torch.randn(n, 2, generator=generator)
    radii = torch.randint(1, 9, (n,), generator=generator, dtype=torch.int32)
    radii[::3] = 0
    means2d.grad[::3] = 0
    image = torch.zeros(3, 4, 4)
    return RenderResult(image, image[0], radii, means2d, 2 * means2d.grad.abs())


@pytest.mark.parametrize("absgrad", [False, True])
def test_statistics_and_growth_are_gsplats(absgrad: bool) -> None:
    settings = TrainSettings(
        iterations=100,
        densification=Densification(start=2, until=60, every=10, reset_every=1000),
    )
    (stage,) = StagePlan.create((64, 48), 100, 1)
    schedule = StageSchedule.create(settings, stage)
    fields = [TrainableField.create(blob_field(200), settings.learning_rates, EXTENT) for _ in range(2)]
    ours = Densifier(schedule, Gradients(grow_grad2d=2e-4, absgrad=absgrad), EXTENT)
    theirs = DefaultStrategy(
        refine_start_iter=2, refine_stop_iter=60, refine_every=10, reset_every=1000, absgrad=absgrad
    )
    state = theirs.initialize_state(scene_scale=EXTENT)
    camera = replace(ring_camera(0.0), width=64, height=48)
    for iteration in range(1, 11):
        result = rendered(200, iteration)
        torch.manual_seed(iteration)
        edited = ours.after_step(fields[0], iteration, result, camera)
        assert edited == (iteration == 10)
        means2d: Any = torch.zeros(1, 200, 2)
        means2d.grad, means2d.absgrad = result.means2d.grad[None], result.absgrad2d[None]
        info = {"means2d": means2d, "width": 64, "height": 48, "n_cameras": 1, "gaussian_ids": None}
        info["radii"] = result.radii[None, :, None].expand(1, -1, 2)
        torch.manual_seed(iteration)
        theirs.step_post_backward(fields[1].params, fields[1].optimizers, state, iteration, info)
        for name in ("grad2d", "count"):
            assert torch.equal(ours.state[name], state[name]), (name, iteration)
    assert len(fields[0]) == len(fields[1]) != 200
    for name, value in fields[0].params.items():
        assert torch.equal(value, fields[1].params[name]), name


@pytest.mark.parametrize(
    ("options", "opacity", "scale"),
    [
        (Gradients(), 0.0, 0.0),
        (Gradients(opacity_regularization=0.02), 0.02, 0.0),
        (Multiview(scale_regularization=0.5), 0.0, 0.5),
        (Mcmc(), 0.01, 0.01),
        (Mcmc(opacity_regularization=0.0), 0.0, 0.01),
    ],
)
def test_regularization_is_a_mean_of_opacities_and_sizes(options: Regularized, opacity: float, scale: float) -> None:
    field = blob_field(7)
    model = TrainableField.create(field, LearningRates(), EXTENT)
    settings = TrainSettings(iterations=100)
    (stage,) = StagePlan.create((64, 48), 100, 1)
    control = options.of_stage(StagePart()).density_control(StageSchedule.create(settings, stage), EXTENT)
    model.params["scales"].grad = torch.full((7, 3), 0.25)
    control.regularize(model, range(1, 4))
    gradients = [model.params[name].grad for name in ("opacities", "scales")]
    if opacity == scale == 0.0:
        assert gradients[0] is None
        assert (gradients[1] == 0.25).all()
        return
    logits, log_scales = field.opacity_logits.double().requires_grad_(), field.log_scales.double().requires_grad_()
    term = (
        opacity * (1 / (1 + (-logits).exp())).sum() / 7 + scale * (5 / EXTENT) * log_scales.exp().sum() / 21
    )  # sizes in fifths of the extent
    expected = torch.autograd.grad(3 * term, (logits, log_scales), materialize_grads=True)
    for found, wanted, before in zip(gradients, expected, (0.0, 0.25), strict=True):
        assert found is not None
        torch.testing.assert_close(found.double(), wanted + before, rtol=1e-6, atol=1e-9)


def test_statistics_of_no_gaussians_are_empty() -> None:
    add_statistics(
        torch.zeros(2, 0, 2), torch.zeros(2, 0).int(), (8, 6), norms := torch.zeros(0), counts := torch.zeros(0)
    )
    assert len(norms) == len(counts) == 0


class Absent(Strategy):
    """A package's strategy that makes no density control."""


class Nothing(Strategy):
    """One that makes something else."""

    def density_control(self, schedule: StageSchedule, extent: float) -> Any:
        return None


@pytest.mark.parametrize(
    ("strategy", "message"),
    [
        (Absent(), "strategy Absent has no method density_control"),
        (Nothing(), "strategy Nothing: density_control returned a NoneType, expected a DensityControl"),
    ],
)
def test_a_strategy_that_makes_no_density_control_is_one_line(strategy: Strategy, message: str) -> None:
    schedule: Any = None
    with pytest.raises(UserInputError, match=message):
        control_of(strategy, schedule, 1.0)
    with pytest.raises(UserInputError, match="density control DensityControl has no method after_step"):
        DensityControl().after_step(schedule, 1, None, ring_camera(0.0))
