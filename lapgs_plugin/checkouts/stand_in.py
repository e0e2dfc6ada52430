"""Check that a CPU stand-in takes what a checkout passes to its rasterizer, and returns what the checkout unpacks."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from pathlib import Path

from lapgs_plugin.checkouts.rasterizer_uses import RasterizerUse
from lapgs_plugin.checkouts.source import readable_source
from lapgs_plugin.errors import MissingExtraError
from lapgs_plugin.reference_raster.standins.variants import VARIANTS, rasterizer_module

OPTIONAL_INPUTS = {"dc", "raster_settings"}
"""Inputs that checkouts pass in one of several calls, and that of the constructor."""


def require_stand_in(variant: str | None, checkout: Path) -> str:
    """Return a variant of `standins.VARIANTS`, chosen for a checkout, if it fits the calls of its training script.

    Args:
        variant: the chosen one; None if none was found.
        checkout: root of the checkout.

    Raises:
        MissingExtraError: it does not; the line says what the nearest one lacks, and where it is needed.
    """
    source = readable_source(checkout)
    uses = () if source is None else source.rasterizers
    if variant is not None and not list(_lacks(variant, uses)):
        return variant
    names = [name for name, each in VARIANTS.items() if each.module in {use.module for use in uses}]
    near = variant or min(names, key=lambda name: len(list(_lacks(name, uses))), default=None)
    lacks = [] if near is None else list(_lacks(near, uses))
    modules, places = (", ".join(dict.fromkeys(each)) for each in ([u.module for u in uses], [u.where for u in uses]))
    why = f"; the nearest, {near}, {' and '.join(lacks)}" if lacks else ""
    raise MissingExtraError(
        f"no CPU stand-in for {modules or 'a rasterizer'}, imported in {places or 'the checkout'}, with the settings, "
        f"inputs and outputs of the checkout{why}; it needs a CUDA device"
    )


def _lacks(variant: str, uses: Iterable[RasterizerUse]) -> Iterator[str]:
    """Yield what a variant, or those beside it, would have to take or return, as ends of sentences."""
    offered = {VARIANTS[each].module: each for each in (variant, *VARIANTS[variant].beside)}
    for use in uses:
        each = VARIANTS.get(offered.get(use.module, ""))
        if each is None:
            yield f"has no {use.module}"
            continue
        if not each.settings:  # a module of functions
            continue
        for name in sorted(use.settings - set(each.settings)):
            yield f"takes no setting {name}"
        for name in sorted(set(each.settings) - use.settings if use.settings else ()):
            yield f"wants the setting {name}"
        forward = rasterizer_module(offered[use.module])["GaussianRasterizer"].forward
        for name in sorted(use.inputs - set(inspect.signature(forward).parameters) - OPTIONAL_INPUTS):
            yield f"takes no input {name}"
        if each.returned is not None and use.outputs > each.returned:
            yield f"returns {each.returned} outputs, not {use.outputs}"
