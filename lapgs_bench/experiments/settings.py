"""Declare the options of an experiment's runs. Imports no pydantic, which is slow to import."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import check_values, option

SELECTION, PLACES, ENGINE = "Selection", "Folders", "Execution"


@dataclass(frozen=True)
class Selection:
    """Choose the part of an experiment to run; None leaves the file's.

    Raises:
        UserInputError: the seeds are no list of different numbers, or there are no iterations.
    """

    scenes: list[str] | None = option(None, "Run only this scene. Repeatable.", panel=SELECTION, names=("--scene",))
    backbones: list[str] | None = option(
        None, "Run only this backbone. Repeatable.", panel=SELECTION, names=("--backbone",)
    )
    variants: list[str] | None = option(
        None, "Run only this variant. Repeatable.", panel=SELECTION, names=("--variant",)
    )
    seeds: str | None = option(None, "Seeds instead of those in the file, such as 0,1,2.", panel=SELECTION)
    iterations: int | None = option(
        None, "Iterations instead of the file's; variants are scaled alike.", panel=SELECTION, least=1
    )

    def __post_init__(self) -> None:
        check_values(self)
        self.seeds_or([])

    def seeds_or(self, those_of_file: list[int]) -> list[int]:
        """Return the seeds to run, given those of the experiment's file."""
        if self.seeds is None:
            return those_of_file
        wrong = f"--seeds {self.seeds}: expected"
        try:
            numbers = [int(part) for part in self.seeds.split(",")]
        except ValueError as error:
            raise UserInputError(f"{wrong} whole numbers separated by commas, such as 0,1,2") from error
        if len(set(numbers)) < len(numbers):
            raise UserInputError(f"{wrong} different numbers")
        return numbers


@dataclass(frozen=True)
class WorkerSettings:
    """Choose where runs are executed, and how many at a time.

    Raises:
        UserInputError: a number is out of range, or an option of the launcher is no NAME=VALUE.
    """

    launcher: str = option("local", "Where runs are executed: local, slurm (with submitit) or ray.", panel=ENGINE)
    workers: int | None = option(
        None, "Runs at a time. Default: one per GPU, or one without GPUs.", panel=ENGINE, least=1, most=1024
    )
    gpus: str | None = option(None, "GPUs to use, as in CUDA_VISIBLE_DEVICES: 0,1. Default: all.", panel=ENGINE)
    launcher_option: list[str] | None = option(
        None,
        "Option of the launcher. Slurm: those of submitit (slurm_partition=gpu, timeout_min=600). Ray: address, "
        "num_gpus, num_cpus. Repeatable.",
        panel=ENGINE,
        metavar="NAME=VALUE",
    )

    def __post_init__(self) -> None:
        check_values(self)
        _ = self.launcher_options

    @property
    def launcher_options(self) -> dict[str, Any]:
        """The values of --launcher-option by name."""
        pairs = _pairs(self.launcher_option, "--launcher-option")
        return {name: int(value) if value.isdecimal() else value for name, value in pairs.items()}


@dataclass(frozen=True)
class BenchSettings:
    """Choose the runs of an experiment, where they are executed and written, and how they are measured."""

    selection: Selection = field(default_factory=Selection)
    out: Path | None = option(
        None, "Folder for runs and results. Default: runs/bench/NAME.", panel=PLACES, names=("--out", "-o")
    )
    paths: list[str] | None = option(
        None,
        "Folder of a data set, scene or checkout that the file names. Repeatable. LAPGS_<NAME> in the environment does "
        "the same.",
        panel=PLACES,
        names=("--path",),
        metavar="NAME=FOLDER",
    )
    engine: WorkerSettings = field(default_factory=WorkerSettings)
    evaluate: bool = option(
        True,
        "Measure every run with `lapgs eval`, or use the metrics that training recorded at its end.",
        names=("--eval/--no-eval",),
    )
    lpips_weights: list[Path] | None = option(None, "Weights of an LPIPS network for `lapgs eval`. Repeatable.")
    dry_run: bool = option(False, "Print the commands of all runs.")
    tables_only: bool = option(False, "Only write the tables from existing results.")

    @property
    def folders(self) -> dict[str, Path]:
        """The folders of --path by name.

        Raises:
            UserInputError: a value is no NAME=FOLDER, or the home folder of an unknown user.
        """
        folders = {}
        for name, text in _pairs(self.paths, "--path").items():
            try:
                folders[name] = Path(text).expanduser()
            except RuntimeError as error:
                raise UserInputError(f"--path {name}={text}: no such user; expected a folder") from error
        return folders


def _pairs(texts: Sequence[str] | None, name_of_option: str) -> dict[str, str]:
    values = {}
    for text in texts or ():
        name, separator, value = text.partition("=")
        if not (separator and name and value):
            raise UserInputError(f"{name_of_option} {text}: expected NAME=VALUE")
        values[name] = value
    return values
