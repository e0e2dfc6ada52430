"""What an experiment file may say, and reading one."""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.experiments.standard import DATASETS, PRESETS
from lapgs_plugin.hierarchy.plan import DEFAULT_HIERARCHY, Hierarchy

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
Options = dict[str, bool | int | float | str]
"""Options of `lapgs train` or `lapgs run` by name, without dashes in front and with underscores inside."""
RESIDUAL_OPTIONS = {
    **{"supervision": "reconstructed", "inherit": None, "joint": 0.0, "residual_color_rate": None},
    **{"residual_resets": False, "residual_threshold": 1.0, "base_sh_degree": None},
}
"""Those that only residuals have, and what of them says no more than leaving them out; None where nothing does."""


class _Part(BaseModel):
    """Every table of the file: unknown keys are errors, and 3 is no text."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SampleScene(_Part):
    """A scene made by `lapgs sample` before the first run; its options."""

    size: str = "480x320"
    views: int = Field(40, ge=2)
    points: int = Field(4000, ge=1)


class Scenes(_Part):
    """One `[[scenes]]`: a standard data set, a folder of one's own, or the sample scene.

    Attributes:
        dataset: name of a standard data set; `only` picks some of its scenes.
        name: of a scene of one's own; its folder is `path`, relative to the experiment file, or given with --path.
        sample: makes a sample scene of that `name` instead of reading one.
        resolution: as `lapgs train --resolution`.
        images: name of the image folder; "downscaled" is the folder that the data set keeps smaller copies in.
    """

    dataset: str | None = None
    only: list[str] = []
    name: str | None = Field(None, pattern=NAME)
    path: str | None = None
    sample: SampleScene | None = None
    resolution: str = "full"
    images: str = "images"

    @model_validator(mode="after")
    def _one_kind(self) -> Scenes:
        if (self.dataset is None) == (self.name is None):
            raise ValueError("give either dataset or name")
        if self.dataset is not None and self.dataset not in DATASETS:
            raise ValueError(f"dataset {self.dataset!r} is not known, expected {', '.join(DATASETS)}")
        for scene in self.only:
            if self.dataset is None or scene not in DATASETS[self.dataset].scenes:
                known = DATASETS[self.dataset].scenes if self.dataset else ()
                raise ValueError(f"only {scene!r}: expected scenes of the data set ({', '.join(known)})")
        if self.images == "downscaled" and self.dataset is None:
            raise ValueError('images = "downscaled" is known of data sets alone; name the folder')
        if self.sample is not None and (self.dataset is not None or self.path is not None):
            raise ValueError("a sample scene has a name alone, no dataset and no path")
        return self

    @property
    def names(self) -> list[str]:
        """Its scenes, in their order."""
        if self.dataset is None:
            return [self.name or ""]
        return self.only or list(DATASETS[self.dataset].scenes)


class Backbone(_Part):
    """One `[backbones.NAME]`: the built-in trainer on a rasterizer, or a checkout.

    Attributes:
        title: in tables; NAME when it is not given.
        rasterizer: of `lapgs train`: gsplat, cpu, auto, ...
        checkout: name under which --path or an environment variable gives the checkout's folder.
        preset: published options for the scenes of standard data sets, a name in data/presets.toml.
        arguments: of the checkout's script, for every run; what is named here wins over the preset.
        options: of `lapgs train` for every run, or of `lapgs run` for every hierarchy.
    """

    title: str = ""
    rasterizer: str | None = None
    checkout: str | None = Field(None, pattern=NAME)
    preset: str | None = None
    arguments: list[str] = []
    options: Options = {}

    @model_validator(mode="after")
    def _one_kind(self) -> Backbone:
        if (self.rasterizer is None) == (self.checkout is None):
            raise ValueError("give either rasterizer (the built-in trainer) or checkout (a script of its own)")
        if self.rasterizer is not None and (self.preset is not None or self.arguments):
            raise ValueError("preset and arguments are for the script of a checkout")
        if self.preset is not None and self.preset not in PRESETS:
            raise ValueError(f"preset {self.preset!r} is not known, expected {', '.join(PRESETS)}")
        return self

    @property
    def command(self) -> str:
        """The `lapgs` command that trains it as a hierarchy."""
        return "train" if self.checkout is None else "run"


class Variant(_Part):
    """One `[[variants]]`: a setting that every scene is trained with.

    Attributes:
        name: in tables.
        method: "hierarchy", or "bare": the checkout's script by itself, or one level of the built-in trainer.
        backbones: those that it is trained on; empty means all.
        iterations, resolution: instead of the experiment's and the scene's.
        options: of `lapgs train` or `lapgs run`, over those of the backbone.
        arguments: of the checkout's script, after those of the backbone.
        section: heading in tables above this row.
        paper: row of the paper's table, or one for each backbone.
        baseline: what other variants on the same backbone are compared with.
    """

    name: str
    method: Literal["hierarchy", "bare"] = "hierarchy"
    backbones: list[str] = []
    iterations: int | None = Field(None, ge=1)
    resolution: str | None = None
    options: Options = {}
    arguments: list[str] = []
    section: str = ""
    paper: str | dict[str, str] = ""
    baseline: bool = False

    def paper_row(self, backbone: str) -> str:
        """Name of the row that the paper prints for it, "" when it prints none."""
        return self.paper if isinstance(self.paper, str) else self.paper.get(backbone, "")


class Table(_Part):
    """`[table]`: how results are shown.

    Attributes:
        paper: the paper's table, a file in data/paper.
        columns: of `aggregate.COLUMNS`.
        transposed: one column a variant.
        by_scene: also a table for each scene.
    """

    paper: str | None = None
    columns: list[str] = ["minutes", "psnr", "ssim", "lpips", "gaussians_millions", "fps"]
    transposed: bool = False
    by_scene: bool = False


class Experiment(_Part):
    """A whole file."""

    name: str = Field(pattern=NAME)
    title: str
    iterations: int = Field(30_000, ge=1)
    seeds: list[int] = Field([0], min_length=1)
    scenes: list[Scenes] = Field(min_length=1)
    backbones: dict[str, Backbone] = Field(min_length=1)
    variants: list[Variant] = Field(min_length=1)
    table: Table = Table()

    @model_validator(mode="after")
    def _consistent(self) -> Experiment:
        if (twice := _twice([variant.name for variant in self.variants])) is not None:
            raise ValueError(f"two variants are called {twice!r}")
        if (twice := _twice([name for entry in self.scenes for name in entry.names])) is not None:
            raise ValueError(f"scene {twice!r} is there twice; a variant may have a resolution of its own instead")
        for variant in self.variants:
            unknown = {*variant.backbones, *(variant.paper if isinstance(variant.paper, dict) else ())}
            for name in sorted(unknown - self.backbones.keys()):
                raise ValueError(
                    f"variant {variant.name!r} names backbone {name!r}, expected {', '.join(self.backbones)}"
                )
            self._check_effect(variant)
        return self

    def _check_effect(self, variant: Variant) -> None:
        """Refuse what would change nothing."""
        checkouts = [self.backbones[name].checkout is not None for name in variant.backbones or self.backbones]
        if variant.method == "bare" and "levels" in variant.options:
            raise ValueError(f"variant {variant.name!r} is bare, which is one level; leave levels out")
        if variant.method == "bare" and variant.options and all(checkouts):
            raise ValueError(
                f"variant {variant.name!r} is bare: options of `lapgs run` mean nothing; set the script's arguments"
            )
        if variant.arguments and not any(checkouts):
            raise ValueError(f"variant {variant.name!r} has arguments, but no script of a checkout to give them to")


PARTS: Mapping[str, type[BaseModel]] = {
    "scenes": Scenes,
    "backbones": Backbone,
    "variants": Variant,
    "table": Table,
    "sample": SampleScene,
}
"""The model behind each key that holds tables."""


def load_experiment(path: Path, option_names: Mapping[str, Set[str]]) -> Experiment:
    """Read and check an experiment file.

    Args:
        path: a TOML file.
        option_names: by command, "train" and "run", the options that an experiment may set.

    Raises:
        UserInputError: it is not readable, not TOML, or says something that no experiment may say; names the key, and
            for an unknown one the nearest that is known.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserInputError(f"{path}: {error.strerror}; expected an experiment file such as smoke.toml") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserInputError(f"{path} is not TOML: {error}; expected an experiment file") from error
    try:
        experiment = Experiment.model_validate(values)
    except ValidationError as error:
        raise UserInputError(f"{path}: {_first_problem(error)}") from None
    _check_options(path, experiment, option_names)
    return experiment


def _twice(names: list[str]) -> str | None:
    """The first name that is there more than once."""
    return next((name for name in names if names.count(name) > 1), None)


def nearest(name: str, known: Set[str]) -> str:
    """What to say of an unknown name: the nearest known one, or all of them."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else f"expected one of {', '.join(sorted(known))}"


def _first_problem(error: ValidationError) -> str:
    """One of pydantic's complaints as one line: an unknown key before one that is missing, which it may be."""
    problems = error.errors(include_url=False)
    problem = next((each for each in problems if each["type"] == "extra_forbidden"), problems[0])
    place = [str(part) for part in problem["loc"]]
    where = ".".join(place)
    if problem["type"] == "extra_forbidden":
        holders = [part for part in place[:-1] if part in PARTS]
        model = PARTS[holders[-1]] if holders else Experiment
        return f"unknown key {where}; {nearest(place[-1], model.model_fields.keys())}"
    if problem["type"] == "missing":
        return f"{where} is missing; give it"
    message = re.sub(r"^Value error, ", "", str(problem["msg"]))
    received = problem["input"]
    shown = "" if isinstance(received, (dict, BaseModel)) else f", received {received!r}"
    return f"{where}: {message}{shown}" if where else message


def _check_options(path: Path, experiment: Experiment, option_names: Mapping[str, Set[str]]) -> None:
    """Every option is one of the command that it will be given to."""

    def check(where: str, options: Mapping[str, Any], command: str) -> None:
        for name in options:
            if name not in option_names[command]:
                raise UserInputError(
                    f"{path}: {where} sets {name}, which `lapgs {command}` does not have or the experiment sets "
                    f"itself; {nearest(name, option_names[command])}"
                )

    for key, backbone in experiment.backbones.items():
        check(f"backbones.{key}.options", backbone.options, backbone.command)
        for variant in experiment.variants:
            if not variant.backbones or key in variant.backbones:
                check(f"variant {variant.name!r}", variant.options, backbone.command)
                if variant.method != "bare" or backbone.checkout is None:
                    options = {**backbone.options, **variant.options}
                    _check_residuals(f"{path}: variant {variant.name!r} on backbone {key!r}", options)


def _check_residuals(where: str, options: Mapping[str, Any]) -> None:
    """Refuse what the command would refuse, before the first run starts."""
    if options.get("hierarchy", DEFAULT_HIERARCHY.value) != Hierarchy.NESTED.value:
        return
    for name, idle in RESIDUAL_OPTIONS.items():
        if options.get(name, idle) != idle:
            raise UserInputError(
                f"{where} sets {name}, which is about residuals, and nested levels have none; leave it out, or add "
                f'hierarchy = "{Hierarchy.LAPLACIAN.value}" to train residuals'
            )
