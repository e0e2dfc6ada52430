"""Find statements that update the rows of a mask, in functions of a checkout. Imports no torch, executes nothing.

Loops of the family gather statistics of the Gaussians that a view shows:

    gaussians.max_radii2D[shown] = torch.max(gaussians.max_radii2D[shown], radii[shown])
    self.xyz_gradient_accum[shown] += torch.norm(points.grad[shown, :2], dim=-1, keepdim=True)
    self.denom[shown] += 1

Each `x[shown]` of a mask waits for the GPU, which has to say how many rows there are, and is several launches.
Some of these statements are in a method of the model, which the loop calls after others of them.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

from lapgs_plugin.checkouts.rewriting import Change, StatementsChange, call

UPDATE = "_lapgs_update"
"""Name of the function that updates the rows, and returns whether it did."""
KNOWN = "_lapgs_known"
"""Name of the function that returns whether a method is the one whose statements are known."""
VISIBLE = "_lapgs_visible"
"""Name of the function that takes the place of `(radii > 0).nonzero()`."""
KEY = "visibility_filter"
"""Name of the mask, or of its indices, in the results of the family's renderers."""
CALLERS = ("partial", "map")
"""Functions by which a function calls another one itself, under no name."""
LARGEST = ("max", "maximum")
"""Functions of torch that return the larger one of two tensors' elements."""


class _Update(NamedTuple):
    """Describe a statement.

    Attributes:
        mask: variable of the mask.
        arguments: of `ops.masked_updates.Update`, as expressions.
    """

    mask: str
    arguments: tuple[ast.expr, ...]


class _Updates(NamedTuple):
    """Describe what a statement does, an update or a call of a method that does nothing but updates.

    Attributes:
        statement: itself.
        mask: variable of the mask; None if it does something else.
        updates: arguments of each.
        method: what is called.
    """

    statement: ast.stmt
    mask: str | None = None
    updates: Sequence[Sequence[ast.expr]] = ()
    method: ast.expr | None = None


class MaskedUpdates(StatementsChange):
    """Replace runs of statements that update rows of a mask, where the same can be done without listing the rows.

    if not (KNOWN(model.add) and UPDATE(shown, (self.largest, True, radii, None, None), (model.views, ...))):
        self.largest[shown] = torch.max(self.largest[shown], radii[shown])
        model.add(shown)

    Args:
        methods: trees of the model's methods by name; where one is called beside such statements, it may be replaced.
    """

    def __init__(self, methods: Mapping[str, ast.FunctionDef]) -> None:
        self._methods = methods

    def _replaced(self, statements: list[ast.stmt]) -> list[ast.stmt]:
        runs = groupby((self._updates_of(statement) for statement in statements), lambda updates: updates.mask)
        replaced = [self._updated(mask, list(run)) for mask, run in runs]
        return [statement for run in replaced for statement in run]

    def _updates_of(self, statement: ast.stmt) -> _Updates:
        if (update := _update(statement)) is not None:
            return _Updates(statement, update.mask, [update.arguments])
        match statement:
            case ast.Expr(ast.Call(ast.Attribute(_, name)) as called) if name in self._methods:
                return _updates_by(statement, called, self._methods[name])
        return _Updates(statement)

    def _updated(self, mask: str | None, run: Sequence[_Updates]) -> list[ast.stmt]:
        statements, methods = [one.statement for one in run], [one.method for one in run if one.method is not None]
        if mask is None or len(methods) == len(run):  # what a method does by itself is replaced in it
            return statements
        self.changes += len(statements)
        updates = [ast.Tuple(copy.deepcopy(list(update)), ast.Load()) for one in run for update in one.updates]
        done: ast.expr = call(UPDATE, ast.Name(mask, ast.Load()), *updates)
        if methods:
            done = ast.BoolOp(ast.And(), [*(call(KNOWN, copy.deepcopy(method)) for method in methods), done])
        return [ast.copy_location(ast.If(ast.UnaryOp(ast.Not(), done), statements, []), statements[0])]


class _Substitution(ast.NodeTransformer):
    """Replace variables by expressions."""

    def __init__(self, values: Mapping[str, ast.expr]) -> None:
        self._values = values

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return what takes the place of a variable."""
        return copy.deepcopy(self._values[node.id])


def _updates_by(statement: ast.stmt, called: ast.Call, method: ast.FunctionDef) -> _Updates:
    """Return what a statement does that calls a method, by the variables of the caller."""
    other = _Updates(statement)
    body = method.body[1:] if ast.get_docstring(method) is not None else method.body
    updates = [update for line in body if (update := _update(line)) is not None]
    parameters = [parameter.arg for parameter in method.args.args]
    assert isinstance(called.func, ast.Attribute)
    arguments = [called.func.value, *called.args]
    if called.keywords or len(parameters) != len(arguments) or not all(map(_is_value, arguments)):
        return other
    values, masks = dict(zip(parameters, arguments, strict=True)), {update.mask for update in updates}
    if len(updates) < len(body) or len(masks) != 1 or not set().union(*map(_names, updates)) <= values.keys():
        return other
    mask, change = values.get(masks.pop()), _Substitution(values)
    if not isinstance(mask, ast.Name):
        return other
    own = [[change.visit(copy.deepcopy(part)) for part in update.arguments] for update in updates]
    return _Updates(statement, mask.id, own, called.func)


def _names(update: _Update) -> set[str]:
    nodes = [node for part in update.arguments for node in ast.walk(part)]
    return {node.id for node in nodes if isinstance(node, ast.Name)}


def _is_value(expression: ast.expr) -> bool:
    """Return whether an expression is a variable, its attribute or item, or a constant: it may be read twice."""
    match expression:
        case ast.Name() | ast.Constant():
            return True
        case ast.Attribute(value) | ast.Subscript(value, ast.Constant()):
            return _is_value(value)
    return False


class VisibleIndices(Change):
    """Replace `(radii > 0).nonzero()` in the results of a renderer, which does not use them itself."""

    def visit_Dict(self, node: ast.Dict) -> ast.AST:
        """Return the node with another value of `KEY`."""
        self.generic_visit(node)
        for position, item in enumerate(zip(node.keys, node.values, strict=True)):
            match item:
                case (
                    ast.Constant(str(key)),
                    ast.Call(
                        ast.Attribute(ast.Compare(ast.Name() as radii, [ast.Gt()], [ast.Constant(0)]), "nonzero"),
                        [],
                        [],
                    ) as indices,
                ) if key == KEY:
                    self.changes += 1
                    node.values[position] = ast.copy_location(call(VISIBLE, radii), indices)
        return node


def _update(statement: ast.stmt) -> _Update | None:
    match statement:
        case ast.Assign(
            targets=[ast.Subscript(target, ast.Name(mask)) as rows],
            value=ast.Call(ast.Attribute(ast.Name("torch"), function), [one, other], []),
        ) if function in LARGEST:
            value = next((new for old, new in ((one, other), (other, one)) if _is_same(rows, old)), None)
            takes_largest = True
        case ast.AugAssign(target=ast.Subscript(target, ast.Name(mask)), op=ast.Add(), value=value):
            takes_largest = False
        case _:
            return None
    source = _source(value, mask)
    if source is None or not _is_plain(target, mask):
        return None
    return _Update(mask, (target, ast.Constant(takes_largest), *source))


def _is_same(stored: ast.Subscript, loaded: ast.expr) -> bool:
    return ast.unparse(stored) == ast.unparse(loaded)


def _source(value: ast.expr | None, mask: str) -> tuple[ast.expr, ast.expr, ast.expr] | None:
    """Return the source, columns and factor of an update by a value; None for other values."""
    nothing = ast.Constant(None)
    match value:
        case ast.Constant(int() | float()):
            return value, nothing, nothing
        case ast.BinOp(norm, ast.Mult(), ast.Subscript(factor, ast.Name(index))) if index == mask:
            source = _rows(norm, mask)
            return (*source, factor) if source is not None and _is_plain(factor, mask) else None
    source = _rows(value, mask)
    return None if source is None else (*source, nothing)


def _rows(value: ast.expr | None, mask: str) -> tuple[ast.expr, ast.expr] | None:
    """Return the source and columns of `source[mask]` or `torch.norm(source[mask, a:b], dim=-1, keepdim=True)`."""
    match value:
        case ast.Subscript(source, ast.Name(index)) if index == mask and _is_plain(source, mask):
            return source, ast.Constant(None)
        case ast.Call(
            ast.Attribute(ast.Name("torch"), "norm"),
            [ast.Subscript(source, ast.Tuple([ast.Name(index), ast.Slice(first, last, None)]))],
            keywords,
        ) if index == mask and _is_plain(source, mask):
            options = sorted((str(option.arg), ast.unparse(option.value)) for option in keywords)
            bounds = [ast.Constant(None) if bound is None else bound for bound in (first, last)]
            if options == [("dim", "-1"), ("keepdim", "True")] and all(isinstance(b, ast.Constant) for b in bounds):
                return source, ast.Tuple(bounds, ast.Load())
    return None


def _is_plain(expression: ast.expr, mask: str) -> bool:
    """Return whether an expression is another variable than the mask, or an attribute of one."""
    while isinstance(expression, ast.Attribute):
        expression = expression.value
    return isinstance(expression, ast.Name) and expression.id != mask


def only_updates_by(function: ast.FunctionDef, mask: str, methods: Mapping[str, ast.FunctionDef] | None = None) -> bool:
    """Return whether a function uses a variable for nothing but updates of its rows.

    Args:
        function: a tree, not changed yet.
        mask: the variable.
        methods: of the model, that the function may give the variable to, by name.
    """
    nodes = list(ast.walk(function))
    uses = {node for node in nodes if isinstance(node, ast.Name) and node.id == mask and isinstance(node.ctx, ast.Load)}
    for node in nodes:
        if isinstance(node, ast.stmt) and (update := _update(node)) is not None and update.mask == mask:
            uses -= set(ast.walk(node))
        elif isinstance(node, ast.Call):
            uses -= {argument for argument in node.args if _is_only_updated_by(node, argument, methods or {})}
    return not uses


def _is_only_updated_by(node: ast.Call, argument: ast.expr, methods: Mapping[str, ast.FunctionDef]) -> bool:
    """Return whether a method that is called with an argument uses it for nothing but updates of its rows."""
    method = methods.get(node.func.attr) if isinstance(node.func, ast.Attribute) else None
    position = node.args.index(argument) + 1  # after self
    if method is None or position >= len(method.args.args) or any(isinstance(a, ast.Starred) for a in node.args):
        return False
    return only_updates_by(method, method.args.args[position].arg)


def keeps_masks(function: ast.FunctionDef, renderers: Collection[str], methods: Mapping[str, ast.FunctionDef]) -> bool:
    """Return whether a function uses the indices of its renders for nothing but updates of their rows, or not at all.

    Args:
        function: its tree, not changed yet.
        renderers: names of the functions that return the indices, as `KEY` of their results.
        methods: of the model, by name.
    """
    nodes = list(ast.walk(function))
    parents = {child: node for node in nodes for child in ast.iter_child_nodes(node)}
    if not all(_is_called_by_name(node, parents) for node in nodes if _name_of(node) in renderers):
        return False
    results = set()
    for node in nodes:
        if isinstance(node, ast.Call) and _name_of(node.func) in renderers:
            match parents[node]:
                case ast.Assign(targets=[ast.Name(name)]):
                    results.add(name)
                case ast.Subscript(slice=ast.Constant(str(key))) if key != KEY:
                    pass
                case _:
                    return False
    masks = set()
    for node in nodes:
        if isinstance(node, ast.Name) and node.id in results and isinstance(node.ctx, ast.Load):
            match parents[node]:
                case ast.Subscript(value, ast.Constant(str(key)), ast.Load()) as item if value is node:
                    if key == KEY:
                        masks.add(_variable(item, parents))
                case _:
                    return False
    return all(mask is not None and only_updates_by(function, mask, methods) for mask in masks)


def _name_of(node: ast.AST) -> str | None:
    """Return the name of a variable or an attribute; None for other nodes."""
    return getattr(node, "id", getattr(node, "attr", None))


def _is_called_by_name(renderer: ast.AST, parents: Mapping[ast.AST, ast.AST]) -> bool:
    """Return whether a function calls a renderer where it names it, or gives it to another function, which calls it."""
    parent = parents[renderer]
    if isinstance(parent, ast.keyword):
        parent = parents[parent]
    if not isinstance(parent, ast.Call):
        return False
    return parent.func is renderer or _name_of(parent.func) not in CALLERS


def _variable(value: ast.expr, parents: Mapping[ast.AST, ast.AST]) -> str | None:
    """Return the variable that a value is assigned to, by itself or among others."""
    parent = parents[value]
    match parent:
        case ast.Assign(targets=[ast.Name(name)]):
            return name
        case ast.Tuple(values):
            match parents[parent]:
                case ast.Assign(targets=[ast.Tuple(targets)]) if len(targets) == len(values):
                    target = targets[values.index(value)]
                    return target.id if isinstance(target, ast.Name) else None
    return None
