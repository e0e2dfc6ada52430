"""Read the results in an experiment's folder: the rows of its results.csv, and its run folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lapgs_bench.experiments.commands import IMPORTED
from lapgs_bench.experiments.execution import RUNS
from lapgs_bench.experiments.exports import CSV, NAMES, Row, read_csv
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.files import is_folder
from lapgs_plugin.reports.charts import VARIANT_COLORS
from lapgs_plugin.reports.report import MeasuredRun
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.untrusted import shortened

COUNTS = {
    "weighted_gaussians": "Gaussians of levels, weighted by iterations",
    "mean_gaussians": "Gaussians optimized, mean",
    "gaussians": "Gaussians to render",
}
"""Columns with numbers of Gaussians; the first that all rows have is drawn."""
FIGURES = ("train_seconds", "gaussians")
"""Columns with numbers that every row has."""


@dataclass(frozen=True)
class Results:
    """Hold the results in an experiment's folder: the rows of its results.csv, in order."""

    folder: Path
    rows: Sequence[Row]

    @classmethod
    def read(cls, folder: Path) -> Results:
        """Read the results in a folder of `lapgs bench`.

        Raises:
            RunFolderError: they are missing, or cannot be read.
        """
        path = folder / CSV
        try:
            rows = read_csv(path)
        except (OSError, ValueError) as error:
            raise RunFolderError(f"{path} cannot be read ({error}); expected what `lapgs bench` writes") from error
        for row in rows or [{}]:
            if missing := {*NAMES, *FIGURES} - row.keys():
                raise RunFolderError(
                    f"{path} lacks {', '.join(sorted(missing))}; expected what `lapgs bench` writes when runs are done"
                )
            for name, value in row.items():
                if (name in FIGURES or name in COUNTS or name.endswith(("_seconds", "_ms"))) and isinstance(value, str):
                    raise RunFolderError(
                        f"{path}: {shortened(name)} is {shortened(value)}, expected a number; write it again with "
                        "`lapgs bench` and --tables-only"
                    )
        return cls(folder, rows)

    @property
    def variants(self) -> list[str]:
        """Variants in the experiment's order."""
        return list(dict.fromkeys(row["variant"] for row in self.rows))

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Pairs of scene and backbone."""
        return list(dict.fromkeys((row["scene"], row["backbone"]) for row in self.rows))

    def of(self, scene: str, backbone: str, variant: str) -> list[Row]:
        """Return the rows of a variant, one for each seed."""
        wanted = (scene, backbone, variant)
        return [row for row in self.rows if (row["scene"], row["backbone"], row["variant"]) == wanted]

    def baseline(self, backbone: str) -> str:
        """Return the variant that others on a backbone are compared with."""
        return str(next(row["baseline"] for row in self.rows if row["backbone"] == backbone))

    def style(self, variant: str) -> str:
        """Return the style of a variant's lines and arrows."""
        return f"variant-{self.variants.index(variant) % len(VARIANT_COLORS)}"

    def title(self, scene: str, backbone: str) -> str:
        """Return the name of a scene, with the backbone if there are several."""
        several = len({row["backbone"] for row in self.rows}) > 1
        return f"{scene}, {backbone}" if several else scene

    def run_folder(self, row: Row) -> Path:
        """Return a run's folder, that of the attempt that finished, inside the folder, which may be moved."""
        return self.folder / RUNS / Path(str(row.get("folder", row["run"]))).name

    def run(self, row: Row) -> MeasuredRun:
        """Open a run.

        Raises:
            RunFolderError: it is missing or damaged.
        """
        path = self.run_folder(row)
        archive = RunArchive.open(path / IMPORTED if is_folder(path / IMPORTED) else path)
        return MeasuredRun(archive, archive.metrics() or {"train_seconds": row["train_seconds"]})
