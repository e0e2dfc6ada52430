"""Build the commands that train and evaluate a run, and find scenes and checkouts on this machine."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar

from lapgs_bench.experiments.expansion import RunSpec, SceneSpec
from lapgs_plugin.adapters.info import RASTER_OPTIONS
from lapgs_plugin.adapters.registry import recognise
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_folder
from lapgs_plugin.hierarchy.plan import REFERENCE_DENSIFY_FROM, REFERENCE_ITERATIONS
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.scenes.resolution import BACKBONE_DIVISORS, parse_resolution
from lapgs_plugin.training.settings import TrainSettings
from lapgs_plugin.untrusted import STRICT

LAPGS = (sys.executable, "-m", "lapgs_plugin")
IMPORTED = "lapgs"
"""Folder inside a bare run's folder where `lapgs import-run` writes the run that `lapgs eval` reads."""
NEVER = "-1"
ON_BY_DEFAULT = ("dry-run", "fused-adam", "fused-ssim", "prune-by-size", "run-ahead")
"""Options that --no-NAME switches off."""


@dataclass(frozen=True)
class Step:
    """Hold one command of a run, with its arguments, and its working directory."""

    __pydantic_config__: ClassVar[Any] = STRICT

    command: tuple[str, ...]
    cwd: str


class Locations:
    """Find folders of scenes, data sets and checkouts: by name from --path, or relative to the experiment file."""

    def __init__(self, folders: Mapping[str, Path], base: Path) -> None:
        self._folders, self._base = folders, base

    def scene(self, scene: SceneSpec) -> Path:
        """Find the folder of a scene.

        Raises:
            UserInputError: its folder is not given, or has no such images.
        """
        folder = self._find(scene.name)
        if folder is None and scene.dataset and (root := self._find(scene.dataset)) is not None:
            folder = root / scene.name
        if folder is None and scene.folder is not None:
            folder = self._base / scene.folder
        names = [scene.name, *([scene.dataset] if scene.dataset else [])]
        folder = self._require_folder(f"scene {scene.name}", folder, names)
        transforms = any(folder.glob("transforms*.json"))
        if not transforms and not is_folder(folder / scene.images):
            raise UserInputError(
                f"scene {scene.name}: {folder} has no image folder {scene.images}; expected a COLMAP or Blender-style "
                f'scene; give another folder with --path {scene.name}=FOLDER or set images = "..." in the experiment'
            )
        return folder

    def checkout(self, name: str, script: str) -> Path:
        """Find the folder of a backbone's checkout with a training script.

        Raises:
            UserInputError: its folder is not given, or has no training script.
        """
        otherwise = ", or choose other backbones with --backbone"
        folder = self._require_folder(f"checkout {name}", self._find(name), [name], otherwise)
        if not (folder / script).is_file():
            raise UserInputError(
                f"checkout {name}: {folder} has no {script}; give its folder with --path {name}=FOLDER"
            )
        return folder

    def _find(self, name: str) -> Path | None:
        variable = os.environ.get(_environment_variable(name))
        return self._folders.get(name, None if variable is None else Path(variable))

    @staticmethod
    def _require_folder(name: str, folder: Path | None, keys: Iterable[str], otherwise: str = "") -> Path:
        ways = " or ".join(f"--path {key}=FOLDER ({_environment_variable(key)})" for key in keys) + otherwise
        if folder is None:
            raise UserInputError(f"{name}: its folder is not given; give {ways}")
        if not is_folder(folder):
            raise UserInputError(f"{name}: {folder} is not a folder; give {ways}")
        return folder.absolute()


def _environment_variable(name: str) -> str:
    """Return the environment variable that gives a folder."""
    return "LAPGS_" + name.upper().replace("-", "_").replace(".", "_")


def run_steps(
    spec: RunSpec, scene: Path, checkout: Path | None, folder: Path, evaluate: Sequence[str] | None
) -> list[Step]:
    """Return the commands of a run, in order.

    Args:
        scene, folder: the scene's folder and the output folder, whose content is replaced.
        checkout: folder of the backbone's checkout; None for the built-in trainer.
        evaluate: options of `lapgs eval`, the last command; None leaves it out.

    Raises:
        UserInputError: a checkout's script cannot read the scene at this resolution.
    """
    if checkout is None:
        steps = [Step(_train(spec, scene, folder), str(folder.parent))]
    else:
        bare = spec.method == "bare"
        how = ("--off", "--record") if bare else ("--overwrite",)
        options = "--seed", str(spec.seed), *_as_options(spec.options)
        command = *LAPGS, "run", *how, *options, *_script(spec, scene, checkout, folder)
        steps = [Step(command, str(checkout))]
        if bare and evaluate is not None:
            steps.append(Step(_import(spec, scene, checkout, folder), str(checkout)))
    if evaluate is not None:
        steps.append(Step((*LAPGS, "eval", str(measured_folder(spec, folder)), *evaluate), str(folder.parent)))
    return steps


def defaults_of(spec: RunSpec) -> str:
    """Return, as JSON, the settings that a run's training command has without options, to notice a changed default."""
    if spec.checkout is None:
        settings = TrainSettings(iterations=spec.iterations).resolved()
    else:
        settings = {} if spec.method == "bare" else RunSettings().resolved()
    return json.dumps(dict(_flat(settings)), sort_keys=True, default=str)


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield settings by name, those of nested dictionaries too."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value)
        else:
            yield name, value


def measured_folder(spec: RunSpec, folder: Path) -> Path:
    """Return the folder of a run's manifest."""
    return folder / IMPORTED if spec.checkout is not None and spec.method == "bare" else folder


def _train(spec: RunSpec, scene: Path, folder: Path) -> tuple[str, ...]:
    assert spec.rasterizer is not None, "checked by the schema"
    levels = {"levels": 1} if spec.method == "bare" else {}
    return (
        *(*LAPGS, "train", str(scene), "--out", str(folder), "--overwrite", "--eval"),
        *("--iterations", str(spec.iterations), "--resolution", spec.resolution, "--images", spec.images),
        *("--seed", str(spec.seed), "--rasterizer", spec.rasterizer),
        # Backbones compensate no exposure, and tables compare views without compensation.
        *_as_options({"appearance": "none", **spec.options, **levels}),
    )


def _script(spec: RunSpec, scene: Path, checkout: Path, folder: Path) -> tuple[str, ...]:
    return (
        *(str(checkout / spec.script), "-s", str(scene), "-i", spec.images, "-m", str(folder), "--eval"),
        *("-r", _backbone_resolution(spec, scene)),
        *("--test_iterations", NEVER, "--checkpoint_iterations", NEVER, "--save_iterations", str(spec.iterations)),
        *_schedule(spec.iterations),
        *spec.arguments,
    )


def _schedule(iterations: int) -> tuple[str, ...]:
    """Return 3DGS's schedule for a number of iterations: everything scales except the intervals."""
    if iterations == REFERENCE_ITERATIONS:
        return ()
    start = max(1, round(REFERENCE_DENSIFY_FROM * min(1.0, iterations / REFERENCE_ITERATIONS)))
    return (
        *("--iterations", str(iterations), "--position_lr_max_steps", str(iterations)),
        *("--densify_from_iter", str(start), "--densify_until_iter", str(iterations // 2)),
    )


def _import(spec: RunSpec, scene: Path, checkout: Path, folder: Path) -> tuple[str, ...]:
    adapter = recognise(checkout)
    named = () if adapter is None else ("--backbone", adapter.info.name)
    return (
        *(*LAPGS, "import-run", str(folder), "--out", str(folder / IMPORTED), "--scene", str(scene), "--overwrite"),
        *(*named, *_raster_options(spec.arguments)),
    )


def _raster_options(arguments: Sequence[str]) -> list[str]:
    """Return the script's arguments that affect how a saved field is rendered, the last of each kind."""
    values: dict[str, str] = {}
    for word, following in zip(arguments, [*arguments, "-"][1:], strict=True):
        name, assigned, value = word.removeprefix("--").partition("=")
        if word.startswith("--") and name in RASTER_OPTIONS:
            values[name] = value if assigned else "true" if following.startswith("-") else following
    return [text for name, value in values.items() for text in ("--set", f"{name}={value}")]


def _as_options(options: Mapping[str, Any]) -> list[str]:
    words = []
    for name, value in options.items():
        option = name.replace("_", "-")
        if not isinstance(value, bool):
            words += [f"--{option}", str(value)]
        elif value or option in ON_BY_DEFAULT:
            words.append(f"--{option}" if value else f"--no-{option}")
    return words


def _backbone_resolution(spec: RunSpec, scene: Path) -> str:
    """Return the value of a 3DGS codebase's -r for one of our resolutions."""
    text = spec.resolution
    rule = parse_resolution(text)
    if rule.backbone is not None:
        return str(rule.backbone)
    if rule.width is None:
        divisor = 1 / rule.fraction
        if divisor not in BACKBONE_DIVISORS:
            raise UserInputError(
                f"resolution {text!r} for scene {spec.scene}: the script of a checkout takes 1k, 2k, 4k, widths and "
                f"{', '.join(str(Fraction(1, d)) for d in BACKBONE_DIVISORS)}"
            )
        return str(int(divisor))
    width = _first_width(scene / spec.images)
    return str(rule.size_for(width, 1)[0]) if width > rule.width else "1"


def _first_width(images: Path) -> int:
    """Return the width of a scene's first image, in pixels."""
    from lapgs_plugin.scenes.images import image_size, is_photo

    for path in sorted(images.rglob("*")):
        if is_photo(path):
            return image_size(path)[0]
    raise UserInputError(f"{images} holds no image; expected the photos of a scene")
