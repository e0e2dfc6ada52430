"""Describe a checkout for `lapgs doctor CHECKOUT`, from its sources alone."""

from __future__ import annotations

import sys
from pathlib import Path

from lapgs_plugin.adapters.base import PARAMETERS
from lapgs_plugin.adapters.registry import adapter_class, known_extensions
from lapgs_plugin.checkouts.model_values import explain_values_beside
from lapgs_plugin.checkouts.rasterizer_uses import RasterizerUse
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.source import CheckoutSource, training_scripts
from lapgs_plugin.environment import is_installed
from lapgs_plugin.environment.findings import Finding
from lapgs_plugin.errors import MissingExtraError, UserInputError

README = "install it as the checkout's README says"

COLORS = {"shs", "colors_precomp"}
"""Inputs of rasterizers by which a residual gets colours of both signs."""


def describe(path: Path) -> dict[str, list[Finding]]:
    """Return what `lapgs run` makes of a checkout, by section.

    Args:
        path: its root, its training script, or a folder of scripts in it.

    Raises:
        UserInputError: it is no 3DGS checkout, and the line says what is missing; or it has several training scripts
            and none of them is `train.py` in its root.
    """
    source, others = _source(path)
    more = [f"{', '.join(others)}; describe one with `lapgs doctor {path / others[0]}`"] if others else []
    unused = f"none of the {len(source.modules)} modules that the script imports uses one"
    adapter = adapter_class(source.root)
    parameters = ", ".join(argument.arg for argument in source.training.args.args)
    return {
        "Checkout": [
            Finding("Root", "ok", str(source.root)),
            Finding("Adapter", "ok", f"{adapter.info.title} (--backbone {adapter.info.name})"),
            Finding("Training", "ok", f"{source.place(source.training)}: {source.training.name}({parameters})"),
            *(Finding("Other scripts", "ok", text) for text in more),
            Finding("Gaussians", "ok", f"{source.model[1]}: {source.model[0]}"),
        ],
        "Rasterizers": [_rasterizer(use, source) for use in source.rasterizers] or [Finding("none", "problem", unused)],
        "Packages": _packages(source),
        "Schedule": _schedule(source),
        "lapgs run": [*_kinds(source), _stand_in(source)],
    }


def _source(path: Path) -> tuple[CheckoutSource, list[str]]:
    """Return the sources of the training script to describe, and the names of other training scripts."""
    if path.is_file():
        return CheckoutSource.read(path), []
    found: dict[str, CheckoutSource] = {}
    problems: list[UserInputError] = []
    for script in training_scripts(path.absolute()):
        try:
            found[str(script.relative_to(path.absolute()))] = CheckoutSource.read(script)
        except UserInputError as error:
            problems.append(error)
    if not found:
        lacks = "has no train*.py" if path.exists() else "does not exist"
        missing = f"{path} {lacks}, expected the root of a 3DGS checkout, or its training script"
        raise problems[0] if problems else UserInputError(missing)
    names = list(found)
    if len(names) > 1 and names[0] != "train.py":
        usual = adapter_class(found[names[0]].root).info.script
        raise UserInputError(
            f"{path} has several training scripts: {', '.join(names)}; expected one of them, as in "
            f"`lapgs doctor {path / (usual if usual in names else names[0])}`"
        )
    return found[names[0]], names[1:]


def _rasterizer(use: RasterizerUse, source: CheckoutSource) -> Finding:
    inputs = ", ".join(sorted(use.inputs))
    detail = f"{use.where} imports it for {', '.join(use.functions)}; outputs: {use.outputs}; inputs: {inputs}"
    if use.module in source.modules:
        return Finding(use.module, "ok", f"part of the checkout; {detail}")
    if is_installed(use.module):
        return Finding(use.module, "ok", detail)
    return Finding(use.module, "absent", f"not installed; {detail}", _how_to_install(use.module, source, README))


def _how_to_install(module: str, source: CheckoutSource, otherwise: str = "") -> str:
    own = source.own_package(_package(module))
    return otherwise if own is None else own.install


def _packages(source: CheckoutSource) -> list[Finding]:
    """Return packages that the script cannot do without and that are not installed."""
    needed = {one.name.partition(".")[0]: one for one in reversed(source.externals) if not one.optional}
    known = sys.stdlib_module_names | {module.partition(".")[0] for module in source.rasterizer_modules}
    missing = {name: one for name, one in needed.items() if name not in known and not is_installed(name)}
    if not missing:
        return [Finding("Imports", "ok", "all others are installed")]
    return [
        Finding(name, "absent", f"{one.where} imports it; not installed", _how_to_install(name, source))
        for name, one in sorted(missing.items())
    ]


def _package(module: str) -> str:
    return module.partition(".")[0]


def _schedule(source: CheckoutSource) -> list[Finding]:
    """Return what the training loop does at which iteration."""
    lines = [line.partition(": ") for line in Schedule(source.training).describe()]
    return [Finding(place, "ok", event) for place, _, event in lines] or [Finding("none", "ok", "counts no iterations")]


def _kinds(source: CheckoutSource) -> list[Finding]:
    if why := source.hindrance(adapter_class(source.root).archived_parameters()):
        return [Finding(kind, "absent", why) for kind in ("nested", "laplacian")]
    taken = {module: set[str]() for module in source.rasterizer_modules}
    for use in source.rasterizers:
        taken[use.module] |= use.inputs & COLORS
    more = "the dry run of `lapgs run` says more"
    nested = Finding("nested", "ok", f"one call of the checkout's own training; {more}")
    axes = source.scale_axes
    if axes is not None and axes[0] != 3:
        return [nested, Finding("laplacian", "absent", f"residuals need three scale axes; {axes[1]} makes {axes[0]}")]
    if why := explain_values_beside(source, PARAMETERS):
        return [nested, Finding("laplacian", "absent", why)]
    blind = [module for module, inputs in taken.items() if not inputs]
    if len(blind) < len(taken):
        takes = " and ".join(sorted(set[str]().union(*taken.values())))
        but = f", but {' and '.join(blind)} does not" if blind else ""
        return [nested, Finding("laplacian", "ok", f"its rasterizer takes {takes}{but}; {more}")]
    why = f"its rasterizer takes neither {' nor '.join(sorted(COLORS))}, by which a residual has colours of both signs"
    return [nested, Finding("laplacian", "absent", why)]


def _stand_in(source: CheckoutSource) -> Finding:
    stood_in = {*map(_package, known_extensions()), *map(_package, source.rasterizer_modules)}
    for one in source.externals:
        own = None if one.optional or _package(one.name) in stood_in else source.own_package(_package(one.name))
        if own is not None and own.needs_cuda and not is_installed(_package(one.name)):
            why = f"no CPU stand-in for {one.name}, which {one.where} imports from {own.folder}; it needs a CUDA device"
            return Finding("--device cpu", "absent", why)
    try:
        return Finding("--device cpu", "ok", f"stand-in {adapter_class(source.root).stand_in_for(source.root, ())}")
    except MissingExtraError as error:
        return Finding("--device cpu", "absent", str(error))
