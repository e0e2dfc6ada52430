"""Check the rasterizers of this machine: `lapgs conformance`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from lapgs_plugin.evaluation.conformance import Outcome, Subject

COLUMNS = {
    "image": "image",
    "transmittance": "transm.",
    "means2d": "screen",
    "means": "means",
    "quaternions": "quats",
    "log_scales": "scales",
    "opacity_logits": "opacity",
    "sh": "SH",
}
"""Titles of the errors in the table."""
FAMILY = "family"
"""Our versions of the 3DGS family's rasterizers."""


def conformance(
    rasterizer: Annotated[
        list[str] | None,
        typer.Option(
            "--rasterizer",
            help="Rasterizer to check. Repeatable. `family` checks our version of each rasterizer of the 3DGS family. "
            "Default: all that this machine can run, but `family`, which takes minutes.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all errors as JSON, for scripts.")] = False,
) -> None:
    """Check images and gradients of the rasterizers on this machine against a float64 reference.

    Every rasterizer renders the same small scenes, most of them corner cases, with clamped and with signed colour. The
    table shows the worst error of each scene: absolute for pixels, relative to the largest value for gradients. "band"
    counts pixels that depend on a comparison which rounding can turn; they are only checked for plausibility.

    Our versions of the 3DGS family's rasterizers are checked in each one's rules, on the CPU and on a GPU.
    A CUDA extension is checked with its native signed colour, if it has any, and with colours precomputed in PyTorch.
    gsplat compiles its CUDA code at first use, which takes minutes. The exit code is 1 if a check fails.
    """
    from lapgs_plugin.evaluation.conformance import check, conformance_cases

    subjects = _chosen(rasterizer or [])
    cases = conformance_cases()
    outcomes_of = {subject.name: list(check(subject, cases)) for subject in subjects}
    failed = any(outcome.problems for outcomes in outcomes_of.values() for outcome in outcomes)
    if as_json:
        print(json.dumps(outcomes_of, indent=1, default=asdict))
    else:
        for subject in subjects:
            _print(subject, outcomes_of[subject.name])
    if failed:
        raise typer.Exit(1)


def reachable() -> dict[str, Callable[[], list[Subject]]]:
    """Return by name the rasterizers that this machine can run, as functions that make their subjects."""
    import torch

    from lapgs_plugin.evaluation.conformance import Subject
    from lapgs_plugin.rasterizers.choice import OWN, RASTERIZERS
    from lapgs_plugin.rasterizers.extensions import installed_extensions
    from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer

    subjects: dict[str, Callable[[], list[Subject]]] = {
        "cpu": lambda: [Subject("cpu", CpuRasterizer()), Subject("cpu, float64", CpuRasterizer(), torch.float64)],
        "oracle": lambda: [Subject("oracle, float32", OracleRasterizer())],
        FAMILY: _family_subjects,
    }
    if torch.cuda.is_available():
        for name in installed_extensions():
            subjects[name] = partial(_extension_subjects, name)
    for name in RASTERIZERS:
        if name not in OWN or not OWN[name].missing():
            subjects.setdefault(name, partial(_subject, name))
    return subjects


def _subject(name: str) -> list[Subject]:
    """Return a rasterizer of this package or of an installed one."""
    from lapgs_plugin.evaluation.conformance import Subject
    from lapgs_plugin.rasterizers.choice import placed_rasterizer

    placed = placed_rasterizer(name)
    return [Subject(name, placed.rasterizer, device=placed.device.type, semantics=placed.rasterizer.semantics)]


def _family_subjects() -> list[Subject]:
    """Return our version of each variant, by each engine that this machine can run."""
    import torch

    from lapgs_plugin.evaluation.variants import variant_subjects

    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    return [subject for device in devices for subject in variant_subjects(device)]


def _extension_subjects(name: str) -> list[Subject]:
    """Return an extension with its own path for signed colour, and with precomputed colours."""
    from lapgs_plugin.evaluation.conformance import Subject
    from lapgs_plugin.rasterizers.extensions import CudaExtension
    from lapgs_plugin.rasterizers.signed_color import ColorPath, SignedColorRasterizer

    extension = CudaExtension(name)
    paths = dict.fromkeys([SignedColorRasterizer(extension).path, ColorPath.PRECOMPUTED])
    return [
        Subject(
            f"{name}, {path.value} signed colour",
            SignedColorRasterizer(extension, path=path),
            device="cuda",
            semantics=extension.semantics,
        )
        for path in paths
    ]


def _chosen(names: Sequence[str]) -> list[Subject]:
    """Return the rasterizers of these names, or without names all that this machine can run except `FAMILY`."""
    available = reachable()
    for name in names:
        if name not in available:
            raise UserInputError(
                f"--rasterizer {name}: expected one that this machine can run: {', '.join(available)}; "
                "`lapgs doctor` says what is missing"
            )
    chosen = names or [name for name in available if name != FAMILY]
    return [subject for name in chosen for subject in available[name]()]


def _print(subject: Subject, outcomes: Sequence[Outcome]) -> None:
    from rich.markup import escape
    from rich.table import Table

    failed = [outcome for outcome in outcomes if outcome.problems]
    console = make_console()
    table = Table(title=subject.name, title_justify="left", box=None, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("case")
    for title in COLUMNS.values():
        table.add_column(title, justify="right")
    table.add_column("band", justify="right")
    table.add_column("")
    for case in dict.fromkeys(outcome.case for outcome in outcomes):
        both = [outcome for outcome in outcomes if outcome.case == case]
        errors = [max(outcome.errors.get(name, 0.0) for outcome in both) for name in COLUMNS]
        verdict = "[bold red]FAIL[/bold red]" if any(outcome.problems for outcome in both) else "[green]ok[/green]"
        band = max(outcome.band_pixels for outcome in both)
        table.add_row(case, *(f"{error:.0e}" if error else "0" for error in errors), str(band), verdict)
    console.print(table)
    for outcome in failed:
        kind = "signed" if outcome.signed else "clamped"
        for problem in outcome.problems:
            console.print(f"  [red]{outcome.case}, {kind}:[/red] {escape(problem)}", soft_wrap=True)
    for case, reason in subject.semantics.departures.items():
        console.print(f"  not compared, by design: {case}: {reason}", soft_wrap=True)
    if subject.semantics.note:
        console.print(f"  by design: {subject.semantics.note}", soft_wrap=True)
    console.print(f"  {len(outcomes) - len(failed)} of {len(outcomes)} passed\n")
