"""Follow a checkout's functions along the branches that its options take by default. Executes nothing of it."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

from lapgs_plugin.checkouts.syntax import called_name, stored_names

PARSER = "parser"
"""Parameter of functions in which the family's scripts declare their options."""

DECIDABLE = (
    *(ast.Expression, ast.Name, ast.Attribute, ast.Constant, ast.BoolOp, ast.UnaryOp, ast.Compare),
    *(ast.boolop, ast.unaryop, ast.cmpop, ast.expr_context),
)
"""Nodes of conditions that can be evaluated: they call nothing of the checkout's."""


def default_options(trees: Iterable[ast.Module]) -> dict[str, Any]:
    """Return the constants that options are by default, by name; options with several are left out.

    Args:
        trees: syntax trees of a checkout, the script's first.
    """
    script, *modules = trees
    functions = [node for tree in (script, *modules) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    declaring = [node for node in functions if any(argument.arg == PARSER for argument in node.args.args)]
    values: dict[str, list[Any]] = {}
    for node in (*ast.walk(script), *(node for function in declaring for node in ast.walk(function))):
        if isinstance(node, ast.Call) and called_name(node) == "add_argument":
            words = {word.arg: getattr(word.value, "value", None) for word in node.keywords}
            flag = {"store_true": False, "store_false": True}.get(str(words.get("action")))
            names = [str(argument.value) for argument in node.args if isinstance(argument, ast.Constant)]
            name, default = names[-1].strip("-").replace("-", "_") if names else "", words.get("default", flag)
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
            name, default = getattr(node.targets[0], "attr", "").removeprefix("_"), node.value.value
        else:
            continue
        values.setdefault(name, []).append(default)
    return {name: constants[0] for name, constants in values.items() if len(constants) == 1}


class Branches:
    """Follow functions with the values of options.

    Args:
        options: values of options by name, which are read as attributes.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._options = SimpleNamespace(**options)

    def executed(self, function: ast.FunctionDef, passed: Mapping[str, Any], *, surely: bool) -> Iterator[ast.AST]:
        """Yield nodes that a function executes; loops are taken to run.

        Args:
            function: the function.
            passed: its arguments that are known constants, by parameter name.
            surely: whether undecided branches, and `try`, are left out; else each way of them is followed.
        """
        waiting: list[ast.AST] = [*function.body]
        while waiting:
            node = waiting.pop()
            if isinstance(node, (ast.FunctionDef, ast.Lambda)) or (isinstance(node, ast.Try) and surely):
                continue
            yield node
            if not isinstance(node, (ast.If, ast.IfExp)):
                waiting += ast.iter_child_nodes(node)
                continue
            waiting.append(node.test)
            holds = self._decide(node.test, passed)
            for branch, wanted in ((node.body, True), (node.orelse, False)):
                if holds is wanted or (holds is None and not surely):
                    waiting += branch if isinstance(branch, list) else [branch]

    def arguments(self, function: ast.FunctionDef, call: ast.Call) -> dict[str, Any]:
        """Return the arguments of a call that are constants or options by parameter, defaults included."""
        parameters = [argument.arg for argument in (*function.args.posonlyargs, *function.args.args)]
        defaults = function.args.defaults
        values = dict(zip(parameters[len(parameters) - len(defaults) :], defaults, strict=True))
        positional = parameters[1:] if parameters[:1] == ["self"] else parameters
        values |= dict(zip(positional, call.args, strict=False))
        values |= {word.arg: word.value for word in call.keywords if word.arg is not None}
        if any(word.arg is None for word in call.keywords) or any(isinstance(item, ast.Starred) for item in call.args):
            return {}
        changed, known = stored_names(function), {}
        for name, value in values.items():
            with suppress(ValueError):  # it is neither
                known[name] = self._evaluated(value, {})
        return {name: value for name, value in known.items() if name not in changed}

    def _decide(self, condition: ast.expr, variables: Mapping[str, Any]) -> bool | None:
        """Return whether a condition holds, None if that hangs on more than options and known variables."""
        with suppress(ValueError):
            return bool(self._evaluated(condition, variables))
        return None

    def _evaluated(self, expression: ast.expr, variables: Mapping[str, Any]) -> Any:
        """Return the value of an expression of constants, options and known variables.

        Raises:
            ValueError: it hangs on more.
        """
        nodes = list(ast.walk(expression))
        if not all(isinstance(node, DECIDABLE) for node in nodes):
            raise ValueError("it does more than compare")
        holders = (node.value for node in nodes if isinstance(node, ast.Attribute))
        namespaces = {holder.id for holder in holders if isinstance(holder, ast.Name)} - {"self"}
        names = {**dict.fromkeys(namespaces, self._options), **variables, "__builtins__": {}}
        try:
            return eval(compile(ast.Expression(expression), "", "eval"), names)
        except Exception as error:
            raise ValueError("it has a name or an attribute that is none of these") from error
