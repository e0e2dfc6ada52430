"""Test whose rasterizer renders a script that trains splats: decided, compared, and call by call."""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.checkouts.packages import AUTO, OURS, OWN
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.rasterizers.gsplat.rasterization import rasterization, refusal
from lapgs_plugin.reference_raster.gsplat import spherical_harmonics
from lapgs_plugin.runner import rasterizer_trial
from lapgs_plugin.runner.splats import choice
from lapgs_plugin.runner.splats.choice import OurRasterizer, decided, sample_calls
from lapgs_plugin.runner.splats.on_cpu import rasterization_on_cpu
from lapgs_plugin.runner.splats.signed import Rasterize, Rasterizer
from lapgs_plugin.runner.splats.views import SplatView

DEVICE = torch.device("cpu")


def trainer(**settings: Any) -> Any:
    generator = torch.Generator().manual_seed(0)
    count = 20
    splats = {
        "means": torch.rand(count, 3, generator=generator) * 2 - 1 + torch.tensor([0.0, 0.0, 4.0]),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.full((count, 3), -1.5),
        "opacities": torch.randn(count, generator=generator),
        "sh0": torch.randn(count, 1, 3, generator=generator),
        "shN": torch.zeros(count, 3, 3),
    }
    config = {"near_plane": 0.01, "far_plane": 1e10, "strategy": SimpleNamespace(absgrad=True), **settings}
    parameters = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in splats.items()})
    return SimpleNamespace(cfg=SimpleNamespace(**config), splats=parameters)


def calls(**settings: Any) -> dict[str, dict[str, Any]]:
    matrix = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])
    item = {"K": matrix, "camtoworld": torch.eye(4)}
    views = [SplatView(f"{i}.png", item, torch.zeros(24, 32, 3, dtype=torch.uint8)) for i in range(4)]
    return sample_calls(trainer(**settings), views, [0, 1], DEVICE)


def rasterizer(rasterize: Rasterize = rasterization_on_cpu) -> Rasterizer:
    return Rasterizer(rasterize, spherical_harmonics)


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Triton and gsplat's CUDA part, as on a machine that has both; our function on the CPU."""
    monkeypatch.setattr(choice, "triton_missing", lambda: "")
    monkeypatch.setattr(choice, "is_compiled", lambda: True)
    monkeypatch.setattr(choice, "gsplat_missing", lambda: "")
    monkeypatch.setattr(choice, "rasterization", rasterization_on_cpu)
    monkeypatch.setattr(rasterizer_trial, "LATER_COUNT", 60)


def test_calls_are_those_of_training() -> None:
    by_view = calls()
    assert [(each["width"], each["height"]) for each in by_view.values()] == [(32, 24)] * 2 + [(16, 12)] * 2
    assert next(iter(by_view)) == "0.png of level 0"
    for inputs in by_view.values():
        assert refusal(inputs) == ""
        assert inputs["sh_degree"] == 1
        assert inputs["absgrad"]
        assert inputs["scales"].requires_grad


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"pose_opt": True}, "gradients by cameras"),
        ({"packed": True}, "packed=True"),
        ({"sparse_grad": True}, "sparse_grad=True"),
        ({"antialiased": True}, "rasterize_mode='antialiased'"),
        ({"depth_loss": True}, "gradients by depths (render_mode='RGB+ED')"),
        ({"with_ut": True}, "with_ut=True"),
    ],
)
def test_what_only_gsplat_can_do_stays_gsplats(settings: dict[str, Any], why: str) -> None:
    asked = calls(**settings)
    assert {refusal(inputs) for inputs in asked.values()} == {why}
    decision = decided(AUTO, rasterizer(), asked)
    assert decision.rasterizer == OWN
    assert why in decision.why
    with pytest.raises(UserInputError, match=r"^--rasterizer lapgs: it cannot render calls with "):
        decided(OURS, rasterizer(), asked)


def test_depths_and_cameras_without_gradients_are_ours() -> None:
    inputs = next(iter(calls(depth_loss=True, pose_opt=True).values()))
    with torch.no_grad():
        assert refusal(inputs) == ""


@pytest.mark.parametrize("wanted", [OWN, OURS])
def test_what_is_asked_for_is_taken(wanted: str) -> None:
    decision = decided(wanted, rasterizer(), calls())
    assert (decision.rasterizer, decision.why) == (wanted, f"--rasterizer {wanted}")


@pytest.mark.parametrize(("works", "taken"), [(True, OURS), (False, OWN)])
def test_ours_renders_where_gsplat_is_not_built(works: bool, taken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "is_compiled", lambda: False)
    monkeypatch.setattr(choice, "direct_works", lambda: works)
    assert decided(AUTO, rasterizer(), calls()).rasterizer == taken


def test_nothing_is_compared_without_a_dry_run() -> None:
    decision = decided(AUTO, rasterizer(), calls(), tries=False)
    assert decision.rasterizer == OWN
    assert "without a dry run" in decision.why


def test_equal_rasterizers_are_compared_by_their_times() -> None:
    decision = decided(AUTO, rasterizer(), calls())
    assert "times as fast" in decision.why
    assert "8 renders with up to 60 Gaussians" in decision.why


def changed(change: Callable[[Tensor, dict[str, Any]], Tensor]) -> Rasterize:
    def rasterize(**inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        images, alphas, info = rasterization_on_cpu(**inputs)
        return change(images, info), alphas, info

    return rasterize


def wider(images: Tensor, info: dict[str, Any]) -> Tensor:
    info["radii"] = info["radii"] * 3
    return images


@pytest.mark.parametrize(
    ("rasterize", "why"),
    [(changed(lambda images, _: images * 1.1), "% of the pixels"), (changed(wider), "% of the radii")],
)
def test_one_that_differs_keeps_the_scripts_own(rasterize: Rasterize, why: str) -> None:
    decision = decided(AUTO, rasterizer(rasterize), calls())
    assert decision.rasterizer == OWN
    assert why in decision.why
    assert "0.png of level 0 at 32x24" in decision.why


def test_one_that_fails_keeps_the_scripts_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**_: Any) -> Any:
        raise RuntimeError("no kernel image")

    monkeypatch.setattr(choice, "rasterization", fail)
    decision = decided(AUTO, rasterizer(), calls())
    assert decision.rasterizer == OWN
    assert "no kernel image" in decision.why


def test_calls_that_ours_cannot_do_are_gsplats_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    asked: list[str] = []

    def own(**inputs: Any) -> Any:
        asked.append(inputs["rasterize_mode"])
        return rasterization_on_cpu(**{**inputs, "rasterize_mode": "classic"})

    ours, inputs = OurRasterizer.instead_of(rasterizer(own)), next(iter(calls().values()))
    with caplog.at_level(logging.INFO):
        for mode in ("classic", "antialiased", "antialiased"):
            ours.render(**{**inputs, "rasterize_mode": mode})
    assert asked == ["antialiased"] * 2
    assert [record.message for record in caplog.records] == [
        "rasterizer: gsplat's own renders calls with rasterize_mode='antialiased'"
    ]


def test_calls_that_nothing_can_do_name_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "gsplat_missing", lambda: "gsplat's CUDA part is not built")
    inputs = next(iter(calls(antialiased=True).values()))
    with pytest.raises(MissingExtraError, match=r"rasterize_mode='antialiased', and gsplat's CUDA part is not built"):
        OurRasterizer.instead_of(rasterizer()).render(**inputs)


def test_residuals_are_raw_sh_over_black(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[dict[str, Any]] = []

    def spy(**inputs: Any) -> Any:
        taken.append(inputs)

    monkeypatch.setattr(choice, "rasterization", spy)
    inputs = next(iter(calls().values()))
    OurRasterizer.instead_of(rasterizer()).signed(**inputs, backgrounds=torch.ones(1, 3))
    assert [(each["signed"], each["sh_degree"], each["backgrounds"]) for each in taken] == [(True, 1, None)]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_ours_agrees_with_gsplats_own(monkeypatch: pytest.MonkeyPatch) -> None:
    gsplat = pytest.importorskip("gsplat")
    monkeypatch.setattr(choice, "rasterization", rasterization)
    asked = {
        name: {key: each.cuda() if isinstance(each, Tensor) else each for key, each in inputs.items()}
        for name, inputs in calls().items()
    }
    why = decided(AUTO, Rasterizer(gsplat.rasterization, gsplat.spherical_harmonics), asked).why
    assert "differs" not in why
    assert "times as fast" in why
