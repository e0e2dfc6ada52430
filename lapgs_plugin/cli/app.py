"""Register every command, and turn errors into one line and an exit code."""

from __future__ import annotations

import sys
import traceback
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from lapgs_plugin import __version__, interrupt
from lapgs_plugin.cli import patch
from lapgs_plugin.cli.config_file import naming_the_config
from lapgs_plugin.cli.conformance import conformance
from lapgs_plugin.cli.doctor import doctor
from lapgs_plugin.cli.evaluate import evaluate
from lapgs_plugin.cli.export import export
from lapgs_plugin.cli.help import show_topic
from lapgs_plugin.cli.help_texts import join_lines, module_summary, show_flags_without_type
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
from lapgs_plugin.errors import LapgsError, UserInputError, typed_line
from lapgs_plugin.registry import Registry
from lapgs_plugin.training.ranks import launcher

INSTALLED: Registry[typer.Typer] = Registry("lapgs", "lapgs.commands", typer.Typer, {})
"""Commands of entry points, such as `lapgs bench`; those of this file come first."""


class InstalledCommand(TyperCommand):
    """Import a command of an entry point when it is called. `lapgs --help` only reads its source."""

    def __init__(self, name: str) -> None:
        super().__init__(name, help=module_summary(INSTALLED.entries[name].module))

    def load(self) -> Any:
        """Import the command and return it as click's object.

        Raises:
            UserInputError: it cannot be imported, or is no `typer.Typer` with a command.
        """
        assert self.name is not None
        installed = INSTALLED[self.name]
        join_lines(installed)
        try:
            command: Any = typer.main.get_command(installed)
        except (AssertionError, RuntimeError, TypeError) as error:  # typer's, such as of an app without commands
            raise UserInputError(
                f"lapgs {self.name}: {INSTALLED.entries[self.name].value} is no command ({typed_line(error)}); fix or "
                "uninstall the package that brings it"
            ) from error
        command.params = [one for one in command.params if one.name not in ("install_completion", "show_completion")]
        show_flags_without_type(command)
        return command

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        return self.load().make_context(*args, **kwargs)


class Commands(TyperGroup):
    """Run a command so that a signal ends it as in `lapgs_plugin.interrupt`, and usage errors are one line."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        show_flags_without_type(self)

    def list_commands(self, ctx: Any) -> list[str]:
        for name in INSTALLED:
            if name not in self.commands:
                self.commands[name] = InstalledCommand(name)
        return super().list_commands(ctx)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in self.commands:  # looking for entry points takes time
            self.list_commands(ctx)
        return super().get_command(ctx, cmd_name)

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        with one_line_usage_errors():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        with interrupt.command(), naming_the_config(ctx.meta), one_line_usage_errors(ctx):
            return super().invoke(ctx)


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
app.command("conformance")(conformance)
app.add_typer(patch.app, name="patch")
app.command("doctor")(doctor)
app.command("help")(show_topic)


join_lines(app)


def all_commands() -> Any:
    """Return all commands as click's objects, with those of entry points imported."""
    group = typer.main.get_command(app)
    commands: dict[str, Any] = vars(group)["commands"]
    for name in group.list_commands(typer.Context(group)):  # type: ignore[attr-defined]  # it is a group
        if isinstance(commands[name], InstalledCommand):
            commands[name] = commands[name].load()
    return group


def run(began: float | None = None) -> None:
    """Run the command line; a `LapgsError` becomes one line on stderr and its exit code.

    The traceback of an exception in a checkout's script begins there, as if Python ran the script.

    Args:
        began: when the process began, by `time.monotonic`, for the commands' context; None for now.
    """
    try:
        app(prog_name="lapgs", obj=began)
    except LapgsError as error:
        line, code = f"lapgs: {error}", interrupt.exit_code(error.exit_code)
        if launcher.is_rank():
            launcher.end_rank(error, line, code)
        print(line, file=sys.stderr)
        sys.exit(code)
    except Exception as error:
        if launcher.is_rank():
            launcher.end_rank(error, traceback.format_exc(), 1)
        from lapgs_plugin.checkouts.script import frames_of_script

        frames = frames_of_script(error)
        if frames is None:
            raise
        traceback.print_exception(type(error), error, frames)
        sys.exit(1)
