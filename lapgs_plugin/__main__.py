"""Run the `lapgs` command with this interpreter: `python -m lapgs_plugin`."""

from __future__ import annotations

from lapgs_plugin.cli import main

main()
