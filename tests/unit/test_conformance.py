"""Test that the conformance suite passes correct rasterizers and fails each kind of error."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from lapgs_plugin.cli import conformance as command
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation import cases, conformance
from lapgs_plugin.evaluation.cases import Case
from lapgs_plugin.evaluation.conformance import Outcome, Subject, check, check_case
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, Semantics
from lapgs_plugin.reference_raster import OracleRasterizer, oracle

ORACLE = OracleRasterizer()


def by_name() -> dict[str, Case]:
    return {case.name: case for case in conformance.conformance_cases()}


def ordinary(signed: bool = False) -> Case:
    case = by_name()["degree_2_coloured"]
    sh = case.field.sh.clone()
    sh[:, 0] -= 1.0  # channels on both sides of the clamp
    return replace(case, field=replace(case.field.with_parameters({"sh": sh}), signed=signed))


class Mutant(Rasterizer):
    """An oracle with an error: `before` changes its input, `after` its output."""

    name = "mutant"

    def __init__(
        self,
        *,
        before: Callable[[GaussianField], GaussianField] = lambda field: field,
        after: Callable[[RenderResult], RenderResult] = lambda result: result,
        degree: int | None = None,
    ) -> None:
        self._before, self._after, self._degree = before, after, degree

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        degree = sh_degree if self._degree is None else self._degree
        return self._after(ORACLE(self._before(field), camera, background=background, sh_degree=degree))


def changed(field: GaussianField, name: str, change: Callable[[Tensor], Tensor]) -> GaussianField:
    return field.with_parameters({name: change(field.parameters[name])})


def image_of(change: Callable[[Tensor], Tensor]) -> Callable[[RenderResult], RenderResult]:
    return lambda result: replace(result, image=change(result.image))


def scaled_gradient(factor: float | Tensor) -> Callable[[Tensor], Tensor]:
    """Return the same values with another derivative."""
    return lambda value: factor * value + ((1 - factor) * value).detach()


def first_tile_without_gradient(image: Tensor) -> Tensor:
    tile = torch.zeros_like(image, dtype=torch.bool)
    tile[:, :16, :16] = True
    return torch.where(tile, image.detach(), image)


def with_wrong_mean2d_gradient(result: RenderResult) -> RenderResult:
    means2d = result.means2d.detach().requires_grad_()
    # The gradient by normalised device coordinates, not converted to pixels.
    result.means2d.register_hook(lambda gradient: setattr(means2d, "grad", 22.5 * gradient))
    return replace(result, means2d=means2d)


MUTANTS: dict[str, tuple[Mutant, bool, str]] = {
    "negated": (Mutant(after=image_of(torch.neg)), True, "image is off"),
    "clamped instead of signed": (Mutant(before=lambda f: replace(f, signed=False)), True, "image is off"),
    "signed instead of clamped": (Mutant(before=lambda f: replace(f, signed=True)), False, "image is off"),
    "a pixel to the right": (Mutant(after=image_of(lambda i: i.roll(1, 2))), False, "image is off"),
    "half a thousandth brighter": (Mutant(after=image_of(lambda i: i + 5e-4)), False, "image is off"),
    "transposed colours": (Mutant(after=image_of(lambda i: i.flip(0))), False, "image is off"),
    "a lower SH degree": (Mutant(degree=1), False, "image is off"),
    "not finite": (Mutant(after=image_of(lambda i: i / i.abs().clamp(max=0))), False, "not finite"),
    "another size": (Mutant(after=image_of(lambda i: i[:, :-1])), False, "raised RuntimeError"),
    "opacity for transmittance": (
        Mutant(after=lambda r: replace(r, transmittance=1 - r.transmittance)), False, "transmittance is off",
    ),
    "radii one too large": (Mutant(after=lambda r: replace(r, radii=r.radii + 1)), False, "radii are wrong"),
    "nothing culled": (Mutant(after=lambda r: replace(r, radii=r.radii.clamp(min=1))), False, "radii are wrong"),
    "centres from the first pixel's corner": (
        Mutant(after=lambda r: replace(r, means2d=_kept(r.means2d + 0.5, r))), False, "means2d is off",
    ),
    "screen gradient by other units": (Mutant(after=with_wrong_mean2d_gradient), False, "gradient of means2d is off"),
    "no screen gradient": (
        Mutant(after=lambda r: replace(r, means2d=r.means2d.detach())), False, "gradient of means2d is missing",
    ),
    "absolute screen gradient not finite": (
        Mutant(after=lambda r: replace(r, absgrad2d=torch.full_like(r.means2d, torch.nan))), False,
        "gradient of absgrad2d has 120 values that are not finite",
    ),
    "absolute screen gradient without x and y": (
        Mutant(after=lambda r: replace(r, absgrad2d=r.means2d.detach()[:, 0])), False,
        "gradient of absgrad2d has shape (60,), expected (60, 2)",
    ),
    "a tile without gradient": (Mutant(after=image_of(first_tile_without_gradient)), False, "gradient of sh is off"),
    "background counted twice": (
        Mutant(after=lambda r: replace(r, image=r.image + 0.5 * (r.transmittance - r.transmittance.detach()))),
        False, "gradient of opacity_logits is off",
    ),
    "raises": (Mutant(degree=9), False, "raised UserInputError: sh_degree 9"),
    **{
        f"no gradient of {name}": (
            Mutant(before=lambda f, n=name: changed(f, n, Tensor.detach)), False, f"gradient of {name} is missing",
        )
        for name in conformance.GRADIENTS[1:]
    },
    **{
        f"gradient of {name} times {factor}": (
            Mutant(before=lambda f, n=name, k=factor: changed(f, n, scaled_gradient(k))),
            False, f"gradient of {name} is off",
        )
        for name in conformance.GRADIENTS[1:] for factor in (-1.0, 1.001)
    },
}  # fmt: skip
"""By name: rasterizer, whether colour is signed, and the expected words."""


def _kept(means2d: Tensor, result: RenderResult) -> Tensor:
    moved = means2d.detach().requires_grad_()
    result.means2d.register_hook(lambda gradient: setattr(moved, "grad", gradient))
    return moved


@pytest.mark.parametrize("name", MUTANTS)
def test_every_mutant_is_caught_and_named(name: str) -> None:
    mutant, signed, message = MUTANTS[name]
    outcome = check_case(Subject("mutant", mutant), ordinary(signed))
    assert any(message in problem for problem in outcome.problems), outcome.problems


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_oracle_passes(signed: bool, dtype: torch.dtype) -> None:
    outcome = check_case(Subject("oracle", Mutant(), dtype), ordinary(signed))
    assert outcome.problems == ()
    assert set(conformance.GRADIENTS) | {"image", "transmittance", "radii", "centres", "absgrad2d"} == set(
        outcome.errors
    )


def test_the_oracle_in_float32_passes_every_case() -> None:
    outcomes = list(check(Subject("oracle", ORACLE), conformance.conformance_cases()))
    assert len(outcomes) == 2 * len(by_name())
    assert {outcome.signed for outcome in outcomes} == {False, True}
    assert [outcome for outcome in outcomes if outcome.problems] == []


def test_the_cases_are_those_the_docs_promise() -> None:
    found = by_name().values()
    assert {case.field.sh_degree for case in found} == {0, 1, 2, 3}
    assert {case.background for case in found} >= {cases.BLACK, cases.WHITE, cases.COLORED}
    assert any(case.camera.width % 16 and case.camera.height % 16 for case in found)
    assert {0, 1} <= {len(case.field) for case in found}
    assert max(len(case.field) for case in found) >= 1000
    assert any((case.camera.width, case.camera.height) == (1, 1) for case in found)


def test_the_band_is_bounded() -> None:
    """Near the culling depth a third of the pixels may go either way, but none may be brighter than all Gaussians."""
    case = by_name()["near_plane"]
    mask = conformance.threshold_mask(case.to(torch.float32).field, case.camera)
    assert mask.pixels.any()

    def spoil(image: Tensor) -> Tensor:
        return torch.where(mask.pixels, image + 10, image)

    outcome = check_case(Subject("mutant", Mutant(after=image_of(spoil))), case)
    assert outcome.errors["image"] < 1e-5
    assert outcome.band_pixels >= int(mask.pixels.sum())
    assert any("outside the range" in problem for problem in outcome.problems)


def test_a_rasterizer_without_the_three_sigma_cut_is_held_to_its_own_image() -> None:
    """Opaque Gaussians reach 0.33 sigma further: an error for one rasterizer, required of the other."""
    case = by_name()["saturated"]
    uncut = OracleRasterizer(three_sigma_cut=False)
    honest = Subject("uncut", uncut, semantics=Semantics(three_sigma_cut=False))
    assert check_case(honest, case).problems == ()
    assert any("image is off" in problem for problem in check_case(Subject("uncut", uncut), case).problems)


class _ExpandedConic(torch.autograd.Function):
    """Invert a 2D covariance, with the backward pass -C G C multiplied out over det^2."""

    @staticmethod
    def forward(ctx: Any, xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
        ctx.save_for_backward(xx, xy, yy)
        return torch.stack([yy, -xy, xx], dim=-1) / (xx * yy - xy * xy)[:, None]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        a, b, c = ctx.saved_tensors
        g_a, g_b, g_c = gradient.unbind(-1)
        determinant = a * c - b * b
        scale = 1 / (determinant.square() + 1e-7)
        return (
            scale * (b * c * g_b - c * c * g_a + (determinant - a * c) * g_c),
            scale * (2 * b * c * g_a - (determinant + 2 * b * b) * g_b + 2 * a * b * g_c),
            scale * (a * b * g_b - a * a * g_c + (determinant - a * c) * g_a),
        )


@pytest.mark.parametrize("name", ["needles", "pancakes", "giants", "degree_2_coloured"])
def test_needles_alone_suffer_from_a_multiplied_out_conic_gradient(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wider bounds are what the formula costs in float32, and hold for no other case."""

    def expanded(xx: Tensor, xy: Tensor, yy: Tensor, determinants: Tensor) -> Tensor:
        if xx.dtype == torch.float32:
            return _ExpandedConic.apply(xx, xy, yy)  # type: ignore[no-untyped-call, no-any-return]  # torch's
        return torch.stack([yy, -xy, xx], dim=-1) / determinants[:, None]

    monkeypatch.setattr(oracle, "inverse_covariances", expanded)
    case = by_name()[name]
    known = Semantics(expanded_conic_gradient=True)
    for signed in (False, True):
        case = replace(case, field=replace(case.field, signed=signed))
        assert check_case(Subject("expanded", ORACLE, semantics=known), case).problems == ()
        unknown = check_case(Subject("expanded", ORACLE), case).problems
        assert any("gradient of log_scales is off" in problem for problem in unknown) == (name == "needles")


def with_rebuilt_transmittance(result: RenderResult) -> RenderResult:
    """Give gradients through each pixel the relative error of a transmittance 1 - (1 - T)."""
    assert result.transmittance is not None
    left = result.transmittance.detach()  # (h, w), float32
    factors = torch.where(left > 0, (1 - (1 - left)) / left, 1)  # (h, w)
    return replace(result, image=scaled_gradient(factors)(result.image))


@pytest.mark.parametrize("name", ["opaque_crowd", "crowd", "degree_2_coloured"])
def test_opaque_pixels_alone_suffer_from_a_rebuilt_transmittance(name: str) -> None:
    """The wider bounds are what keeping opacities costs, and hold for no other case."""
    rebuilding = Mutant(after=with_rebuilt_transmittance)
    known = Semantics(rebuilt_transmittance=True)
    for signed in (False, True):
        case = replace(by_name()[name], field=replace(by_name()[name].field, signed=signed))
        assert check_case(Subject("rebuilding", rebuilding, semantics=known), case).problems == ()
        unknown = check_case(Subject("rebuilding", rebuilding), case).problems
        assert any("gradient of opacity_logits is off" in line for line in unknown) == (
            name == "opaque_crowd" and not signed
        )


def test_without_the_cut_invisible_gaussians_may_have_no_radius() -> None:
    case = by_name()["invisible"]
    subject = Subject("cut", ORACLE, semantics=Semantics(three_sigma_cut=False))
    assert check_case(subject, case).problems == ()
    culled = Mutant(after=lambda r: replace(r, radii=torch.zeros_like(r.radii)))
    assert check_case(replace(subject, rasterizer=culled), ordinary()).problems != ()


def test_departures_by_design_are_bounded_but_not_compared() -> None:
    case = by_name()["saturated"]
    departing = Semantics(departures={"saturated": "the cap is another"})
    dimmer = Mutant(before=lambda f: changed(f, "opacity_logits", lambda logits: logits - 3))
    assert check_case(Subject("dimmer", dimmer), case).problems != ()
    outcome = check_case(Subject("dimmer", dimmer, semantics=departing), case)
    assert outcome.problems == ()
    assert outcome.band_share == 1
    assert check_case(Subject("dimmer", dimmer, semantics=departing), ordinary()).problems != ()
    for spoiled, said in (
        (Mutant(after=image_of(lambda image: image + 10)), "outside the range"),
        (Mutant(after=image_of(lambda image: image / 0)), "not finite"),
        (Mutant(before=lambda f: changed(f, "means", Tensor.detach)), "gradient of means is missing"),
    ):
        problems = check_case(Subject("spoiled", spoiled, semantics=departing), case).problems
        assert any(said in problem for problem in problems), problems


# ------------------------------------------------------------------------------------------------ the command


def run(monkeypatch: pytest.MonkeyPatch, arguments: list[str], problems: tuple[str, ...] = ()) -> tuple[int, str]:
    import typer

    subject = Subject("oracle", ORACLE)
    outcomes = [Outcome("oracle", "one_pixel", signed, {"image": 1e-7}, problems=problems) for signed in (False, True)]
    monkeypatch.setattr(command, "reachable", lambda: {"oracle": lambda: [subject]})
    monkeypatch.setattr(conformance, "check", lambda *_: iter(outcomes))
    app = typer.Typer()
    app.command()(command.conformance)
    result = CliRunner().invoke(app, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def test_exit_code_and_table(monkeypatch: pytest.MonkeyPatch) -> None:
    code, output = run(monkeypatch, [])
    assert code == 0
    assert "one_pixel" in output
    assert "2 of 2 passed" in output
    code, output = run(monkeypatch, ["--rasterizer", "oracle"], ("image is off by 1",))
    assert code == 1
    assert "one_pixel, signed: image is off by 1" in output


def test_json(monkeypatch: pytest.MonkeyPatch) -> None:
    code, output = run(monkeypatch, ["--json"], ("broken",))
    assert code == 1
    outcomes = json.loads(output)["oracle"]
    assert [item["problems"] for item in outcomes] == [["broken"]] * 2


def test_an_unknown_rasterizer_is_named_with_those_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserInputError, match="--rasterizer gpu: expected one that this machine can run: oracle"):
        run(monkeypatch, ["--rasterizer", "gpu"])


def test_this_machine_reaches_the_cpu_rasterizers() -> None:
    reachable = command.reachable()
    assert [subject.dtype for subject in reachable["cpu"]()] == [torch.float32, torch.float64]
    assert reachable["oracle"]()[0].dtype == torch.float32
