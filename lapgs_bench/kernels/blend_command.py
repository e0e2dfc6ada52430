"""Benchmark the kernels that blend on a GPU: `lapgs bench blend`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import UserInputError


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
    from rich import box
    from rich.table import Table

    from lapgs_plugin.evaluation import bench_blend, bench_raster
    from lapgs_plugin.fields.gaussian_field import GaussianField

    counts = [int(each) if each.strip().isdecimal() else 0 for each in views.split(",")]
    if min(counts) < 1:
        raise UserInputError(f"--views {views!r}: expected numbers of views such as 1,8")
    cases = bench_raster.parse_cases(sizes)
    if not torch.cuda.is_available():
        raise UserInputError("lapgs bench blend: PyTorch finds no CUDA device; `lapgs doctor` says why")
    if find_spec("triton") is None:
        raise UserInputError("lapgs bench blend: Triton is not installed; it comes with PyTorch for CUDA on Linux")
    parsed = bench_blend.parse_shapes(shapes)
    table = Table(title=f"Blending on {torch.cuda.get_device_name()}, ms for one view", box=box.SIMPLE)
    for heading in ("field", "views", "kernels", "forward", "backward", "both", "speed-up", "difference"):
        table.add_column(heading, justify="right" if heading not in ("field", "kernels") else "left")
    field = None if ply is None else GaussianField.load_ply(ply)
    for count in counts:
        fields = {case.name: bench_blend.random_views(case.width, case.height, case.gaussians, count) for case in cases}
        if field is not None and ply is not None:
            around = bench_blend.views_around(field, cases[0].width, cases[0].height, count)
            fields[f"{ply.name}/{len(field)}"] = field, around
        for name, (one, cameras) in fields.items():
            by_gsplat, shown = 0.0, name
            for found in bench_blend.run_case(one, cameras, repeats, parsed):
                both = found.forward + found.backward
                by_gsplat = by_gsplat or both
                table.add_row(
                    shown, str(count), found.kernels, f"{found.forward:.3f}", f"{found.backward:.3f}",
                    f"{both:.3f}", f"{by_gsplat / both:.2f}",
                    f"{found.difference:.0e}",
                )  # fmt: skip
                shown = ""
    make_console().print(table)
