"""Benchmark parts of an iteration: `lapgs bench raster`, `blend` and `ops`. Imports torch only when one runs."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_folder, write_text
from lapgs_plugin.limits import LONGEST_STEM

if TYPE_CHECKING:
    import torch
    from rich.table import Table

    from lapgs_bench.kernels.raster import BenchCase, CaseResult

DTYPES = ("float32", "float64")


def _titled_table(title: str, words: Sequence[str], numbers: Sequence[str]) -> Table:
    """Return a table with columns of words, then of numbers."""
    from rich import box
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE, pad_edge=False)
    for heading in words:
        table.add_column(heading)
    for heading in numbers:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


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

    from lapgs_bench.kernels.raster import parse_cases, report

    precision: torch.dtype = getattr(torch, dtype)
    results = _measure(parse_cases(sizes), repeats, precision)
    _print_results(results)
    if json_file is not None:
        write_text(json_file, json.dumps(report(results, precision), indent=2))
    if check and any(result.missed for result in results):
        raise typer.Exit(1)


def _measure(cases: Sequence[BenchCase], repeats: int, dtype: torch.dtype) -> list[CaseResult]:
    """Measure all cases, with a progress bar."""
    from lapgs_bench.kernels.raster import contender_names, planned_turns, run_case
    from lapgs_plugin.progress import item_progress

    turns = sum(len(planned_turns(case, repeats, contender_names(dtype))) for case in cases)
    with item_progress("turns") as progress:
        task = progress.add_task("preparing", total=turns)

        def measure(case: BenchCase) -> CaseResult:
            show = partial(progress.update, task, advance=1)
            return run_case(case, repeats, dtype, lambda name: show(description=f"{case.name} {name}"))

        return [measure(case) for case in cases]


def _print_results(results: Sequence[CaseResult]) -> None:
    from lapgs_bench.kernels.raster import FAST, machine

    headings = "size", "Gaussians", "blended\nper pixel", "contender", "ms", "times cpu", "required"
    times = _titled_table("A training iteration, medians", (), headings)
    names = "size", *(name.replace("_", "\n") for name in results[0].parts), "loss\nadds", "MB"
    parts = _titled_table(f"Where the time of {FAST} goes, medians in ms", (), names)
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


def blend(
    sizes: Annotated[
        str, typer.Option(help="Cases WIDTHxHEIGHT/GAUSSIANS of random fields, separated by commas.")
    ] = "800x533/300000,800x533/1000000",
    views: Annotated[str, typer.Option(help="Numbers of views that are rendered together, separated by commas.")] = (
        "1,8"
    ),
    ply: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also time this field, from cameras around its middle.")
    ] = None,
    shapes: Annotated[
        str | None,
        typer.Option(
            metavar="ROWS[xSPLATS],...",
            help="Shapes of our kernel to time. Default: the one that training uses.",
        ),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Turns; the table has medians over them.")] = 7,
) -> None:
    """Time blending and its gradients on a GPU, by gsplat's kernels and by ours.

    Milliseconds are for one view. Differences are of images and gradients from gsplat's, relative to the largest.
    """
    import torch

    from lapgs_bench.kernels.blend import parse_shapes, random_views, time_kernels, views_around
    from lapgs_bench.kernels.raster import parse_cases
    from lapgs_plugin.fields.gaussian_field import GaussianField
    from lapgs_plugin.rasterizers.gsplat.rasterizer import gsplat_missing

    counts = [int(number) if number.strip().isdecimal() else 0 for number in views.split(",")]
    if min(counts) < 1:
        raise UserInputError(f"--views {views!r}: expected numbers of views such as 1,8")
    cases = parse_cases(sizes)
    if not torch.cuda.is_available():
        raise UserInputError("lapgs bench blend: PyTorch finds no CUDA device; `lapgs doctor` says why")
    if find_spec("triton") is None:
        raise UserInputError("lapgs bench blend: Triton is not installed; it comes with PyTorch for CUDA on Linux")
    if reason := gsplat_missing():
        raise UserInputError(f"lapgs bench blend compares with gsplat: {reason}; `lapgs doctor` says more")
    parsed = parse_shapes(shapes)
    table = _titled_table(
        f"Blending on {torch.cuda.get_device_name()}, ms for one view",
        ("field", "kernels"),
        ("views", "forward", "backward", "both", "speed-up", "difference"),
    )
    field = None if ply is None else GaussianField.load_ply(ply)
    for count in counts:
        fields = {case.name: random_views(case.width, case.height, case.gaussians, count) for case in cases}
        if field is not None and ply is not None:
            around = views_around(field, cases[0].width, cases[0].height, count)
            fields[f"{ply.name}/{len(field)}"] = field, around
        for name, (one, cameras) in fields.items():
            by_gsplat, shown = 0.0, name
            for time in time_kernels(one, cameras, repeats, parsed):
                both = time.forward + time.backward
                by_gsplat = by_gsplat or both
                numbers = f"{time.forward:.3f}", f"{time.backward:.3f}", f"{both:.3f}", f"{by_gsplat / both:.2f}"
                table.add_row(shown, time.kernels, str(count), *numbers, f"{time.difference:.0e}")
                shown = ""
    make_console().print(table)


def ops(
    width: Annotated[int, typer.Option(min=3, max=16384, help="Width of the images in pixels.")] = 800,
    height: Annotated[int, typer.Option(min=3, max=16384, help="Height of the images in pixels.")] = 532,
    gaussians: Annotated[int, typer.Option(min=1, max=10_000_000, help="Number of Gaussians in the field.")] = 100_000,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Turns; the table has medians over them.")] = 7,
    device: Annotated[
        str, typer.Option(metavar="auto|cpu|cuda", help="Where to run; auto takes a GPU if there is one.")
    ] = "auto",
    only: Annotated[str, typer.Option(metavar="TEXT", help="Time the operations whose names have this text.")] = "",
) -> None:
    """Time each operation of a training iteration in every version that this machine has.

    "GPU ms" is the time of the kernels, "ms" that of a call on its own, with its start by the processor. Speed-ups and
    differences are against PyTorch's operations. Other libraries have their own names.
    """
    import torch

    from lapgs_bench.kernels.operations import benchmark
    from lapgs_plugin.environment.device import chosen_device

    where = torch.device(chosen_device(device))
    title = f"Operations at {width}x{height} with {gaussians} Gaussians on {where}"
    clocks = ("ms", "GPU ms") if where.type == "cuda" else ("ms",)
    table = _titled_table(title, ("operation", "version"), (*clocks, "speed-up", "difference"))
    times, shown = benchmark(where, width, height, gaussians, repeats, only), ""
    if not times:
        raise UserInputError(f"--only {only}: no operation's name has this text; without it all are timed")
    for time in times:
        name = "" if time.op == shown else time.op
        measured = [f"{one:.3f}" for one in (time.milliseconds, time.busy) if one is not None]
        table.add_row(name, time.version, *measured, f"{time.ratio:.2f}", f"{time.difference:.0e}")
        shown = time.op
    make_console().print(table)
