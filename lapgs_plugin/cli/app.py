"""Register every command, and turn errors into one line and an exit code."""

from __future__ import annotations

import inspect
import sys
import traceback
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lapgs_bench.app import bench_app
from lapgs_plugin import __version__, interrupt
from lapgs_plugin.cli import patch
from lapgs_plugin.cli.config_file import naming_the_config
from lapgs_plugin.cli.conformance import conformance
from lapgs_plugin.cli.doctor import doctor
from lapgs_plugin.cli.evaluate import evaluate
from lapgs_plugin.cli.export import export
from lapgs_plugin.cli.help import show_topic
from lapgs_plugin.cli.import_run import import_run
from lapgs_plugin.cli.prepare import prepare
from lapgs_plugin.cli.render import render
from lapgs_plugin.cli.report import report
from lapgs_plugin.cli.run import CONTEXT as RUN_CONTEXT
from lapgs_plugin.cli.run import run as run_backbone
from lapgs_plugin.cli.sample import sample
from lapgs_plugin.cli.train import train
from lapgs_plugin.cli.usage import one_line_usage_errors
from lapgs_plugin.cli.view import view
from lapgs_plugin.errors import LapgsError


class Commands(TyperGroup):
    """Run a command so that signals end it as `lapgs_plugin.interrupt` says and usage errors are one line."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        _show_flags_without_type(self)

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        with one_line_usage_errors():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        with interrupt.command(), naming_the_config(ctx.meta), one_line_usage_errors(ctx):
            return super().invoke(ctx)


def _show_flags_without_type(command: Any) -> None:
    """Leave out `<bool>` behind flags in help texts: it reads as if a value had to follow."""
    for each in command.get_params(typer.Context(command)):
        if getattr(each, "is_flag", False):
            each.metavar = ""
    for below in getattr(command, "commands", {}).values():
        _show_flags_without_type(below)


app = typer.Typer(
    name="lapgs", cls=Commands, no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"lapgs {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Train 3D Gaussian Splatting coarse to fine, on your scenes or inside an existing 3DGS codebase.

    Get a scene with `lapgs sample` or `lapgs prepare`. Train it with `lapgs train`, or with the train.py of a checkout
    through `lapgs run`. Then use `lapgs eval`, `lapgs render`, `lapgs report` and `lapgs view` on the run folder.
    `lapgs doctor` checks this machine. `lapgs help` has the documentation.
    """


app.command("sample")(sample)
app.command("prepare")(prepare)
app.command("train")(train)
app.command("run", context_settings=RUN_CONTEXT)(run_backbone)
app.command("eval")(evaluate)
app.command("render")(render)
app.command("report")(report)
app.command("view")(view)
app.command("export")(export)
app.command("import-run")(import_run)
app.add_typer(bench_app, name="bench")
app.command("conformance")(conformance)
app.add_typer(patch.app, name="patch")
app.command("doctor")(doctor)
app.command("help")(show_topic)


def _flowing_help(group: typer.Typer) -> None:
    """Join the lines of each paragraph of the help texts, which typer would print broken as they are in the source."""
    for each in [*group.registered_commands, group.registered_callback]:
        if each is not None and each.callback is not None:
            paragraphs = inspect.cleandoc(each.callback.__doc__ or "").split("\n\n")
            each.help = "\n\n".join(text.replace("\n", " ") for text in paragraphs)
    for inner in group.registered_groups:
        if inner.typer_instance is not None:
            _flowing_help(inner.typer_instance)


_flowing_help(app)


def run() -> None:
    """Run the command line; a `LapgsError` becomes one line on stderr and its exit code.

    The traceback of an exception in a checkout's script begins there, as if Python ran the script.
    """
    try:
        app(prog_name="lapgs")
    except LapgsError as error:
        print(f"lapgs: {error}", file=sys.stderr)
        sys.exit(interrupt.exit_code(error.exit_code))
    except Exception as error:
        from lapgs_plugin.checkouts.script import frames_of_script

        frames = frames_of_script(error)
        if frames is None:
            raise
        traceback.print_exception(type(error), error, frames)
        sys.exit(1)
