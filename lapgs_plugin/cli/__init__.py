"""The `lapgs` command."""

from __future__ import annotations


def main() -> None:
    """Entry point of the console script."""
    from lapgs_plugin.cli.app import run

    run()
