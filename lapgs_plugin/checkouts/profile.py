"""Find the objects of a checkout whose definitions have been executed: its classes, its renderers, its rasterizers.

They are found by what they do, and replaced wherever the checkout holds them, by identity. So names may differ.
"""

from __future__ import annotations

import ast
import dis
import importlib
import inspect
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

from lapgs_plugin.checkouts.rasterizer_uses import RasterizerUse
from lapgs_plugin.checkouts.script import Script
from lapgs_plugin.checkouts.source import MODEL_ROLES, OTHERWISE, SCENE_ROLES, CheckoutSource
from lapgs_plugin.checkouts.syntax import called_name, plain_assignments
from lapgs_plugin.errors import UserInputError, typed_line

CAMERA_ROLES = {"world_view_transform", "image_name"}
"""Attributes that a camera with an image sets when it is made; a viewer's cameras have no image."""

COUNT_CHANGES = ("prune_points", "densification_postfix")
"""Methods of every model of the family through which Gaussians are removed and added."""

OPACITY_RESET = "reset_opacity"
"""Method of the family's models that is density control and can be skipped by itself."""

BACKGROUND_WORDS = {"bg", "background"}
TRAINING_WORDS = {"train", "training"}


@dataclass(frozen=True)
class BoundRasterizer:
    """Hold the objects of a rasterizer that a checkout uses.

    Attributes:
        use: how it uses them.
        module: the rasterizer's module.
        settings: names of its settings' classes in the module.
        entries: names of its classes and functions that render.
    """

    use: RasterizerUse
    module: ModuleType
    settings: tuple[str, ...]
    entries: tuple[str, ...]


class Profile:
    """Describe a loaded checkout.

    Args:
        script: its training script, whose definitions have been executed, and none of whose symbols are replaced.

    Attributes:
        source: what its sources say.
        model: class of the Gaussians; `choose_model` finds out which it is where the script does not name it.
        scene: class of the scene, which has the cameras.
        cameras: classes of cameras that have an image.
        training: the script's function that trains.
        renderers: functions that rasterize. A view is recognised when one of them is called with it.
        rasterizers: those that can be imported, that of the training loop first.

    Raises:
        UserInputError: it is no 3DGS checkout; the line says what is missing and where it was expected.
        ImportError: the rasterizer of the training loop cannot be imported.
    """

    def __init__(self, script: Script) -> None:
        self.script = script
        self.source = CheckoutSource.read(script.path)
        self.model = self._find_model()
        self.scene = self._find_scene()
        makers = [(kind, vars(kind).get("__init__")) for kind in self._classes()]
        self.cameras = tuple(kind for kind, make in makers if _attributes_set(make) >= CAMERA_ROLES)
        self.training: Callable[..., Any] = vars(script.module)[self.source.training.name]
        self.renderers = tuple(self._find_renderers())
        self._model_call = self._first_call(self.script_names(self.model))
        self._scene_call = self._first_call(self.script_names(self.scene))
        self._loop_call = self._first_call({n for f in self.renderers for n in (*self.script_names(f), f.__name__)})
        self.loop_renderer = self._find_loop_renderer()
        self.rasterizers = tuple(self._find_rasterizers())

    @property
    def density_control(self) -> tuple[str, ...]:
        """Names of the model's methods that add, remove or reset Gaussians, directly or through others."""
        return tuple(sorted(_changing(self.model)))

    def choose_model(self, model: type) -> None:
        """Note which class the script makes its model of."""
        self.model = model
        chosen = next(
            (candidate for candidate in self.source.models if candidate[0] == model.__name__), self.source.model
        )
        self.source = replace(self.source, model=chosen)

    @property
    def modules(self) -> list[ModuleType]:
        """Modules of the checkout that are imported, the script first."""
        packages = {name.partition(".")[0] for name in self.source.modules} - {"__main__"}
        others = [module for name, module in sys.modules.items() if name.partition(".")[0] in packages]
        return [self.script.module, *(module for module in others if isinstance(module, ModuleType))]

    def holders(self, value: Any) -> list[tuple[ModuleType, str]]:
        """Return modules of the checkout, each with a name, that hold an object."""
        return [(module, name) for module in self.modules for name, held in held_by(module) if held is value]

    def named(self, names: Iterable[str]) -> list[tuple[ModuleType, str]]:
        """Return modules of the checkout, each with a name of these that it holds."""
        return [(module, name) for name in names for module in self.modules if name in vars(module)]

    def script_names(self, value: Any) -> set[str]:
        """Return the names by which the script knows an object."""
        return {name for name, held in held_by(self.script.module) if held is value}

    def rasterizer_holders(self, rasterizer: BoundRasterizer, name: str) -> list[tuple[ModuleType, str]]:
        """Return modules in which the checkout looks up a name of a rasterizer's module, each with the name there."""
        use = rasterizer.use
        holders = self.holders(vars(rasterizer.module)[name])
        if use.inside:  # an import in a function looks the name up in the rasterizer's module at each call
            holders.append((rasterizer.module, name))
        holder = self._holder(use)
        if holder is None or name not in vars(holder) or (holder, name) in holders:
            return holders
        # Something that wraps it, unless another rasterizer has the same name and this one is imported in a function.
        others = [vars(other.module).get(name) for other in self.rasterizers if other.module is not rasterizer.module]
        return holders if any(vars(holder)[name] is other for other in others) else [*holders, (holder, name)]

    def make_model(self, values: Mapping[str, Any]) -> Any:
        """Return a model, made with the arguments that the script gives, or by its statements if it names no class.

        Args:
            values: arguments of the training function by parameter name.

        Raises:
            UserInputError: the statements fail outside of the training loop, or make something else.
        """
        if self._model_call is not None and len(self.source.models) == 1:
            return self._call(self.model, self._model_call, values, {})
        statements, name = self.source.model_statements, self.source.model_variable
        if not statements:
            return self._call(self.model, self._model_call, values, {})
        names, where = {**vars(self.script.module), **values}, self.source.location(statements[-1])
        try:
            exec(compile(ast.Module(statements, []), str(self.script.path), "exec", dont_inherit=True), names)
        except Exception as error:  # the statements need something that exists in the loop only
            raise UserInputError(
                f"{where}: {name} cannot be made outside of the training loop ({typed_line(error)}), expected "
                f"statements that take the arguments of {self.source.training.name}(); {OTHERWISE}"
            ) from error
        if not all(hasattr(names[name], role) for role in MODEL_ROLES):
            raise UserInputError(
                f"{where}: {name} is a {type(names[name]).__name__}, expected Gaussians with "
                f"{' and '.join(MODEL_ROLES)}; {OTHERWISE}"
            )
        return names[name]

    def make_scene(self, values: Mapping[str, Any], model: Any) -> Any:
        """Return a scene, made with the arguments that the script gives.

        Args:
            values: arguments of the training function by parameter name.
            model: takes the place of the Gaussians.
        """
        if self._scene_call is None:
            raise UserInputError(
                f"{self._training_place}() makes no {self.scene.__name__}, expected a scene of its own; {OTHERWISE}"
            )
        return self._call(self.scene, self._scene_call, {**values, self.source.model_variable: model}, {})

    def render(self, values: Mapping[str, Any], view: Any, model: Any, background: Any, **options: Any) -> Any:
        """Render a view as the training loop does, and return what its function returns.

        Arguments that depend on the loop's state, such as the size of a photo, have their defaults. Flags of training,
        with which a fork leaves Gaussians out at random, are off.

        Args:
            values: arguments of the training function by parameter name.
            view: the camera.
            model: the Gaussians.
            background: (3,) behind them.
            options: arguments to pass whatever the loop passes; those that the function does not take are left out.

        Raises:
            UserInputError: the loop calls no function that rasterizes, or one that needs more than can be known here.
        """
        renderer = self.loop_renderer
        if renderer is None:
            names = ", ".join(function.__name__ for function in self.renderers) or "no function of the checkout"
            raise UserInputError(
                f"{self._training_place}() calls no function that rasterizes ({names} does), expected a call that "
                f"renders a view; {OTHERWISE}"
            )
        first, second, *others = _parameters(renderer)
        named = {name: background for name in others if BACKGROUND_WORDS & _words(name)}
        named |= {name: False for name in others if self._is_training_flag(name, values)}
        named |= {first: view, second: model} | {name: value for name, value in options.items() if name in others}
        # Looked up at each call: it may be replaced meanwhile.
        function = vars(sys.modules[renderer.__module__])[renderer.__name__]
        return self._call(function, self._loop_call, values, named)

    def loop_argument(self, name: str, values: Mapping[str, Any]) -> Any:
        """Return the value of a keyword in the loop's call that renders; None if there is none, or it is unknown here.

        Args:
            name: the keyword.
            values: arguments of the training function by parameter name.
        """
        words = [] if self._loop_call is None else self._loop_call.keywords
        try:
            return next((self._evaluated(word.value, values) for word in words if word.arg == name), None)
        except Exception:  # it depends on the state of the loop
            return None

    def _is_training_flag(self, name: str, values: Mapping[str, Any]) -> bool:
        """Return whether a parameter of the loop's renderer says that the image is trained on."""
        assert self.loop_renderer is not None, "asked of its parameters"
        if not TRAINING_WORDS & _words(name):
            return False
        default = _parameters(self.loop_renderer)[name].default
        return isinstance(default if isinstance(default, bool) else self.loop_argument(name, values), bool)

    @property
    def _training_place(self) -> str:
        return f"{self.source.location(self.source.training)}: {self.source.training.name}"

    def _find_model(self) -> type:
        name, where = self.source.model
        for kind in self._classes():
            if kind.__name__ == name and all(hasattr(kind, role) for role in MODEL_ROLES):
                return kind
        raise UserInputError(
            f"{name} in {where} has no {' and '.join(MODEL_ROLES)}, expected of the class of the Gaussians; {OTHERWISE}"
        )

    def _find_scene(self) -> type:
        for kind in self._classes():
            if all(hasattr(kind, role) for role in SCENE_ROLES):
                return kind
        raise UserInputError(
            f"{self.script.path} imports no class with {' and '.join(SCENE_ROLES)}, expected of a scene; {OTHERWISE}"
        )

    def _holder(self, use: RasterizerUse) -> ModuleType | None:
        """Return the module that imports a rasterizer; None if it is not imported itself."""
        return self.script.module if use.holder == "__main__" else sys.modules.get(use.holder)

    def _find_renderers(self) -> Iterator[FunctionType]:
        for use in self.source.rasterizers:
            holder = self._holder(use)
            for name in use.functions:
                if isinstance(function := getattr(holder, name, None), FunctionType):
                    yield function

    def _find_loop_renderer(self) -> FunctionType | None:
        """Return the function that the training loop renders with."""
        if self._loop_call is None:
            return None
        name = called_name(self._loop_call)
        held = vars(self.script.module).get(name)
        return next((renderer for renderer in self.renderers if renderer is held or renderer.__name__ == name), None)

    def _find_rasterizers(self) -> Iterator[BoundRasterizer]:
        name = None if self.loop_renderer is None else self.loop_renderer.__name__
        for use in sorted(self.source.rasterizers, key=lambda use: name not in use.functions):
            try:
                module = importlib.import_module(use.module)
            except ImportError:
                if not use.inside or name in use.functions:
                    raise
                continue  # imported in a function that the loop does not call
            there = [name for name in use.names if hasattr(module, name)]
            settings = tuple(name for name in there if "setting" in name.lower())
            yield BoundRasterizer(use, module, settings, tuple(name for name in there if name not in settings))

    def _classes(self) -> list[type]:
        """Return the classes of the checkout."""
        names = {module.__name__ for module in self.modules}
        held = [value for module in self.modules for _, value in held_by(module) if isinstance(value, type)]
        return list(dict.fromkeys(value for value in held if value.__module__ in names))

    def _first_call(self, names: Container[str]) -> ast.Call | None:
        """Return the training function's first call of one of these names, if possible one that gradients come from.

        A loop's calls for a viewer are in a `try`, those for scores in a `with torch.no_grad()`.
        """
        nodes = list(ast.walk(self.source.training))
        beside = [node for node in nodes if isinstance(node, ast.Try) or _records_no_gradients(node)]
        tried = {id(inner) for node in beside for inner in ast.walk(node)}
        calls = [node for node in nodes if isinstance(node, ast.Call) and called_name(node) in names]
        return min(calls, key=lambda call: (id(call) in tried, call.lineno), default=None)

    def _call(
        self,
        function: Callable[..., Any],
        call: ast.Call | None,
        values: Mapping[str, Any],
        fixed: Mapping[str, Any],
    ) -> Any:
        """Call a function with the arguments of a call in the script, as far as they can be evaluated outside of it."""
        parameters = _parameters(function)
        written: dict[str, ast.expr] = {}
        if call is not None:
            written |= dict(zip(parameters, call.args, strict=False))
            written |= {word.arg: word.value for word in call.keywords if word.arg is not None}
        arguments = dict(fixed)
        for name, expression in written.items():
            if name in fixed:
                continue
            try:
                arguments[name] = self._evaluated(expression, values)
            except Exception as error:  # the expression needs something that exists in the loop only
                if name not in parameters or parameters[name].default is inspect.Parameter.empty:
                    raise UserInputError(
                        f"{self.source.location(expression)}: {ast.unparse(expression)}, the {name} of "
                        f"{getattr(function, '__name__', function)}(), is known inside of the training loop only "
                        f"({type(error).__name__}), and has no default; {OTHERWISE}"
                    ) from error
        return function(**arguments)

    def _evaluated(self, expression: ast.expr, values: Mapping[str, Any]) -> Any:
        code = _compiled(expression, str(self.script.path))
        try:
            return eval(code, vars(self.script.module), dict(values))
        except NameError:
            return eval(code, vars(self.script.module), self._with_locals(values))

    def _with_locals(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return arguments of the training function with the local variables that it sets plainly before its loop."""
        names = dict(values)
        for code in _compiled_assignments(self.source.training, str(self.script.path)):
            with suppress(Exception):  # it needs something that exists in the loop only
                exec(code, vars(self.script.module), names)
        return names


def held_by(module: ModuleType) -> list[tuple[str, Any]]:
    """Return the names of a module with their values, as a copy: to look at a value may add names to a lazy module."""
    return list(vars(module).items())


def _changing(model: type) -> set[str]:
    """Return the names of a model's methods that add, remove or reset Gaussians."""
    methods = {n: _names(value) for n, value in inspect.getmembers(model, inspect.isfunction) if not n.startswith("__")}
    changing = set(COUNT_CHANGES) & methods.keys()
    while more := {name for name, used in methods.items() if used & changing} - changing:
        changing |= more
    return changing | ({OPACITY_RESET} & methods.keys())


def _names(function: Any) -> set[str]:
    """Return the names of attributes and globals that a function uses, none for anything else."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return set() if code is None else set(code.co_names)


def _attributes_set(function: Any) -> set[str]:
    """Return the names of attributes that a function sets, none for anything else."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    instructions = () if code is None else dis.get_instructions(code)
    return {instruction.argval for instruction in instructions if instruction.opname == "STORE_ATTR"}


def _records_no_gradients(node: ast.AST) -> bool:
    """Return whether a node is a `with torch.no_grad():`."""
    if not isinstance(node, ast.With):
        return False
    calls = [item.context_expr for item in node.items if isinstance(item.context_expr, ast.Call)]
    return any(called_name(call) == "no_grad" for call in calls)


# All of these are asked for in every iteration of joint training.


@lru_cache(maxsize=256)
def _words(name: str) -> frozenset[str]:
    """Return the words that a name consists of."""
    return frozenset(name.split("_"))


@lru_cache(maxsize=64)
def _compiled(expression: ast.expr, path: str) -> CodeType:
    return compile(ast.Expression(expression), path, "eval", dont_inherit=True)


@lru_cache(maxsize=64)
def _compiled_assignments(function: ast.FunctionDef, path: str) -> list[CodeType]:
    """Return the code of each statement of `plain_assignments`."""
    statements = plain_assignments(function)
    return [compile(ast.Module([statement], []), path, "exec", dont_inherit=True) for statement in statements]


@lru_cache(maxsize=64)
def _parameters(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(function).parameters
