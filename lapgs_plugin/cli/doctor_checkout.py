"""Describe a checkout for `lapgs doctor CHECKOUT`, from its sources and the compiled modules that are installed."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

from lapgs_plugin.adapters.base import PARAMETERS
from lapgs_plugin.adapters.registry import adapter_class, known_extensions
from lapgs_plugin.checkouts.model_values import explain_values_beside
from lapgs_plugin.checkouts.other_trainers import known_trainer
from lapgs_plugin.checkouts.packages import COMPANIONS, OURS, README, missing_packages, package_of
from lapgs_plugin.checkouts.rasterizer_uses import RasterizerUse
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.source import CheckoutSource, readable_sources
from lapgs_plugin.checkouts.splat_script import SplatScript
from lapgs_plugin.environment import is_installed
from lapgs_plugin.environment.findings import Finding
from lapgs_plugin.errors import MissingExtraError, UserInputError

COLORS = {"shs", "colors_precomp"}
"""Inputs of rasterizers that accept signed colours."""


def describe(path: Path) -> dict[str, list[Finding]]:
    """Return findings about a checkout for `lapgs run`, by section.

    Args:
        path: its root, its training script, or a folder of scripts in it.

    Raises:
        UserInputError: it is no 3DGS checkout; or it has several training scripts, none of them `train.py` in its root.
    """
    if path.is_file() and (splats := SplatScript.read(path.absolute())) is not None:
        return _of_splats(splats)
    source, others = _source(path)
    unused = f"none of the {len(source.modules)} modules that the script imports uses one"
    adapter = adapter_class(source.root)
    parameters = ", ".join(argument.arg for argument in source.training.args.args)
    return {
        "Checkout": [
            Finding("Root", "ok", str(source.root)),
            Finding("Adapter", "ok", f"{adapter.info.title} (--backbone {adapter.info.name})"),
            Finding("Training", "ok", f"{source.location(source.training)}: {source.training.name}({parameters})"),
            *others,
            Finding("Gaussians", "ok", _gaussians(source)),
        ],
        "Rasterizers": [_rasterizer(use, source) for use in source.rasterizers] or [Finding("none", "problem", unused)],
        "Packages": _packages(source),
        "Schedule": _schedule(source),
        "lapgs run": [*_kinds_of_models(source), _rasterizer_on_gpu(source), _stand_in(source)],
    }


def _of_splats(script: SplatScript) -> dict[str, list[Finding]]:
    """Return what `lapgs run` makes of a script whose class trains splats."""
    absent = [name for name in script.packages if not is_installed(name)]
    packages = [Finding(name, "absent", "not installed; its requirements.txt lists it") for name in absent]
    return {
        "Checkout": [
            Finding("Script", "ok", str(script.path)),
            Finding("Training", "ok", f"{script.trainer}.train() renders with gsplat's rasterization()"),
        ],
        "Packages": packages or [Finding("Imports", "ok", "all are installed")],
        "lapgs run": [
            Finding("nested", "ok", f"one call of {script.trainer}.train()"),
            Finding("laplacian", "ok", "residuals get their colours as they are; no patch is needed"),
            Finding("--device cpu", "ok", "stand-in of rasterization(), where its packages are installed"),
        ],
    }


def _source(path: Path) -> tuple[CheckoutSource, list[Finding]]:
    """Return the sources of the training script to describe, and findings about other training scripts."""
    if path.is_file():
        return CheckoutSource.read(path), []
    if (advice := known_trainer(path)) is not None:
        raise UserInputError(f"{path} is no 3DGS checkout: {advice}")
    sources, problems = readable_sources(path.absolute())
    if not sources:
        raise (
            problems[0]
            if problems
            else UserInputError(f"{path} {_lack(path)}, expected the root of a 3DGS checkout, or its training script")
        )
    scripts = {str(source.script.relative_to(path.absolute())): source for source in sources}
    hindered = {name: why for name, source in scripts.items() if (why := _hindrance(source)) is not None}
    useful = [name for name in scripts if name not in hindered] or list(scripts)
    if len(useful) > 1 and useful[0] != "train.py":
        usual = adapter_class(scripts[useful[0]].root).info.script
        raise UserInputError(
            f"{path} has several training scripts: {', '.join(useful)}; expected one of them, as in "
            f"`lapgs doctor {path / (usual if usual in useful else useful[0])}`"
        )
    first, *more = useful
    beside = [f"{', '.join(more)}; describe one with `lapgs doctor {path / more[0]}`"] if more else []
    unused = [Finding(name, "absent", why) for name, why in hindered.items() if name not in useful]
    return scripts[first], [*(Finding("Other scripts", "ok", text) for text in beside), *unused]


def _lack(path: Path) -> str:
    """Return why there is no training script at a path."""
    if not path.exists():
        return "does not exist"
    if any(path.iterdir()):
        return "has no train*.py"
    return "is empty (in a clone `git submodule update --init --recursive` fills its submodules)"


def _hindrance(source: CheckoutSource) -> str | None:
    return source.hindrance(adapter_class(source.root).archived_parameters())


def _gaussians(source: CheckoutSource) -> str:
    """Return the class of the Gaussians with its file, or all that the script may choose."""
    if len(source.models) == 1:
        return f"{source.model[1]}: {source.model[0]}"
    choice = [f"{source.location(node)} chooses: {ast.unparse(node)}" for node in source.model_statements[-1:]]
    return "; ".join([", ".join(f"{where}: {name}" for name, where in source.models), *choice])


def _rasterizer(use: RasterizerUse, source: CheckoutSource) -> Finding:
    inputs = ", ".join(sorted(use.inputs))
    detail = (
        f"{use.where} imports it for {', '.join(use.functions)}; outputs: {len(use.outputs) or 1}; inputs: {inputs}"
    )
    if use.module in source.modules:
        return Finding(use.module, "ok", f"part of the checkout; {detail}")
    if is_installed(use.module):
        return Finding(use.module, "ok", detail)
    own = source.own_package(package_of(use.module))
    return Finding(use.module, "absent", f"not installed; {detail}", README if own is None else own.install)


def _packages(source: CheckoutSource) -> list[Finding]:
    """Return packages that the script cannot do without and that are not installed, besides those that lapgs has."""
    compiled = {*map(package_of, source.rasterizer_modules), *COMPANIONS}
    missing = [one for one in missing_packages(source, known_extensions()) if one.name not in compiled]
    if not missing:
        return [Finding("Imports", "ok", "all others are installed")]
    return [Finding(one.name, "absent", f"{one.where} imports it; not installed", one.install) for one in missing]


def _schedule(source: CheckoutSource) -> list[Finding]:
    """Return the events of the training loop with their iterations."""
    lines = [line.partition(": ") for line in Schedule(source.training).describe()]
    return [Finding(iterations, "ok", event) for iterations, _, event in lines] or [
        Finding("none", "ok", "counts no iterations")
    ]


def _kinds_of_models(source: CheckoutSource) -> list[Finding]:
    """Return which kinds of hierarchy work: with the first model where the script may choose several."""
    first, *others = ((name, _kinds(replace(source, model=(name, where)))) for name, where in source.models)
    findings = []
    for i, finding in enumerate(first[1]):
        more = [f"{name}: {kinds[i].detail}" for name, kinds in others if kinds[i].detail != finding.detail]
        detail = "; ".join([f"{first[0]}: {finding.detail}", *more]) if more else finding.detail
        findings.append(replace(finding, detail=detail))
    return findings


def _kinds(source: CheckoutSource) -> list[Finding]:
    if why := _hindrance(source):
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
    if why := explain_values_beside(source, PARAMETERS, surely=False):
        more = f"{more}: perhaps {why}"
    blind = [module for module, inputs in taken.items() if not inputs]
    if len(blind) < len(taken):
        takes = " and ".join(sorted(set[str]().union(*taken.values())))
        but = f", but {' and '.join(blind)} does not" if blind else ""
        return [nested, Finding("laplacian", "ok", f"its rasterizer takes {takes}{but}; {more}")]
    why = f"its rasterizer takes neither {' nor '.join(sorted(COLORS))}, by which a residual has colours of both signs"
    return [nested, Finding("laplacian", "absent", why)]


def _rasterizer_on_gpu(source: CheckoutSource) -> Finding:
    """Return whose rasterizer `lapgs run` would take on a GPU."""
    from lapgs_plugin.checkouts.compiled_modules import compiled_modules  # imports PyTorch

    kind, option = adapter_class(source.root), "--rasterizer auto"
    try:
        modules = compiled_modules(source, lambda: kind.stand_in_for(source.root, ()))
    except MissingExtraError as error:
        return Finding(option, "absent", str(error))
    whose = "that of lapgs" if modules.rasterizer == OURS else "the checkout's own"
    if modules.beside:
        whose = "the checkout's own or that of lapgs: the dry run of `lapgs run` compares and times both"
    return Finding(option, "ok", "; ".join(filter(None, (whose, modules.hindrance, modules.describe()))))


def _stand_in(source: CheckoutSource) -> Finding:
    stood_in = {*map(package_of, known_extensions()), *map(package_of, source.rasterizer_modules)}
    for one in source.externals:
        own = None if one.optional or package_of(one.name) in stood_in else source.own_package(package_of(one.name))
        if own is not None and own.needs_cuda and not is_installed(package_of(one.name)):
            why = f"no CPU stand-in for {one.name}, which {one.where} imports from {own.folder}; it needs a CUDA device"
            return Finding("--device cpu", "absent", why)
    try:
        return Finding("--device cpu", "ok", f"stand-in {adapter_class(source.root).stand_in_for(source.root, ())}")
    except MissingExtraError as error:
        return Finding("--device cpu", "absent", str(error))
