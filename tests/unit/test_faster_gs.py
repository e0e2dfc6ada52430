"""Faster-GS behind our interface: its kernels' rules in PyTorch, and the family's stand-in, against the oracle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.cli.conformance import reachable
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.evaluation.cases import Case, pixel_weights
from lapgs_plugin.evaluation.conformance import Subject, check, conformance_cases
from lapgs_plugin.family import stand_ins
from lapgs_plugin.fields.rasterizer import RenderResult, Semantics, render_depths, render_transmittance
from lapgs_plugin.ops.densification_statistics import add_statistics
from lapgs_plugin.rasterizers import faster_gs
from lapgs_plugin.rasterizers.choice import RASTERIZERS, placed_rasterizer
from lapgs_plugin.rasterizers.faster_gs import SEMANTICS, FasterGsRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.strategies import Gradients, Mcmc
from tests.faster_gs_on_cpu import BACKEND
from tests.training_runs import train
from tests.training_scene import ring_scene
from tests.unit.test_rasterizers import faint

CASES = conformance_cases()


def subject(semantics: Semantics = SEMANTICS) -> Subject:
    return Subject("faster-gs", FasterGsRasterizer("cpu", backend=BACKEND), device="cpu", semantics=semantics)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_it_passes_the_conformance_cases_by_its_own_rules(case: Case) -> None:
    # Worst seen: image 5e-6, gradients 2e-4 of their largest element, all of needles.
    assert [outcome.problems for outcome in check(subject(), [case])] == [(), ()]


def test_each_departure_is_one() -> None:
    strict = subject(replace(SEMANTICS, departures={}))
    departing = [case for case in CASES if case.name in SEMANTICS.departures]
    assert len(departing) == len(SEMANTICS.departures)
    for case in departing:
        assert all(outcome.problems for outcome in check(strict, [case])), case.name


@pytest.mark.parametrize("signed", [False, True])
def test_it_renders_by_the_familys_stand_in(signed: bool) -> None:
    """With arguments that are those of its module: another stand-in than that of the rules."""
    backend = SimpleNamespace(**vars(stand_ins("faster-gs")[faster_gs.MODULE]))
    case, results = faint(signed), []
    for rasterizer in (FasterGsRasterizer("cpu", backend=backend), CpuRasterizer()):
        fresh = case.with_leaves()
        result = fresh.render(rasterizer)
        (result.image * pixel_weights(case)).sum().backward()
        results.append((result, {name: value.grad for name, value in fresh.field.parameters.items()}, fresh))
    (theirs, their_gradients, _), (ours, our_gradients, _) = results
    assert ours.image.min() < -0.1 or not signed
    torch.testing.assert_close(theirs.image, ours.image, rtol=0, atol=1e-5)  # worst seen: 6e-7
    for name, gradient in our_gradients.items():
        assert gradient is not None
        assert (their_gradients[name] - gradient).norm() < 1e-4 * gradient.norm(), name  # worst seen: 1.1e-6
    norms, expected = _statistics(theirs, case), _statistics(ours, case)
    assert (norms - expected).norm() < 1e-4 * expected.norm()  # worst seen: 8e-7


def _statistics(result: RenderResult, case: Case) -> Tensor:
    """Return the gradient norms (n,) that density control sums of a render."""
    norms, counts = torch.zeros(len(case.field)), torch.zeros(len(case.field))
    gradient = result.means2d.grad
    assert gradient is not None
    add_statistics(gradient, result.radii, case.camera.size, norms, counts)
    return norms


def test_a_second_backward_pass_notes_its_own_gradients() -> None:
    case = faint(True).with_leaves()
    result = case.render(subject().rasterizer)
    loss = result.image.square().sum()
    loss.backward(retain_graph=True)
    assert result.means2d.grad is not None
    once = result.means2d.grad.clone()
    assert once.abs().max() > 0
    loss.backward()
    torch.testing.assert_close(result.means2d.grad, 2 * once)  # autograd adds the second to the first


def test_residual_colours_that_are_all_zero_learn() -> None:
    """The kernel has no gradient where a colour is clamped, which zeros would be by rounding."""
    case = faint(True)
    blank = case.field.with_parameters({"sh": torch.zeros_like(case.field.sh)})
    fresh = replace(case, field=blank).with_leaves()
    image = fresh.render(subject().rasterizer).image
    assert image.abs().max() < 1e-6  # worst seen: 6e-8
    (image * pixel_weights(case)).sum().backward()
    expected = replace(case, field=blank).with_leaves()
    (expected.render(CpuRasterizer()).image * pixel_weights(case)).sum().backward()
    torch.testing.assert_close(
        fresh.field.sh.grad, expected.field.sh.grad, rtol=1e-4, atol=1e-5
    )  # worst seen: 2e-6, of 1.3


def test_an_image_of_nothing_is_the_background() -> None:
    case, background = faint(False), torch.tensor([0.2, 0.4, 0.6])
    rasterizer = subject().rasterizer
    behind = case.field.with_parameters({"means": 2 * case.camera.position - case.field.means})
    nobody = case.field.with_parameters({name: value[:0] for name, value in case.field.parameters.items()})
    for field in (behind, nobody):
        for signed in (False, True):
            leaves = replace(case, field=replace(field, signed=signed)).with_leaves().field
            result = rasterizer(leaves, case.camera, background=background)
            torch.testing.assert_close(result.image, background[:, None, None].expand_as(result.image))
            assert (result.radii == 0).all()
            result.image.sum().backward()
            assert all((value.grad == 0).all() for value in leaves.parameters.values())


def test_images_alone_are_those_of_a_call_and_other_values_can_be_blended() -> None:
    case, rasterizer = faint(True), subject().rasterizer
    background = torch.zeros(3)
    expected = rasterizer(case.field, case.camera, background=background).image
    assert torch.equal(rasterizer.render_image(case.field, case.camera, background=background), expected)
    assert torch.equal(rasterizer.render_images(case.field, [case.camera], background=background)[0], expected)
    exact = CpuRasterizer()
    for value, other in zip(
        render_depths(rasterizer, case.field, case.camera), render_depths(exact, case.field, case.camera), strict=True
    ):
        torch.testing.assert_close(value, other, rtol=0, atol=1e-4)  # depths of up to 6; worst seen: 2.4e-6
    shown = render_transmittance(rasterizer, case.field, case.camera)
    torch.testing.assert_close(shown, render_transmittance(exact, case.field, case.camera), rtol=0, atol=1e-5)


def test_what_it_lacks_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "faster-gs" in RASTERIZERS
    assert "faster-gs" not in reachable()
    with pytest.raises(MissingExtraError, match=r"^--rasterizer faster-gs: PyTorch finds no CUDA device$"):
        placed_rasterizer("faster-gs")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    line = (
        r"^--rasterizer faster-gs: FasterGSCudaBackend is not installed; `pip install git\+https://github.com/nerficg-"
        r"project/faster-gaussian-splatting/#subdirectory=FasterGSCudaBackend --no-build-isolation` installs it"
    )
    with pytest.raises(MissingExtraError, match=line):
        placed_rasterizer("faster-gs")


def test_another_branch_and_other_numbers_are_refused() -> None:
    def fused(means: Tensor, moments_means: Tensor) -> None: ...

    other: Any = SimpleNamespace(diff_rasterize=fused)
    with pytest.raises(UserInputError, match=r"takes means, moments_means, expected means, scales, .*branch main"):
        FasterGsRasterizer("cpu", backend=other)
    case = faint(False)
    field = case.field.to(dtype=torch.float64)
    with pytest.raises(UserInputError, match=r"means is torch.float64 on cpu, expected float32 on cpu; use .to\(\)"):
        subject().rasterizer(field, case.camera, background=torch.zeros(3))


@pytest.mark.parametrize("strategy", ["mcmc", "3dgs"])
def test_a_run_of_residuals_learns_as_on_the_cpu_rasterizer(strategy: str, tmp_path: Path) -> None:
    options = {"mcmc": Mcmc(), "3dgs": Gradients()}[strategy]
    settings = TrainSettings(
        iterations=30, levels=2, hierarchy="laplacian", sh_degree=1, appearance="none",
        densification=Densification(strategy=strategy, options=options, every=10),
    )  # fmt: skip
    scene, outcomes = ring_scene(train=5, test=1), []
    for rasterizer in (subject().rasterizer, CpuRasterizer()):
        archive = train(tmp_path / rasterizer.name, scene, settings, rasterizer)
        last = [entry["psnr"] for entry in archive.history() if "psnr" in entry][-1]
        outcomes.append((last, [len(archive.field(level)) for level in archive.available_levels]))
    (psnr, counts), (expected, their_counts) = outcomes
    assert psnr == pytest.approx(expected, abs=0.1)  # worst seen: 0.004
    assert counts == pytest.approx(their_counts, rel=0.05)  # worst seen: the same
