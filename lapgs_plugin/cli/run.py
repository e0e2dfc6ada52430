"""Run a checkout's training script with a hierarchy: `lapgs run`."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.adapters.registry import GENERIC, OWN, adapter_class
from lapgs_plugin.checkouts import packages
from lapgs_plugin.cli.bridge import chosen_options, takes_settings
from lapgs_plugin.cli.output import log_to_stderr
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.cli.viewing import ViewOptions, watching
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import check_values, option
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.options import PANEL, MeasuringOptions

if TYPE_CHECKING:
    from lapgs_plugin.adapters.base import BackboneAdapter
    from lapgs_plugin.checkouts.compiled_modules import CompiledModules
    from lapgs_plugin.checkouts.splat_script import SplatScript
    from lapgs_plugin.runs.watcher import Watcher

OF_OFF = {
    *("off", "script", "arguments", "record", "gpu_busy", "test_every"),
    *("backbone", "device", "rasterizer", "verbose", "seed"),
}
"""Parameters that `--off` can be combined with."""

USAGE = 2
"""Exit code of argparse for a command line that it refuses."""

CONTEXT = {"allow_interspersed_args": False}
"""Options after the script are passed to the script."""


@dataclass(frozen=True)
class ScriptOptions:
    """Choose what is done with a checkout's script, and on which device.

    Raises:
        UserInputError: the device is unknown, or an option has no effect with the others.
    """

    resume: bool = option(False, "Continue the run in -m after its last finished level. Repeat its other options.")
    overwrite: bool = option(False, "Replace the run in -m.")
    viewing: ViewOptions = field(default_factory=ViewOptions)
    off: bool = option(False, "Run the script unchanged, without a hierarchy.")
    record: bool = option(
        False, "With --off: record time, Gaussians, memory and held-out PSNR of the unchanged run in its -m folder."
    )
    backbone: str | None = option(
        None,
        f"Adapter of the checkout: {', '.join(OWN)}, {GENERIC} (any fork), or one of an installed package. Default: "
        "the one that recognises it.",
    )
    device: str = option(
        "auto",
        "cuda, cpu (with our modules in place of the checkout's CUDA extensions), or auto: CUDA if there is a CUDA "
        "device, else the CPU.",
        choices=("auto", "cuda", "cpu"),
    )
    rasterizer: str = option(
        packages.AUTO,
        "Whose rasterizer renders on a GPU: checkout (its own, compiled), lapgs (ours with its rules, which needs no "
        "compiler), or auto: where both are there, the dry run times and compares them, and the faster one is taken if "
        "they agree; --off takes its own. On a CPU it is always ours.",
        choices=packages.CHOICES,
    )
    verbose: bool = option(
        False, "Log which symbols are replaced, and where they are used.", panel=PANEL, names=("--verbose", "-v")
    )

    def __post_init__(self) -> None:
        check_values(self)
        if self.record and not self.off:
            raise UserInputError("--record needs --off: the run folder of a hierarchy has these figures; leave it out")


@takes_settings
def run(
    context: typer.Context,
    script: Annotated[Path, typer.Argument(help="Training script of a checkout: its train.py.", metavar="SCRIPT")],
    arguments: Annotated[
        list[str] | None, typer.Argument(help="Arguments of the script, as without lapgs.", metavar="ARGUMENTS...")
    ] = None,
    *,
    settings: RunSettings,
    options: ScriptOptions,
    measuring: MeasuringOptions,
) -> None:
    """Train with a 3DGS checkout's own train.py, coarse to fine; its files stay unchanged.

    Put `lapgs run` before the arguments that you give to Python today:

        lapgs run train.py -s data/garden -i images --eval

    Everything after the script is passed to it. Its output folder (-m) becomes a run folder with one folder per level,
    which `lapgs eval`, `lapgs render`, `lapgs report` and `lapgs view` read. After Ctrl-C, repeat the command with
    --resume to continue. `lapgs doctor CHECKOUT` says what works with a checkout.
    """
    from lapgs_plugin.checkouts.script import require_script
    from lapgs_plugin.checkouts.source import OTHERWISE, CheckoutSource
    from lapgs_plugin.checkouts.splat_script import SplatScript
    from lapgs_plugin.environment.device import chosen_device
    from lapgs_plugin.runner.installed_packages import require_packages

    if options.off and (idle := sorted(chosen_options(context) - OF_OFF)):
        options_given = ", ".join(f"--{name.replace('_', '-')}" for name in idle)
        raise UserInputError(f"{options_given} has no effect with --off, which runs the script unchanged; leave it out")
    plain = options.off and not options.record
    measured = {"--gpu-busy": measuring.gpu_busy, "--test-every": measuring.test_every is not None}
    if plain and (idle := [name for name, chosen in measured.items() if chosen]):
        raise UserInputError(f"{idle[0]} has no effect with --off, which runs the script unchanged; add --record")
    # What is refused by the sources alone is refused before PyTorch is imported.
    path, words = require_script(script), arguments or []
    splats = SplatScript.read(path) if options.backbone is None else None
    needed = not plain or options.rasterizer != packages.AUTO
    kind = _recognised(script, options.backbone, needed=needed) if splats is None else None
    if kind is not None and not options.off:
        source = CheckoutSource.read(script)
        if why := source.hindrance(kind.archived_parameters()):
            raise UserInputError(f"{script} cannot be trained in levels: {why}; {OTHERWISE}")
        if not isinstance(context.obj, Rehearsal):
            require_packages(source, options.device)
    device = chosen_device(options.device, "--device cpu runs the checkout on CPU stand-ins")
    if device == "cpu" and options.rasterizer == packages.OWN:
        raise UserInputError("--rasterizer checkout needs a CUDA device, and this run is on the CPU; leave it out")
    if measuring.gpu_busy:
        from lapgs_plugin.runs.gpu_busy import require_cuda

        require_cuda(device)
    watcher = context.with_resource(watching(options.viewing, path.parent.name, device))
    if isinstance(context.obj, Rehearsal):
        context.obj.run(settings, words)
        return
    log_to_stderr()
    logging.getLogger("lapgs_plugin").setLevel(logging.INFO)
    logging.getLogger("lapgs_plugin.rasterizers.choice").setLevel(logging.WARNING)  # of the preview
    attachment = logging.getLogger("lapgs_plugin.checkouts.attachment")
    attachment.setLevel(logging.INFO if options.verbose else logging.WARNING)
    if options.device == "auto" and device == "cpu":
        logging.getLogger(__name__).info(
            "no CUDA device: the script runs on the CPU, with our modules in place of its CUDA extensions; this is slow"
        )
    with _misplaced_options_named(context, script, words):
        if splats is not None:
            _execute_splats(splats, words, device, options, settings, measuring, watcher)
        else:
            _execute(path, words, kind, device, options, settings, measuring, watcher)


@contextmanager
def _misplaced_options_named(context: typer.Context, script: Path, words: Sequence[str]) -> Iterator[None]:
    """Name options of ours that were given after the script, if the script refuses its command line.

    A script may have options of the same names, so its own message comes first.

    Raises:
        UserInputError: the script ended as argparse does, and got at least one of our options.
    """
    try:
        yield
    except SystemExit as end:
        ours = {name for parameter in context.command.params for name in parameter.opts if name.startswith("--")}
        given = dict.fromkeys(word.partition("=")[0] for word in words)
        if end.code != USAGE or not (found := [name for name in given if name in ours]):
            raise
        raise UserInputError(
            f"{found[0]} is an option of `lapgs run`: if it is meant, give it before {script}"
        ) from end


def _execute_splats(
    described: SplatScript,
    arguments: Sequence[str],
    device: str,
    options: ScriptOptions,
    settings: RunSettings,
    measuring: MeasuringOptions,
    watcher: Watcher,
) -> None:
    """Execute a script whose class trains splats: with a hierarchy, or unchanged with --off."""
    from lapgs_plugin.checkouts.script import loaded_script
    from lapgs_plugin.checkouts.seeds import moved_seeds
    from lapgs_plugin.errors import MissingExtraError, first_line
    from lapgs_plugin.rasterizers.gsplat.rasterizer import gsplat_missing
    from lapgs_plugin.runner.splats.driver import SplatDriver, run_bare
    from lapgs_plugin.runner.splats.on_cpu import splats_on_cpu, without_compiled_parts
    from lapgs_plugin.runner.splats.run import SplatRequest
    from lapgs_plugin.viewer.preview import save_run_preview

    path = described.path
    if options.record:
        raise UserInputError(f"--record: {path} records its time and quality itself, in stats/; leave it out")
    ours = options.rasterizer == packages.OURS or (options.rasterizer == packages.AUTO and bool(gsplat_missing()))
    may_be_ours = ours if options.off else options.rasterizer != packages.OWN
    on_device = splats_on_cpu() if device == "cpu" else without_compiled_parts(may_be_ours)
    try:
        with on_device, moved_seeds(settings.seed), loaded_script(path, arguments) as loaded:
            if options.off:
                run_bare(loaded, described, device, ours)
                return
            request = SplatRequest(
                loaded, described, settings, device, options.rasterizer, options.resume, options.overwrite, measuring,
                watcher,
            )  # fmt: skip
            folder = SplatDriver(request).run()
        if folder is not None:
            save_run_preview(folder, device)
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"{path} needs {error.name}, which is not installed ({first_line(error)}); install what its "
            "requirements.txt lists, in this environment"
        ) from error


def _execute(
    script: Path,
    arguments: Sequence[str],
    kind: type[BackboneAdapter] | None,
    device: str,
    options: ScriptOptions,
    settings: RunSettings,
    measuring: MeasuringOptions,
    watcher: Watcher,
) -> None:
    """Execute the script: with a hierarchy, or unchanged with --off."""
    from lapgs_plugin.checkouts.script import loaded_script
    from lapgs_plugin.checkouts.seeds import moved_seeds
    from lapgs_plugin.runner.context import RunRequest
    from lapgs_plugin.runner.driver import HierarchyDriver
    from lapgs_plugin.runner.installed_packages import explain_import_error
    from lapgs_plugin.runner.recording import BareRunRecorder
    from lapgs_plugin.viewer.preview import save_run_preview

    on_device: AbstractContextManager[None] = nullcontext()
    compiled = None
    if device == "cpu":
        on_device = _on_cpu(script, arguments, kind)
    elif kind is not None:
        compiled = _compiled_modules(script, arguments, kind, options)
        on_device = compiled.in_place()
    try:
        with on_device, moved_seeds(settings.seed), loaded_script(script, arguments) as loaded:
            if kind is None or (options.off and not options.record):
                loaded.run_main()
                return
            if options.off:
                reasons = None if compiled is None else compiled.reasons
                BareRunRecorder(kind(loaded), device, measuring, reasons).run()
                return
            request = RunRequest(
                kind(loaded),
                settings,
                compiled,
                device=device,
                resume=options.resume,
                overwrite=options.overwrite,
                measuring=measuring,
                watcher=watcher,
            )
            folder = HierarchyDriver(request).run()
        if folder is not None:
            save_run_preview(folder, device)
    except ImportError as error:
        line = None if options.off else explain_import_error(error, script, on_cpu=device == "cpu")
        if line is None:
            raise
        raise line from error


def _on_cpu(script: Path, arguments: Sequence[str], kind: type[BackboneAdapter] | None) -> AbstractContextManager[None]:
    """Return a block in which a script runs on the CPU; `kind` is the adapter of its checkout, if it is one."""
    from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
    from lapgs_plugin.checkouts.source import CheckoutSource

    if kind is None:
        return cuda_on_cpu(None)
    source = CheckoutSource.read(script)
    return cuda_on_cpu(kind.stand_in_for(source.root, arguments), neighbours=source.unpacks("distCUDA2"))


def _compiled_modules(
    script: Path, arguments: Sequence[str], kind: type[BackboneAdapter], options: ScriptOptions
) -> CompiledModules:
    """Return whose compiled modules a checkout imports on a GPU, and say which are ours."""
    from lapgs_plugin.checkouts.compiled_modules import compiled_modules
    from lapgs_plugin.checkouts.source import CheckoutSource

    source = CheckoutSource.read(script)
    fitting = partial(kind.stand_in_for, source.root, arguments)
    modules = compiled_modules(source, fitting, options.rasterizer, bare=options.off)
    if line := modules.describe():
        logging.getLogger(__name__).info("%s", line)
    return modules


def _recognised(script: Path, backbone: str | None, *, needed: bool) -> type[BackboneAdapter] | None:
    """Return the adapter of a script's checkout; None for another script if none is needed."""
    from lapgs_plugin.checkouts.source import CheckoutSource

    try:
        return adapter_class(CheckoutSource.read(script).root, backbone)
    except UserInputError:
        if needed or backbone is not None:
            raise
        return None
