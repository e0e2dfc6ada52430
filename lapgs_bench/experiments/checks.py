"""Check all runs of an experiment before the first one starts.

The command line of each run is parsed by its command, which checks its settings and ends (`rehearsal.Rehearsal`). An
experiment therefore refuses the same options as the commands, with the same messages.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import typer

from lapgs_bench.experiments.commands import LAPGS
from lapgs_bench.experiments.expansion import PlannedRun, RunSpec, SceneSpec
from lapgs_bench.experiments.mistakes import Mistakes
from lapgs_bench.experiments.store import Job
from lapgs_plugin.cli.app import app
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.cli.usage import USAGE_ERROR, usage_message
from lapgs_plugin.errors import LapgsError, MissingExtraError, SceneError, UserInputError
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.hierarchy.settings import AUTO, HierarchySettings
from lapgs_plugin.limits import LONGEST_STEM
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.scenes.resolution import BACKBONE_PREFIX, parse_resolution, parse_size

if TYPE_CHECKING:
    from lapgs_plugin.training.preparation import TrainRequest

ANY_SIZE = (1 << 20, 1 << 20)
"""Size to check when that of the images is unknown: no image is larger."""
OWN_ARGUMENTS = ("-m", "--model_path", "-s", "--source_path")
"""Options of a checkout's script that the experiment sets itself: output folder and scene."""

Sizes = Callable[[str], tuple[int, int]]
"""Size of a scene's smallest image at a resolution."""


def check_runs(
    planned: Sequence[PlannedRun],
    jobs: Sequence[Job],
    scenes: Mapping[str, tuple[SceneSpec, Path]],
    mistakes: Mistakes,
    *,
    here: bool,
) -> None:
    """Collect the mistakes in these runs.

    Args:
        scenes: the scenes that exist or will be made, with their folders, by name.
        here: whether the runs are for this machine; if so, a missing package or device is a mistake.
    """
    by_id = {job.run_id: job for job in jobs}
    sizes = {name: cache(partial(_smallest_size, *scene)) for name, scene in scenes.items()}
    for run in planned:
        spec, keys = run.spec, mistakes.keys_of(run)
        try:
            HierarchySettings(seed=spec.seed)
            parse_resolution(spec.resolution)
            _check_name(spec)
            _check_arguments(spec)
            _check_kinds(spec)
            if (job := by_id.get(spec.run_id)) is not None:
                _rehearse(job, _Check(spec, sizes.get(spec.scene), here))
        except SceneError as error:
            mistakes.add(keys["scene"], str(error))
        except (LapgsError, USAGE_ERROR) as error:
            if here or not isinstance(error, MissingExtraError):
                _note(mistakes, keys, usage_message(error) if isinstance(error, USAGE_ERROR) else str(error))


def check_run(job: Job, spec: RunSpec, folder: Path) -> None:
    """Check the command line of one run for this machine, whose scene is in a folder.

    Raises:
        LapgsError: its command would refuse it.
    """
    scene = SceneSpec(spec.scene, spec.dataset, None, None, spec.resolution, spec.images)
    try:
        _rehearse(job, _Check(spec, partial(_smallest_size, scene, folder), here=True))
    except USAGE_ERROR as error:
        raise UserInputError(usage_message(error)) from error


def _note(mistakes: Mistakes, keys: Mapping[str, str], message: str) -> None:
    """Add a message under the key of the first option in it that the experiment sets."""
    options = (match.replace("-", "_") for match in re.findall(r"--([a-z][a-z-]*[a-z])", message))
    mistakes.add(next((keys[option] for option in options if option in keys), keys["run"]), message)


@dataclass
class _Check(Rehearsal):
    """Check that the rasterizer exists on this machine and that the images are large enough for all levels."""

    spec: RunSpec
    size: Sizes | None  # None: the scene is missing, which is already a mistake
    here: bool

    def train(self, request: TrainRequest) -> None:
        from lapgs_plugin.training.backend import training_rasterizer
        from lapgs_plugin.training.planning import make_plan, require_pruning

        settings, rasterizer = request.settings, request.control.rasterizer
        if self.size is not None:
            require_pruning(make_plan(self.size(request.photos.resolution), settings), settings)
        if self.here or rasterizer != AUTO:  # auto may choose another one elsewhere
            training_rasterizer(rasterizer, settings)

    def run(self, settings: RunSettings, arguments: Sequence[str]) -> None:
        assert self.size is not None, "commands of a checkout need a scene"
        if self.spec.method == "bare" or sets_option(self.spec.arguments, "--iterations"):
            return
        known = None
        if not sets_option(self.spec.arguments, "-r", "--resolution"):
            # The script may read scenes that we cannot read.
            with suppress(SceneError):
                known = self.size(BACKBONE_PREFIX + arguments[list(arguments).index("-r") + 1])
        StagePlan.create(known or ANY_SIZE, self.spec.iterations, settings.levels, settings.shares, settings.kind)


def _rehearse(job: Job, check: _Check) -> None:
    """Let the first command of a run check its options."""
    name, *words = job.steps[0].command[len(LAPGS) :]
    if not check.here and name == "run":
        words = _without_device(words)
    command = _command(name)
    with command.make_context(name, words, obj=check) as context:
        command.invoke(context)


def _without_device(words: Sequence[str]) -> list[str]:
    """Return a command line without `--device cuda`, because the machine that runs it may have a GPU."""
    kept = list(words)
    if "--device" in kept and kept[(at := kept.index("--device")) + 1] == "cuda":
        del kept[at : at + 2]
    return kept


@cache
def _command(name: str) -> Any:
    """Return a command as click's object."""
    return cast(Any, typer.main.get_command(app)).commands[name]


def _check_kinds(spec: RunSpec) -> None:
    """Check that flags are true or false and that other options are not."""
    flags = {
        p.name for p in _command("train" if spec.checkout is None else "run").params if getattr(p, "is_flag", False)
    }
    for name, value in spec.options.items():
        option = f"--{name.replace('_', '-')} {str(value).lower() if isinstance(value, bool) else value}"
        if isinstance(value, bool) != (name in flags):
            raise UserInputError(f"{option}: expected {'true or false' if name in flags else 'a number or text'}")
        if isinstance(value, str) and "\0" in value:
            raise UserInputError(f"{option}: expected no NUL, which no command line can hold")


def _check_name(spec: RunSpec) -> None:
    """Check that the names of a run's files are not too long."""
    if len(spec.run_id) > LONGEST_STEM:
        raise UserInputError(
            f"a run called {spec.run_id:.60}... has {len(spec.run_id)} characters, expected at most {LONGEST_STEM}; "
            "choose shorter names for the scene and the backbone"
        )


def _check_arguments(spec: RunSpec) -> None:
    """Refuse arguments of a checkout's script that would change the output folder or the scene."""
    for word in spec.arguments:
        if "\0" in word:
            raise UserInputError(f"arguments {word!r}: expected no NUL, which no command line can hold")
        if sets_option([word], *OWN_ARGUMENTS):
            raise UserInputError(
                f"arguments {word!r}: the experiment sets output folder and scene; expected other options of the script"
            )


def sets_option(arguments: Sequence[str], *options: str) -> bool:
    """Tell whether arguments of a script set any of these options."""
    return any(word == option or word.startswith(f"{option}=") for word in arguments for option in options)


def _smallest_size(scene: SceneSpec, folder: Path, resolution: str) -> tuple[int, int]:
    """Return the smallest width and height of a scene's images."""
    if scene.sample is not None and not folder.is_dir():
        return parse_resolution(resolution).size_for(*parse_size(scene.sample.size))
    from lapgs_plugin.scenes.scene import load_cameras, smallest_of

    train, test = load_cameras(folder, resolution=resolution, images=scene.images, eval=True)
    return smallest_of([*train.values(), *test.values()])
