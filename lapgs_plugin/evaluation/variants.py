"""Make the subjects of `lapgs conformance --rasterizer family`: each variant of the 3DGS family, by each engine."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

from lapgs_plugin.evaluation.conformance import Subject
from lapgs_plugin.family import VARIANTS, stand_ins
from lapgs_plugin.family.call import Options
from lapgs_plugin.fields.rasterizer import Semantics
from lapgs_plugin.rasterizers.extensions import CONSTANTS, CudaExtension
from lapgs_plugin.rasterizers.signed_color import SignedColorRasterizer

VALUES: dict[str, tuple[Any, ...]] = {"antialiasing": (False, True), "mult": (1.0, 0.5)}
"""Values of settings that are checked, beside those of `CONSTANTS`."""
NEUTRAL = {"depth_threshold": 1e-6}
"""Values with which a setting changes no gradient."""
ELLIPSES = "tiles by the ellipse of mult times the squared distance at which alpha is 1/255, not by three sigma"


def variant_subjects(device: str) -> Iterator[Subject]:
    """Yield the variants that have a class as graphdeco's and whose image is that of Gaussians.

    Args:
        device: "cpu" or "cuda", which chooses the engine.
    """
    for name, variant in VARIANTS.items():
        if not variant.settings or not variant.renders_gaussians:
            continue
        for given in _settings_of(variant.settings):
            options = variant.options(SimpleNamespace(**CONSTANTS | given))
            label = ", ".join([name, *(f"{key} {value}" for key, value in given.items() if key in VALUES), device])
            extension = CudaExtension(variant.module, device, settings=given, module=stand_ins(name)[variant.module])
            yield Subject(label, SignedColorRasterizer(extension), device=device, semantics=_semantics(options, device))


def _settings_of(fields: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield the settings with which a rasterizer of these fields is checked."""
    neutral = {name: value for name, value in NEUTRAL.items() if name in fields}
    varied = [name for name in VALUES if name in fields]
    if not varied:
        yield neutral
    for name in varied:
        for value in VALUES[name]:
            yield neutral | {name: value}


def _semantics(options: Options, device: str) -> Semantics:
    """Return the rules that a variant's options ask an engine for."""
    cut, on_gpu = options.mult is None, device == "cuda"
    return Semantics(
        three_sigma_cut=cut,
        mult=None if options.mult == 1 else options.mult,  # with 1 the ellipses hold all alphas of 1/255
        antialiasing=options.antialiasing,
        exact_antialiasing=options.exact_antialiasing,
        blur=options.blur,
        expanded_conic_gradient=on_gpu,
        rebuilt_transmittance=on_gpu,
        note="" if cut else ELLIPSES,
    )
