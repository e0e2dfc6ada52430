"""Run a checkout's training script with a hierarchy: `lapgs run`."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.adapters.registry import OWN, adapter_class
from lapgs_plugin.cli.bridge import given_options, takes_settings
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.cli.viewing import ViewOption, ViewPortOption, keep_preview, watching
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.options import MeasuringOptions

if TYPE_CHECKING:
    from lapgs_plugin.adapters.base import BackboneAdapter

OF_OFF = {"off", "script", "arguments", "record", "gpu_busy", "backbone", "device", "verbose"}
"""Parameters that `--off` can be combined with."""

CONTEXT = {"allow_interspersed_args": False}
"""Options after the script are passed to the script."""


@takes_settings
def run(
    context: typer.Context,
    script: Annotated[Path, typer.Argument(help="Training script of a checkout: its train.py.", metavar="SCRIPT")],
    settings: RunSettings,
    measuring: MeasuringOptions,
    arguments: Annotated[
        list[str] | None, typer.Argument(help="Arguments of the script, as without lapgs.", metavar="ARGUMENTS...")
    ] = None,
    off: Annotated[bool, typer.Option("--off", help="Run the script unchanged, without a hierarchy.")] = False,
    record: Annotated[
        bool,
        typer.Option(
            "--record",
            help="With --off: record time, Gaussians, memory and held-out PSNR of the unchanged run in its -m folder.",
        ),
    ] = False,
    backbone: Annotated[
        str | None,
        typer.Option(
            help=f"{', '.join(OWN)}, or a backbone of an installed package. Default: recognised from the checkout."
        ),
    ] = None,
    device: Annotated[
        str,
        typer.Option(
            help="cuda, cpu (the checkout on CPU stand-ins for its CUDA extensions), or auto: CUDA if there is a CUDA "
            "device, else the CPU."
        ),
    ] = "auto",
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the run in -m after its last finished level.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in -m.")] = False,
    view: ViewOption = False,
    view_port: ViewPortOption = None,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", "-v", help="Log which symbols are replaced, and where they are used."),
    ] = False,
) -> None:
    """Train with a 3DGS checkout's own train.py, coarse to fine; its files stay unchanged.

    Put `lapgs run` before the arguments that you give to Python today:

        lapgs run train.py -s data/garden -i images --eval

    --backbone lists the recognised codebases. Everything after the script is passed to it. The run is written to the
    script's output folder (-m) with one folder per level; `lapgs render`, `lapgs eval` and `lapgs report` read it.
    After Ctrl-C, repeat the command with --resume to continue after the last finished level.
    """
    import logging

    from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
    from lapgs_plugin.checkouts.script import loaded_script, require_script
    from lapgs_plugin.runner.driver import HierarchyDriver
    from lapgs_plugin.runner.installed_rasterizer import explain_import_error
    from lapgs_plugin.runner.recording import BareRunRecorder
    from lapgs_plugin.runs.gpu_busy import require_cuda

    if off and (idle := sorted(given_options(context) - OF_OFF)):
        options_given = ", ".join(f"--{name.replace('_', '-')}" for name in idle)
        raise UserInputError(f"{options_given} has no effect with --off, which runs the script unchanged; leave it out")
    if record and not off:
        raise UserInputError("--record needs --off: the run folder of a hierarchy has these figures; leave it out")
    if measuring.gpu_busy and off and not record:
        raise UserInputError("--gpu-busy has no effect with --off, which runs the script unchanged; add --record")
    chosen = _chosen_device(device)
    if measuring.gpu_busy:
        require_cuda(chosen)
    path, words = require_script(script), arguments or []
    watcher = context.with_resource(watching(view, view_port, path.parent.name, chosen))
    plain = off and not record
    kind, root = _recognised(path, backbone, needed=not plain)
    if isinstance(context.obj, Rehearsal):
        context.obj.run(settings, words)
        return
    logging.basicConfig(format="lapgs: %(message)s")
    logging.getLogger("lapgs_plugin").setLevel(logging.INFO)
    logging.getLogger("lapgs_plugin.checkouts.attachment").setLevel(logging.INFO if verbose else logging.WARNING)
    on_device: AbstractContextManager[None] = nullcontext()
    if chosen == "cpu":
        on_device = cuda_on_cpu(None if kind is None else kind.stand_in_for(root, words))
    try:
        with on_device, loaded_script(script, words) as loaded:
            if kind is None or plain:
                loaded.run_main()
                return
            if off:
                BareRunRecorder(kind(loaded), chosen, measuring.gpu_busy).run()
                return
            driver = HierarchyDriver(
                kind(loaded),
                settings,
                device=chosen,
                resume=resume,
                overwrite=overwrite,
                breakdown=measuring.breakdown,
                gpu_busy=measuring.gpu_busy,
                watcher=watcher,
                test_every=measuring.test_every,
            )
            driver.run()
        if driver.folder is not None:
            keep_preview(driver.folder, chosen)
    except ImportError as error:
        line = None if off else explain_import_error(error, path, on_cpu=chosen == "cpu")
        if line is None:
            raise
        raise line from error


def _chosen_device(device: str) -> str:
    """Return "cuda" or "cpu" for a value of --device."""
    import torch

    if device not in ("auto", "cuda", "cpu"):
        raise UserInputError(f"--device {device}: expected auto, cuda or cpu")
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise UserInputError(
            "--device cuda: PyTorch finds no CUDA device; --device cpu runs the checkout on CPU stand-ins"
        )
    return device if device != "auto" else "cuda" if available else "cpu"


def _recognised(script: Path, backbone: str | None, *, needed: bool) -> tuple[type[BackboneAdapter] | None, Path]:
    """Return the adapter of a script's checkout, None for another script if none is needed, and the checkout's root."""
    from lapgs_plugin.checkouts.source import CheckoutSource

    try:
        root = CheckoutSource.read(script).root
        return adapter_class(root, backbone), root
    except UserInputError:
        if needed or backbone is not None:
            raise
        return None, script.parent
