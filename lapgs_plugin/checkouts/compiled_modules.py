"""Put our modules in the places of a checkout's compiled ones that cannot be imported, so that it trains without them.

An installed one may crash the process that imports it, so it is imported in a process of its own first.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from lapgs_plugin.checkouts.attachment import replaced
from lapgs_plugin.checkouts.packages import AUTO, COMPANIONS, OURS, OWN, README, changes_path, package_of
from lapgs_plugin.checkouts.rasterizer_uses import unlike
from lapgs_plugin.checkouts.source import CheckoutSource, External
from lapgs_plugin.checkouts.stand_in import fitting_stand_in
from lapgs_plugin.environment import is_installed
from lapgs_plugin.environment.probes import run_probe
from lapgs_plugin.errors import MissingExtraError
from lapgs_plugin.family import VARIANTS, stand_ins, unavailable
from lapgs_plugin.family.variants import rasterizer_module

NOT_INSTALLED = "not installed"


@dataclass(frozen=True)
class CompiledModules:
    """Say whose compiled modules a checkout imports.

    Attributes:
        rasterizer: whose rasterizer it imports, `OWN` or `OURS`.
        wanted: as of `--rasterizer`.
        placed: our modules, by full name, that take the places of its own.
        reasons: why they do, by package.
        beside: our modules of rasterizers that it imports its own of, by full name; a dry run may choose them.
        hindrance: why ours cannot take the place of its rasterizer; empty if it can.
        lacks: what ours cannot do of what its own does; empty if it does all.
    """

    rasterizer: str
    wanted: str = AUTO
    placed: Mapping[str, ModuleType] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[str, ModuleType] = field(default_factory=dict)
    hindrance: str = ""
    lacks: str = ""

    @property
    def why(self) -> str:
        """Why ours take places of the checkout's own, and why its rasterizer's cannot be taken; empty for no reason."""
        reasons = (f"{package}: {reason}" for package, reason in self.reasons.items())
        return "; ".join(filter(None, (*reasons, self.hindrance)))

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Let imports find our modules inside."""
        with replaced(sys.modules, self.placed):
            yield

    def describe(self) -> str:
        """Return one line that says which modules are ours and why; empty if none is."""
        parts = [f"{package} ({reason})" for package, reason in self.reasons.items()]
        without = f"; its rasterizer does without {self.lacks}" if self.lacks and self.rasterizer == OURS else ""
        return f"compiled modules of lapgs in place of the checkout's: {', '.join(parts)}{without}" if parts else ""


def compiled_modules(
    source: CheckoutSource, fitting: Callable[[], str], wanted: str = AUTO, *, bare: bool = False
) -> CompiledModules:
    """Decide which compiled modules of a checkout are ours: a rasterizer as `wanted` says, others that do not load.

    Args:
        source: the checkout.
        fitting: returns the variant of the family that fits the checkout, as `BackboneAdapter.stand_in_for`.
        wanted: one of `packages.CHOICES`.
        bare: only what the script cannot do without is ours.

    Raises:
        MissingExtraError: its rasterizer cannot be imported, and ours cannot take its place or is not wanted; or ours
            is wanted and cannot.
    """
    variant, hindrance = _variant(fitting)
    ours = _our_modules(source, variant)
    rasterizers = dict.fromkeys(package_of(name) for name in source.rasterizer_modules if name not in source.modules)
    problems = _problems(source, ours, rasterizers if wanted == OURS else (), bare)
    if wanted == OURS and hindrance:
        raise MissingExtraError(f"--rasterizer lapgs: {hindrance}")
    broken = next(filter(problems.get, rasterizers), None)
    left_to_script = bare or changes_path(source)  # importing says more
    if broken is not None and (wanted == OWN or (hindrance and not left_to_script)):
        raise _cannot_be_imported(source, broken, problems[broken], hindrance)
    because = dict.fromkeys(rasterizers, "--rasterizer lapgs" if wanted == OURS else "") | problems
    packages = set(map(package_of, ours))
    reasons = {package: why for package, why in because.items() if why and package in packages}
    beside = [name for name in source.rasterizer_modules if name in ours and package_of(name) not in reasons]
    if wanted == AUTO and beside:
        ours |= _our_modules(source, _as_installed(source, variant, beside[0]))
        reasons |= {package_of(name): why for name in beside if (why := _of_other_code(source, name))}
        beside = [name for name in beside if package_of(name) not in reasons]
    return CompiledModules(
        OWN if beside or hindrance else OURS,
        wanted,
        placed={name: module for name, module in ours.items() if package_of(name) in reasons},
        reasons=reasons,
        beside={name: ours[name] for name in beside if wanted == AUTO},
        hindrance=hindrance,
        lacks=unavailable(variant) if variant else "",
    )


def _cannot_be_imported(source: CheckoutSource, package: str, problem: str, hindrance: str) -> MissingExtraError:
    """Return the error of a rasterizer that cannot be imported, where ours does not take its place."""
    own = source.own_package(package)
    install = README if own is None else own.install
    otherwise = hindrance or "leave out --rasterizer checkout, and ours takes its place"
    return MissingExtraError(f"{package} cannot be imported ({problem}): {install}; {otherwise}")


def _variant(fitting: Callable[[], str]) -> tuple[str, str]:
    """Return the variant that fits, or an empty name and why there is none."""
    try:
        return fitting(), ""
    except MissingExtraError as error:
        return "", str(error)


def _our_modules(source: CheckoutSource, variant: str) -> dict[str, ModuleType]:
    """Return our modules by full name: those of a variant, and without one those that need none."""
    modules = stand_ins(variant or next(iter(VARIANTS)), neighbours=source.unpacks("distCUDA2"))
    return {name: module for name, module in modules.items() if variant or package_of(name) in COMPANIONS}


def _problems(
    source: CheckoutSource, ours: Mapping[str, ModuleType], left_out: Iterable[str], bare: bool
) -> dict[str, str]:
    """Return why the checkout cannot import what it takes from compiled packages, by package; empty where it can."""
    packages = {*map(package_of, (*ours, *source.rasterizer_modules)), *COMPANIONS}.difference(left_out)
    imports: dict[str, list[str]] = {}
    for one in source.externals:
        if (package := package_of(one.name)) in packages and (names := _needed(one, source, ours, bare)):
            imports.setdefault(package, []).extend(names)
    there = {package: names for package, names in imports.items() if is_installed(package)}
    loads = not _import_error(*there.values())
    failed = {} if loads else {package: _import_error(names) for package, names in there.items()}
    return {package: failed.get(package, "") if package in there else NOT_INSTALLED for package in imports}


def _needed(one: External, source: CheckoutSource, ours: Mapping[str, ModuleType], bare: bool) -> list[str]:
    """Return the imports of a module that have to work, as `probes` takes them.

    Of an import that may fail these are the names that ours offers: a checkout asks for sparse Adam where it can do
    without.
    """
    if not one.optional:
        return [one.name, *(f"{one.name}:{name}" for name in one.names)]
    if one.name not in ours or (bare and one.name not in source.rasterizer_modules):
        return []
    return [one.name, *(f"{one.name}:{name}" for name in one.names if hasattr(ours[one.name], name))]


def _import_error(*names: list[str]) -> str:
    """Return why modules, or names of them, cannot be imported in a process of their own; empty if they can."""
    wanted = dict.fromkeys(name for use_names in names for name in use_names)
    # Extensions find PyTorch's libraries after it is loaded.
    return run_probe("import", "torch", *wanted).error if wanted else ""


def _of_other_code(source: CheckoutSource, module: str) -> str:
    """Return how an installed rasterizer differs from what the checkout calls; forks share names of modules."""
    names = vars(importlib.import_module(module))
    reasons = (unlike(use, names) for use in source.rasterizers if use.module == module)
    return next((f"the installed one {why}" for why in reasons if why), "")


def _as_installed(source: CheckoutSource, variant: str, module: str) -> str:
    """Return the variant whose rasterizer is called as the installed one, if one fits the checkout, else `variant`.

    A checkout whose calls depend on what is installed fits several.
    """
    installed = _call_of(vars(importlib.import_module(module)))
    alike = [name for name, variant in VARIANTS.items() if variant.module == module and variant.settings]
    called_so = (name for name in (variant, *alike) if _call_of(rasterizer_module(name)) == installed)
    return next((name for name in called_so if _fits(source, name)), variant)


def _fits(source: CheckoutSource, variant: str) -> bool:
    try:
        return fitting_stand_in(source.root, variant) == variant
    except MissingExtraError:
        return False


def _call_of(names: Mapping[str, Any]) -> tuple[set[str], list[str]] | None:
    """Return the settings and the inputs of a rasterizer's module by name; None if they are not to be read."""
    try:
        settings = names["GaussianRasterizationSettings"]._fields
        return set(settings), list(inspect.signature(names["GaussianRasterizer"].forward).parameters)
    except (KeyError, AttributeError, TypeError, ValueError):
        return None
