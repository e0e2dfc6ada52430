"""What is known beforehand: standard data sets, options that backbones publish for them, figures that the paper prints.

All of it is data, in data/datasets.toml, data/presets.toml and data/paper/*.csv.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.untrusted import read_toml

DATA = Path(__file__).parent / "data"
KEYS = ("dataset", "scene", "row")
"""Columns of a paper table that say what its figures are of."""


@dataclass(frozen=True)
class Dataset:
    """A data set that papers report on.

    Attributes:
        title: as papers write it.
        scenes: its scenes in their usual order, each with the name of the folder of its smaller copies.
    """

    title: str
    scenes: Mapping[str, str]


@dataclass(frozen=True)
class Preset:
    """Options that a backbone publishes.

    Attributes:
        source: where.
        common: for every scene.
        scenes: what is added, by scene.
    """

    source: str
    common: tuple[str, ...]
    scenes: Mapping[str, tuple[str, ...]]

    def arguments(self, scene: str) -> list[str]:
        """Of the backbone's script, for a scene; one that it says nothing about gets what is common."""
        return [*self.common, *self.scenes.get(scene, ())]


@dataclass(frozen=True)
class Printed:
    """A figure, or one for each level, as the paper prints it.

    Attributes:
        values: one, or one a level.
        exact: whether it is of the very scenes that were asked for; else it is of the whole data set.
    """

    values: tuple[float, ...]
    exact: bool

    @property
    def value(self) -> float:
        """All levels together."""
        return math.fsum(self.values)


class PaperTable:
    """One table of the paper.

    Args:
        name: of its file.

    Raises:
        UserInputError: there is none of that name.
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
        """Names of its rows."""
        return {row for _, _, row in self._figures}

    def figure(self, dataset: str, scenes: Collection[str], row: str, column: str) -> Printed | None:
        """What is printed for some scenes of a data set, their mean where it prints them one by one.

        Returns:
            None where it prints nothing, neither for them nor for the whole data set.
        """
        single = [self._figures.get((dataset, scene, row), {}).get(column) for scene in scenes]
        if len(single) == 1 and single[0] is not None:
            return Printed(single[0], True)
        whole = self._figures.get((dataset, "", row), {}).get(column)
        complete = dataset in DATASETS and set(scenes) == set(DATASETS[dataset].scenes)
        if whole is not None and complete:
            return Printed(whole, True)
        values = [value for value in single if value is not None]
        if values and len(values) == len(scenes):
            levels = zip(*values, strict=True)
            return Printed(tuple(math.fsum(level) / len(values) for level in levels), True)
        return None if whole is None else Printed(whole, False)


def _figures(text: str) -> tuple[float, ...]:
    """ "0.71/0.87" -> (0.71, 0.87), coarsest first."""
    return tuple(float(part) for part in text.split("/"))


def _read(name: str) -> dict[str, Any]:
    values: dict[str, Any] = read_toml(DATA / name, advice="install lapgs_plugin again")
    return values


def _datasets() -> dict[str, Dataset]:
    return {
        name: Dataset(values["title"], {scene: about["downscaled"] for scene, about in values["scenes"].items()})
        for name, values in _read("datasets.toml").items()
    }


def _presets() -> dict[str, Preset]:
    return {
        f"{backbone}.{name}": Preset(
            preset["source"], tuple(preset["common"]), {s: tuple(words) for s, words in preset["scenes"].items()}
        )
        for backbone, presets in _read("presets.toml").items()
        for name, preset in presets.items()
    }


DATASETS = _datasets()
"""By the name that experiments use."""
PRESETS = _presets()
"""By backbone and name, such as "backbone.big"."""
