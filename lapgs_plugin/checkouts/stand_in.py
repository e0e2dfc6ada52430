"""Choose the variant that takes what a checkout passes to its rasterizer and returns what the checkout unpacks."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from pathlib import Path

from lapgs_plugin.checkouts.rasterizer_uses import RasterizerUse
from lapgs_plugin.checkouts.source import CheckoutSource, readable_source
from lapgs_plugin.errors import MissingExtraError
from lapgs_plugin.family.variants import VARIANTS, rasterizer_module

OPTIONAL_INPUTS = {"dc", "raster_settings"}
"""Inputs that checkouts pass in one of several calls, and that of the constructor."""

KINDS = {
    "radii": "radii", "depth": "depth", "alpha": "alpha", "acc": "alpha", "opacity": "alpha", "silhouette": "alpha",
}  # fmt: skip
"""Kinds of outputs, as in `Variant.returned`, by the names of the variables that checkouts unpack them into."""

DECORATIONS = "rendered_", "render_", "_image", "_map"
"""Parts of these names that say nothing of the kind."""


def fitting_stand_in(checkout: Path, preferred: str = "") -> str:
    """Return the variant of `family.VARIANTS` that fits the imports and calls of a checkout's training script.

    Args:
        checkout: root of the checkout.
        preferred: variant to choose if it fits; empty prefers the one with the fewest functions of its own.

    Raises:
        MissingExtraError: none does; the line says what the nearest one lacks, and where it is needed.
    """
    source = readable_source(checkout)
    uses = () if source is None else source.rasterizers
    modules, places = (dict.fromkeys(values) for values in ([use.module for use in uses], [use.where for use in uses]))
    known = [name for name, variant in VARIANTS.items() if variant.module in modules]
    known.sort(key=lambda name: len(VARIANTS[name].functions) + len(VARIANTS[name].beside))
    names = dict.fromkeys([preferred, *known] if preferred else known)
    lacks = {name: {} if source is None else dict.fromkeys(_lacks(name, source)) for name in names}
    near = min(lacks, key=lambda name: len(lacks[name]), default="")
    if any(_unreturned(near, uses)):
        near = next((name for name in lacks if not lacks[name] and _returns_as_named(name, uses)), near)
    faults = [*lacks.get(near, ()), *dict.fromkeys(_unreturned(near, uses))]
    if near and not faults:
        return near
    verbs = dict.fromkeys(verb for verb, _ in faults)
    parts = [f"{verb} {', '.join(what for of_verb, what in faults if of_verb == verb)}" for verb in verbs]
    why = f"; the nearest, {near}, {' and '.join(parts)}" if near else ""
    raise MissingExtraError(
        f"lapgs has no rasterizer in place of {', '.join(modules) or 'the compiled one'}, imported in "
        f"{', '.join(places) or 'the checkout'}, with the settings, inputs and outputs of the checkout{why}; it needs "
        "its own, compiled, and a CUDA device"
    )


def _lacks(variant: str, source: CheckoutSource) -> Iterator[tuple[str, str]]:
    """Yield what a variant, or those beside it, would have to have or take: a verb, and a name."""
    offered = _offered(variant)
    for one in source.externals:
        if one.name in offered and not one.optional:
            absent = set(one.names) - rasterizer_module(offered[one.name]).keys() - {"_C"}
            yield from (("has no", name) for name in sorted(absent))
    for use in source.rasterizers:
        near = VARIANTS.get(offered.get(use.module, ""))
        if near is None:
            yield "has no", use.module
            continue
        if not near.settings:  # a module of functions
            continue
        for name in sorted(use.settings - set(near.settings)):
            yield "takes no setting", name
        for name in sorted(set(near.settings) - use.settings if use.settings else ()):
            yield "wants the setting", name
        forward = rasterizer_module(offered[use.module])["GaussianRasterizer"].forward
        for name in sorted(use.inputs - set(inspect.signature(forward).parameters) - OPTIONAL_INPUTS):
            yield "takes no input", name


def _unreturned(variant: str, uses: Iterable[RasterizerUse]) -> Iterator[tuple[str, str]]:
    """Yield the outputs that a variant would have to return, as `_lacks`."""
    for use, returned in _outputs(variant, uses):
        if len(use.outputs) > len(returned):
            yield "returns", f"{len(returned)} outputs, not {len(use.outputs)}"


def _returns_as_named(variant: str, uses: Iterable[RasterizerUse]) -> bool:
    """Return whether a variant returns what a checkout's variables say; their number does not tell what outputs are."""
    pairs = list(_outputs(variant, uses))
    return bool(pairs) and all(
        [_kind(name) for name in use.outputs[1:]] == [*returned[1:]] for use, returned in pairs if use.outputs
    )


def _kind(variable: str) -> str:
    """Return the kind of output that a variable is named after; empty for names such as `inv_depth`, too."""
    for part in DECORATIONS:
        variable = variable.replace(part, "")
    return KINDS.get(variable, "")


def _outputs(variant: str, uses: Iterable[RasterizerUse]) -> Iterator[tuple[RasterizerUse, tuple[str, ...]]]:
    """Yield each use of a rasterizer whose outputs are known in a variant, with their kinds there."""
    offered = _offered(variant) if variant else {}
    for use in uses:
        if use.module in offered and (returned := VARIANTS[offered[use.module]].returned):
            yield use, returned


def _offered(variant: str) -> dict[str, str]:
    """Return a variant and those beside it by their modules."""
    return {VARIANTS[name].module: name for name in (variant, *VARIANTS[variant].beside)}
