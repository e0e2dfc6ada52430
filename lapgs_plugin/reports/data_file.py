"""Append runs to a CSV file, one row each: `lapgs report --csv`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_file, is_folder, require_own, write_text
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.reports.report import MeasuredRun, is_imported, knows_options
from lapgs_plugin.untrusted import read_text, shortened

COLUMNS = (
    *("scene", "views", "width", "height", "iterations", "method", "seed", "seconds", "busy_seconds"),
    *("psnr", "psnr_fit", "ssim", "lpips", "frames_per_second", "peak_gb"),
)
DECIMALS = 4
"""Decimals of all figures, as many as tables show of SSIM and LPIPS."""

Row = Mapping[str, str | float | None]


def data_row(run: MeasuredRun, moved_to: Path | None = None) -> Row:
    """Return the figures of a run by column; None where one is not known.

    Columns:
        scene: name of the scene's folder.
        views: number of training views; None if the scene is not there any more.
        width, height: of the finest level, in pixels.
        iterations: of all levels.
        method: as `method_of`.
        seed: None unless `lapgs train` or `lapgs run` trained the run.
        seconds, busy_seconds: of the optimization, and those in which the GPU executed kernels.
        psnr, psnr_fit, ssim, lpips: means over held-out views, PSNR in dB, LPIPS of AlexNet; None of other views.
        frames_per_second: of the composed image.
        peak_gb: highest GPU memory in training, 10^9 bytes.

    Args:
        run: the run.
        moved_to: current folder of the scene; None for that of the manifest.

    Raises:
        RunFolderError, SceneError: the scene is not the run's, or cannot be read.
    """
    manifest, metrics = run.archive.manifest, run.metrics
    is_there = moved_to is not None or is_folder(Path(manifest.scene.path))
    width, height = manifest.record(0).image_size
    quality = metrics if metrics["split"] == "test" else {}
    peak = metrics["peak_memory_bytes"]
    figures = {
        "seconds": metrics["train_seconds"] or None,  # a loop of the user's own may have measured none
        "busy_seconds": metrics.get("gpu_busy_seconds"),
        "psnr": quality.get("psnr"),
        "psnr_fit": quality.get("fitted_psnr"),
        "ssim": quality.get("ssim"),
        "lpips": quality.get("lpips_alex"),
        "frames_per_second": metrics["fps"],
        "peak_gb": None if peak is None else 1e-9 * peak,
    }
    return {
        "scene": Path(manifest.scene.path).name,
        "views": len(run_cameras(run.archive, moved_to)[0]) if is_there else None,
        "width": width,
        "height": height,
        "iterations": sum(record.iterations for record in manifest.records),
        "method": method_of(run),
        "seed": manifest.seed if knows_options(manifest) else None,
        **{name: None if value is None else round(value, DECIMALS) for name, value in figures.items()},
    }


def method_of(run: MeasuredRun) -> str:
    """Return "one field", "nested", "laplacian", or "own script" for an imported run without a hierarchy."""
    manifest = run.archive.manifest
    if manifest.levels == 1:
        return "own script" if is_imported(manifest) else "one field"
    return "laplacian" if any(record.signed for record in manifest.records) else "nested"


def append_rows(path: Path, rows: Sequence[Row]) -> None:
    """Append rows to a file of `COLUMNS`, which is made if it is not there. All are written, or none.

    Raises:
        UserInputError: the file is a folder, or has other columns.
        RunFolderError: it cannot be read or written, or is a link.
    """
    require_own(path)
    if is_folder(path):
        raise UserInputError(f"--csv {path} is a folder; expected a file, or a name for a new one")
    text = read_text(path, advice="name another file") if is_file(path) else ""
    header = text.partition("\n")[0].strip()
    if text and [name.strip('"') for name in header.split(",")] != list(COLUMNS):
        raise UserInputError(
            f"--csv {path} has the columns {shortened(header)}, expected {','.join(COLUMNS)}; name another file"
        )
    table = io.StringIO()
    writer = csv.DictWriter(table, COLUMNS, lineterminator="\n")
    if not text:
        writer.writeheader()
    elif not text.endswith("\n"):
        table.write("\n")
    writer.writerows(rows)
    write_text(path, text + table.getvalue())
