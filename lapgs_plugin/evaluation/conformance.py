"""Compare a rasterizer with the float64 oracle, case by case.

Image, transmittance, radii, screen-space gradients and the gradients of all parameters have to agree, except where the
image depends on a comparison that rounding can turn (`reference_raster.thresholds`). Such pixels and Gaussians form a
band. They are counted, must stay within the bounds of either decision, and are left out of the loss. A case where a
rasterizer differs by design is all band.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import typed_line
from lapgs_plugin.evaluation.cases import ADVERSARIAL, BLACK, COLORED, WHITE, Case, pixel_weights, random_case
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, Semantics, degree_to_evaluate, render_transmittance
from lapgs_plugin.rasterizers.signed_color import precomputed_colors
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.reference_raster.thresholds import ThresholdMask, threshold_mask


@dataclass(frozen=True)
class Bounds:
    """Largest errors of a rasterizer outside the band.

    Attributes:
        image: error of a pixel of the image or the transmittance, relative to the largest colour or 1.
        element: error of a gradient, relative to its largest element.
        row: error of one Gaussian's gradient, relative to its norm or to `ROW_FLOOR` times the largest norm.
        relative_l2: distance of the whole gradient, relative to its norm.
        mean2d: error of a projected centre in pixels, relative to the larger image side or the coordinate.
    """

    image: float
    element: float
    row: float
    relative_l2: float
    mean2d: float


BOUNDS = {
    # Worst seen, oracle and CPU rasterizer in float32: image 2e-5, element 4e-5, row 6e-4, L2 2e-5, all by needles.
    torch.float32: Bounds(image=1e-4, element=3e-4, row=1e-2, relative_l2=3e-4, mean2d=1e-5),
    # Worst seen, CPU rasterizer: image 2e-14, element 7e-14.
    torch.float64: Bounds(image=1e-12, element=1e-11, row=1e-9, relative_l2=1e-11, mean2d=1e-13),
}
"""By the rasterizer's float type."""
RULES = ("three_sigma_cut", "mult", "antialiasing", "exact_antialiasing", "blur")
"""Fields of `Semantics` that are options of the oracle."""
ROW_FLOOR = 1e-3
"""Share of the largest norm of a gradient below which rows are compared as if they had that norm."""
ROUNDINGS = 16
"""Width of the band, in epsilon of the float type."""

EXPANDED_CONIC: dict[str, dict[str, dict[str, float]]] = {
    "needles": {
        # Worst seen on an H200, and in brackets in the emulation of tests/unit/test_conformance.py.
        "means": {"element": 1.5e-3, "relative_l2": 1e-3},  # 6e-4 (7e-4), 3e-4 (4e-4)
        "quaternions": {"element": 1.5e-3, "row": 4e-2, "relative_l2": 2e-3},  # 7e-4 (8e-4), 1e-2 (2e-2), 6e-4 (9e-4)
        "log_scales": {"element": 5e-2, "row": 1e-1, "relative_l2": 3e-2},  # 2e-2 (3e-2), 3e-2 (5e-2), 8e-3 (1e-2)
    }
}
"""Replacements in `Bounds`, by case and gradient, where `Semantics.expanded_conic_gradient` holds.

CUDA code of the 3DGS family multiplies out -C G C, the gradient by the 2D covariance, entry by entry. Terms then cancel
to a part l2/l1 as large, where l1 > l2 are the covariance's eigenvalues, and needles lose most of the digits of their
long scale. Derivation: docs/notes/2026-11-conformance.md.
"""
REBUILT_TRANSMITTANCE: dict[str, dict[str, dict[str, float]]] = {
    # Worst seen on an H200, and in the emulation of tests/unit/test_conformance.py: both 1.0e-2.
    "opaque_crowd": {"opacity_logits": {"row": 2e-2}}
}
"""The same where `Semantics.rebuilt_transmittance` holds.

The backward pass takes the last transmittance T from a float32 opacity 1 - T. Near the end of blending T is small, so
all gradients through that pixel share a relative error. Derivation: docs/notes/2026-11-conformance.md.
"""
MAX_BAND = 0.4
"""Largest share of pixels in the band; only `near_plane` reaches a third."""
ANTIALIASED_BANDS = {"needles": 0.6}
"""The same by case with antialiasing: 53 % seen. Opacities hang on determinants of needles without the blur, which
cancel."""
KINK_FACTOR = 2.0
"""Longest gradient of a Gaussian at a kink, where either side is correct, relative to the longest of the case."""
GRADIENTS = ("means2d", "means", "quaternions", "log_scales", "opacity_logits", "sh")


@dataclass(frozen=True)
class Subject:
    """A rasterizer to check.

    Attributes:
        name: its name in the report.
        rasterizer: the rasterizer.
        dtype: float type of the fields that it renders.
        device: device of the fields.
        semantics: where it differs from the oracle by design.
    """

    name: str
    rasterizer: Rasterizer
    dtype: torch.dtype = torch.float32
    device: str = "cpu"
    semantics: Semantics = field(default_factory=Semantics)


@dataclass(frozen=True)
class Outcome:
    """The result of one rasterizer on one case.

    Attributes:
        rasterizer, case: their names.
        signed: whether colour is signed.
        errors: by quantity, the largest error outside the band, as `Bounds.image` or `Bounds.element` measures it.
        band_pixels, band_share: number and share of the pixels in the band.
        band_error: largest error of the image in the band.
        band_gaussians: Gaussians whose radius or gradient is in the band.
        problems: one line for each problem; empty when the case passed.
    """

    rasterizer: str
    case: str
    signed: bool
    errors: dict[str, float] = field(default_factory=dict)
    band_pixels: int = 0
    band_share: float = 0.0
    band_error: float = 0.0
    band_gaussians: int = 0
    problems: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Rendered:
    """A rendering and the gradients of its loss, in float64 on the CPU."""

    image: Tensor
    transmittance: Tensor
    radii: Tensor
    means2d: Tensor
    gradients: dict[str, Tensor | None]


def conformance_cases() -> list[Case]:
    """Build all cases: the adversarial ones, and ordinary scenes of each SH degree over each background."""
    ordinary = [
        replace(
            random_case(60, 45, 37, seed=100 + degree, sh_degree=degree, background=background),
            name=f"degree_{degree}_{shade}",
        )
        for degree in range(4)
        for shade, background in (("black", BLACK), ("white", WHITE), ("coloured", COLORED))
    ]
    return [*(build() for build in ADVERSARIAL.values()), *ordinary]


def check(subject: Subject, cases: Sequence[Case]) -> Iterator[Outcome]:
    """Check each case with clamped and with signed colour; errors of the rasterizer become problems."""
    for case in cases:
        for signed in (False, True):
            yield check_case(subject, replace(case, field=replace(case.field, signed=signed)))


def check_case(subject: Subject, case: Case) -> Outcome:
    """Check one case as it is, see `check`."""
    case = case.to(subject.dtype)
    exact = case.to(torch.float64)
    semantics = subject.semantics
    rules: dict[str, Any] = {name: getattr(semantics, name) for name in RULES}
    mask = threshold_mask(
        exact.field,
        exact.camera,
        sh_degree=case.sh_degree,
        tolerance=ROUNDINGS * torch.finfo(subject.dtype).eps,
        **rules,
    )
    if case.name in semantics.departures:
        mask = ThresholdMask(*(torch.ones_like(part) for part in (mask.pixels, mask.radii, mask.kinks)))
    weights = pixel_weights(exact) * ~mask.pixels  # (3, h, w)
    expected = _render(OracleRasterizer(**rules), exact, weights, "cpu")
    outcome = Outcome(
        subject.name,
        case.name,
        case.field.signed,
        band_pixels=int(mask.pixels.sum()),
        band_share=float(mask.pixels.double().mean()),
        band_gaussians=int((mask.radii | mask.kinks).sum()),
    )
    try:
        actual = _render(subject.rasterizer, case, weights, subject.device)
    except Exception as error:  # an error of the rasterizer is a result, and the next case follows
        return replace(outcome, problems=(f"raised {typed_line(error)}",))
    problems = list(_shape_problems(actual, expected))
    if problems:
        return replace(outcome, problems=tuple(problems))
    return _compare(outcome, actual, expected, mask, exact, subject)


def _render(rasterizer: Rasterizer, case: Case, weights: Tensor, device: str) -> _Rendered:
    """Render the case, with the gradients of sum(weights * image)."""
    case = replace(case, field=case.field.to(device), camera=case.camera.to(device)).with_leaves()
    result: RenderResult = case.render(rasterizer)
    if result.image.requires_grad:
        (result.image * weights.to(result.image)).sum().backward()  # type: ignore[no-untyped-call]  # torch's
    gradients = {name: value.grad for name, value in case.field.parameters.items()} | {"means2d": result.means2d.grad}
    if result.absgrad2d is not None:
        gradients["absgrad2d"] = result.absgrad2d
    transmittance = result.transmittance
    if transmittance is None:
        transmittance = render_transmittance(rasterizer, case.field, case.camera)
    return _Rendered(
        image=_exact(result.image),
        transmittance=_exact(transmittance),
        radii=result.radii.detach().cpu().long(),
        means2d=_exact(result.means2d),
        gradients={name: None if value is None else _exact(value) for name, value in gradients.items()},
    )


def _exact(value: Tensor) -> Tensor:
    return value.detach().to("cpu", torch.float64)


def _shape_problems(actual: _Rendered, expected: _Rendered) -> Iterator[str]:
    """Report values that are missing, of another shape or not finite."""
    for name in ("image", "transmittance", "radii", "means2d"):
        yield from _value_problems(name, getattr(actual, name), getattr(expected, name))
    for name, wanted in expected.gradients.items():
        if name in GRADIENTS or name in actual.gradients:  # not all offer absgrad2d
            yield from _value_problems(f"gradient of {name}", actual.gradients.get(name), wanted)


def _value_problems(name: str, actual: Tensor | None, expected: Tensor | None) -> Iterator[str]:
    assert expected is not None, f"the oracle gives no {name}"
    if actual is None:
        yield f"{name} is missing"
    elif actual.shape != expected.shape:
        yield f"{name} has shape {tuple(actual.shape)}, expected {tuple(expected.shape)}"
    elif not bool(torch.isfinite(actual).all()):
        yield f"{name} has {int((~torch.isfinite(actual)).sum())} values that are not finite"


def _compare(
    outcome: Outcome, actual: _Rendered, expected: _Rendered, mask: ThresholdMask, case: Case, subject: Subject
) -> Outcome:
    bounds, problems = BOUNDS[subject.dtype], []
    errors: dict[str, float] = {}
    most = ANTIALIASED_BANDS.get(case.name, MAX_BAND) if subject.semantics.antialiasing else MAX_BAND
    if outcome.band_share > most and case.name not in subject.semantics.departures:
        problems.append(f"the band has {outcome.band_share:.0%} of the pixels, expected at most {most:.0%}")
    scale = max(1.0, _largest(expected.image))
    for name in ("image", "transmittance"):
        difference = (getattr(actual, name) - getattr(expected, name)).abs() / scale  # (..., h, w)
        errors[name] = _largest(difference.masked_fill(mask.pixels, 0))
        if errors[name] > bounds.image:
            problems.append(f"{name} is off by {errors[name]:.1e}, expected at most {bounds.image:.0e}")
    band_error = _largest((actual.image - expected.image)[:, mask.pixels])
    problems += _band_problems(actual, mask, case, bounds.image)

    by_opacity = expected.gradients["opacity_logits"]
    assert by_opacity is not None
    # A Gaussian that contributes to no pixel outside the band may be culled.
    culled_freely = (by_opacity == 0) & (not subject.semantics.three_sigma_cut)  # (n,)
    errors["radii"], radius_problems = _compare_radii(actual.radii, expected.radii, mask.radii, culled_freely)
    problems += radius_problems
    shown = (actual.radii > 0) & (expected.radii > 0)  # (n,)
    coordinates = expected.means2d[shown].abs().clamp(min=max(case.camera.width, case.camera.height))
    errors["centres"] = _largest((actual.means2d - expected.means2d)[shown] / coordinates)
    if errors["centres"] > bounds.mean2d:
        problems.append(f"means2d is off by {errors['centres']:.1e}, expected at most {bounds.mean2d:.0e}")
    wanted_gradients = dict(expected.gradients)
    if subject.semantics.screen_gradient_norms:
        wanted_gradients["means2d"] = _norms_alone(expected.gradients["means2d"], case)
    for name, wanted in wanted_gradients.items():
        got = actual.gradients.get(name)
        if got is not None and wanted is not None:
            errors[name], further = _compare_gradients(name, got, wanted, mask.kinks, _bounds(subject, case.name, name))
            problems += further
    return replace(outcome, errors=errors, band_error=band_error, problems=tuple(problems))


def _norms_alone(gradient: Tensor | None, case: Case) -> Tensor:
    """Return a gradient (n, 2) by centres as `Semantics.screen_gradient_norms` says."""
    assert gradient is not None
    halves = gradient.new_tensor([case.camera.width / 2, case.camera.height / 2])
    norms = (gradient * halves).norm(dim=1) / halves[0]
    return torch.stack([norms, torch.zeros_like(norms)], 1)


def _bounds(subject: Subject, case: str, gradient: str) -> Bounds:
    """Return the bounds of one gradient."""
    bounds, semantics = BOUNDS[subject.dtype], subject.semantics
    for holds, granted in (
        (semantics.expanded_conic_gradient, EXPANDED_CONIC),
        (semantics.rebuilt_transmittance, REBUILT_TRANSMITTANCE),
    ):
        if holds:
            bounds = replace(bounds, **granted.get(case, {}).get(gradient, {}))
    return bounds


def _band_problems(actual: _Rendered, mask: ThresholdMask, case: Case, tolerance: float) -> Iterator[str]:
    """Check that pixels in the band are convex combinations of colours and background, whatever was decided."""
    transmittance = actual.transmittance[mask.pixels]  # (p,)
    if bool(((transmittance < -tolerance) | (transmittance > 1 + tolerance)).any()):
        yield "transmittance in the band is not in [0, 1]"
    colors = precomputed_colors(case.field, case.camera, degree_to_evaluate(case.field, case.sh_degree))  # (n, 3)
    palette = torch.cat([colors, case.background_tensor[None]])  # (n + 1, 3)
    low, high = (palette.amin(0) - tolerance)[:, None], (palette.amax(0) + tolerance)[:, None]  # (3, 1) each
    pixels = actual.image[:, mask.pixels]  # (3, p)
    outside = int(((pixels < low) | (pixels > high)).sum())
    if outside:
        yield f"{outside} values in the band are outside the range of the scene's colours"


def _compare_radii(actual: Tensor, expected: Tensor, is_open: Tensor, culled_freely: Tensor) -> tuple[float, list[str]]:
    """Compare radii, and return the largest difference that is not allowed with the problems.

    Args:
        actual, expected: (n,) whole pixels, 0 where culled.
        is_open: (n,) where rounding decides: one pixel more or less, or culled.
        culled_freely: (n,) where 0 is correct too.
    """
    difference = (actual - expected).abs()  # (n,)
    either_culled = (actual == 0) | (expected == 0)  # (n,)
    # Float32 cannot represent all integers above 2^24: the error is then relative.
    allowed = (difference <= 1) | (difference <= expected * 1e-5) | either_culled
    fine = (difference == 0) | (culled_freely & (actual == 0)) | (is_open & allowed)  # (n,)
    wrong = (~fine).nonzero()[:, 0].tolist()
    if not wrong:
        return 0.0, []
    first = wrong[0]
    return _largest(difference[~fine].double()), [
        f"{len(wrong)} radii are wrong: Gaussian {first} has {int(actual[first])}, expected {int(expected[first])}"
    ]


def _compare_gradients(
    name: str, actual: Tensor, expected: Tensor, kinks: Tensor, bounds: Bounds
) -> tuple[float, list[str]]:
    """Compare gradients, and return the largest element's error, relative to the largest element, with the problems."""
    problems = []
    rows, wanted = ((v[:, None] if v.ndim == 1 else v.flatten(1)) for v in (actual, expected))  # (n, m) each
    longest = _largest(wanted.norm(dim=1))
    if _largest(rows[kinks].norm(dim=1)) > KINK_FACTOR * longest:
        problems.append(f"gradient of {name}: longer at a kink than {KINK_FACTOR:g} times the longest elsewhere")
    rows, wanted = rows[~kinks], wanted[~kinks]
    difference = rows - wanted
    norms = wanted.norm(dim=1).clamp(min=max(ROW_FLOOR * longest, 1e-30))  # (n,)
    measured = {
        "its largest element": (_largest(difference) / max(_largest(wanted), 1e-30), bounds.element),
        "the Gaussian's own norm": (_largest(difference.norm(dim=1) / norms), bounds.row),
        "its norm": (float(difference.norm()) / max(float(wanted.norm()), 1e-30), bounds.relative_l2),
    }
    for measure, (error, bound) in measured.items():
        if error > bound:
            problems.append(f"gradient of {name} is off by {error:.1e} of {measure}, expected at most {bound:.0e}")
    extra = int(((wanted == 0).all(1) & (rows != 0).any(1)).sum())
    if extra:
        problems.append(f"gradient of {name}: {extra} Gaussians that are in no pixel have one")
    return measured["its largest element"][0], problems


def _largest(values: Tensor) -> float:
    return float(values.abs().max()) if values.numel() else 0.0
