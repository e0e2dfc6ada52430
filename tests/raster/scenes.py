"""Hypothesis strategies over the cases of `lapgs_plugin.evaluation.cases`, which this module exports too; gradients."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import strategies as st
from torch import Tensor

from lapgs_plugin.evaluation.cases import *  # noqa: F403 - one place to import cases and strategies from
from lapgs_plugin.evaluation.cases import BLACK, COLORED, WHITE, Case, make_camera, random_case
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.rasterizer import Rasterizer


def gradients(rasterizer: Rasterizer, case: Case, weights: Tensor) -> dict[str, Tensor]:
    """Return the gradients of sum(weights * image), by parameter name, "means2d" and, where offered, "absgrad2d"."""
    case = case.with_leaves()
    result = case.render(rasterizer)
    (result.image * weights).sum().backward()  # type: ignore[no-untyped-call]  # torch's
    slopes = {name: value.grad for name, value in case.field.parameters.items()} | {"means2d": result.means2d.grad}
    if result.absgrad2d is not None:
        slopes["absgrad2d"] = result.absgrad2d.clone()
    missing = [name for name, value in slopes.items() if value is None]
    assert not missing, f"no gradient for {missing}"
    return {name: value for name, value in slopes.items() if value is not None}


def backgrounds() -> st.SearchStrategy[tuple[float, float, float]]:
    return st.sampled_from([BLACK, WHITE, COLORED])


@st.composite
def cameras(draw: st.DrawFn, max_side: int = 40) -> Camera:
    """Draw cameras of any size, from wide angle to tele, with any pose and any principal point in view."""
    width, height = draw(st.integers(1, max_side)), draw(st.integers(1, max_side))
    focal = draw(st.floats(0.4, 4.0)) * max(width, height)
    stretch = draw(st.sampled_from([1.0, 0.7, 1.6]))
    shift = draw(st.sampled_from([(0.0, 0.0), (0.3, -0.2), (-0.45, 0.45)]))
    return make_camera(
        width,
        height,
        focal=(focal, focal * stretch),
        principal_offset=(shift[0] * width, shift[1] * height),
        pose_seed=draw(st.one_of(st.none(), st.integers(0, 10_000))),
    )


@st.composite
def random_cases(draw: st.DrawFn, max_gaussians: int = 40, max_side: int = 40) -> Case:
    """Draw scenes of any size, degree, sign and background, with Gaussians from sub-pixel to screen-filling."""
    camera = draw(cameras(max_side))
    smallest = draw(st.sampled_from([0.01, 0.3, 1.0, 3.0]))
    case = random_case(
        draw(st.integers(0, max_gaussians)),
        camera.width,
        camera.height,
        seed=draw(st.integers(0, 10_000)),
        sh_degree=draw(st.integers(0, 3)),
        signed=draw(st.booleans()),
        background=draw(backgrounds()),
        pixels=(smallest, smallest * draw(st.sampled_from([1.5, 10.0, 100.0]))),
        camera=camera,
    )
    return replace(case, sh_degree=draw(st.one_of(st.none(), st.integers(0, case.field.sh_degree))))
