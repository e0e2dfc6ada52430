"""What an experiment file may say, and reading one."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.experiments.standard import DATASETS, PRESETS
from lapgs_plugin.hierarchy.plan import DEFAULT_HIERARCHY, Hierarchy
from lapgs_plugin.untrusted import read_toml

T = TypeVar("T")
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
        if problems := [*self._repetitions(), *self._unknown_backbones(), *self._without_effect()]:
            raise ValueError("\n".join(problems))
        return self

    def _repetitions(self) -> Iterator[str]:
        if (twice := _twice([variant.name for variant in self.variants])) is not None:
            yield f"variants: two variants are called {twice!r:.80}; expected different names"
        if (twice := _twice([name for entry in self.scenes for name in entry.names])) is not None:
            yield f"scenes: scene {twice!r} is there twice; a variant may have a resolution of its own instead"
        if (seed := _twice(self.seeds)) is not None:
            yield f"seeds: {seed} is there twice, which would count its runs twice; expected different seeds"

    def _unknown_backbones(self) -> Iterator[str]:
        for number, variant in enumerate(self.variants):
            unknown = {*variant.backbones, *(variant.paper if isinstance(variant.paper, dict) else ())}
            for name in sorted(unknown - self.backbones.keys()):
                yield (
                    f"variants.{number}: variant {variant.name!r} names backbone {name!r}, expected "
                    f"{', '.join(self.backbones)}"
                )

    def _without_effect(self) -> Iterator[str]:
        """What would change nothing."""
        for number, variant in enumerate(self.variants):
            names = [name for name in variant.backbones or self.backbones if name in self.backbones]
            checkouts = [self.backbones[name].checkout is not None for name in names]
            where = f"variants.{number}: variant {variant.name!r}"
            if variant.method == "bare" and "levels" in variant.options:
                yield f"{where} is bare, which is one level; leave levels out"
            if variant.method == "bare" and variant.options and all(checkouts):
                yield f"{where} is bare: options of `lapgs run` mean nothing; set the script's arguments"
            if variant.arguments and not any(checkouts):
                yield f"{where} has arguments, but no script of a checkout to give them to"


PARTS: Mapping[str, type[BaseModel]] = {
    "scenes": Scenes,
    "backbones": Backbone,
    "variants": Variant,
    "table": Table,
    "sample": SampleScene,
}
"""The model behind each key that holds tables."""
LONGEST_LINE = 1000
"""Characters of one mistake."""
ALTERNATIVES = ("bool", "int", "float", "str", "dict[str,str]")
"""What pydantic calls the types of a value that may be one of several."""


def load_experiment(path: Path, option_names: Mapping[str, Set[str]]) -> Experiment:
    """Read and check an experiment file.

    Args:
        path: a TOML file.
        option_names: by command, "train" and "run", the options that an experiment may set.

    Raises:
        UserInputError: it is not readable, not TOML, or says something that no experiment may say: a line for each
            mistake, which names the key, and for an unknown one the nearest that is known.
    """
    values = read_toml(path, advice="give an experiment file such as smoke.toml")
    try:
        experiment = Experiment.model_validate(values)
    except ValidationError as error:
        problems = _problems(error)
    else:
        problems = _option_problems(experiment, option_names)
    if problems:
        raise UserInputError("\n".join(one_line(f"{path}: {problem}") for problem in problems))
    return experiment


def _twice(names: Sequence[T]) -> T | None:
    """The first that is there more than once."""
    return next((name for name in names if names.count(name) > 1), None)


def nearest(name: str, known: Set[str]) -> str:
    """What to say of an unknown name: the nearest known one, or all of them."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else f"expected one of {', '.join(sorted(known))}"


def one_line(text: str) -> str:
    """The text on one line that is not endless, with what a terminal would obey spelled out."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}..."


def _problems(error: ValidationError) -> list[str]:
    """Pydantic's complaints, a line each; unknown keys first, and no missing key beside one that is misspelt."""
    found: dict[tuple[str, ...], list[Any]] = {}
    for problem in error.errors(include_url=False):
        # Of a value that may be one of several types there is a complaint for each type, under the type's name.
        place = tuple(str(part) for part in problem["loc"] if part not in ALTERNATIVES)
        found.setdefault(place, []).append(problem)
    unknown = {place: _unknown_key(place) for place, each in found.items() if each[0]["type"] == "extra_forbidden"}
    lines = list(unknown.values())
    for place, problems in found.items():
        missing = problems[0]["type"] == "missing"
        if place in unknown or (missing and any(place[:-1] == other[:-1] for other in unknown)):
            continue
        lines += [f"{'.'.join(place)} is missing; give it"] if missing else _wrong_value(".".join(place), problems)
    return lines


def _unknown_key(place: tuple[str, ...]) -> str:
    holders = [part for part in place[:-1] if part in PARTS]
    model = PARTS[holders[-1]] if holders else Experiment
    return f"unknown key {'.'.join(place)}; {nearest(place[-1], model.model_fields.keys())}"


def _wrong_value(where: str, problems: list[Any]) -> list[str]:
    """What is said of one value, or of what tables say together: there several mistakes may be in one complaint."""
    received = problems[0]["input"]
    of_tables = problems[0]["type"] == "value_error" and isinstance(received, (dict, BaseModel))
    shown = "" if of_tables else f" = {received!r:.80}"
    message = " or ".join(dict.fromkeys(re.sub(r"^Value error, ", "", str(each["msg"])) for each in problems))
    return [f"{where}{shown}: {line}" if where else line for line in message.split("\n")]


def _option_problems(experiment: Experiment, option_names: Mapping[str, Set[str]]) -> list[str]:
    """What is wrong with options: every one has to be of the command that it will be given to."""
    found: dict[str, str] = {}  # by place: what several commands do not have is said once
    residual: dict[str, None] = {}

    def check(where: str, options: Mapping[str, Any], command: str) -> bool:
        unknown = [name for name in options if name not in option_names[command]]
        for name in unknown:
            place = f"{where}.options.{name}"
            found.setdefault(
                place,
                f"{place} = {options[name]!r:.80}: sets {name}, which `lapgs {command}` does not have or the "
                f"experiment sets itself; {nearest(name, option_names[command])}",
            )
        return not unknown

    for key, backbone in experiment.backbones.items():
        known = check(f"backbones.{key}", backbone.options, backbone.command)
        for number, variant in enumerate(experiment.variants):
            if variant.backbones and key not in variant.backbones:
                continue
            if (
                check(f"variants.{number}", variant.options, backbone.command)
                and known
                and (variant.method != "bare" or backbone.checkout is None)
            ):
                options = {**backbone.options, **variant.options}
                where = f"variants.{number}: variant {variant.name!r} on backbone {key!r}"
                residual.update(dict.fromkeys(_residual_problems(where, options)))
    return list(found.values()) or list(residual)


def _residual_problems(where: str, options: Mapping[str, Any]) -> list[str]:
    """What the command would refuse of options about residuals."""
    if options.get("hierarchy", DEFAULT_HIERARCHY.value) != Hierarchy.NESTED.value:
        return []
    return [
        f"{where} sets {name} = {options[name]!r:.80}, which is about residuals, and nested levels have none; leave it "
        f'out, or add hierarchy = "{Hierarchy.LAPLACIAN.value}" to train residuals'
        for name, idle in RESIDUAL_OPTIONS.items()
        if options.get(name, idle) != idle
    ]
