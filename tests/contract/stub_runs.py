"""Run the stub checkouts on the CPU in this process: bare, and as a hierarchy."""

from __future__ import annotations

import io
import math
import random
import re
import runpy
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
from lapgs_plugin.checkouts.script import loaded_script
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.errors import MissingExtraError
from lapgs_plugin.files import BARE_RECORD
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import StageHook
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runner.context import RunRequest
from lapgs_plugin.runner.driver import HierarchyDriver
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.runs.watcher import Watcher

CHECKOUTS = Path(__file__).parent / "checkouts"

ITERATIONS = 90
"""Iterations of a whole run: 30 and 60 in two stages."""

SCHEDULE = ("--eval", "--iterations", ITERATIONS, "--densify_from_iter", 5, "--densification_interval", 5)
SCHEDULE += ("--densify_until_iter", 60, "--percent_dense", 0.05)

SHORT = ("--iterations", 30)
"""Option for stages of 10 and 20 iterations, for what does not depend on their number."""

HALF = ("--iterations", 45)
"""Option for stages of 15 and 30 iterations, for what needs densification in both."""

WHITE = ("--white_background", "--densify_from_iter", 0)
"""Options for a white background. Over white, checkouts reset opacities at the first iteration that densifies, never if
that is 0. In so few iterations opacities would not recover before FastGS prunes faint Gaussians."""

THIRDS: dict[str, Any] = {"split": "1/3,2/3"}
"""Option for stages of 30 and 60 iterations, the default of these tests for residuals."""
KINDS = ("nested", "laplacian")
"""Both kinds of hierarchy."""
SAVING = ("--save_iterations", 40, "--checkpoint_iterations", 40)
"""Options of the session's bare runs, see `conftest.bare_run`."""


@dataclass(frozen=True)
class Stub:
    """Describe a stub checkout.

    Attributes:
        name: its folder.
        stand_in: variant of the rasterizer that it runs with.
        options: options that its tests always pass.
        file: its training script, relative to its folder.
    """

    name: str
    stand_in: str
    options: tuple[Any, ...] = ()
    file: str = "train.py"

    @property
    def script(self) -> Path:
        return CHECKOUTS / self.name / self.file


STUBS = {
    stub.name: stub
    for stub in (
        Stub("fastgs", "fastgs", ("--dense", 0.05)),
        Stub("taming", "taming", ("--budget", 4, "--cams", 5, "--sh_lower")),
        Stub("graphdeco", "graphdeco-accel", ("--disable_viewer",)),
    )
}
NAMES = tuple(STUBS)
STUBS_AND_KINDS = (("fastgs", "laplacian"), ("taming", "nested"), ("graphdeco", "laplacian"), ("graphdeco", "nested"))
"""Every stub and both kinds of hierarchy, for what all stubs share."""

FORKS = {
    stub.name: stub
    for stub in (
        Stub(
            "dash",
            "graphdeco-aa",
            ("--densify_mode", "freq", "--resolution_mode", "freq", "--disable_viewer"),
            "train_dash.py",
        ),
        Stub("speedy", "speedy-splat", ("--prune_from_iter", 30, "--prune_interval", 15, "--prune_until_iter", 90)),
        Stub(
            "mini",
            "mini-splatting",
            ("--imp_metric", "indoor", "--simp_iteration1", 60, "--simp_iteration2", 75, "--num_depth", 600),
            "ms/train.py",
        ),
        Stub(
            "efficient",
            "efficientgs",
            (
                *("--oneupSHdegree_from_iter", 62, "--oneupSHdegree_interval", 3, "--use_sparse_shs"),
                *("--prune_by_max_weight", "--prune_way", "p4"),
            ),
        ),
    )
}
"""Forks whose adapters have a policy of their own."""


def files(folder: Path) -> dict[str, bytes]:
    """Return the files' contents by name, with the folder's own name replaced.

    TensorBoard's log, if it is installed, has another name each time, and only a recorded run has a record.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and ".tfevents." not in path.name)
    name = str(folder).encode()
    contents = {path.relative_to(folder).as_posix(): path.read_bytes().replace(name, b"OUT") for path in paths}
    contents.pop(BARE_RECORD, None)
    return contents


@dataclass(frozen=True)
class Result:
    """Hold the output and the folder of a run."""

    folder: Path
    output: str
    progress: str

    @property
    def losses(self) -> list[float]:
        """Running mean of the loss, which the progress bar shows every ten iterations."""
        shown = re.findall(r"(?<!Depth )Loss=([0-9.]+)", self.progress)
        return [float(value) for i, value in enumerate(shown) if i == 0 or value != shown[i - 1]]

    @property
    def lines(self) -> list[str]:
        """Lines that were printed, without times of day and durations."""
        untimed = re.sub(r" \[\d\d/\d\d \d\d:\d\d:\d\d\]", "", self.output)
        return re.sub(r"(time: |Time taken by None: )[0-9.]+", r"\1", untimed).splitlines()


def arguments(stub: Stub, scene: Path, folder: Path, more: Sequence[Any] = ()) -> list[str]:
    return [str(a) for a in ("-s", scene, "-m", folder, *SCHEDULE, *stub.options, *more)]


PACKAGES = {"arguments", "gaussian_renderer", "scene", "utils"}
"""Packages of every checkout."""


@contextmanager
def forgetting_stubs() -> Iterator[None]:
    """Remove a checkout's modules at the end, including those that the stubs share, which `lapgs run` does not know."""
    try:
        yield
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] in PACKAGES]:
            del sys.modules[name]


@contextmanager
def captured(folder: Path, results: list[Result]) -> Iterator[None]:
    """Append to `results` what is printed inside."""
    output, progress = io.StringIO(), io.StringIO()
    with redirect_stdout(output), redirect_stderr(progress):
        yield
    results.append(Result(folder, output.getvalue(), progress.getvalue()))


def without(kind: type, name: str) -> None:
    """Take a method away from a class and its bases, which a test has loaded for itself."""
    for each in kind.__mro__:
        if name in vars(each):
            delattr(each, name)


def run_bare(stub: Stub, scene: Path, folder: Path, *more: Any) -> Result:
    """Run the script as Python does, without `lapgs run`."""
    results: list[Result] = []
    before = sys.argv, sys.path[:]
    sys.argv = [str(stub.script), *arguments(stub, scene, folder, more)]
    sys.path.insert(0, str(stub.script.parent))
    try:
        with forgetting_stubs(), captured(folder, results), cuda_on_cpu(stub.stand_in):
            runpy.run_path(str(stub.script), run_name="__main__")
    finally:
        sys.argv, sys.path[:] = before
    return results[0]


@contextmanager
def loaded(
    stub: Stub, scene: Path, folder: Path, *more: Any, script: Path | None = None, stand_in: str | None = None
) -> Iterator[BackboneAdapter]:
    """Load a stub's definitions and yield its adapter.

    Args:
        script: script of a changed copy of the stub.
        stand_in: another rasterizer than the checkout's.
    """
    script = stub.script if script is None else script
    with (
        forgetting_stubs(),
        cuda_on_cpu(stub.stand_in if stand_in is None else stand_in),
        loaded_script(script, arguments(stub, scene, folder, more)) as definitions,
    ):
        yield adapter_class(CheckoutSource.read(script).root)(definitions)


def drive(
    adapter: BackboneAdapter,
    *,
    hooks: Sequence[StageHook] = (),
    resume: bool = False,
    breakdown: bool = False,
    gpu_busy: bool = False,
    watcher: Watcher | None = None,
    test_every: int | None = None,
    **options: Any,
) -> None:
    options.setdefault("hierarchy", "nested")
    # Tests that watch a checkout's methods would see the dry run's iteration; `test_run_dry` has tests of it.
    options.setdefault("dry_run", False)
    if options["hierarchy"] == "laplacian" and options.get("levels", 2) == 2:
        options = {**THIRDS, **options}
    request = RunRequest(
        adapter,
        RunSettings(**options),
        device="cpu",
        resume=resume,
        hooks=hooks,
        measuring=MeasuringOptions(test_every=test_every, breakdown=breakdown, gpu_busy=gpu_busy),
        watcher=watcher or Watcher(),
    )
    HierarchyDriver(request).run()


def run_hierarchy(
    stub: Stub,
    scene: Path,
    folder: Path,
    *more: Any,
    hooks: Sequence[StageHook] = (),
    resume: bool = False,
    breakdown: bool = False,
    gpu_busy: bool = False,
    watcher: Watcher | None = None,
    test_every: int | None = None,
    **options: Any,
) -> tuple[RunArchive, Result]:
    """Train a stub as a hierarchy with `RunSettings(**options)`."""
    results: list[Result] = []
    with captured(folder, results), loaded(stub, scene, folder, *more) as adapter:
        drive(
            adapter,
            hooks=hooks,
            resume=resume,
            breakdown=breakdown,
            gpu_busy=gpu_busy,
            watcher=watcher,
            test_every=test_every,
            **options,
        )
    return RunArchive.open(folder), results[0]


def edited_graphdeco(folder: Path, file: str, text: str, instead: str) -> Path:
    """Copy the stubs to a folder, change a text that a file of graphdeco's has once, and return its script."""
    root = Path(shutil.copytree(CHECKOUTS, folder, ignore=shutil.ignore_patterns("__pycache__"))) / "graphdeco"
    content = (root / file).read_text(encoding="utf-8")
    assert content.count(text) == 1
    (root / file).write_text(content.replace(text, instead), encoding="utf-8")
    return root / "train.py"


drive_residuals = partial(drive, hierarchy="laplacian")
run_residuals = partial(run_hierarchy, hierarchy="laplacian")


class StopAt(StageHook):
    """Press Ctrl-C when a stage begins."""

    def __init__(self, level: int) -> None:
        self.level = level

    def on_stage_start(self, stage: Stage) -> None:
        if stage.level == self.level:
            raise KeyboardInterrupt


class Seeded(StageHook):
    """Seed all generators at the start of every stage, so that a resumed run can end as an uninterrupted one."""

    def on_stage_start(self, stage: Stage) -> None:
        random.seed(stage.level)
        np.random.seed(stage.level)
        torch.manual_seed(stage.level)


def composed_psnr(archive: RunArchive) -> float:
    """Return the PSNR of the held-out views, rendered from the archive without the checkout's code, averaged as the
    checkouts do, over views and channels."""
    renderer = run_renderer(archive, device="cpu", rasterizer="cpu")
    values = []
    for view in run_scene(archive).test:
        image = renderer.render(view.camera).composed[0].clamp(0, 1)
        values += [-10 * math.log10(float(error)) for error in ((image - view.image) ** 2).mean((1, 2))]
    return sum(values) / len(values)


def stand_in_is_refused(checkout: Path, pattern: str) -> None:
    """Check that a checkout has no CPU stand-in, and that one line says why."""
    with pytest.raises(MissingExtraError, match=pattern) as caught:
        adapter_class(checkout).stand_in_for(checkout, ())
    assert "\n" not in str(caught.value)
