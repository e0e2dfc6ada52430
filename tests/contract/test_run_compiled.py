"""Test whose compiled modules a checkout imports, and whose rasterizer trains it where both are there."""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import typer

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.checkouts.compiled_modules import CompiledModules, compiled_modules
from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
from lapgs_plugin.checkouts.packages import AUTO, OURS, OWN
from lapgs_plugin.checkouts.script import loaded_script
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import MissingExtraError, RunFolderError
from lapgs_plugin.files import BARE_RECORD
from lapgs_plugin.runner import rasterizer_trial
from lapgs_plugin.runner.context import RunRequest
from lapgs_plugin.runner.driver import HierarchyDriver
from lapgs_plugin.runner.rasterizer_choice import CHOICE
from lapgs_plugin.runner.recording import BareRunRecorder
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.runs.results import read_bare_record
from tests.contract.stub_runs import STUBS, StopAt, Stub, arguments, edited_graphdeco, forgetting_stubs

RASTERIZER = "diff_gaussian_rasterization"
SHORT = ("--iterations", 15)


def modules_of(script: Path, wanted: str = AUTO, *words: str, bare: bool = False) -> CompiledModules:
    source = CheckoutSource.read(script)
    kind = adapter_class(source.root)
    return compiled_modules(source, lambda: kind.stand_in_for(source.root, words), wanted, bare=bare)


@pytest.mark.parametrize("name", STUBS)
def test_a_checkout_that_was_just_cloned_imports_ours(name: str) -> None:
    stub = STUBS[name]
    compiled = modules_of(stub.script)
    assert compiled.rasterizer == OURS
    assert compiled.beside == {}
    rasterizer = adapter_class(stub.script.parent).info.rasterizer
    assert compiled.reasons.items() >= {rasterizer: "not installed", "simple_knn": "not installed"}.items()
    assert f"{rasterizer} (not installed)" in compiled.describe()
    assert "\n" not in compiled.describe()
    before = dict(sys.modules)
    with compiled.in_place():
        assert hasattr(importlib.import_module(rasterizer), "GaussianRasterizer")
        assert hasattr(importlib.import_module("simple_knn._C"), "distCUDA2")
    assert sys.modules == before


def test_a_bare_run_gets_only_what_it_cannot_do_without(tmp_path: Path) -> None:
    script = edited_graphdeco(
        tmp_path / "fork",
        "train.py",
        "import torch\n",
        "import torch\ntry:\n    from fused_ssim import fused_ssim\nexcept ImportError:\n    fused_ssim = None\n",
    )
    assert "fused_ssim" in modules_of(script).reasons
    assert modules_of(script, bare=True).reasons.keys() == {RASTERIZER, "simple_knn"}


def test_its_own_is_wanted_and_not_installed() -> None:
    with pytest.raises(MissingExtraError, match=rf"^{RASTERIZER} cannot be imported \(not installed\): .* --rast"):
        modules_of(STUBS["graphdeco"].script, OWN)


def test_neither_can_be_had(tmp_path: Path) -> None:
    settings = "        debug=pipe.debug,\n"
    file = "gaussian_renderer/__init__.py"
    script = edited_graphdeco(tmp_path / "fork", file, settings, f"{settings}        glow=1,\n")
    expected = rf"^{RASTERIZER} cannot be imported \(not installed\): .*lapgs has no .*takes no setting glow"
    with pytest.raises(MissingExtraError, match=expected):
        modules_of(script)
    assert modules_of(script, bare=True).rasterizer == OWN, "the script is run as it is"
    with pytest.raises(MissingExtraError, match="takes no setting glow"):
        modules_of(script, OURS)


OWN_RASTERIZER = """\
from lapgs_plugin.family.variants import rasterizer_module
globals().update(rasterizer_module("{}"))
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Return a function that installs a rasterizer, and neighbours with a text of theirs."""
    site = tmp_path / "site"
    monkeypatch.syspath_prepend(site)

    def write(variant: str, neighbours: str = "distCUDA2 = abs\n") -> None:
        own = OWN_RASTERIZER.format(variant)
        for name, text in {f"{RASTERIZER}/__init__.py": own, "simple_knn/_C.py": neighbours}.items():
            path = site / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        importlib.invalidate_caches()

    yield write
    for name in [name for name in sys.modules if name.partition(".")[0] in (RASTERIZER, "simple_knn")]:
        del sys.modules[name]


def test_an_installed_one_is_its_own_and_one_that_crashes_is_ours(install: Callable[..., None]) -> None:
    install("graphdeco-accel", "import os\nos.abort()\n")
    compiled = modules_of(STUBS["graphdeco"].script)
    assert compiled.rasterizer == OWN
    assert compiled.reasons["simple_knn"].startswith("crashed")
    assert RASTERIZER not in compiled.placed
    # The stub passes DC apart where sparse Adam is installed, and its sources fit a rasterizer without, too.
    assert hasattr(compiled.beside[RASTERIZER], "SparseGaussianAdam")
    ours = modules_of(STUBS["graphdeco"].script, OURS)
    assert (ours.rasterizer, ours.reasons[RASTERIZER]) == (OURS, "--rasterizer lapgs")


@pytest.mark.parametrize(
    ("variant", "words", "why"),
    [
        ("graphdeco", (), "the installed one takes no antialiasing"),
        (
            "graphdeco-aa",
            ("--optimizer_type", "sparse_adam"),
            f"ImportError: {RASTERIZER} has no SparseGaussianAdam",
        ),
    ],
)
def test_ours_takes_the_place_of_one_that_lacks_what_the_checkout_passes(
    variant: str, words: tuple[str, ...], why: str, install: Callable[..., None]
) -> None:
    install(variant)
    compiled = modules_of(STUBS["graphdeco"].script, AUTO, *words)
    assert compiled.rasterizer == OURS
    assert compiled.reasons == {RASTERIZER: why, "fused_ssim": "not installed"}


def slower(ours: type, clock: SimpleNamespace) -> type:
    """Return a rasterizer for which the clock goes 20 times as fast."""

    class Slower(ours):  # type: ignore[misc]
        calls = 0

        def forward(self, **inputs: Any) -> Any:
            Slower.calls += 1
            clock.seconds += 0.02
            return super().forward(**inputs)

    return Slower


def brighter(ours: type, clock: SimpleNamespace) -> type:
    """Return a slower rasterizer that also adds light to one place."""

    class Brighter(slower(ours, clock)):  # type: ignore[misc]
        def forward(self, **inputs: Any) -> Any:
            image, *others = super().forward(**inputs)
            more = image.detach().clone().zero_()
            more[0, 3:9, 5] = 0.25
            return image + more, *others

    return Brighter


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return the clock that rasterizers are timed by: it goes on by a millisecond when it is read."""
    made = SimpleNamespace(seconds=0.0)

    def read() -> float:
        made.seconds += 0.001
        return float(made.seconds)

    monkeypatch.setattr(rasterizer_trial, "time", SimpleNamespace(perf_counter=read))
    monkeypatch.setattr(rasterizer_trial, "LATER_COUNT", 600)
    return made


@contextmanager
def with_both(
    stub: Stub, scene: Path, folder: Path, own: type, ours: type | None = None, more: tuple[Any, ...] = SHORT
) -> Iterator[tuple[BackboneAdapter, CompiledModules]]:
    """Load a stub with a rasterizer of its own, and yield its adapter with the modules that it may get."""
    with forgetting_stubs(), cuda_on_cpu(stub.stand_in):
        module, beside = sys.modules[RASTERIZER], ModuleType(RASTERIZER)
        vars(beside).update(vars(module))
        if ours is not None:
            beside.GaussianRasterizer = ours  # type: ignore[attr-defined]
        module.GaussianRasterizer = own  # type: ignore[attr-defined]
        with loaded_script(stub.script, arguments(stub, scene, folder, more)) as script:
            yield adapter_class(stub.script.parent)(script), CompiledModules(OWN, beside={RASTERIZER: beside})


def original(stub: Stub) -> type:
    with cuda_on_cpu(stub.stand_in):
        rasterizer: type = sys.modules[RASTERIZER].GaussianRasterizer
    return rasterizer


def trained(
    make: Callable[[type, SimpleNamespace], type], clock: SimpleNamespace, scene: Path, folder: Path, **options: Any
) -> tuple[RunArchive, int]:
    """Train a stub that has both rasterizers; return its run, and how often its own rendered after the dry run."""
    stub = STUBS[options.pop("name", "graphdeco")]
    own, hooks = make(original(stub), clock), options.pop("hooks", ())
    resume, ours = options.pop("resume", False), options.pop("ours", None)
    with with_both(stub, scene, folder, own, ours) as (adapter, compiled):
        request = RunRequest(adapter, RunSettings(**options), compiled, device="cpu", hooks=hooks, resume=resume)
        before = own.calls  # type: ignore[attr-defined]
        HierarchyDriver(request).run()
    return RunArchive.open(folder), own.calls - before  # type: ignore[attr-defined]


@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_the_faster_one_trains_after_both_were_compared(
    hierarchy: str, clock: SimpleNamespace, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "lapgs_plugin.runner"):
        run, calls = trained(slower, clock, scene, tmp_path / "run", hierarchy=hierarchy, levels=2)
    choice = run.manifest.settings[CHOICE]
    assert choice["taken"] == OURS
    assert choice["why"].startswith(f"that of lapgs: 11.00 times as fast as {RASTERIZER}, with the same image")
    views, renders = 3, rasterizer_trial.WARM_UP + rasterizer_trial.REPEATS
    # Once to know a call, then timed with the Gaussians of the start and of later; at the size of each level.
    assert calls == views * 2 * (1 + 2 * renders), "none after the choice"
    assert f"rasterizer: {choice['why']}" in caplog.text
    assert run.manifest.complete


def test_one_that_differs_is_left_alone(
    clock: SimpleNamespace, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run, calls = trained(brighter, clock, scene, tmp_path / "run", hierarchy="nested", levels=1)
    choice = run.manifest.settings[CHOICE]
    assert choice["taken"] == OWN
    assert "ours differs in view " in choice["why"]
    assert "0.2 % of the pixels by more than 0.004, most at x 5, y " in choice["why"]
    assert calls > SHORT[1]


def test_ours_that_cannot_render_a_variant_is_not_taken(clock: SimpleNamespace, scene: Path, tmp_path: Path) -> None:
    class Unable(original(STUBS["graphdeco"])):  # type: ignore[misc]
        def forward(self, **inputs: Any) -> Any:
            raise MissingExtraError("no inverse depths on a GPU")

    run, _ = trained(slower, clock, scene, tmp_path / "run", hierarchy="nested", levels=1, ours=Unable)
    assert run.manifest.settings[CHOICE] == {
        "taken": OWN,
        "why": f"the checkout's own {RASTERIZER}: that of lapgs cannot take its place (no inverse depths on a GPU)",
    }


def test_without_a_dry_run_its_own_stays(clock: SimpleNamespace, scene: Path, tmp_path: Path) -> None:
    run, _ = trained(slower, clock, scene, tmp_path / "run", hierarchy="nested", levels=1, dry_run=False)
    assert run.manifest.settings[CHOICE]["taken"] == OWN
    assert "without a dry run" in run.manifest.settings[CHOICE]["why"]


def test_a_run_that_is_continued_keeps_its_rasterizer(clock: SimpleNamespace, scene: Path, tmp_path: Path) -> None:
    options = {"hierarchy": "laplacian", "levels": 2}
    with pytest.raises(KeyboardInterrupt):
        trained(slower, clock, scene, tmp_path / "run", hooks=(StopAt(0),), **options)
    run, calls = trained(slower, clock, scene, tmp_path / "run", resume=True, **options)
    assert (run.manifest.complete, calls) == (True, 0)
    stub = STUBS["graphdeco"]
    with (
        with_both(stub, scene, tmp_path / "run", original(stub)) as (adapter, _),
        pytest.raises(RunFolderError, match=r"started with the rasterizer of lapgs, which is not to be had now"),
    ):
        HierarchyDriver(
            RunRequest(adapter, RunSettings(levels=2), CompiledModules(OWN, OWN), device="cpu", resume=True)
        ).run()


def test_a_checkout_without_compiled_modules_trains(scene: Path, tmp_path: Path) -> None:
    """The modules are those of a GPU; here they render on the CPU."""
    stub = STUBS["graphdeco"]
    compiled, folder = modules_of(stub.script), tmp_path / "run"
    words = arguments(stub, scene, folder, SHORT)
    with forgetting_stubs(), cuda_on_cpu(None), compiled.in_place(), loaded_script(stub.script, words) as script:
        HierarchyDriver(
            RunRequest(adapter_class(stub.script.parent)(script), RunSettings(), compiled, device="cpu")
        ).run()
    run = RunArchive.open(folder)
    assert run.manifest.complete
    assert run.manifest.settings[CHOICE]["taken"] == OURS
    assert f"{RASTERIZER}: not installed" in run.manifest.settings[CHOICE]["why"]


def test_a_bare_run_without_compiled_modules_says_so_in_its_record(scene: Path, tmp_path: Path) -> None:
    stub = STUBS["graphdeco"]
    compiled, folder = modules_of(stub.script, bare=True), tmp_path / "run"
    words = arguments(stub, scene, folder, SHORT)
    with forgetting_stubs(), cuda_on_cpu(None), compiled.in_place(), loaded_script(stub.script, words) as script:
        BareRunRecorder(
            adapter_class(stub.script.parent)(script), "cpu", MeasuringOptions(), compiled=compiled.reasons
        ).run()
    assert read_bare_record(folder / BARE_RECORD)["compiled"] == compiled.reasons


@pytest.mark.gpu
@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_a_checkout_without_compiled_modules_trains_on_a_gpu(hierarchy: str, scene: Path, tmp_path: Path) -> None:
    stub, folder = STUBS["graphdeco"], tmp_path / "run"
    words = ["run", "--device", "cuda", "--hierarchy", hierarchy, str(stub.script)]
    with forgetting_stubs():
        typer.main.get_command(app)([*words, *arguments(stub, scene, folder, SHORT)], standalone_mode=False)
    run = RunArchive.open(folder)
    assert run.manifest.complete
    assert run.manifest.settings[CHOICE]["taken"] == OURS


def test_what_ours_cannot_do_is_said_where_it_takes_the_place(tmp_path: Path) -> None:
    settings = "        debug=pipe.debug,\n"
    more = f"{settings}        kernel_size=0.1,\n        subpixel_offset=None,\n"
    script = edited_graphdeco(tmp_path / "fork", "gaussian_renderer/__init__.py", settings, more)
    renderer = script.parent / "gaussian_renderer" / "__init__.py"
    text = renderer.read_text(encoding="utf-8").replace("        antialiasing=pipe.antialiasing,\n", "")
    renderer.write_text(text.replace("radii, depth_image = ", "radii = "), encoding="utf-8")
    assert "(not installed), " in (line := modules_of(script).describe())
    assert line.endswith("its rasterizer does without pixels that are moved by subpixel_offset (--ray_jitter)")
