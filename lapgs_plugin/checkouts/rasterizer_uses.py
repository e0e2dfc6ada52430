"""Find in the syntax tree of a checkout's module which rasterizers its functions use, and how. Executes nothing."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.checkouts.syntax import parsed_quietly, place


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
        outputs: number of outputs that are unpacked; 1 if they are not.
    """

    module: str
    names: tuple[str, ...]
    holder: str
    where: str
    inside: bool
    functions: tuple[str, ...]
    settings: frozenset[str]
    inputs: frozenset[str]
    outputs: int


def uses_of_rasterizers(name: str, path: Path, root: Path, modules: Mapping[str, Path]) -> list[RasterizerUse]:
    """Return how the functions of a module use rasterizers."""
    tree = parsed_quietly(path)
    top = _aliases(_outside_functions(tree.body))
    found: dict[str, RasterizerUse] = {}
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        local = _aliases(ast.walk(function))
        scope = {key: alias for key, alias in {**top, **local}.items() if alias.module not in modules}
        used = {node.id for node in ast.walk(function) if isinstance(node, ast.Name) and node.id in scope}
        for module in dict.fromkeys(scope[key].module for key in sorted(used)):
            own = {key: scope[key] for key in used if scope[key].module == module}
            use = _use(name, path, root, function, own, any(key in local for key in own))
            found[module] = _merged(found[module], use) if module in found else use
    return list(found.values())


@dataclass(frozen=True)
class _Alias:
    """A name that an import binds: `name` of `module`, or `module` itself."""

    module: str
    name: str | None
    line: int


def _aliases(nodes: Iterable[ast.AST]) -> dict[str, _Alias]:
    """Return the names of rasterizers that import statements bind."""
    found = {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                if "raster" in alias.name.lower():
                    found[alias.asname or alias.name] = _Alias(node.module, alias.name, node.lineno)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if "raster" in alias.name.lower():
                    found[alias.asname or alias.name.partition(".")[0]] = _Alias(alias.name, None, node.lineno)
    return found


def _outside_functions(body: Iterable[ast.stmt]) -> Iterator[ast.AST]:
    """Yield statements that are executed when a module is imported."""
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            continue
        yield node
        for part in ("body", "orelse", "finalbody"):
            yield from _outside_functions(getattr(node, part, []))
        for handler in getattr(node, "handlers", []):
            yield from _outside_functions(handler.body)


def _use(
    holder: str, path: Path, root: Path, function: ast.FunctionDef, own: Mapping[str, _Alias], local: bool
) -> RasterizerUse:
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]

    def original(call: ast.expr) -> str:
        """Return the rasterizer's name for the function of a call, empty for any other."""
        if isinstance(call, ast.Name) and call.id in own:
            return own[call.id].name or ""
        whole = isinstance(call, ast.Attribute) and isinstance(call.value, ast.Name) and call.value.id in own
        return call.attr if whole and isinstance(call, ast.Attribute) else ""

    names = sorted({original(node) for node in ast.walk(function) if isinstance(node, ast.expr)} - {""})
    settings = [call for call in calls if "setting" in original(call.func).lower()]
    makers = [call for call in calls if original(call.func) and call not in settings]
    made = {
        target.id
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and node.value in makers
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    renders = [call for call in calls if isinstance(call.func, ast.Name) and call.func.id in made] or makers
    inputs = {keyword.arg for call in renders for keyword in call.keywords}
    if None in inputs:  # **inputs: their names are somewhere in the function
        inputs |= {keyword.arg for call in calls for keyword in call.keywords}
        constants = {node.value for node in ast.walk(function) if isinstance(node, ast.Constant)}
        inputs |= {name for name in ("dc", "shs") if name in constants}
    outputs = [
        len(target.elts)
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and node.value in renders
        for target in node.targets
        if isinstance(target, ast.Tuple)
    ]
    alias = next(iter(own.values()))
    return RasterizerUse(
        module=alias.module,
        names=tuple(names),
        holder=holder,
        where=place(path, root, alias.line),
        inside=local or any(each.name is None for each in own.values()),
        functions=(function.name,),
        settings=frozenset(word.arg for call in settings for word in call.keywords if word.arg is not None),
        inputs=frozenset(word for word in inputs if isinstance(word, str)),
        outputs=max(outputs, default=1),
    )


def _merged(one: RasterizerUse, other: RasterizerUse) -> RasterizerUse:
    return RasterizerUse(
        module=one.module,
        names=tuple(dict.fromkeys((*one.names, *other.names))),
        holder=one.holder,
        where=one.where,
        inside=one.inside or other.inside,
        functions=(*one.functions, *other.functions),
        settings=one.settings | other.settings,
        inputs=one.inputs | other.inputs,
        outputs=max(one.outputs, other.outputs),
    )
