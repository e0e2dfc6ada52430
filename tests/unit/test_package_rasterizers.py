"""A rasterizer of an installed package trains, renders and is checked by its name, and its mistakes name it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from lapgs_plugin.cli.conformance import reachable
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.rasterizers.choice import rasterizer_for
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.training.backend import choose_rasterizer, training_rasterizer
from lapgs_plugin.training.densification import Densifier
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import TrainSettings
from lapgs_plugin.training.strategies import Gradients
from tests.plugin_package import install_package
from tests.training_scene import ring_camera

SOURCE = """\
from lapgs_plugin.fields.rasterizer import Rasterizer, Semantics
from lapgs_plugin.reference_raster import CpuRasterizer


class Mine(CpuRasterizer):
    name = "mine"


class OnGpu(Mine):
    name = "on_gpu"
    devices = ("cuda",)


class Misnamed(Mine):
    pass


class Greedy(Mine):
    def __init__(self, options):
        pass


def function(field, camera):
    pass
"""
ENTRIES = "[lapgs_plugin.rasterizers]\n" + "".join(
    f"{name} = my_rasterizers:{kind}\n"
    for name, kind in {
        "mine": "Mine", "on_gpu": "OnGpu", "misnamed": "Misnamed", "greedy": "Greedy", "function": "function"
    }.items()
)  # fmt: skip


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_package(tmp_path / "site", monkeypatch, "my_rasterizers", ENTRIES, SOURCE)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def manifest(rasterizer: str) -> Manifest:
    return Manifest.of_loop(SceneReference("scene", "full", True, (0.0, 0.0, 0.0), "colmap"), 2, rasterizer)


SETTINGS = TrainSettings(iterations=10)


def test_it_trains_renders_and_is_checked_by_its_name() -> None:
    assert choose_rasterizer("mine") == "mine"
    placed = training_rasterizer("mine", SETTINGS)
    assert (placed.rasterizer.name, placed.device.type) == ("mine", "cpu")
    for asked in ("auto", "mine"):
        assert rasterizer_for(manifest("mine"), rasterizer=asked).rasterizer.name == "mine"
    (subject,) = reachable()["mine"]()
    assert (subject.rasterizer.name, subject.device) == ("mine", "cpu")


def test_another_renders_what_was_trained_with_one_that_cannot_here(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "lapgs_plugin.rasterizers.choice")
    assert rasterizer_for(manifest("on_gpu")).rasterizer.name == "cpu"
    assert "the fastest without a CUDA device, because --rasterizer on_gpu: my_rasterizers.OnGpu renders" in caplog.text
    assert rasterizer_for(manifest("of a package that is gone")).rasterizer.name == "cpu"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("on_gpu", r"--rasterizer on_gpu: my_rasterizers.OnGpu renders on cuda, this machine has no CUDA device"),
        ("misnamed", r"my_rasterizers.Misnamed has the name mine, expected that of its entry point, misnamed"),
        ("greedy", r"my_rasterizers.Greedy cannot be made without arguments: TypeError: .*'options'; fix or"),
        ("function", r"my_rasterizers:function is a function, expected a subclass of Rasterizer; fix or uninstall"),
    ],
)
def test_its_mistakes_name_it(name: str, message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        training_rasterizer(name, SETTINGS)
    with pytest.raises(UserInputError, match=message):
        rasterizer_for(manifest("cpu"), rasterizer=name)


def test_unknown_names_list_it() -> None:
    with pytest.raises(UserInputError, match=r"--rasterizer x: expected auto, gsplat, .*mine.* or on_gpu"):
        choose_rasterizer("x")
    with pytest.raises(UserInputError, match="renders on cuda, not on --device cpu; choose another"):
        rasterizer_for(manifest("cpu"), "cpu", "on_gpu")


def test_strategies_say_what_a_rasterizer_leaves_empty() -> None:
    result = RenderResult(torch.zeros(3, 4, 5), None, torch.ones(2, dtype=torch.int32), torch.zeros(2, 2))
    schedule = StageSchedule.create(SETTINGS, Stage(0, (5, 4), 10, signed=False))
    for absgrad, source in ((False, "means2d.grad"), (True, "absgrad2d")):
        control = Densifier(schedule, Gradients(grow_grad2d=2e-4, absgrad=absgrad), 1.0)
        with pytest.raises(UserInputError, match=f"{source}, which this rasterizer leaves empty"):
            control.accumulate(result, ring_camera(0.0))
