"""Read and check experiment files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from lapgs_bench.experiments.standard import DATASETS, EXPERIMENTS, PRESETS
from lapgs_plugin.errors import UserInputError, nearest
from lapgs_plugin.hierarchy.plan import REFERENCE_ITERATIONS
from lapgs_plugin.untrusted import read_toml

T = TypeVar("T")
NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
SCRIPT_PATH = r"^(?:[A-Za-z0-9_-]+/)*[A-Za-z0-9_-]+\.py$"
"""A script inside a folder, such as ms/train.py."""
LINE = r"^[^\x00-\x1f\x7f]*$"
"""Text of one line, which fits into a table."""
SCRIPT = "train.py"
"""Training script of most checkouts, in their folder."""
OF_BARE_RUNS = {"gpu_busy", "test_every"}
"""Options that a checkout's script by itself can be run with."""
Options = dict[str, bool | int | float | str]
"""Options of `lapgs train` or `lapgs run` by name, without leading dashes and with underscores."""


class ExperimentError(UserInputError):
    """Report mistakes in an experiment file, one line each."""


def _known_preset(name: str) -> str:
    if name not in PRESETS:
        raise ValueError(f"expected {', '.join(PRESETS)}")
    return name


PresetName = Annotated[str, AfterValidator(_known_preset)]


class _StrictModel(BaseModel):
    """Refuse unknown keys in a table of the file, and numbers where text belongs."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SampleScene(_StrictModel):
    """Give options of `lapgs sample` for a scene that is made before the first run."""

    size: str = "480x320"
    views: int = Field(40, ge=2)
    points: int = Field(4000, ge=1)

    @property
    def label(self) -> str:
        """A name for these options, such as 480x320-40-4000."""
        return f"{self.size.strip().lower()}-{self.views}-{self.points}"


class Scenes(_StrictModel):
    """Check one `[[scenes]]` table: a standard data set, a folder, or the sample scene.

    Attributes:
        dataset: name of a standard data set; `only` selects some of its scenes.
        name: name of another scene; its folder is `path`, relative to the experiment file, or given with --path.
        sample: make a sample scene of that `name`.
        resolution: see `lapgs train --resolution`.
        images: name of the image folder; "downscaled" is the data set's folder of smaller copies.
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
            raise ValueError('images = "downscaled" is only for data sets; name the folder')
        if self.sample is not None and (self.dataset is not None or self.path is not None):
            raise ValueError("a sample scene has only a name, no dataset and no path")
        return self

    @property
    def names(self) -> list[str]:
        """Names of its scenes, in order."""
        if self.dataset is None:
            return [self.name or ""]
        return self.only or list(DATASETS[self.dataset].scenes)


class Backbone(_StrictModel):
    """Check one `[backbones.NAME]` table: the built-in trainer with a rasterizer, or a checkout.

    Attributes:
        title: its name in tables; NAME by default.
        rasterizer: rasterizer of `lapgs train`: gsplat, cpu, auto, ...
        checkout: name of the checkout, whose folder is given by --path or an environment variable.
        script: training script of the checkout, relative to its folder.
        preset: published options for the scenes of standard data sets, a name in data/presets.toml.
        arguments: arguments of the checkout's script for every run; they override the preset.
        options: options of `lapgs train` for every run, or of `lapgs run` for every hierarchy.
    """

    title: str = Field("", pattern=LINE)
    rasterizer: str | None = None
    checkout: str | None = Field(None, pattern=NAME)
    script: str = Field(SCRIPT, pattern=SCRIPT_PATH)
    preset: PresetName | None = None
    arguments: list[str] = []
    options: Options = {}

    @model_validator(mode="after")
    def _one_kind(self) -> Backbone:
        if (self.rasterizer is None) == (self.checkout is None):
            raise ValueError("give either rasterizer (the built-in trainer) or checkout (a script of its own)")
        if self.rasterizer is not None and (self.preset is not None or self.arguments):
            raise ValueError("preset and arguments are for the script of a checkout")
        if self.rasterizer is not None and self.script != SCRIPT:
            raise ValueError("script is for a checkout; leave it out")
        return self

    @property
    def command(self) -> str:
        """The `lapgs` command that trains a hierarchy on it."""
        return "train" if self.checkout is None else "run"


class Variant(_StrictModel):
    """Check one `[[variants]]` table: a setting that every scene is trained with.

    Attributes:
        name: its name in tables.
        method: "hierarchy"; or "bare": the checkout's script by itself, or one level of the built-in trainer.
        backbones: backbones that it is trained on; empty means all.
        preset: by backbone, published options in place of those of the backbone.
        iterations, resolution: override those of the experiment and of the scene.
        options: options of `lapgs train` or `lapgs run`; they override those of the backbone.
        arguments: arguments of the checkout's script, after those of the backbone.
        section: heading above this row in tables.
        paper: row of the paper's table, or one for each backbone.
        baseline: whether other variants on the same backbone are compared with it.
    """

    name: str = Field(pattern=LINE, min_length=1)
    method: Literal["hierarchy", "bare"] = "hierarchy"
    backbones: list[str] = []
    preset: dict[str, PresetName] = {}
    iterations: int | None = Field(None, ge=1)
    resolution: str | None = None
    options: Options = {}
    arguments: list[str] = []
    section: str = Field("", pattern=LINE)
    paper: str | dict[str, str] = ""
    baseline: bool = False

    def paper_row(self, backbone: str) -> str:
        """Return the name of its row in the paper's table, "" without one."""
        return self.paper if isinstance(self.paper, str) else self.paper.get(backbone, "")


class Table(_StrictModel):
    """Check the `[table]` table: how results are shown.

    Attributes:
        paper: the paper's table, a file in data/paper.
        printed: rows of the paper's table that are shown without a measurement.
        columns: names in `aggregate.COLUMNS`.
        transposed: show each variant as a column.
        by_scene: add a table for each scene.
    """

    paper: str | None = None
    printed: list[str] = []
    columns: list[str] = ["minutes", "psnr", "ssim", "lpips", "gaussians_millions", "fps"]
    transposed: bool = False
    by_scene: bool = False


class Figure(_StrictModel):
    """Check one `[[figures]]` table: an image that is drawn of the results.

    Attributes:
        kind: what it shows.
        scenes: scenes that it shows; empty means all.
        view: held-out view of `crops`; by default the one whose PSNR is the median.
    """

    kind: Literal[
        "psnr_over_seconds", "gaussians_over_iterations", "seconds_over_gaussians", "peak_memory", "crops", "edges"
    ]
    scenes: list[str] = []
    view: str | None = Field(None, pattern=LINE)

    def images(self, scenes: Sequence[str]) -> dict[str, list[str]]:
        """Return the scenes of each of its images, by the image's name: one of all scenes, or one for each."""
        if self.kind in ("seconds_over_gaussians", "peak_memory"):
            return {self.kind: list(scenes)}
        return {f"{self.kind}-{scene}": [scene] for scene in scenes}

    @model_validator(mode="after")
    def _view_of_crops(self) -> Figure:
        if self.view is not None and (self.kind != "crops" or len(self.scenes) != 1):
            raise ValueError("view is for crops of one scene; leave it out")
        return self


class Experiment(_StrictModel):
    """Check a whole experiment file."""

    name: str = Field(pattern=NAME)
    title: str = Field(pattern=LINE)
    iterations: int = Field(REFERENCE_ITERATIONS, ge=1)
    seeds: list[int] = Field([0], min_length=1)
    scenes: list[Scenes] = Field(min_length=1)
    backbones: dict[str, Backbone] = Field(min_length=1)
    variants: list[Variant] = Field(min_length=1)
    table: Table = Table()
    figures: list[Figure] = []

    @model_validator(mode="after")
    def _consistent(self) -> Experiment:
        if problems := [
            *self._repetitions(),
            *self._unknown_backbones(),
            *self._unknown_scenes(),
            *self._without_effect(),
        ]:
            raise ValueError("\n".join(problems))
        return self

    def _repetitions(self) -> Iterator[str]:
        if (twice := _first_duplicate([variant.name for variant in self.variants])) is not None:
            yield f"variants: two variants are called {twice!r:.80}; expected different names"
        if (twice := _first_duplicate([name for entry in self.scenes for name in entry.names])) is not None:
            yield f"scenes: scene {twice!r} is listed twice; a variant may have its own resolution instead"
        if (seed := _first_duplicate(self.seeds)) is not None:
            yield f"seeds: {seed} is listed twice, which would count its runs twice; expected different seeds"
        scenes = [name for entry in self.scenes for name in entry.names]
        drawn = [name for figure in self.figures for name in figure.images(figure.scenes or scenes)]
        if (twice := _first_duplicate(drawn)) is not None:
            yield f"figures: two draw the image {twice}; expected one figure of a kind for a scene"

    def _unknown_backbones(self) -> Iterator[str]:
        for number, variant in enumerate(self.variants):
            unknown = {*variant.backbones, *variant.preset, *(variant.paper if isinstance(variant.paper, dict) else ())}
            for name in sorted(unknown - self.backbones.keys()):
                yield (
                    f"variants.{number}: variant {variant.name!r} names backbone {name!r}, expected "
                    f"{', '.join(self.backbones)}"
                )

    def _unknown_scenes(self) -> Iterator[str]:
        known = {name for entry in self.scenes for name in entry.names}
        for number, figure in enumerate(self.figures):
            for name in figure.scenes:
                if name not in known:
                    yield f"figures.{number}: scene {name!r} is not in the experiment; {nearest(name, known)}"

    def _without_effect(self) -> Iterator[str]:
        """Find settings that change nothing."""
        for number, variant in enumerate(self.variants):
            names = [name for name in variant.backbones or self.backbones if name in self.backbones]
            checkouts = [self.backbones[name].checkout is not None for name in names]
            where = f"variants.{number}: variant {variant.name!r}"
            if variant.method == "bare" and "levels" in variant.options:
                yield f"{where} is bare, which is one level; leave levels out"
            if variant.method == "bare" and variant.options.keys() - OF_BARE_RUNS and all(checkouts):
                yield f"{where} is bare: options of `lapgs run` have no effect; set the script's arguments"
            for name in variant.preset.keys() & self.backbones.keys():
                if self.backbones[name].checkout is None or name not in names:
                    yield f"{where} has a preset for {name}, which it does not train with a checkout; leave it out"
            if variant.arguments and not any(checkouts):
                yield f"{where} has arguments, but no checkout whose script takes them"


PARTS: Mapping[str, type[BaseModel]] = {
    "scenes": Scenes,
    "backbones": Backbone,
    "variants": Variant,
    "table": Table,
    "figures": Figure,
    "sample": SampleScene,
}
"""The model behind each key that holds tables."""
ALTERNATIVES = ("bool", "int", "float", "str", "dict[str,str]")
"""Pydantic's names for the alternative types of a value."""


def load_experiment(path: Path, option_names: Mapping[str, Set[str]]) -> Experiment:
    """Read and check an experiment file in TOML, given the options by command that an experiment may set.

    Raises:
        UserInputError: it cannot be read, is not TOML, or has mistakes: one line for each, which names the key, and for
            an unknown key the nearest known one.
    """
    # The commands refuse numbers that are not finite, and name the option.
    advice = f"give an experiment file, or the name of one that comes with lapgs: {', '.join(EXPERIMENTS)}"
    values = read_toml(path, advice=advice, finite=False)
    try:
        experiment = Experiment.model_validate(values)
    except ValidationError as error:
        problems = _problems(error)
    else:
        problems = _option_problems(experiment, option_names)
    if problems:
        raise ExperimentError(*(f"{path}: {problem}" for problem in problems))
    return experiment


def _first_duplicate(names: Sequence[T]) -> T | None:
    """Return the first item that occurs twice."""
    return next((name for name in names if names.count(name) > 1), None)


def _problems(error: ValidationError) -> list[str]:
    """Turn pydantic's errors into lines; a misspelt key is reported once, not also as a missing one."""
    by_key: dict[tuple[str, ...], list[Any]] = {}
    for problem in error.errors(include_url=False):
        # A value with alternative types has an error for each type, under the type's name.
        key = tuple(str(part) for part in problem["loc"] if part not in ALTERNATIVES)
        by_key.setdefault(key, []).append(problem)
    unknown = {key: _unknown_key(key) for key, problems in by_key.items() if problems[0]["type"] == "extra_forbidden"}
    lines = list(unknown.values())
    for key, problems in by_key.items():
        missing = problems[0]["type"] == "missing"
        if key in unknown or (missing and any(key[:-1] == other[:-1] for other in unknown)):
            continue
        lines += [f"{'.'.join(key)} is missing; give it"] if missing else _wrong_value(".".join(key), problems)
    return lines


def _unknown_key(key: tuple[str, ...]) -> str:
    holders = [part for part in key[:-1] if part in PARTS]
    model = PARTS[holders[-1]] if holders else Experiment
    return f"unknown key {'.'.join(key)}; {nearest(key[-1], model.model_fields.keys())}"


def _wrong_value(where: str, problems: list[Any]) -> list[str]:
    """Report one wrong value, or the errors of a table, which may be several in one message."""
    received = problems[0]["input"]
    of_tables = problems[0]["type"] == "value_error" and isinstance(received, (dict, BaseModel))
    shown = "" if of_tables else f" = {received!r:.80}"
    message = " or ".join(dict.fromkeys(re.sub(r"^Value error, ", "", str(problem["msg"])) for problem in problems))
    return [f"{where}{shown}: {line}" if where else line for line in message.split("\n")]


def _option_problems(experiment: Experiment, option_names: Mapping[str, Set[str]]) -> list[str]:
    """Find options that the command of their runs does not have."""
    tables = [(f"backbones.{key}", table.options, table.command) for key, table in experiment.backbones.items()]
    for number, variant in enumerate(experiment.variants):
        commands = {experiment.backbones[key].command for key in variant.backbones or experiment.backbones}
        tables += [(f"variants.{number}", variant.options, command) for command in sorted(commands)]
    problems: dict[str, str] = {}  # by key, so that a mistake that concerns several commands is reported once
    for where, options, command in tables:
        for name in options.keys() - option_names[command]:
            problems[f"{where}.options.{name}"] = (
                f"{where}.options.{name} = {options[name]!r:.80}: sets {name}, which `lapgs {command}` does not have "
                f"or the experiment sets itself; {nearest(name, option_names[command])}"
            )
    return [problems[key] for key in sorted(problems)]
