"""MCMC's density control: what moves, what is added, and what keeps its look."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gsplat.strategy import MCMCStrategy, ops
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from torch import Tensor

from lapgs_plugin.errors import TrainingStoppedError, UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.hierarchy.settings import Hierarchy
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import world_covariances
from lapgs_plugin.scenes.scene import View
from lapgs_plugin.training import mcmc
from lapgs_plugin.training.mcmc import MOST_COPIES, McmcDensifier, bound_sizes, copies_of, shake
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import Densification, LearningRates, TrainSettings
from lapgs_plugin.training.strategies import GRADIENTS, LONG_RUN, LONG_RUN_OF_LARGE, MCMC, Auto, Gradients, Mcmc
from tests.training_runs import Said, StopAt, plys, resume, ring_manifest, train
from tests.training_scene import blob_field, ring_camera, ring_scene


def model_of(field: GaussianField) -> TrainableField:
    return TrainableField.create(field, LearningRates(), 1.0)


@settings(deadline=None, max_examples=40)
@given(opacity=st.floats(0.005, 0.999), count=st.integers(1, MOST_COPIES))
def test_copies_have_the_opacity_and_the_integral_of_the_one_they_replace(opacity: float, count: int) -> None:
    each, factor = (
        float(value) for value in copies_of(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    )
    assert 1 - (1 - each) ** count == pytest.approx(opacity, rel=1e-12)  # 4.0e-13 seen
    # Along a line through the centre: the alpha of all copies together against that of the single Gaussian.
    together = quad(lambda x: 1 - (1 - each * math.exp(-x * x / (2 * factor**2))) ** count, -12, 12, limit=200)[0]
    assert together == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-6)  # 7.7e-14 seen


def test_noise_has_the_shape_of_faint_gaussians_and_spares_the_others() -> None:
    torch.manual_seed(0)
    one = blob_field(1)
    logits = torch.cat([torch.full((4000,), -20.0), torch.full((1000,), 1.0)])
    field = GaussianField(
        *(value.expand(5000, *value.shape[1:]).clone() for value in (one.means, one.quaternions, one.log_scales)),
        logits,
        one.sh.expand(5000, *one.sh.shape[1:]).clone(),
    )
    model = model_of(field)
    shake(model, 3.0)
    moved = (model.params["means"].detach() - field.means).numpy().astype(np.float64)
    assert not moved[4000:].any()
    covariance = world_covariances(one.quaternions, one.log_scales)[0].double().numpy()
    whiten = np.linalg.inv(3.0 / (1 + math.exp(-0.5)) * covariance)  # of the displacement of a transparent Gaussian
    np.testing.assert_allclose(np.cov((moved[:4000] @ whiten).T), np.eye(3), atol=0.12)  # worst seen 0.04


def schedule_of(iterations: int) -> StageSchedule:
    (stage,) = StagePlan.create((64, 48), iterations, 1)
    chosen = TrainSettings(iterations=iterations, densification=Densification(start=1, every=10, strategy=MCMC))
    return StageSchedule.create(chosen, stage)


def trained_once(count: int) -> TrainableField:
    model = model_of(blob_field(count))
    sum(value.square().sum() for value in model.params.values()).backward()  # type: ignore[union-attr]
    model.step(1e-3)
    return model


def test_the_transparent_move_to_the_opaque_and_keep_their_moments() -> None:
    torch.manual_seed(0)
    model = trained_once(30)
    with torch.no_grad():
        model.params["opacities"][:10] = -9.0
        model.params["opacities"][10:] = 2.0
        model.params["opacities"][29] = -30.0  # never chosen among the living: it moves, too
    before = {name: value.detach().clone() for name, value in model.params.items()}
    kept = model.optimizer_moments()["means"]["exp_avg_sq"][:10].clone()
    (stage,) = StagePlan.create((64, 48), 100, 1)
    schedule = StageSchedule.create(
        TrainSettings(iterations=100, densification=Densification(start=1, every=10)), stage
    )
    control = McmcDensifier(schedule, replace(Mcmc(), cap_max=30))
    model.optimizers["means"].param_groups[0]["lr"] = 0.0  # no noise
    assert control.after_step(model, 20, None, ring_scene().train[0].camera)
    assert len(model) == 30
    gone = [*range(10), 29]
    means = model.params["means"].detach()
    assert all((means[row] == before["means"][10:29]).all(-1).any() for row in gone)
    assert (torch.sigmoid(model.params["opacities"]) > 0.005).all()
    assert torch.equal(model.optimizer_moments()["means"]["exp_avg_sq"][:10], kept)
    changed = (model.params["opacities"] != before["opacities"]).nonzero()[:, 0]
    sources = [int(row) for row in changed if row not in gone]
    assert sources
    assert not model.optimizer_moments()["means"]["exp_avg_sq"][sources].any()


def shown(count: int, gradient: Tensor | None, absolute: Tensor | None = None) -> RenderResult:
    """Return what density control reads of a render of 2x2 pixels, in which a gradient counts as it is."""
    centres = torch.zeros(count, 2, requires_grad=True)
    centres.grad = gradient
    return RenderResult(torch.zeros(()), None, torch.ones(count, dtype=torch.int32), centres, absolute)


def test_gaussians_are_added_by_opacity_and_absolute_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of the draw are opacity times mean gradient norm; nothing is drawn that no view blames."""
    model = trained_once(4)
    model.params["opacities"].data = torch.logit(torch.tensor([0.2, 0.4, 0.4, 0.8]))
    camera = ring_scene().train[0].camera.resized(2, 2)
    control = McmcDensifier(schedule_of(100), replace(Mcmc(), cap_max=6))
    model.optimizers["means"].param_groups[0]["lr"] = 0.0
    seen: list[Tensor] = []
    monkeypatch.setattr(mcmc, "_sample", lambda weights, count: seen.append(weights) or torch.zeros(count).long())
    control.accumulate(shown(4, torch.ones(4, 2), torch.tensor([[3.0, 4.0], [0, 1], [0, 0], [1, 0]])), camera)
    last = shown(4, torch.ones(4, 2), torch.tensor([[0.0, 1.0], [0, 1], [0, 0], [0, 0]]))
    assert control.after_step(model, 20, last, camera)
    torch.testing.assert_close(seen[0], torch.tensor([0.2 * 3.0, 0.4 * 1.0, 0.0, 0.8 * 0.5]))
    assert control.state["grad2d"] is None, "statistics begin anew"


def test_without_absolute_gradients_others_count_and_without_any_opacities(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = ring_scene().train[0].camera.resized(2, 2)
    seen: list[Tensor] = []
    monkeypatch.setattr(mcmc, "_sample", lambda weights, count: seen.append(weights) or torch.zeros(count).long())
    for gradient in (torch.tensor([[2.0, 0.0], [0.0, 0.0]]), None):
        model = trained_once(2)
        model.params["opacities"].data = torch.logit(torch.tensor([0.5, 0.25]))
        model.optimizers["means"].param_groups[0]["lr"] = 0.0
        control = McmcDensifier(schedule_of(100), replace(Mcmc(), cap_max=3))
        assert control.after_step(model, 20, shown(2, gradient), camera)
    torch.testing.assert_close(seen[0], torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(seen[1], torch.tensor([0.5, 0.25]))


@given(chosen=st.lists(st.integers(3, 9), min_size=3, max_size=3))
def test_copies_share_the_gradient_of_the_gaussian_they_replace(chosen: list[int]) -> None:
    control = McmcDensifier(schedule_of(100), replace(Mcmc(), cap_max=10))
    norms = torch.arange(10.0)
    control.state |= {"grad2d": norms.clone(), "count": torch.ones(10)}
    control._share_gradients(torch.arange(3), torch.tensor(chosen))
    for source in range(3, 10):
        rows = [source, *(place for place in range(3) if chosen[place] == source)]
        shared = control.state["grad2d"][rows]
        assert shared.sum() == pytest.approx(norms[source].item(), rel=1e-6)  # 1.2e-7 seen
        assert (shared == shared[0]).all()


def test_statistics_are_taken_right_before_refinements_alone() -> None:
    (stage,) = StagePlan.create((64, 48), 30_000, 1)
    control = McmcDensifier(StageSchedule.create(TrainSettings(), stage), replace(Mcmc(), cap_max=9))
    assert [i for i in range(1, 801) if control.needs_statistics(i)] == [
        *(i for first in (561, 661, 761) for i in range(first, first + 40))
    ]
    assert not any(map(control.needs_statistics, range(24_901, 30_001)))


def relocated(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Compute equation 9 of Kheradmand et al. 2024 term by term, as gsplat's CUDA kernel does."""
    new_opacities = 1 - (1 - opacities) ** (1 / ratios)
    denominators = torch.zeros_like(opacities)
    for row, count in enumerate(ratios.tolist()):
        for i in range(1, count + 1):
            for k in range(i):
                sign = (-1) ** k / math.sqrt(k + 1)
                denominators[row] += math.comb(i - 1, k) * sign * new_opacities[row] ** (k + 1)
    return new_opacities, scales * (opacities / denominators)[:, None]


def test_refinement_edits_parameters_and_moments_as_gsplat_does(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = [torch.tensor([12, 20, 20, 25, 12, 13, 29, 29, 29, 18]), torch.tensor([2, 15, 15])]
    models = [trained_once(30) for _ in range(2)]
    for model in models:
        with torch.no_grad():
            model.params["opacities"][:10] = -9.0
            model.params["opacities"][10:] = torch.linspace(-1, 3, 20)
    ours = iter(drawn)
    monkeypatch.setattr(mcmc, "_sample", lambda weights, count: next(ours))
    control = McmcDensifier(schedule_of(100), replace(Mcmc(), cap_max=33))
    monkeypatch.setattr(mcmc, "shake", lambda *arguments: None)
    assert control.after_step(models[0], 20, None, ring_scene().train[0].camera)

    theirs = iter([drawn[0] - 10, drawn[1]])  # gsplat counts the living alone where it moves the dead
    monkeypatch.setattr(ops, "_multinomial_sample", lambda weights, count, replacement: next(theirs))
    monkeypatch.setattr(ops, "compute_relocation", relocated)
    strategy = MCMCStrategy(cap_max=33)
    binoms = strategy.initialize_state()["binoms"]
    params, optimizers = models[1].params, models[1].optimizers
    strategy._relocate_gs(params, optimizers, binoms)
    ops.sample_add(params, optimizers, {}, 3, binoms)
    assert len(models[0]) == len(models[1]) == 33
    for name, value in params.items():
        torch.testing.assert_close(models[0].params[name], value, rtol=2e-5, atol=2e-5)  # 4.8e-7 seen
        for key, moment in models[1].optimizer_moments()[name].items():
            torch.testing.assert_close(models[0].optimizer_moments()[name][key], moment, msg=f"{name} {key}")


@settings(deadline=None, max_examples=40)
@given(opacities=st.lists(st.floats(0.0, 0.02), min_size=1, max_size=12))
def test_faint_gaussians_of_a_residual_are_removed_and_the_others_stay(opacities: list[float]) -> None:
    model = model_of(replace(blob_field(len(opacities)), signed=True))
    sum(value.square().sum() for value in model.params.values()).backward()  # type: ignore[union-attr]
    model.step(1e-3)
    model.params["opacities"].data = torch.logit(torch.tensor(opacities, dtype=torch.float32))
    reached = torch.sigmoid(model.params["opacities"].detach())
    alive = ((reached >= 0.005) if (reached >= 0.005).any() else reached == reached.max()).nonzero()[:, 0]
    before = {name: value.detach().clone() for name, value in model.params.items()}
    moments = {name: {**each} for name, each in model.optimizer_moments().items()}
    control = McmcDensifier(schedule_of(100), replace(Mcmc(), cap_max=1))  # none are added
    control.state |= {"grad2d": torch.arange(len(reached)) + 1.0, "count": torch.arange(len(reached)) + 2}
    control._remove_dead(model)
    assert torch.equal(control.state["grad2d"], alive + 1.0)
    assert torch.equal(control.state["count"], alive + 2)
    for name, value in before.items():
        assert torch.equal(model.params[name], value[alive]), name
        assert model.params[name].requires_grad
        for key, moment in moments[name].items():
            assert torch.equal(model.optimizer_moments()[name][key], moment if key == "step" else moment[alive])


def test_a_refinement_removes_in_a_residual_alone() -> None:
    for signed in (False, True):
        model = model_of(replace(blob_field(10), signed=signed))
        with torch.no_grad():
            model.params["opacities"][:4] = -9.0
        model.optimizers["means"].param_groups[0]["lr"] = 0.0
        control = McmcDensifier(schedule_of(100), replace(Mcmc(), cap_max=10 - 4 * signed))
        assert control.after_step(model, 20, None, ring_scene().train[0].camera)
        assert len(model) == 10 - 4 * signed
        assert (torch.sigmoid(model.params["opacities"]) >= 0.005).all()


@pytest.mark.parametrize(("weight", "expected"), [(None, [0.01, 0.001]), (0.02, [0.02, 0.02]), (0.0, [0.0, 0.0])])
def test_residuals_weigh_opacities_less_unless_told(weight: float | None, expected: list[float]) -> None:
    options = Mcmc(opacity_regularization=weight)
    for hierarchy, weights in ((Hierarchy.LAPLACIAN, expected), (Hierarchy.NESTED, [expected[0]] * 2)):
        chosen = TrainSettings(hierarchy=hierarchy.value, densification=Densification(strategy=MCMC, options=options))
        stages = StagePlan.create((64, 48), 100, 2, hierarchy=hierarchy)
        strategies = [chosen.strategy_of(stage, 1000) for stage in stages]
        assert [each.opacity_weight for each in strategies if isinstance(each, Mcmc)] == pytest.approx(weights)
        assert [each.scale_weight for each in strategies if isinstance(each, Mcmc)] == [0.01, 0.01]


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize(("iteration", "colorless"), [(1, True), (250, True), (251, False)])
def test_a_residual_learns_colors_before_its_opacities_have_a_weight(
    signed: bool, iteration: int, colorless: bool
) -> None:
    model = model_of(replace(blob_field(5), signed=signed))
    schedule = replace(schedule_of(15_000), densify_until=12_500)
    control = McmcDensifier(schedule, replace(Mcmc(scale_regularization=0.0), cap_max=5))
    control.regularize(model, range(iteration, iteration + 1))
    gradient = model.params["opacities"].grad
    if signed and colorless:
        assert gradient is None
    else:
        assert gradient is not None
        assert (gradient > 0).all()


@pytest.mark.parametrize("signed", [False, True])
def test_removal_leaves_the_weight_of_the_opacities_that_remain(signed: bool) -> None:
    """A residual's pull at each opacity stays when others are removed; a base's grows."""
    model = model_of(replace(blob_field(10), signed=signed))
    control = McmcDensifier(
        replace(schedule_of(15_000), densify_until=12_500), replace(Mcmc(scale_regularization=0.0), cap_max=10)
    )

    def pull(iteration: int) -> float:
        model.params["opacities"].grad = None
        control.regularize(model, range(iteration, iteration + 1))
        gradient = model.params["opacities"].grad
        assert gradient is not None
        return float(gradient[-1])

    before = pull(1000)
    ops.remove(model.params, model.optimizers, {}, torch.arange(10) < 8)
    assert pull(1001) == pytest.approx(before if signed else 5 * before, rel=1e-6)


def test_a_residual_under_pressure_keeps_gaussians(tmp_path: Path) -> None:
    """A mean over those that are left would kill nearly all, with four times the default weight."""
    density = Densification(MCMC, start=1, every=10, options=Mcmc(cap_max=600, opacity_regularization=0.04))
    settings = TrainSettings(iterations=300, levels=2, sh_degree=0, appearance="none", densification=density)
    residual = train(tmp_path / "run", ring_scene(), settings).manifest.records[-1]
    assert residual.start_gaussians == 600
    assert residual.num_gaussians > 30  # 81 seen, 7 before


@pytest.mark.parametrize(
    ("weight", "least"),
    [
        (None, 60),  # the default: a tenth at least; 600 seen
        (0.04, 30),  # 74 seen, 2 by a mean over those that are left
    ],
)
def test_a_residual_of_a_scene_with_detail_keeps_gaussians(weight: float | None, least: int, tmp_path: Path) -> None:
    """Of 30 views whose blobs are as small as a pixel. It starts with as many Gaussians as its limit allows."""
    field = blob_field(1500)
    field = replace(field, log_scales=field.log_scales - 0.8)
    views = []
    for index in range(30):
        camera = ring_camera(2 * math.pi * index / 30)
        image = CpuRasterizer()(field, camera, background=torch.zeros(3)).image
        views.append(View(f"view_{index}.png", camera, image.clamp(0, 1)))
    points = field.means[::3]
    scene = replace(ring_scene(), train=tuple(views), test=(), points=points, colors=torch.full((len(points), 3), 0.5))
    density = Densification(MCMC, start=1, every=10, options=Mcmc(cap_max=600, opacity_regularization=weight))
    settings = TrainSettings(iterations=400, levels=2, sh_degree=0, appearance="none", densification=density)
    residual = train(tmp_path / "run", scene, settings).manifest.records[-1]
    assert residual.start_gaussians == 600
    assert residual.num_gaussians >= least


def test_gaussians_are_added_up_to_the_limit_and_the_image_stays() -> None:
    torch.manual_seed(0)
    model = trained_once(200)
    camera = ring_scene().train[0].camera
    image = CpuRasterizer()(model.field.detach(), camera, background=torch.zeros(3)).image
    (stage,) = StagePlan.create((64, 48), 30_000, 1)
    schedule = StageSchedule.create(TrainSettings(), stage)
    control = McmcDensifier(schedule, replace(Mcmc(), cap_max=215))
    model.optimizers["means"].param_groups[0]["lr"] = 0.0
    counts = []
    for iteration in (600, 650, 700, 800):
        control.after_step(model, iteration, None, camera)
        counts.append(len(model))
    assert counts == [210, 210, 215, 215], "5 % each 100 iterations"
    few = trained_once(3)
    few.optimizers["means"].param_groups[0]["lr"] = 0.0
    for iteration in (600, 700):
        control.after_step(few, iteration, None, camera)
    assert len(few) == 5, "one at least"
    again = CpuRasterizer()(model.field.detach(), camera, background=torch.zeros(3)).image
    assert (again - image).abs().mean() < 0.004  # worst seen 0.0013


def test_a_short_run_grows_in_larger_steps() -> None:
    (stage,) = StagePlan.create((64, 48), 700, 1)
    schedule = StageSchedule.create(TrainSettings(iterations=700, densification=Densification(strategy=MCMC)), stage)
    model = trained_once(100)
    McmcDensifier(schedule, replace(Mcmc(), cap_max=1000)).after_step(model, 100, None, ring_scene().train[0].camera)
    assert len(model) == 150


@pytest.mark.parametrize("views", [1, 3, 8, 16])
def test_noise_of_steps_of_few_views_comes_at_once(monkeypatch: pytest.MonkeyPatch, views: int) -> None:
    """Its variance is that of noise after each step, whatever the number of views of a step."""
    amounts: dict[int, float] = {}
    model, camera, iteration = trained_once(30), ring_scene().train[0].camera, 0
    monkeypatch.setattr(mcmc, "shake", lambda model, amount: amounts.__setitem__(iteration, amount))
    control = McmcDensifier(schedule_of(10_000), replace(Mcmc(), cap_max=30))
    steps = []
    for iteration in range(views, 97, views):
        steps.append(1e-4 / iteration)
        model.optimizers["means"].param_groups[0]["lr"] = steps[-1]
        control.after_step(model, iteration, None, camera)
    together = max(views, math.ceil(8 / views) * views)
    assert list(amounts) == list(range(together, 97, together))
    variance = sum(amount**2 for amount in amounts.values())
    assert variance == pytest.approx(mcmc.NOISE**2 * sum(step**2 for step in steps[: max(amounts) // views]))


@settings(deadline=None, max_examples=60)
@given(
    place=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-2, 9)),
    sigmas=st.tuples(st.floats(0.001, 4), st.floats(0.001, 4), st.floats(0.001, 4)),
    angle=st.floats(0, 6),
    most=st.floats(0.5, 64),
)
def test_what_a_camera_sees_has_no_standard_deviation_above_the_bound(
    place: tuple[float, float, float], sigmas: tuple[float, float, float], angle: float, most: float
) -> None:
    camera = ring_camera(angle)
    pose = camera.world_to_camera.double().numpy()
    x, y, z = place  # as the camera has it, the sides in halves of its image at that depth
    tangents = camera.tan_half_fov
    local = np.array([x * tangents[0] * z, y * tangents[1] * z, z])
    # The limits themselves are left to rounding.
    assume(min(abs(abs(x) - 1.3), abs(abs(y) - 1.3), abs(z - 0.2)) > 1e-3)
    blob = blob_field(1)
    field = blob.with_parameters(
        {
            "means": torch.from_numpy((local - pose[:3, 3]) @ pose[:3, :3]).float()[None],
            "log_scales": torch.tensor([sigmas]).log(),
        }
    )
    model = model_of(field)
    bound_sizes(model, camera, most)
    seen = z > 0.2 and abs(x) < 1.3 and abs(y) < 1.3
    expected = np.minimum(sigmas, most * z / camera.fx) if seen else np.array(sigmas)
    after = model.params["scales"].detach().exp().numpy()[0]
    np.testing.assert_allclose(after, expected, rtol=3e-5)  # 3.0e-6 seen
    small = np.array(sigmas) <= after
    assert torch.equal(model.params["scales"][0, small], field.log_scales[0, small])


@pytest.mark.parametrize(
    ("signed", "size", "bounded"),
    [(True, (1500, 1000), True), (True, (1499, 1000), False), (False, (1500, 1000), False)],
)
def test_sizes_are_bounded_in_residuals_of_large_images_alone(
    signed: bool, size: tuple[int, int], bounded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcmc, "shake", lambda model, amount: None)
    camera = ring_camera(0.0, *size)
    model = trained_once(5)
    model.signed = signed
    with torch.no_grad():
        model.params["scales"].fill_(0.0)  # a unit, of the four that the camera is away
    control = McmcDensifier(schedule_of(10_000), replace(Mcmc(), cap_max=30))
    for iteration in range(1, 9):
        control.after_step(model, iteration, None, camera)
    assert (model.params["scales"] < 0).all().item() is bounded


def test_nothing_is_due_for_resets_that_never_come() -> None:
    schedule = schedule_of(9000)  # 3DGS's heuristics reset every 900 iterations
    assert schedule.sampled(5) == {1800, 3600, 5400, 7200, 9000}


def test_limits_follow_the_pixels_of_a_level() -> None:
    plan = StagePlan.create((800, 533), 30_000, 2, hierarchy=Hierarchy.LAPLACIAN)

    def limits(pixels: tuple[int, int], **options: int) -> list[int | None]:
        chosen = TrainSettings(densification=Densification(strategy=MCMC, options=Mcmc(**options)))
        stages = zip(plan, pixels, strict=True)
        strategies = (chosen.strategy_of(stage, count) for stage, count in stages)
        return [each.cap_max for each in strategies if isinstance(each, Mcmc)]

    assert limits((10**9, 10**9)) == [500_000, 1_000_000]
    assert limits((32_000, 160_000)) == [2_000, 10_000]
    assert limits((10**9, 10**9), cap_max=70) == [70, 70]
    assert limits((10**9, 10**9), base_cap_max=70) == [70, 1_000_000]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"iterations": LONG_RUN_OF_LARGE}, MCMC),
        ({"iterations": LONG_RUN_OF_LARGE - 1}, GRADIENTS),
        ({"iterations": LONG_RUN_OF_LARGE, "densification": Densification(options=Auto(absgrad=True))}, GRADIENTS),
        ({"iterations": LONG_RUN_OF_LARGE, "prune": 0.01}, GRADIENTS),
        ({"iterations": LONG_RUN_OF_LARGE, "protocol": "paper"}, GRADIENTS),
    ],
)
def test_auto_takes_mcmc_for_shorter_runs_of_large_photos(options: dict[str, Any], expected: str) -> None:
    settings = TrainSettings(**options)
    assert settings.densification.strategy == GRADIENTS
    large = settings.for_size((1062, 1894), choose=True)
    assert large.densification.strategy == expected
    assert large.shares == ((Fraction(2, 3), Fraction(1, 3)) if expected == MCMC else settings.shares)
    assert settings.for_size((1062, 1894)).densification == settings.densification, "it was asked for"
    assert settings.for_size((980, 545), choose=True) is settings


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"iterations": LONG_RUN}, MCMC),
        ({"iterations": LONG_RUN - 1}, GRADIENTS),
        ({"iterations": 100, "densification": Densification(options=Auto(cap_max=9))}, MCMC),
        ({"densification": Densification(options=Auto(absgrad=True))}, GRADIENTS),
        ({"densification": Densification(reset_every=500)}, GRADIENTS),
        ({"prune": 0.01}, GRADIENTS),
        ({"residual_resets": True}, GRADIENTS),
        ({"protocol": "paper"}, GRADIENTS),
    ],
)
def test_auto_follows_the_length_of_a_run_and_what_was_given(options: dict[str, object], expected: str) -> None:
    chosen = TrainSettings(**options).densification  # type: ignore[arg-type]  # some of its fields
    assert chosen.strategy == expected
    assert type(chosen.options) is {MCMC: Mcmc, GRADIENTS: Gradients}[expected]
    densification = options.get("densification", Densification())
    assert isinstance(densification, Densification)
    for name in vars(chosen.options):
        assert getattr(chosen.options, name) == getattr(densification.options, name), name


def test_options_of_both_are_refused() -> None:
    message = "--cap-max is an option of --strategy mcmc, which does not take --densify-threshold, --prune; leave"
    with pytest.raises(UserInputError, match=message):
        TrainSettings(prune=0.01, densification=Densification(options=Auto(cap_max=9, grow_grad2d=1e-4)))
    with pytest.raises(UserInputError, match=r"--base-cap-max is an option .* does not take --protocol paper"):
        TrainSettings(protocol="paper", densification=Densification(options=Auto(base_cap_max=9)))
    with pytest.raises(UserInputError, match="--base-cap-max 9: one level has no base; give --cap-max"):
        TrainSettings(levels=1, densification=Densification(options=Auto(base_cap_max=9)))
    with pytest.raises(UserInputError, match=r"--densify-threshold 0\.0: expected a positive gradient"):
        TrainSettings(densification=Densification(options=Auto(grow_grad2d=0.0)))
    with pytest.raises(UserInputError, match="--strategy mcmc with --protocol paper: the paper has 3dgs"):
        TrainSettings(protocol="paper", densification=Densification(strategy=MCMC))


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_manifests_are_read(hierarchy: str) -> None:
    density = Densification(strategy=MCMC, options=Mcmc(cap_max=9))
    chosen = TrainSettings(hierarchy=hierarchy, densification=density)
    manifest = ring_manifest(chosen)
    assert settings_from_manifest(manifest).for_manifest() == chosen.for_manifest()


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_runs_say_their_limits_stay_under_them_and_learn(hierarchy: str, tmp_path: Path) -> None:
    density = Densification(start=3, until=55, every=5, strategy=MCMC, options=Mcmc(cap_max=120, base_cap_max=110))
    chosen = TrainSettings(
        iterations=60, hierarchy=hierarchy, sh_degree=1, sh_every=10, split="1/2,1/2", densification=density
    )
    said = Said()
    run = train(tmp_path / "run", ring_scene(), chosen, monitor=said)
    assert "density control: --strategy mcmc, at most 110 and 120 Gaussians" in said.lines
    assert [record.num_gaussians for record in run.manifest.records] == [110, 120]
    assert [record.signed for record in run.manifest.records] == [False, hierarchy == "laplacian"]
    first, last = (run.history()[i]["loss"] for i in (0, -1))
    assert last < first


def test_a_residual_that_lost_gaussians_is_resumed_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcmc, "LEAST_OPACITY", 0.3)  # so short a stage makes none fainter than the true one
    density = Densification(start=3, until=55, every=5, strategy=MCMC, options=Mcmc(cap_max=90, base_cap_max=110))
    chosen = TrainSettings(iterations=60, sh_degree=1, sh_every=10, split="1/2,1/2", densification=density)
    whole = train(tmp_path / "whole", ring_scene(), chosen)
    counts = [line["num_gaussians"] for line in whole.history() if line["level"] == 0]
    assert min(counts) < 80
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "stopped", ring_scene(), chosen, monitor=StopAt(0, 21))
    assert plys(resume(tmp_path / "stopped", ring_scene(), chosen)) == plys(whole)


def test_a_sparse_step_leaves_out_what_no_view_shows_although_the_loss_has_all_opacities() -> None:
    scene = ring_scene()
    first = blob_field(40)
    means = torch.cat([first.means[:30], first.means[30:] + 1000.0])
    model = model_of(first.with_parameters({"means": means}))
    result = CpuRasterizer()(model.field, scene.train[0].camera, background=torch.zeros(3))
    result.image.square().mean().backward()  # type: ignore[no-untyped-call]  # torch's
    McmcDensifier(schedule_of(100), replace(Mcmc(), cap_max=40)).regularize(model, range(1, 2))
    assert (model.params["opacities"].grad != 0).all()
    touched = model._touched
    assert touched[:30].any()
    assert not (touched & (result.radii.reshape(40, -1).amax(-1) == 0)).any()
    assert not touched[30:].any()


@pytest.mark.parametrize(("photos", "scale"), [(40, 0.1), (39, 1.0)])
def test_a_base_starts_small_unless_photos_are_few_and_half_opaque(photos: int, scale: float) -> None:
    field = blob_field(5)
    started = Mcmc().start(field, photos)
    torch.testing.assert_close(started.log_scales.exp(), scale * field.log_scales.exp())
    torch.testing.assert_close(started.opacity_logits.sigmoid(), torch.full((5,), 0.5))
