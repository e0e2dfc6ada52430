"""Check this machine: `lapgs doctor`."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future

    from lapgs_plugin.environment.findings import Finding
    from lapgs_plugin.environment.probes import Probe


IMPORTED = ("OpenImageIO", "pycolmap")
"""Packages with compiled code that no other probe imports."""
NOT_NEEDED = ("Kernel cache",)
"""Findings that do not prevent training."""
ON_THE_CPU = "`lapgs train --rasterizer cpu` works without it"
GSPLAT_FILES = ("gsplat/rendering.py", "examples/simple_trainer.py")
"""Files of a checkout of gsplat, which `lapgs run` does not drive."""
MARKS = {"ok": "[green]ok[/green]", "absent": "[dim]--[/dim]", "problem": "[bold red]!![/bold red]"}


def doctor(
    checkout: Annotated[
        Path | None,
        typer.Argument(metavar="CHECKOUT", help="3DGS checkout, or a training script in it, to describe instead."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print all findings as JSON, for scripts and bug reports.")
    ] = False,
) -> None:
    """Check Python, PyTorch, GPU, compilers and packages, and name the rasterizer of `lapgs train`.

    With a checkout, describe it: its root, its training function, its rasterizers, and the kinds of levels that work.
    Nothing is changed or downloaded. Lines marked !! are problems with advice; lines marked -- are optional
    parts that are not installed. The exit code is 0 unless CHECKOUT is not a checkout.
    """
    from dataclasses import asdict

    from lapgs_plugin.cli.doctor_checkout import describe

    sections = examine() if checkout is None else describe(checkout)
    if as_json:
        print(json.dumps(sections, indent=2, default=asdict))
    else:
        _print(sections)


def examine() -> dict[str, list[Finding]]:
    """Return all findings by section, the conclusion last. Slow probes run in parallel."""
    from concurrent.futures import ThreadPoolExecutor, wait

    from lapgs_plugin.adapters.registry import known_extensions
    from lapgs_plugin.environment import driver_version, findings
    from lapgs_plugin.environment.probes import run_probe

    requirements = findings.own_requirements()
    try:
        modules, adapters = known_extensions(), []
    except UserInputError as error:  # of an installed package
        modules, adapters = {}, [findings.Finding("Backbones", "problem", str(error))]
    with ThreadPoolExecutor() as pool, _stopping_programs(pool):
        torch_probe = pool.submit(run_probe, "torch")
        raster_probe = pool.submit(run_probe, "rasterizer")
        driver = pool.submit(driver_version)
        imports = {name: pool.submit(run_probe, "import", name) for name in IMPORTED}
        extensions = [pool.submit(findings.extension_finding, *known) for known in modules.items()]
        everything: list[Future[Any]] = [torch_probe, raster_probe, driver, *imports.values(), *extensions]
        wait(everything)
    torch = torch_probe.result()
    compilers = findings.compiler_findings(torch.facts.get("cuda"))
    sections = {
        "System": findings.system_findings(),
        "PyTorch": findings.torch_findings(torch, driver.result()),
        "Compilers": compilers,
        "CPU rasterizer": findings.numba_findings(raster_probe.result()),
        "Packages": findings.package_findings(
            requirements[""], {name: probe.result() for name, probe in imports.items()}
        ),
        "Extras": findings.extra_findings(requirements),
        "Entry points of other packages": findings.entry_point_findings(),
        "Backbones": [
            findings.triton_finding(torch),
            findings.gsplat_finding(torch, nvcc=compilers[0].status == "ok"),
            *(extension.result() for extension in extensions),
            *(adapters or [current_folder(Path.cwd(), bool(torch.facts.get("gpus")))]),
        ],
    }
    sections["lapgs train"] = _conclusion(sections, torch)
    return {title: section for title, section in sections.items() if section}


@contextmanager
def _stopping_programs(pool: Executor) -> Iterator[None]:
    """Kill the programs of a pool's threads when a signal ends the block, because the process waits for them."""
    from lapgs_plugin.environment import stop_programs

    try:
        yield
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        stop_programs()
        raise


def current_folder(folder: Path, has_gpu: bool) -> Finding:
    """Judge whether a folder is a checkout, and on which device `lapgs run` would train it."""
    from lapgs_plugin.adapters.registry import recognise
    from lapgs_plugin.checkouts.source import readable_sources
    from lapgs_plugin.environment.findings import Finding

    try:
        adapter = recognise(folder)
    except UserInputError as error:
        return Finding("Current folder", "problem", str(error))
    if adapter is not None:
        device = "the GPU, with its own extensions" if has_gpu else "the CPU, with stand-ins for its extensions"
        parameters = adapter.archived_parameters()
        sources = [(source.script, source.hindrance(parameters)) for source in readable_sources(folder)[0]]
        names = [str(path.relative_to(folder.absolute())) for path, why in sources if why is None]
        if sources and not names:
            detail = f"a checkout of {adapter.info.title} or a fork of it, without levels: {sources[0][1]}"
            return Finding("Current folder", "absent", detail)
        script = adapter.info.script if adapter.info.script in names or not names else names[0]
        detail = f"a checkout of {adapter.info.title} or a fork of it; `lapgs run {script} ...` trains it on {device}"
        return Finding("Current folder", "ok", detail)
    if all((folder / file).is_file() for file in GSPLAT_FILES):
        return Finding("Current folder", "ok", "a checkout of gsplat")
    return Finding("Current folder", "absent", "not a known 3DGS checkout")


def _conclusion(sections: dict[str, list[Finding]], torch: Probe) -> list[Finding]:
    """Return the rasterizer of `lapgs train`, as `training.backend.choose_rasterizer` decides, or the problems."""
    from lapgs_plugin.environment import gpus_are_hidden
    from lapgs_plugin.environment.findings import Finding

    needed = [*sections["System"], *sections["PyTorch"], *sections["CPU rasterizer"], *sections["Packages"]]
    broken = [finding.name for finding in needed if finding.status == "problem" and finding.name not in NOT_NEEDED]
    if gpus_are_hidden():
        broken = [name for name in broken if name != "GPU"]
    advice = "see the lines !!"
    if broken == ["GPU"]:
        advice += f"; {ON_THE_CPU}"
    if not broken and torch.facts["gpus"]:
        triton, gsplat = sections["Backbones"][:2]
        for finding, rasterizer in ((triton, "our kernels"), (gsplat, "gsplat")):
            if finding.status == "ok":
                return [Finding("will use", "ok", f"{rasterizer} on the GPU, {torch.facts['gpus'][0]}")]
        broken, advice = [triton.name], f"{triton.advice}; {ON_THE_CPU}"
    if broken:
        return [Finding("will use", "problem", f"nothing until this is fixed: {', '.join(broken)}", advice)]
    return [Finding("will use", "ok", f"the CPU rasterizer, {sections['CPU rasterizer'][0].detail}")]


def _print(sections: dict[str, list[Finding]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    table.add_column()
    table.add_column()
    table.add_column(overflow="fold")  # whole paths, to be copied
    for title, findings in sections.items():
        table.add_row("", f"[bold]{title}[/bold]")
        for finding in findings:
            advice = f"\n[yellow]{escape(finding.advice)}[/yellow]" if finding.advice else ""
            table.add_row(MARKS[finding.status], escape(finding.name), escape(finding.detail) + advice)
    console = make_console()
    with console.capture() as shown:
        console.print(table)
    # Each row is padded to the longest: where lines are not cut, a narrow window would show the spaces as empty lines.
    print(re.sub(" +$", "", shown.get(), flags=re.MULTILINE), end="")
