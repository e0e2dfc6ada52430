"""Benchmark the CPU rasterizer: `lapgs bench raster`."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_folder, write_text
from lapgs_plugin.limits import LONGEST_STEM

if TYPE_CHECKING:
    import torch

    from lapgs_plugin.evaluation.bench_raster import BenchCase, CaseResult

DTYPES = ("float32", "float64")


def raster(
    sizes: Annotated[
        str | None,
        typer.Option(
            help="Image sizes, separated by commas: 200x150, 400x300, 800x533, 1600x1066, or WIDTHxHEIGHT/GAUSSIANS. "
            "Default: the first four."
        ),
    ] = None,
    repeats: Annotated[
        int, typer.Option(min=1, max=1000, help="Repeats at each size; slow rasterizers get fewer at large sizes.")
    ] = 5,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write all measurements to this file.")
    ] = None,
    dtype: Annotated[
        str, typer.Option(metavar="|".join(DTYPES), help="Precision; gsplat is measured in float32 only.")
    ] = "float32",
    check: Annotated[bool, typer.Option("--check", help="Exit with code 1 if it is slower than required.")] = False,
) -> None:
    """Measure training iterations of the CPU rasterizer and of rasterizers in plain PyTorch.

    An iteration renders a random scene at SH degree 3, computes L1 + SSIM and its gradients, and steps Adam. The fast
    CPU rasterizer is compared with the oracle and with gsplat's PyTorch code, both differentiated by autograd. All
    sizes together take minutes.
    """

    if dtype not in DTYPES:
        raise UserInputError(f"--dtype {dtype}: expected {' or '.join(DTYPES)}")
    if json_file is not None and (
        not is_folder(json_file.parent)
        or not os.access(json_file.parent, os.W_OK)
        or is_folder(json_file)
        or len(os.fsencode(json_file.name)) > LONGEST_STEM
    ):
        raise UserInputError(f"--json {json_file}: expected a file in a folder that exists and may be written")

    import torch

    from lapgs_plugin.evaluation import bench_raster

    precision: torch.dtype = getattr(torch, dtype)
    results = _measure(bench_raster.parse_cases(sizes), repeats, precision)
    _print_results(results)
    if json_file is not None:
        write_text(json_file, json.dumps(bench_raster.report(results, precision), indent=2))
    if check and any(result.missed for result in results):
        raise typer.Exit(1)


def _measure(cases: Sequence[BenchCase], repeats: int, dtype: torch.dtype) -> list[CaseResult]:
    """Measure all cases, with a progress bar."""
    from lapgs_plugin.evaluation.bench_raster import contender_names, planned_turns, run_case
    from lapgs_plugin.progress import item_progress

    turns = sum(len(planned_turns(case, repeats, contender_names(dtype))) for case in cases)
    with item_progress("turns") as progress:
        task = progress.add_task("preparing", total=turns)

        def advance(name: str) -> None:
            progress.update(task, description=f"{case.name} {name}", advance=1)

        results = []
        for case in cases:
            results.append(run_case(case, repeats, dtype, advance))
    return results


def _print_results(results: Sequence[CaseResult]) -> None:
    from rich import box
    from rich.table import Table

    from lapgs_plugin.evaluation.bench_raster import FAST, machine

    times = Table(title="A training iteration, medians", box=box.SIMPLE, pad_edge=False)
    for heading in ("size", "Gaussians", "blended\nper pixel", "contender", "ms", "times cpu", "required"):
        times.add_column(heading, justify="right", no_wrap=True)
    parts = Table(title=f"Where the time of {FAST} goes, medians in ms", box=box.SIMPLE, pad_edge=False)
    for heading in ("size", *(name.replace("_", "\n") for name in results[0].parts), "loss\nadds", "MB"):
        parts.add_column(heading, justify="right", no_wrap=True)
    for result in results:
        case = result.case
        for name, ms in result.milliseconds.items():
            about = [""] * 3
            if name == FAST:
                about = [case.size, str(case.gaussians), f"{result.blended_per_pixel:.0f}"]
            ratio = f"{result.ratios[name]:.1f}" if name in result.ratios else ""
            required = f"{case.required[name]:g}" if name in case.required else ""
            times.add_row(*about, name, f"{ms:.1f}", ratio, required)
        times.add_section()
        memory = "" if result.peak_memory is None else f"{result.peak_memory / 1e6:.0f}"
        parts.add_row(case.size, *(f"{ms:.1f}" for ms in result.parts.values()), f"{result.loss_share:.0%}", memory)
    console = make_console()
    console.print(times, parts)
    for result in results:
        if result.gsplat_tile_loop is not None:
            console.print(f"{result.case.size}: {result.gsplat_tile_loop:.0f} ms of gsplat's are its loop over tiles")
    console.print(", ".join(f"{key} {value}" for key, value in machine().items()))
    for line in (line for result in results for line in result.missed):
        console.print(f"[red]missed[/red] {line}")
