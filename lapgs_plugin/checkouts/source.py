"""Read the syntax trees of a checkout: its root, its model class, its rasterizers, its training function.

Nothing is executed, so a checkout can be described before its packages are installed. Imports no torch.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from lapgs_plugin.checkouts.conditions import Branches, default_options
from lapgs_plugin.checkouts.other_trainers import advice_for
from lapgs_plugin.checkouts.rasterizer_uses import RasterizerUse, uses_of_rasterizers
from lapgs_plugin.checkouts.syntax import (
    called_methods,
    called_name,
    called_names,
    executed_on_import,
    file_of_script,
    location,
    parsed,
    parsed_quietly,
    stored_names,
)
from lapgs_plugin.checkouts.training_call import NEEDED, ROLES, lacks_role
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import as_pip_argument

SETUP = "training_setup"
"""Method of the Gaussians that makes their optimizer."""

MODEL_ROLES = ("get_xyz", SETUP)
"""Methods by which the class of the Gaussians is recognised."""

SCENE_ROLES = ("getTrainCameras", "getTestCameras")
"""Methods by which the class of a scene is recognised."""

START = "create_from_pcd"
"""Method of the family's models that makes Gaussians of a scene's points."""

FROM_RUN = "load_iteration"
"""Argument of the family's scenes that says which finished model they read."""

SCALES = re.compile(r"\w*scal.*\.repeat\(1, ([0-9])\).*", re.DOTALL)
"""Statement by which models of the family give a point one scale along each of its axes."""

SCENE_SCALES = "resolution_scales"
"""Argument of the family's scenes that says at which scales they hold images."""

FOLDERS_UP = 3
"""How far above a script the root of its checkout is searched."""

OTHERWISE = "`lapgs run --off` runs the script as it is, `lapgs train` trains the scene without a checkout"


@dataclass(frozen=True)
class External:
    """Name a module that the checkout imports and does not contain.

    Attributes:
        name: full name of the module.
        names: names that are imported from it.
        where: file and line of its import.
        optional: whether the import may fail or be left out: in a `try`, in a branch, or in a function.
    """

    name: str
    names: tuple[str, ...]
    where: str
    optional: bool


@dataclass(frozen=True)
class OwnPackage:
    """Name a package that a checkout brings to be installed.

    Attributes:
        folder: folder of its setup.py.
        needs_cuda: whether it is compiled for CUDA.
    """

    folder: Path
    needs_cuda: bool

    @property
    def install(self) -> str:
        """The command that installs it."""
        # A build of its own would not find the PyTorch that it is compiled for.
        return f"pip install {'--no-build-isolation ' * self.needs_cuda}{as_pip_argument(self.folder)}"


@dataclass(frozen=True)
class CheckoutSource:
    """Describe a checkout by its sources.

    Attributes:
        script: absolute path of the training script.
        root: folder of the checkout; the script may lie in a folder below it.
        modules: files of the checkout's modules that the script imports, directly or not.
        externals: modules that these import from elsewhere.
        model: class of the Gaussians, and its file and line: the first of `models` where the sources do not tell it.
        models: classes that the script may make its model of, as `model`.
        rasterizers: how rasterizers are used.
        training: the script's function that trains.
    """

    script: Path
    root: Path
    modules: Mapping[str, Path]
    externals: tuple[External, ...]
    model: tuple[str, str]
    models: tuple[tuple[str, str], ...]
    rasterizers: tuple[RasterizerUse, ...]
    training: ast.FunctionDef = field(repr=False)

    @classmethod
    def read(cls, script: Path) -> CheckoutSource:
        """Read the sources that a training script imports; again only if a file or folder of theirs has changed.

        Raises:
            UserInputError: it is not Python, or not the training script of a 3DGS checkout; the line says what is
                missing.
        """
        typed, script = script, file_of_script(script)
        known, changed = _READ.get(script, (None, {}))
        if known is not None and _times(changed) == changed:
            return known
        source = cls._read(script, typed)
        files = {script, *source.modules.values()}
        _READ[script] = source, _times({*files, *(file.parent for file in files)})
        return source

    @classmethod
    def _read(cls, script: Path, typed: Path) -> CheckoutSource:
        tree = parsed(script)
        near, training = "", _find_training(tree)
        for root in (script.parent, *script.parent.parents[:FOLDERS_UP]):
            modules = dict(_reachable(script, (script.parent, root)))
            models, close = _find_models(modules, root)
            near = near or close
            if models:
                break
        else:
            raise UserInputError(
                f"{typed} is not the training script of a 3DGS checkout: {near or 'none of its imports'} has a class "
                f"with {' and '.join(MODEL_ROLES)}; {advice_for(_packages(tree, script))}"
            )
        if training is None:
            raise UserInputError(
                f"{typed} has no function that its main block calls and that calls backward(), expected a function "
                f"like training(dataset, opt, pipe, ...); {advice_for(_packages(tree, script))}"
            )
        uses = tuple(use for name, path in modules.items() for use in uses_of_rasterizers(name, path, root, modules))
        needed = {name for name, _ in _reachable(script, (script.parent, root), surely=True)}
        externals = tuple(_externals(modules, root, needed))
        # One that the script makes, if it names any; others may be their bases.
        called = (
            {*called_names(nodes), *called_methods(nodes)} for nodes in map(list, map(ast.walk, (training, tree)))
        )
        named = ([model for model in models if model[0] in names] for names in called)
        models = next(filter(None, named), models)
        return cls(script, root, modules, externals, models[0], tuple(models), uses, training)

    def location(self, node: ast.AST) -> str:
        """Return the file and line of a node of the script."""
        return f"{self.script.relative_to(self.root)}:{getattr(node, 'lineno', 0)}"

    @property
    def model_variable(self) -> str:
        """Name of the training function's variable for the model."""
        set_up, assigned, models = list[str](), list[str](), dict(self.models)
        for node in sorted(ast.walk(self.training), key=lambda node: getattr(node, "lineno", 0)):
            if isinstance(node, ast.Attribute) and node.attr == SETUP and isinstance(node.value, ast.Name):
                set_up.append(node.value.id)
            elif (
                isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and called_name(node.value) in models
            ):
                assigned += [target.id for target in node.targets if isinstance(target, ast.Name)]
        return next((name for name in set_up if name in assigned), next(iter((*assigned, *set_up)), "gaussians"))

    @property
    def model_statements(self) -> list[ast.stmt]:
        """Statements of the training function that make the model before it is set up, and what they need."""
        body, names, kept = self.training.body, {self.model_variable}, list[ast.stmt]()
        ends = (i for i, node in enumerate(body) if SETUP in called_methods(ast.walk(node)))
        for node in reversed(body[: next(ends, 0)]):
            if names & stored_names(node):
                kept.insert(0, node)
                names |= {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
        return kept

    @property
    def scale_axes(self) -> tuple[int, str] | None:
        """Number of scales that the model gives each point, and the place where; None if its sources do not say."""
        for path in self.modules.values():
            classes = (node for node in parsed_quietly(path).body if isinstance(node, ast.ClassDef))
            models = (node for node in classes if node.name == self.model[0])
            for node in (
                statement for model in models for statement in ast.walk(model) if isinstance(statement, ast.Assign)
            ):
                if scales := SCALES.fullmatch(ast.unparse(node)):
                    return int(scales[1]), location(path, self.root, node.lineno)
        return None

    @property
    def image_scales(self) -> tuple[str, str] | None:
        """Scales at which the training function asks its scene for images, and the place; None if it asks for one."""
        calls = (node for node in ast.walk(self.training) if isinstance(node, ast.Call))
        for value in (keyword.value for call in calls for keyword in call.keywords if keyword.arg == SCENE_SCALES):
            if isinstance(value, (ast.List, ast.Tuple)) and len(value.elts) > 1:
                return ", ".join(map(ast.unparse, value.elts)), self.location(value)
        return None

    def hindrance(self, parameters: Collection[str]) -> str | None:
        """Return why no level can be trained; None if the sources do not say.

        Args:
            parameters: attributes of the model that a field is archived from.
        """
        if absent := self.unknown_attributes(parameters):
            return f"its Gaussians ({self.model[1]}) have no {', '.join(absent)}, from which fields are archived"
        if (several := self.image_scales) is not None:
            return f"its scene has images at the scales {several[0]} ({several[1]}), and levels have sizes of their own"
        arguments = [argument.arg for argument in self.training.args.args]
        if role := next((role for role in NEEDED if self._is_nested(role, arguments)), None):
            return lacks_role(self.training.name, arguments, role)
        return self.of_finished_model or self._explain_frozen_model(parameters)

    @cached_property
    def of_finished_model(self) -> str | None:
        """How the training function takes Gaussians from elsewhere than a scene's points; None if it does not.

        A script that trains segmentations, features or trees on a finished model is one.
        """
        functions = [node for node in self._nodes() if isinstance(node, ast.FunctionDef)]
        callers = (node for node in functions if node.name != "restore")  # of a checkpoint
        if not any(SETUP in called_methods(ast.walk(node)) for node in callers):
            return f"it trains something else than {self.model[0]}: {self.location(self.training)} calls no {SETUP}"
        classes = self.classes
        for node in (call for call in ast.walk(self.training) if isinstance(call, ast.Call)):
            name = called_name(node)
            methods = methods_of(classes[name], classes)[0] if name in classes else {}
            if "__init__" not in methods or not methods.keys() >= set(SCENE_ROLES):
                continue
            constructor, known = methods["__init__"], self.branches.arguments(methods["__init__"], node)
            possible = called_methods(self.branches.executed(constructor, known, surely=False))
            if known.get(FROM_RUN) or (START in called_methods(ast.walk(constructor)) and START not in possible):
                return f"it trains on a finished model: {self.location(node)}: {ast.unparse(node)} makes none of points"
        return None

    def _explain_frozen_model(self, parameters: Collection[str]) -> str | None:
        """Return what the model's optimizer steps by default, if that is none of `parameters`; else None."""
        setup = methods_of(self.classes[self.model[0]], self.classes)[0].get(SETUP)
        if setup is None or not parameters or "super" in called_names(ast.walk(setup)):
            return None
        nodes = self.branches.executed(setup, {}, surely=False)
        groups = [node for node in nodes if isinstance(node, ast.Dict)]
        values = [v for group in groups for k, v in zip(group.keys, group.values, strict=True) if _is(k, "params")]
        stepped = {node.attr for value in values for node in ast.walk(value) if isinstance(node, ast.Attribute)}
        if not stepped or stepped.intersection(parameters):
            return None
        names = ", ".join(sorted(stepped))
        return f"it trains on a finished model: by default its optimizer ({self.model[1]}) steps {names} alone"

    @cached_property
    def branches(self) -> Branches:
        """What its functions execute by default."""
        return Branches(default_options(map(parsed_quietly, self.modules.values())))

    def _is_nested(self, role: str, parameters: Collection[str]) -> bool:
        """Return whether only parts of arguments have a role: training reads `cfg.opt.iterations`, no `opt.iterations`.

        Args:
            role: of `training_call.ROLES`.
            parameters: of the training function.
        """
        nodes = (attribute for attribute in ast.walk(self.training) if isinstance(attribute, ast.Attribute))
        holders = [ast.unparse(attribute.value).split(".") for attribute in nodes if attribute.attr in ROLES[role]]
        depths = [len(names) for names in holders if names[0] in parameters]
        return min(depths, default=1) > 1

    def unknown_attributes(self, names: Iterable[str]) -> list[str]:
        """Return those of these attributes that no module of the checkout has; none if the model has foreign bases."""
        classes = self.classes
        if not methods_of(classes[self.model[0]], classes)[1]:
            return []
        known = self.attributes
        return [name for name in names if name not in known]

    @cached_property
    def classes(self) -> dict[str, ast.ClassDef]:
        """Classes of its modules by name."""
        trees = [parsed_quietly(path) for path in self.modules.values()]
        return {node.name: node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)}

    @property
    def attributes(self) -> set[str]:
        """Names of attributes that its modules set or read."""
        return {node.attr for node in self._nodes() if isinstance(node, ast.Attribute)}

    def _nodes(self) -> Iterator[ast.AST]:
        """Yield every node of its modules."""
        return (node for path in self.modules.values() for node in ast.walk(parsed_quietly(path)))

    def unpacks(self, function: str) -> bool:
        """Return whether the checkout unpacks what a function of that name returns, or takes one of its results."""
        for node in self._nodes():
            if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
                call = node.value if isinstance(node.slice.value, int) else None
            else:
                call = node.value if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple) else None
            if isinstance(call, ast.Call) and ast.unparse(call.func) == function:
                return True
        return False

    def own_package(self, package: str) -> OwnPackage | None:
        """Return the folder of the checkout that a package is installed from; None if there is none."""
        for setup in sorted([*self.root.glob("*/setup.py"), *self.root.glob("*/*/setup.py")]):
            text = setup.read_text(encoding="utf-8", errors="replace")
            if (setup.parent / package).is_dir() or re.search(rf"""["']{re.escape(package)}["'.]""", text):
                return OwnPackage(setup.parent, "CUDAExtension" in text)
        return None

    @property
    def rasterizer_modules(self) -> tuple[str, ...]:
        """Modules of rasterizers, in the order in which they are imported."""
        return tuple(dict.fromkeys(use.module for use in self.rasterizers))


_READ: dict[Path, tuple[CheckoutSource, dict[Path, int]]] = {}
"""Sources by script, with the times at which their files and folders had changed: experiments read one many times."""


def _times(paths: Iterable[Path]) -> dict[Path, int]:
    """Return the times of the last changes of paths that exist."""
    return {path: path.stat().st_mtime_ns for path in paths if path.exists()}


def training_scripts(folder: Path) -> list[Path]:
    """Return files of a folder, and of the folders in it, that may be training scripts: `train.py` first."""
    scripts = [*folder.glob("train*.py"), *folder.glob("*/train*.py")]
    return sorted(scripts, key=lambda path: (len(path.parts), path.name != "train.py", path))


def readable_sources(folder: Path) -> tuple[list[CheckoutSource], list[UserInputError]]:
    """Return the sources of a folder's training scripts that are ones of 3DGS, and why others are not.

    Those that train on a finished model come last.
    """
    sources, problems = list[CheckoutSource](), list[UserInputError]()
    for script in training_scripts(folder):
        try:
            sources.append(CheckoutSource.read(script))
        except UserInputError as error:
            problems.append(error)
    return sorted(sources, key=lambda source: source.of_finished_model is not None), problems


def readable_source(folder: Path) -> CheckoutSource | None:
    """Return the sources of a folder's first training script that is one of 3DGS; None if there is none."""
    sources, _ = readable_sources(folder)
    return next((source for source in sources if source.root == folder.absolute()), None)


def _reachable(script: Path, folders: tuple[Path, ...], *, surely: bool = False) -> Iterator[tuple[str, Path]]:
    """Yield the checkout's modules that a script imports, the script itself first, with their files.

    With `surely`, those that it imports whichever way branches go.
    """
    waiting, seen = [("__main__", script)], {"__main__"}
    while waiting:
        name, path = waiting.pop(0)
        yield name, path
        tree = parsed_quietly(path)
        for node in executed_on_import(tree.body, surely=True) if surely else ast.walk(tree):
            for imported in _imported(node, name, path):
                file = _file_of(imported, folders)
                if file is not None and imported not in seen:
                    seen.add(imported)
                    waiting.append((imported, file))


def _imported(node: ast.AST, module: str, path: Path) -> Iterator[str]:
    """Yield full names of modules that an import statement may import, packages before what is in them."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            parts = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
            base = ".".join([*parts[: len(parts) - node.level + 1], *([base] if base else [])])
        names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
    else:
        return
    for name in names:
        parts = name.split(".")
        yield from (".".join(parts[: i + 1]) for i in range(len(parts)))


def _packages(tree: ast.Module, script: Path) -> set[str]:
    """Return the names of packages that a script imports."""
    return {name.partition(".")[0] for node in ast.walk(tree) for name in _imported(node, "__main__", script)}


def _file_of(name: str, folders: Iterable[Path]) -> Path | None:
    for folder in folders:
        base = folder.joinpath(*name.split("."))
        for file in (base / "__init__.py", base.with_suffix(".py")):
            if name and file.is_file():
                return file
    return None


def _find_models(modules: Mapping[str, Path], root: Path) -> tuple[list[tuple[str, str]], str]:
    """Return the names and places of classes of Gaussians, and the place of one that only resembles them."""
    near, models = "", []
    classes = {
        node.name: (node, path)
        for path in modules.values()
        for node in parsed_quietly(path).body
        if isinstance(node, ast.ClassDef)
    }
    nodes = {name: node for name, (node, _) in classes.items()}
    for name, (node, path) in classes.items():
        methods, whole = methods_of(node, nodes)
        if "training_setup" not in methods:
            continue
        where = location(path, root, node.lineno)
        if whole and (lacks := set(MODEL_ROLES) - methods.keys()):
            near = f"{name} in {where} lacks {', '.join(lacks)}, and no other of its imports"
        else:
            models.append((name, where))
    return models, near


def _is(key: ast.expr | None, text: str) -> bool:
    return isinstance(key, ast.Constant) and key.value == text


def methods_of(node: ast.ClassDef, classes: Mapping[str, ast.ClassDef]) -> tuple[dict[str, ast.FunctionDef], bool]:
    """Return the methods of a class by name, with those of its bases, and whether all bases were found."""
    methods, whole = {method.name: method for method in node.body if isinstance(method, ast.FunctionDef)}, True
    for base in node.bases:
        name = base.id if isinstance(base, ast.Name) else base.attr if isinstance(base, ast.Attribute) else ""
        if name in classes and classes[name] is not node:
            more, more_whole = methods_of(classes[name], classes)
            methods, whole = more | methods, whole and more_whole
        else:
            whole = whole and name in ("object", "Module")
    return methods, whole


def _find_training(tree: ast.Module) -> ast.FunctionDef | None:
    """Return the function that the main block calls and that trains."""
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    blocks = [node for node in tree.body if isinstance(node, ast.If)]
    called = [name for block in blocks for name in called_names(ast.walk(block))]
    # Some main blocks call a function that calls the one that trains.
    called += [name for outer in called if outer in functions for name in called_names(ast.walk(functions[outer]))]
    candidates = (functions[name] for name in called if name in functions)
    return next((function for function in candidates if "backward" in called_methods(ast.walk(function))), None)


def _externals(modules: Mapping[str, Path], root: Path, needed: Collection[str]) -> Iterator[External]:
    """Yield imports of modules that are not in the checkout; its own modules `needed` are imported for sure."""
    for module, path in modules.items():
        tree = parsed_quietly(path)
        sure = {id(node) for node in executed_on_import(tree.body, surely=True)} if module in needed else set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                imports: dict[str, tuple[str, ...]] = {alias.name: () for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imports = {node.module: tuple(alias.name for alias in node.names)}
            else:
                continue
            where = location(path, root, node.lineno)
            for imported, names in imports.items():
                own = imported.partition(".")[0] in modules or any(name.startswith(f"{imported}.") for name in modules)
                if imported not in modules and not own:
                    yield External(imported, names, where, id(node) not in sure)
