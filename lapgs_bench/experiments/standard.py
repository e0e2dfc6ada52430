"""Load standard data sets, backbones' published options for them, experiments, and the figures of the paper.

All of them are files in data/: datasets.toml, presets.toml, experiments/*.toml and paper/*.csv.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_file
from lapgs_plugin.hierarchy.plan import REFERENCE_ITERATIONS
from lapgs_plugin.untrusted import read_toml

DATA = Path(__file__).parent / "data"
EXPERIMENTS = {path.stem: path for path in sorted((DATA / "experiments").glob("*.toml"))}
"""Experiment files that come with this package, by name."""
KEYS = ("dataset", "scene", "row")
"""Columns of a paper table that identify a row."""


def experiment_file(name: Path) -> Path:
    """Return the file of an experiment that a user gave by its path or, for one of `EXPERIMENTS`, by its name."""
    return name if is_file(name) else EXPERIMENTS.get(str(name), name)


@dataclass(frozen=True)
class Dataset:
    """Describe a data set by its title in papers and its scenes, each with the name of its folder of smaller images."""

    title: str
    scenes: Mapping[str, str]


@dataclass(frozen=True)
class Preset:
    """Hold options that a backbone publishes at `source`.

    Attributes:
        common: for every scene.
        scenes: further ones by scene.
        schedule: iterations that the script takes as options, of a run of `REFERENCE_ITERATIONS`; they scale with its
            length.
        options: those of `lapgs run`, where the script has none.
    """

    source: str
    common: tuple[str, ...]
    scenes: Mapping[str, tuple[str, ...]]
    schedule: Mapping[str, int] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    def arguments(self, scene: str, iterations: int = REFERENCE_ITERATIONS) -> list[str]:
        """Return the script's arguments for a scene and a length of the run; unknown scenes have the common ones."""
        scaled = (
            (f"--{name}", str(max(1, round(at * iterations / REFERENCE_ITERATIONS))))
            for name, at in self.schedule.items()
        )
        return [*chain.from_iterable(scaled), *self.common, *self.scenes.get(scene, ())]


@dataclass(frozen=True)
class PaperFigure:
    """Hold a figure of the paper, or one for each level.

    Attributes:
        values: one, or one for each level, coarsest first.
        exact: whether it is of exactly the requested scenes; otherwise it is of the whole data set.
    """

    values: tuple[float, ...]
    exact: bool

    @property
    def value(self) -> float:
        """Sum over the levels."""
        return math.fsum(self.values)


class PaperTable:
    """Look up figures in one table of the paper, a file in data/paper.

    Raises:
        UserInputError: there is no table of that name.
    """

    def __init__(self, name: str) -> None:
        path = DATA / "paper" / f"{name}.csv"
        if not path.is_file():
            known = ", ".join(sorted(p.stem for p in path.parent.glob("*.csv")))
            raise UserInputError(f"table.paper = {name!r}: expected one of {known}")
        self.name = name
        self._figures: dict[tuple[str, str, str], dict[str, tuple[float, ...]]] = {}
        with path.open(newline="", encoding="utf-8") as stream:
            for line in csv.DictReader(stream):
                key = (line["dataset"], line["scene"], line["row"])
                self._figures[key] = {c: _figures(text) for c, text in line.items() if c not in KEYS and text}

    @property
    def rows(self) -> set[str]:
        """Names of the rows."""
        return {row for _, _, row in self._figures}

    def figure(self, dataset: str, scenes: Collection[str], row: str, column: str) -> PaperFigure | None:
        """Return the figure for some scenes of a data set: their mean when they are printed one by one.

        Returns:
            None when neither they nor the whole data set are printed.
        """
        single = [self._figures.get((dataset, scene, row), {}).get(column) for scene in scenes]
        whole = self._figures.get((dataset, "", row), {}).get(column)
        complete = dataset in DATASETS and set(scenes) == set(DATASETS[dataset].scenes)
        if whole is not None and complete:
            return PaperFigure(whole, True)
        values = [value for value in single if value is not None]
        if values and len(values) == len(scenes):
            levels = zip(*values, strict=True)
            return PaperFigure(tuple(math.fsum(level) / len(values) for level in levels), True)
        return None if whole is None else PaperFigure(whole, False)


def _figures(text: str) -> tuple[float, ...]:
    """ "0.71/0.87" -> (0.71, 0.87), coarsest first."""
    return tuple(float(part) for part in text.split("/"))


def _read(name: str, kind: Any) -> Any:
    return read_toml(DATA / name, kind, advice="install lapgs_plugin again")


DATASETS: Mapping[str, Dataset] = _read("datasets.toml", dict[str, Dataset])
"""Data sets by their names in experiments."""
PRESETS: Mapping[str, Preset] = {
    f"{backbone}.{name}": preset
    for backbone, presets in _read("presets.toml", dict[str, dict[str, Preset]]).items()
    for name, preset in presets.items()
}
"""Presets by backbone and name, such as "backbone.big"."""
