"""Choose the stand-in for a checkout's rasterizer from the checkout's imports and calls."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from lapgs_plugin.reference_raster.standins.variants import VARIANTS, Variant, rasterizer_module

IGNORED_FOLDERS = {"submodules", "SIBR_viewers", "site-packages"}
"""Folders of checkouts that hold other people's sources."""

SETTINGS, CALL = "GaussianRasterizationSettings", {"means3D", "means2D", "opacities"}
"""The family's settings by name, and keywords by which a call of its rasterizer is known."""


@dataclass
class Uses:
    """Collect how sources use CUDA modules that have stand-ins.

    Attributes:
        imported: names imported from each module, except those that a `try` makes optional.
        settings: keywords of each construction of settings.
        calls: keywords of the calls of a rasterizer, for each function that has some.
    """

    imported: dict[str, set[str]] = field(default_factory=dict)
    settings: list[set[str]] = field(default_factory=list)
    calls: list[list[set[str]]] = field(default_factory=list)

    def read(self, source: str) -> None:
        """Add a Python file; raises SyntaxError or ValueError if it is none."""
        tree = ast.parse(source)
        optional = {id(node) for each in ast.walk(tree) if isinstance(each, ast.Try) for node in ast.walk(each)}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and id(node) not in optional:
                self.imported.setdefault(node.module, set()).update(alias.name for alias in node.names)
            elif isinstance(node, ast.FunctionDef):
                self._read_function(node)

    def _read_function(self, function: ast.FunctionDef) -> None:
        calls = []
        for node in ast.walk(function):
            if isinstance(node, ast.Call):
                keywords = {each.arg for each in node.keywords if each.arg}
                if isinstance(node.func, ast.Name) and node.func.id == SETTINGS:
                    self.settings.append(keywords)
                elif keywords >= CALL and isinstance(node.func, ast.Name):
                    calls.append(keywords)
        if calls:
            self.calls.append(calls)


def variant_for(root: Path) -> str | None:
    """Return the variant that offers everything that a checkout imports, constructs and calls; None if there is none.

    Args:
        root: folder of the checkout.
    """
    uses = Uses()
    for path in _sources(root):
        text = path.read_text(encoding="utf-8", errors="replace")
        if "asteriz" in text or "relocation" in text or "FusedAdam" in text:
            try:
                uses.read(text)
            except (SyntaxError, ValueError):
                continue  # an unused script may be for another Python
    fitting = [name for name, variant in VARIANTS.items() if _fits(name, variant, uses)]
    # A variant with functions of its own is for checkouts that need them.
    fitting.sort(key=lambda name: len(VARIANTS[name].functions) + len(VARIANTS[name].beside))
    return fitting[0] if fitting else None


def _sources(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.is_symlink() and not path.name.startswith("."):
            if path.name not in IGNORED_FOLDERS:
                yield from _sources(path)
        elif path.suffix == ".py":
            yield path


def _fits(name: str, variant: Variant, uses: Uses) -> bool:
    offered = {VARIANTS[each].module: set(rasterizer_module(each)) for each in (name, *variant.beside)}
    known = {other.module for other in VARIANTS.values()}
    needed = {module: names for module, names in uses.imported.items() if module in known}
    if variant.module not in needed or any(names - offered.get(module, set()) for module, names in needed.items()):
        return False
    variants = [VARIANTS[each] for each in (name, *variant.beside) if VARIANTS[each].settings]
    if not all(any(keywords == set(each.settings) for each in variants) for keywords in uses.settings):
        return False
    forwards = [_arguments(each) for each in (name, *variant.beside) if VARIANTS[each].settings]
    return all(_any_fits(calls, forwards) for calls in uses.calls)


def _arguments(name: str) -> tuple[set[str], set[str]]:
    """Return the arguments of a variant's `forward`, and those without a default."""
    found = inspect.signature(rasterizer_module(name)["GaussianRasterizer"].forward).parameters
    required = {key for key, each in found.items() if each.default is each.empty and key != "self"}
    return set(found) - {"self"}, required


def _any_fits(calls: Iterable[set[str]], forwards: list[tuple[set[str], set[str]]]) -> bool:
    return any(required <= call <= taken for call in calls for taken, required in forwards)
