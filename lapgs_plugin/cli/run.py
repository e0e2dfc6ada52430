"""`lapgs run`: a backbone's own training script, trained as a hierarchy."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.adapters.registry import OWN, adapter_class
from lapgs_plugin.cli.bridge import given_options, takes_settings
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.cli.viewing import ViewOption, ViewPortOption, keep_preview, watching
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runner.settings import RunSettings

if TYPE_CHECKING:
    from lapgs_plugin.adapters.base import BackboneAdapter

OF_OFF = {"off", "script", "arguments", "record", "backbone", "device", "verbose"}
"""What `--off` goes with."""

CONTEXT = {"allow_interspersed_args": False}
"""Everything after the script belongs to the script, options included."""


@takes_settings
def run(
    context: typer.Context,
    script: Annotated[Path, typer.Argument(help="The training script of a checkout: its train.py.", metavar="SCRIPT")],
    settings: RunSettings,
    arguments: Annotated[
        list[str] | None, typer.Argument(help="The script's own arguments, as without lapgs.", metavar="ARGUMENTS...")
    ] = None,
    off: Annotated[bool, typer.Option("--off", help="Replace nothing: the script as Python would run it.")] = False,
    record: Annotated[
        bool,
        typer.Option(
            "--record",
            help="With --off: note time, Gaussians, memory and held-out PSNR of the script's own run in its -m folder.",
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
            help="cuda, or cpu: the unmodified checkout on CPU stand-ins of its CUDA modules. auto: what is there."
        ),
    ] = "auto",
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the run in -m after its last finished level.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run that is in -m.")] = False,
    test_every: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Measure held-out PSNR this often, for the curves of `lapgs report`; its time is not counted. "
            "Default: at the end of the run.",
        ),
    ] = None,
    breakdown: Annotated[
        bool,
        typer.Option(
            "--breakdown",
            help="Measure where the time of iterations goes: forward, loss, backward, densification, optimizer, other.",
        ),
    ] = False,
    view: ViewOption = False,
    view_port: ViewPortOption = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Say which symbols are replaced, and who uses them.")
    ] = False,
) -> None:
    """Train a backbone's checkout as a hierarchy: one word before the command you type today.

    lapgs run train.py -s data/garden -i images --eval

    The checkout stays unmodified, and --backbone says which ones are recognised. Everything after the script is handed
    to it. The run goes into the script's own output folder (-m), one folder a level, and `lapgs render`,
    `eval` and `report` work on it. After Ctrl-C the finished levels are kept; the same command with --resume goes on
    after them.
    """
    import logging

    import torch

    from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
    from lapgs_plugin.checkouts.script import loaded_script, require_script
    from lapgs_plugin.runner.driver import HierarchyDriver
    from lapgs_plugin.runner.installed_rasterizer import explain_import_error
    from lapgs_plugin.runner.recording import BareRunRecorder

    if off and (idle := sorted(given_options(context) - OF_OFF)):
        options_given = ", ".join(f"--{name.replace('_', '-')}" for name in idle)
        raise UserInputError(
            f"{options_given} with --off: nothing is replaced, so there is nothing for that to act on; leave it out"
        )
    if record and not off:
        raise UserInputError("--record is for --off: a hierarchy's own run folder says what it took; leave it out")
    if device not in ("auto", "cuda", "cpu"):
        raise UserInputError(f"--device {device}: expected auto, cuda or cpu")
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise UserInputError(
            "--device cuda: PyTorch sees no CUDA device here; --device cpu runs the checkout on stand-ins"
        )
    chosen = device if device != "auto" else "cuda" if available else "cpu"
    checkout, words = require_script(script).parent, arguments or []
    watcher = context.with_resource(watching(view, view_port, checkout.absolute().name, chosen))
    plain = off and not record
    # On a GPU a script that runs as it is needs no adapter.
    recognised = not plain or chosen == "cpu" or backbone is not None
    kind: type[BackboneAdapter] | None = adapter_class(checkout, backbone) if recognised else None
    if isinstance(context.obj, Rehearsal):
        context.obj.run(settings, words)
        return
    logging.basicConfig(format="lapgs: %(message)s")
    logging.getLogger("lapgs_plugin").setLevel(logging.INFO)
    logging.getLogger("lapgs_plugin.checkouts.attachment").setLevel(logging.INFO if verbose else logging.WARNING)
    on_device = cuda_on_cpu(kind.stand_in_for(checkout, words)) if kind and chosen == "cpu" else nullcontext()
    try:
        with on_device, loaded_script(script, words) as loaded:
            if kind is None or plain:
                loaded.run_main()
                return
            if off:
                BareRunRecorder(kind(loaded), chosen).run()
                return
            driver = HierarchyDriver(
                kind(loaded),
                settings,
                device=chosen,
                resume=resume,
                overwrite=overwrite,
                breakdown=breakdown,
                watcher=watcher,
                test_every=test_every,
            )
            driver.run()
        if driver.folder is not None:
            keep_preview(driver.folder, chosen)
    except ImportError as error:
        line = None if off else explain_import_error(error, str(script))
        if line is None:
            raise
        raise line from error
