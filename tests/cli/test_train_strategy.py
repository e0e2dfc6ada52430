"""A strategy of density control that another package brings trains like those of this package."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.options import option, options_of
from lapgs_plugin.registry import Registry
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.training.saved_settings import settings_from_manifest
from tests.refusals import refuses

PLUGIN = '''
from dataclasses import dataclass
from typing import ClassVar

from lapgs_plugin.options import option
from lapgs_plugin.training.strategies import Strategy


@dataclass(frozen=True)
class Copying(Strategy):
    """Copy the first Gaussians whenever the schedule densifies."""

    densify_until: ClassVar[int] = 30_000
    copies: int = option(2, "Gaussians to copy at a time.", panel="Density control", least=1)

    def start(self, field, photos):
        return field.with_parameters({name: value[:100] for name, value in field.parameters.items()})

    def density_control(self, schedule, extent):
        import torch
        from gsplat.strategy.ops import duplicate

        from lapgs_plugin.training.densification import DensityControl

        class Control(DensityControl):
            def after_step(self, model, iteration, result, camera, scores=None):
                due = schedule.refines(iteration) and iteration < schedule.densify_until
                if due:
                    first = torch.arange(len(model)) < copies
                    duplicate(model.params, model.optimizers, self.state, first)
                return due

        copies = self.copies
        return Control()


COPYING = Copying()
'''


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with the metadata and the module of an installed package."""
    info = tmp_path / "site" / "copying-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: copying\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[lapgs_plugin.strategies]\ncopying = copying_strategy:COPYING\nbroken = no_such_module:STRATEGY\n"
    )
    (tmp_path / "site" / "copying_strategy.py").write_text(PLUGIN)
    return tmp_path / "site"


def lapgs(installed: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lapgs_plugin", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def test_a_strategy_of_another_package_trains_with_its_options(installed: Path, tmp_path: Path) -> None:
    scene, run = tmp_path / "scene", tmp_path / "run"
    make_sample_scene(scene, width=64, height=48, views=6, points=300, progress=False)
    words = ("train", scene, "-o", run, "--iterations", "40", "--levels", "1", "--densify-every", "10")
    done = lapgs(installed, *words, "--strategy", "copying", "--copies", "7")
    assert done.returncode == 0, done.stderr
    manifest = RunArchive.open(run).manifest
    assert manifest.record(0).num_gaussians == 100 + 3 * 7, "100 to start with; 7 more after 10, 20 and 30 iterations"
    density = json.loads((run / "manifest.json").read_text())["settings"]["densification"]
    assert (density["strategy"], density["options"]) == ("copying", {"copies": 7})
    with pytest.raises(
        RunFolderError, match="--strategy copying: expected auto, mcmc, 3dgs, multiview; install the pack"
    ):
        settings_from_manifest(manifest)


@dataclass(frozen=True)
class Tame:
    size: int = option(1, "How large.", least=0)


@dataclass(frozen=True)
class Wild(Tame):
    speed: float = option(2.0, "How fast.")


@dataclass(frozen=True)
class Clashing:
    speed: float = option(3.0, "Another speed.")


def command(**animals: Any) -> Any:
    """A command with the options of these choices; returns its settings as a dictionary."""
    registry: Registry[Any] = Registry("--animal", "lapgs_plugin.tests.none", object, animals)

    @dataclass(frozen=True)
    class Settings:
        animal: str = option("tame", "Which.")
        options: Any = options_of(registry, "animal")

    def show(settings: Any) -> dict[str, Any]:
        return asdict(settings)

    show.__annotations__["settings"] = Settings
    return takes_settings(show)


def test_choices_have_their_own_options_and_those_they_inherit() -> None:
    show = command(tame=Tame(), wild=Wild(size=5))
    assert list(show.__signature__.parameters) == ["animal", "size", "speed"]
    options = {"animal": "wild", "size": 4, "speed": 7.0}
    assert show(**options) == {"animal": "wild", "options": {"size": 4, "speed": 7.0}}
    with pytest.raises(UserInputError, match=r"--speed 7\.0 with --animal tame: an option of --animal wild; leave"):
        show(**{**options, "animal": "tame"})
    refuses(UserInputError, "--animal lame: expected tame or wild", show, **{**options, "animal": "lame"})


def test_an_option_that_two_choices_declare_is_refused() -> None:
    show = command(tame=Tame(), wild=Wild(), zippy=Clashing())
    with pytest.raises(UserInputError, match="--animal zippy: --speed is also an option of something else; fix or un"):
        show(animal="tame", size=1, speed=2.0)
