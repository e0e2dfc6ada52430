"""`lapgs run`: a backbone's own training script, trained as a hierarchy."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.options import (
    DEFAULT_INHERITANCE,
    HIERARCHY,
    PRUNE_HELP,
    GridOption,
    InheritOption,
    SupervisionOption,
    check_residual_options,
    given_options,
)
from lapgs_plugin.cli.viewing import ViewOption, ViewPortOption, keep_preview, watching
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import DEFAULT_HIERARCHY, JOINT_SHARE, NESTED_COARSE_THRESHOLD, RESIDUAL_COLOR_RATE

if TYPE_CHECKING:
    from lapgs_plugin.adapters.base import BackboneAdapter

MEMORY = "Memory and speed"

OF_OFF = {"off", "script", "arguments", "record", "backbone", "device", "verbose"}
"""What `--off` goes with."""

CONTEXT = {"allow_interspersed_args": False}
"""Everything after the script belongs to the script, options included."""


def run(
    context: typer.Context,
    script: Annotated[Path, typer.Argument(help="The training script of a checkout: its train.py.", metavar="SCRIPT")],
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
        str | None, typer.Option(help="fastgs, taming or graphdeco; recognised from the checkout when not given.")
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
    hierarchy: Annotated[
        str,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help="What finer levels are. nested: the coarser level's field, trained on at the finer size, which makes "
            "the whole image alone. laplacian: the paper's residuals, added to what the coarser levels make; they save "
            "more time where images are large and views are few.",
        ),
    ] = DEFAULT_HIERARCHY.value,
    levels: Annotated[
        int,
        typer.Option(
            min=1, rich_help_panel=HIERARCHY, help="Number of levels; 1 is the backbone alone, archived as a run."
        ),
    ] = 2,
    split: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help="Share of the iterations of each stage, coarsest first. Two levels: 1/2,1/2; a base and a residual "
            "1/3,2/3, as in the paper.",
        ),
    ] = None,
    supervision: SupervisionOption = "reconstructed",
    inherit: InheritOption = None,
    joint: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help="Of residuals: share of each residual stage, its last, in which the finished coarser fields are "
            f"optimized too; 0 leaves them as they are, as in the paper. Default: {JOINT_SHARE:g}.",
        ),
    ] = None,
    grid: GridOption = "camera",
    residual_color_rate: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help=f"Factor on the SH learning rates of residual stages. Default: {RESIDUAL_COLOR_RATE:g}.",
        ),
    ] = None,
    residual_resets: Annotated[
        bool,
        typer.Option(
            "--residual-resets",
            rich_help_panel=HIERARCHY,
            help="Let the backbone reset opacities in residual stages, too, as in the paper; without it the base's "
            "alone.",
        ),
    ] = False,
    coarse_threshold: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help="Factor on the backbone's gradient thresholds for densification, for each time that a level's images "
            "are halved: above 1 gives coarse levels fewer Gaussians. "
            f"Default: {NESTED_COARSE_THRESHOLD:g}, and 1 for residuals.",
        ),
    ] = None,
    prune: Annotated[float, typer.Option(rich_help_panel=HIERARCHY, help=PRUNE_HELP)] = 0.0,
    seed: Annotated[
        int,
        typer.Option(
            rich_help_panel=HIERARCHY,
            min=0,
            help="Decides which Gaussians are inherited (--inherit with a ratio); the script has its own seeds.",
        ),
    ] = 0,
    images_on: Annotated[
        str,
        typer.Option(
            rich_help_panel=MEMORY,
            help="Where level images and predictions are kept: gpu, memory (page-locked), disk, or auto by their size.",
        ),
    ] = "auto",
    prediction_precision: Annotated[
        str, typer.Option(rich_help_panel=MEMORY, help="Of cached predictions before Up: float32, float16 or uint8.")
    ] = "float16",
    fused_adam: Annotated[
        bool,
        typer.Option(
            "--fused-adam/--no-fused-adam",
            rich_help_panel=MEMORY,
            help="Step the backbone's plain Adam optimizers in one kernel a tensor.",
        ),
    ] = True,
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

    Recognised are FastGS, Taming-3DGS and the graphdeco 3DGS repository, each unmodified. Everything after the script
    is handed to it. The run goes into the script's own output folder (-m), one folder a level, and `lapgs render`,
    `eval` and `report` work on it. After Ctrl-C the finished levels are kept; the same command with --resume goes on
    after them.
    """
    import logging

    import torch

    from lapgs_plugin.adapters.registry import adapter_class
    from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
    from lapgs_plugin.checkouts.script import loaded_script, require_script
    from lapgs_plugin.hierarchy.inheritance import parse_inheritance
    from lapgs_plugin.runner.driver import HierarchyDriver
    from lapgs_plugin.runner.installed_rasterizer import explained
    from lapgs_plugin.runner.recording import BareRunRecorder
    from lapgs_plugin.runner.run_state import HierarchyOptions

    logging.basicConfig(format="lapgs: %(message)s")
    logging.getLogger("lapgs_plugin").setLevel(logging.INFO)
    logging.getLogger("lapgs_plugin.checkouts.attachment").setLevel(logging.INFO if verbose else logging.WARNING)
    if off and (idle := sorted(given_options(context) - OF_OFF)):
        options_given = ", ".join(f"--{name.replace('_', '-')}" for name in idle)
        raise UserInputError(
            f"{options_given} with --off: nothing is replaced, so there is nothing for that to act on; leave it out"
        )
    if record and not off:
        raise UserInputError("--record is for --off: a hierarchy's own run folder says what it took; leave it out")
    check_residual_options(
        hierarchy,
        {
            "--inherit": inherit,
            "--residual-color-rate": residual_color_rate,
            "--residual-resets": residual_resets or None,
        },
    )
    mode, ratio = parse_inheritance(DEFAULT_INHERITANCE if inherit is None else inherit)
    options = HierarchyOptions(
        hierarchy=hierarchy,
        levels=levels,
        split=split,
        grid=grid,
        supervision=supervision,
        inherit=mode,
        inherit_ratio=ratio,
        joint=joint,
        residual_color_rate=RESIDUAL_COLOR_RATE if residual_color_rate is None else residual_color_rate,
        residual_resets=residual_resets,
        coarse_threshold=coarse_threshold,
        prune=prune,
        images_on=images_on,
        prediction_precision=prediction_precision,
        fused_adam=fused_adam,
        seed=seed,
    )
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
    kind: type[BackboneAdapter] = adapter_class(checkout, backbone)
    on_device = cuda_on_cpu(kind.stand_in_for(checkout, words)) if chosen == "cpu" else nullcontext()
    try:
        with on_device, loaded_script(script, words) as loaded:
            if off and record:
                BareRunRecorder(kind(loaded), chosen).run()
                return
            if off:
                loaded.run_main()
                return
            driver = HierarchyDriver(
                kind(loaded),
                options,
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
        line = None if off else explained(error, str(script))
        if line is None:
            raise
        raise line from error
