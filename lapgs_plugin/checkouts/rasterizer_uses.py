"""Find in the syntax tree of a checkout's module which rasterizers its functions use, and how. Executes nothing."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lapgs_plugin.checkouts.syntax import executed_on_import, location, parsed_quietly


@dataclass(frozen=True)
class RasterizerUse:
    """Describe how one module of a checkout uses a rasterizer.

    Attributes:
        module: the rasterizer's module.
        names: names that are taken from it, or looked up in it.
        holder: module of the checkout that imports it.
        where: file and line of the import.
        inside: whether it is imported in a function or as a whole, so that its names are looked up at each call.
        functions: functions of `holder` that use it.
        settings: names of the settings that are passed.
        inputs: names of the inputs that are passed.
        outputs: what outputs are unpacked into, names of variables in most checkouts; empty if they are not.
    """

    module: str
    names: tuple[str, ...]
    holder: str
    where: str
    inside: bool
    functions: tuple[str, ...]
    settings: frozenset[str]
    inputs: frozenset[str]
    outputs: tuple[str, ...]


def unlike(use: RasterizerUse, names: Mapping[str, Any]) -> str:
    """Return what a rasterizer does not take or wants besides what a checkout passes; empty if nothing is known.

    Args:
        use: how the checkout uses it.
        names: what its module has.
    """
    parts = list[str]()
    for settings in (names.get(name) for name in use.names if "setting" in name.lower()):
        fields, defaults = getattr(settings, "_fields", None), getattr(settings, "_field_defaults", {})
        if fields is not None and use.settings:
            parts += [f"takes no {name}" for name in sorted(use.settings - set(fields))]
            parts += [f"wants {name}" for name in sorted(set(fields) - set(defaults) - use.settings)]
    return " and ".join(dict.fromkeys(parts))


def uses_of_rasterizers(name: str, path: Path, root: Path, modules: Mapping[str, Path]) -> list[RasterizerUse]:
    """Return how the functions of a module use rasterizers."""
    tree = parsed_quietly(path)
    top = _aliases(executed_on_import(tree.body))
    uses: dict[str, RasterizerUse] = {}
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        local = _aliases(ast.walk(function))
        scope = {key: alias for key, alias in {**top, **local}.items() if not _wraps(modules.get(alias.module))}
        used = {node.id for node in ast.walk(function) if isinstance(node, ast.Name) and node.id in scope}
        for module in dict.fromkeys(scope[key].module for key in sorted(used)):
            own = {key: scope[key] for key in used if scope[key].module == module}
            use = _use(name, path, root, function, own, any(key in local for key in own))
            uses[module] = _merged(uses[module], use) if module in uses else use
    return list(uses.values())


def _wraps(path: Path | None) -> bool:
    """Return whether a module, whose file is that if it is one of the checkout's, only uses rasterizers.

    The binding of a rasterizer that the checkout contains, and compiles when it is imported, is one.
    """
    if path is None:
        return False
    imports = (node for node in ast.walk(parsed_quietly(path)) if isinstance(node, ast.ImportFrom))
    return not any(alias.name == "_C" for node in imports for alias in node.names)


@dataclass(frozen=True)
class _Alias:
    """A name that an import binds: `name` of `module`, or `module` itself."""

    module: str
    name: str | None
    line: int


def _aliases(nodes: Iterable[ast.AST]) -> dict[str, _Alias]:
    """Return the names of rasterizers that import statements bind."""
    aliases = {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                if "raster" in alias.name.lower():
                    aliases[alias.asname or alias.name] = _Alias(node.module, alias.name, node.lineno)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if "raster" in alias.name.lower():
                    aliases[alias.asname or alias.name.partition(".")[0]] = _Alias(alias.name, None, node.lineno)
    return aliases


def _use(
    holder: str, path: Path, root: Path, function: ast.FunctionDef, own: Mapping[str, _Alias], local: bool
) -> RasterizerUse:
    """Return how a function uses the rasterizer whose names are `own` there; `local` if it imports some itself."""
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    names = {_original(node, own) for node in ast.walk(function) if isinstance(node, ast.expr)} - {""}
    settings = [call for call in calls if "setting" in _original(call.func, own).lower()]
    makers = [call for call in calls if _original(call.func, own) and call not in settings]
    rasterizers = {target.id for target in _targets(function, makers) if isinstance(target, ast.Name)}
    renders = [call for call in calls if isinstance(call.func, ast.Name) and call.func.id in rasterizers] or makers
    unpacked = [target.elts for target in _targets(function, renders) if isinstance(target, ast.Tuple)]
    alias = next(iter(own.values()))
    return RasterizerUse(
        module=alias.module,
        names=tuple(sorted(names)),
        holder=holder,
        where=location(path, root, alias.line),
        inside=local or any(alias.name is None for alias in own.values()),
        functions=(function.name,),
        settings=frozenset(word.arg for call in settings for word in call.keywords if word.arg is not None),
        inputs=_inputs(function, renders),
        outputs=tuple(ast.unparse(element) for element in max(unpacked, key=len, default=[])),
    )


def _original(expression: ast.expr, own: Mapping[str, _Alias]) -> str:
    """Return the rasterizer's name for an expression such as `Rasterizer` or `module.Rasterizer`; empty for others."""
    if isinstance(expression, ast.Name) and expression.id in own:
        return own[expression.id].name or ""
    if isinstance(expression, ast.Attribute) and isinstance(expression.value, ast.Name) and expression.value.id in own:
        return expression.attr
    return ""


def _targets(function: ast.FunctionDef, calls: list[ast.Call]) -> Iterator[ast.expr]:
    """Yield what the results of these calls are assigned to."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and node.value in calls:
            yield from node.targets


def _inputs(function: ast.FunctionDef, renders: list[ast.Call]) -> frozenset[str]:
    """Return the names of the inputs of calls that render, which may be passed as `**inputs`."""
    inputs = {word.arg for call in renders for word in call.keywords}
    if None in inputs:
        calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
        collecting = [call for call in calls if ast.unparse(call.func).rpartition(".")[2] in ("dict", "update")]
        inputs |= {word.arg for call in collecting for word in call.keywords}
        constants = {node.value for node in ast.walk(function) if isinstance(node, ast.Constant)}
        inputs |= {name for name in ("dc", "shs", "colors_precomp") if name in constants}
    return frozenset(word for word in inputs if word is not None)


def _merged(one: RasterizerUse, other: RasterizerUse) -> RasterizerUse:
    return replace(
        one,
        names=tuple(dict.fromkeys((*one.names, *other.names))),
        inside=one.inside or other.inside,
        functions=(*one.functions, *other.functions),
        settings=one.settings | other.settings,
        inputs=one.inputs | other.inputs,
        outputs=max(one.outputs, other.outputs, key=len),
    )
