"""List the methods that are compared, and describe their runs as those of experiments."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lapgs_bench.experiments.checks import OWN_ARGUMENTS, sets_option
from lapgs_bench.experiments.commands import defaults_of, run_steps
from lapgs_bench.experiments.execution import LOGS, RUNS
from lapgs_bench.experiments.expansion import RunSpec
from lapgs_bench.experiments.schema import SCRIPT
from lapgs_bench.experiments.store import Job
from lapgs_bench.pareto.settings import ParetoSettings
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_file
from lapgs_plugin.hierarchy.plan import Hierarchy

ONE_FIELD = "one field"
BARE, UNDER_RUN = "bare", "hierarchy"  # methods of a `RunSpec`
OPTION = "--iterations"


@dataclass(frozen=True)
class Method:
    """A way to train a field.

    Attributes:
        name: as on the page.
        hierarchy: the kind of hierarchy; None without one.
        checkout: folder of a checkout; None for `lapgs train`.
        arguments: options of the checkout's script.
    """

    name: str
    hierarchy: Hierarchy | None
    checkout: Path | None = None
    arguments: tuple[str, ...] = ()


def methods_of(settings: ParetoSettings) -> list[Method]:
    """Return the methods to compare: those of `lapgs train`, then those of each checkout.

    Raises:
        UserInputError: a folder has no training script with --iterations, or two folders have the same name.
    """
    kinds = (None, Hierarchy.NESTED, Hierarchy.LAPLACIAN)
    methods = [Method(kind.value if kind else ONE_FIELD, kind) for kind in kinds]
    for folder, arguments in settings.script_options:
        _require_iterations(folder)
        if own := next((word for word in arguments if sets_option([word], OPTION, *OWN_ARGUMENTS)), None):
            raise UserInputError(f"--checkout-options {own}: scene, folder and budgets decide it; leave it out")
        name = folder.absolute().name
        methods += [
            Method(f"{name}, {kind.value if kind else 'own script'}", kind, folder.absolute(), tuple(arguments))
            for kind in kinds
        ]
    names = [method.name for method in methods]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UserInputError(f"--checkout: two folders make the method {twice!r}; rename one of them")
    return methods


def _require_iterations(folder: Path) -> None:
    """Refuse a folder whose script cannot be shortened by --iterations."""
    if not is_file(folder / SCRIPT):
        raise UserInputError(f"--checkout {folder}: has no {SCRIPT}; expected the folder of a 3DGS checkout")
    source = CheckoutSource.read(folder / SCRIPT)
    if not any(_names_iterations(path) for path in {source.script, *source.modules.values()}):
        raise UserInputError(
            f"--checkout {folder}: {SCRIPT} has no option {OPTION}, by which runs are shortened to a budget; expected "
            "a 3DGS checkout"
        )


def _names_iterations(path: Path) -> bool:
    """Tell whether a module names the option: in a parser's text, or as an attribute such as `opt.iterations`."""
    return any(
        (isinstance(node, ast.Constant) and node.value == OPTION)
        or (isinstance(node, ast.Attribute) and node.attr == OPTION.removeprefix("--"))
        for node in ast.walk(ast.parse(path.read_bytes()))
    )


def run_spec(method: Method, settings: ParetoSettings, scene: Path, iterations: int, seed: int) -> RunSpec:
    """Describe a run of a method with so many iterations."""
    # Quality is compared after the colour fit too, so `lapgs train` compensates exposure as it does by default.
    options: dict[str, Any] = {"appearance": "auto"} if method.checkout is None else {"device": settings.device}
    if method.hierarchy is not None:
        options["hierarchy"] = method.hierarchy.value
    return RunSpec(
        scene=scene.absolute().name,
        dataset="",
        images=settings.images,
        resolution=settings.resolution,
        backbone="lapgs" if method.checkout is None else method.checkout.name,
        rasterizer=settings.rasterizer if method.checkout is None else None,
        checkout=None if method.checkout is None else str(method.checkout),
        method=BARE if method.hierarchy is None else UNDER_RUN,
        iterations=iterations,
        seed=seed,
        options=options,
        arguments=list(method.arguments),
    )


def job_of(spec: RunSpec, scene: Path, folder: Path, evaluate: Sequence[str] | None) -> Job:
    """Return the job by which a worker makes a run of a method: its commands, run folder and log.

    Args:
        spec: the run.
        scene: the scene's folder.
        folder: where runs and logs are written.
        evaluate: options of `lapgs eval`; None for a short run that only tells the machine's rate.
    """
    name = spec.run_id if evaluate is not None else f"rate-{spec.run_id}"
    own = folder.absolute() / RUNS / name
    checkout = None if spec.checkout is None else Path(spec.checkout)
    steps = run_steps(spec, scene.absolute(), checkout, own, evaluate)
    log = folder.absolute() / LOGS / f"{name}.log"
    where = str(scene.absolute())
    return Job(name, spec, str(own), str(log), tuple(steps), evaluate is not None, defaults_of(spec), where)
