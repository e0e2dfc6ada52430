"""Test whose rasterizer trains a checkout: by measurements, and without any."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.checkouts.compiled_modules import CompiledModules
from lapgs_plugin.checkouts.packages import AUTO, OURS, OWN
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.family.variants import rasterizer_module
from lapgs_plugin.runner.rasterizer_choice import CHOICE, GAIN, Times, Trial, decide, decided_without_trials
from lapgs_plugin.runner.rasterizer_trial import RasterizerCall as Call
from lapgs_plugin.runner.rasterizer_trial import Rendered, difference, rendered, repeated, stretched
from lapgs_plugin.runs.manifest import Manifest, SceneReference

BOTH = CompiledModules(OWN, beside={"diff_raster": ModuleType("diff_raster")})


def trial(own: float, ours: float, difference: str = "", count: int = 1000) -> Trial:
    return Trial("a.jpg", (40, 30), count, Times(own / 4, own * 3 / 4), Times(ours / 2, ours / 2), difference)


@pytest.mark.parametrize(
    ("times", "taken"),
    [
        ([(8.0, 2.0), (2.0, 8.0)], OWN),
        ([(8.0, 2.0), (2.0, 2.1)], OURS),
        ([(4.0, 1.0), (20.0, 40.0)], OWN),
        ([(GAIN, 1.0)], OURS),
        ([(GAIN - 0.01, 1.0)], OWN),
    ],
)
def test_the_faster_one_of_all_renders_is_taken(times: list[tuple[float, float]], taken: str) -> None:
    decision = decide("diff_raster", [trial(*each) for each in times])
    assert decision.rasterizer == taken
    ratio = sum(own for own, _ in times) / sum(ours for _, ours in times)
    assert f"{ratio:.2f} times as fast" in decision.why
    assert "diff_raster" in decision.why
    assert "\n" not in decision.why


def test_times_are_said_of_both_passes() -> None:
    why = decide("diff_raster", [trial(8.0, 2.0), trial(4.0, 1.0, count=300_000)]).why
    assert "forward 0.75 instead of 1.50 ms, backward 0.75 instead of 4.50 ms" in why
    assert "2 renders with up to 300000 Gaussians" in why


def test_one_that_differs_is_not_taken_however_fast_it_is() -> None:
    decision = decide("diff_raster", [trial(8.0, 1.0), trial(8.0, 1.0, "most at x 3, y 4: 0.1 instead of 0.2")])
    assert decision.rasterizer == OWN
    assert decision.why == (
        "the checkout's own diff_raster: ours differs in view a.jpg at 40x30 with 1000 Gaussians: most at x 3, y 4: "
        "0.1 instead of 0.2"
    )


def manifest(taken: str | None) -> Manifest:
    scene = SceneReference("/scene", "3dgs:1", True, (0.0, 0.0, 0.0), "colmap")
    settings = {} if taken is None else {CHOICE: {"taken": taken, "why": "it was faster"}}
    return Manifest(scene, 1, "camera", "reconstructed", "geometry", 3, "diff_raster", 0, settings)


@pytest.mark.parametrize(
    ("modules", "tries", "taken"),
    [
        (CompiledModules(OURS, reasons={"diff_raster": "not installed"}), True, OURS),
        (CompiledModules(OURS, OURS, reasons={"diff_raster": "--rasterizer lapgs"}), True, OURS),
        (CompiledModules(OWN, OWN), True, OWN),
        (CompiledModules(OWN, AUTO, hindrance="takes no setting glow"), True, OWN),
        (BOTH, False, OWN),
        (BOTH, True, None),
    ],
)
def test_what_needs_no_measurement(modules: CompiledModules, tries: bool, taken: str | None) -> None:
    decision = decided_without_trials(modules, None, tries=tries)
    assert (decision and decision.rasterizer) == taken
    if decision is not None:
        assert all(reason in decision.why for reason in (modules.hindrance, *modules.reasons.values()))


@pytest.mark.parametrize("taken", [OWN, OURS])
def test_a_run_that_is_continued_keeps_its_rasterizer(taken: str) -> None:
    decision = decided_without_trials(BOTH, manifest(taken), tries=True)
    assert decision is not None
    assert (decision.rasterizer, decision.why) == (taken, "it was faster")
    before = decided_without_trials(BOTH, manifest(None), tries=True)
    assert before is not None
    assert before.rasterizer == OWN, "of a version before the choice"
    other = OURS if taken == OWN else OWN
    with pytest.raises(RunFolderError, match=rf"which is not to be had now \(.*resume with --rasterizer {taken}"):
        decided_without_trials(CompiledModules(other, other), manifest(taken), tries=True)


def result(image: Tensor, radii: Tensor | None = None, **gradients: Tensor) -> Rendered:
    return Rendered(image, radii, gradients, Times(1, 1))


def test_rounding_is_no_difference() -> None:
    generator = torch.Generator().manual_seed(0)
    image, means = torch.rand(3, 50, 40, generator=generator), torch.randn(90, 3, generator=generator)
    noise = 1e-4 * torch.randn(3, 50, 40, generator=generator)
    noise[:, 7, 9] = 0.011  # an opacity of 1/255 more or less, in one pixel
    radii = torch.full((90,), 5, dtype=torch.int32)
    ours = result(image + noise, radii + 1, means3D=means * 1.001)
    assert difference(result(image, radii, means3D=means), ours) == ""


@pytest.mark.parametrize(
    ("image", "radius", "gradient", "said"),
    [
        (0.1, 0, 0.0, "most at x 9, y 7: 0.6000 0.5000 0.5000 instead of 0.5000 0.5000 0.5000 with its own"),
        (float("nan"), 0, 0.0, "most at x 9, y 7: nan 0.5000 0.5000 instead of 0.5000 0.5000 0.5000 with its own"),
        (0.0, 3, 0.0, "1.1 % of the radii, most of Gaussian 4: 8 instead of 5 px"),
        (0.0, -5, 0.0, "1.1 % of the radii, most of Gaussian 4: 0 instead of 5 px"),
        (0.0, 0, 1.0, "the gradient by means3D by 6.1 % of its norm, most of Gaussian 11: 2 instead of 1"),
        (0.0, 0, float("nan"), "most of Gaussian 11: nan instead of 1"),
    ],
)
def test_what_differs_is_said_with_its_place_and_both_values(
    image: float, radius: int, gradient: float, said: str
) -> None:
    own = result(torch.full((3, 50, 40), 0.5), torch.full((90,), 5, dtype=torch.int32), means3D=torch.ones(90, 3))
    ours = result(own.image.clone(), own.radii.clone(), means3D=own.gradients["means3D"].clone())  # type: ignore[union-attr]
    ours.image[0, 7, 9] += image
    ours.radii[4] += radius  # type: ignore[index]
    ours.gradients["means3D"][11, 1] += gradient
    found = difference(own, ours)
    assert said in found
    assert "\n" not in found


def call(device: torch.device) -> Call:
    """Return a call of the family's first rasterizer for a handful of Gaussians before a camera."""
    module = rasterizer_module("graphdeco")
    projection = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]])
    settings = module["GaussianRasterizationSettings"](
        image_height=48, image_width=48, tanfovx=1.0, tanfovy=1.0, bg=torch.zeros(3, device=device), scale_modifier=1.0,
        viewmatrix=torch.eye(4, device=device), projmatrix=projection.to(device), sh_degree=0,
        campos=torch.zeros(3, device=device), prefiltered=False, debug=False,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(1)
    means = torch.rand(20, 3, generator=generator) * 2 - 1 + torch.tensor([0.0, 0.0, 4.0])
    inputs: dict[str, Any] = {
        "means3D": means,
        "means2D": torch.zeros(20, 3),
        "opacities": torch.full((20, 1), 0.6),
        "shs": torch.randn(20, 1, 3, generator=generator),
        "scales": torch.full((20, 3), 0.2),
        "rotations": torch.tensor([[1.0, 0, 0, 0]]).repeat(20, 1),
    }
    tensors = {name: value.to(device).requires_grad_() for name, value in inputs.items()}
    rasterizer = module["GaussianRasterizer"](settings)
    return Call("a.jpg", rasterizer, rasterizer, tensors, settings)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_rasterizer_is_rendered_with_the_gradients_of_all_its_inputs(device: str) -> None:
    of = call(torch.device(device))
    result = rendered(of.own, of, torch.device(device))
    assert result.image.shape == (3, 48, 48)
    assert result.radii is not None
    assert bool((result.radii > 0).any())
    assert result.gradients.keys() == of.inputs.keys()
    assert all(value.grad is None for value in of.inputs.values()), "the checkout's tensors stay as they are"
    assert result.times.forward > 0
    assert result.times.backward > 0


def test_compared_gaussians_have_gradients_by_their_rotations() -> None:
    spheres = call(torch.device("cpu"))
    before, after = (rendered(of.own, of, torch.device("cpu")) for of in (spheres, stretched(spheres)))
    assert before.gradients["rotations"].norm() < 1e-6 * before.gradients["scales"].norm()
    assert after.gradients["rotations"].norm() > 1e-2 * after.gradients["scales"].norm()
    assert bool((spheres.inputs["scales"] == 0.2).all()), "the checkout's tensors stay as they are"


def test_later_in_a_run_there_are_more_and_smaller_gaussians() -> None:
    before = call(torch.device("cpu"))
    later = repeated(before, 170)
    assert later is not None
    assert later.count == 160
    assert all(len(value) == 160 and value.requires_grad for value in later.inputs.values())
    torch.testing.assert_close(later.inputs["scales"].pow(3).sum(), before.inputs["scales"].pow(3).sum())
    image = rendered(later.own, later, torch.device("cpu")).image
    assert 0.2 < image.mean() / rendered(before.own, before, torch.device("cpu")).image.mean() < 5
    assert repeated(later, 300) is None
