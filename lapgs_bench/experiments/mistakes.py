"""Collect all mistakes of an experiment, to report them together before anything is written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lapgs_bench.experiments.expansion import PlannedRun
from lapgs_bench.experiments.schema import Experiment, ExperimentError
from lapgs_bench.experiments.settings import Selection
from lapgs_plugin.errors import LapgsError


class Mistakes:
    """Collect the mistakes of one experiment file, each one line: file, key, value, expectation."""

    def __init__(self, file: Path, experiment: Experiment, selection: Selection) -> None:
        self._file, self._experiment, self._selection = file, experiment, selection
        self._lines: dict[str, None] = {}

    def add(self, key: str, message: str) -> None:
        """Add a mistake; a repeated one is kept once."""
        self._lines[f"{self._file}: {key}: {message}"] = None

    @contextmanager
    def at(self, key: str) -> Iterator[None]:
        """Add the error that ends the block, if any."""
        try:
            yield
        except LapgsError as error:
            self.add(key, str(error))

    def refuse(self) -> None:
        """Raise all mistakes as one error.

        Raises:
            ExperimentError: there are mistakes.
        """
        if self._lines:
            raise ExperimentError(*self._lines)

    def scene_key(self, name: str) -> str:
        """Return the key of a scene in the file."""
        return f"{self._scene(name)} ({name})"

    def keys_of(self, run: PlannedRun) -> dict[str, str]:
        """Return the keys in the file, or on the command line, that define a run: by option, the key and its value.

        "run" is the key of the whole run, "scene" that of its scene.
        """
        experiment, selection, spec, scene = self._experiment, self._selection, run.spec, self._scene(run.spec.scene)
        number = next(i for i, variant in enumerate(experiment.variants) if variant.name == run.variant)
        variant, backbone = experiment.variants[number], experiment.backbones[spec.backbone]
        own, its = f"variants.{number}", f"backbones.{spec.backbone}"
        iterations = f"{own}.iterations" if variant.iterations else "iterations"
        keys = {
            "seed": "--seeds" if selection.seeds else f"seeds.{experiment.seeds.index(spec.seed)}",
            "iterations": "--iterations" if selection.iterations else iterations,
            "resolution": f"{own if variant.resolution else scene}.resolution",
            "images": f"{scene}.images",
            "rasterizer": f"{its}.rasterizer",
            **{name: f"{its}.options.{name}" for name in backbone.options},
            **{name: f"{own}.options.{name}" for name in variant.options},
        }
        values = {name: value for name, value in {**vars(spec), **spec.options}.items() if value is not None}
        return {
            "run": f"{own} ({json.dumps(variant.name, ensure_ascii=False)} on {spec.backbone})",
            "scene": self.scene_key(spec.scene),
            **{name: f"{key} = {json.dumps(values[name]):.80}" for name, key in keys.items() if name in values},
        }

    def _scene(self, name: str) -> str:
        number = next(i for i, entry in enumerate(self._experiment.scenes) if name in entry.names)
        return f"scenes.{number}"
