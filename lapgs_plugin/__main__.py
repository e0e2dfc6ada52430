"""`python -m lapgs_plugin`: the `lapgs` command of this interpreter, for whoever starts it as a process of its own."""

from __future__ import annotations

from lapgs_plugin.cli import main

main()
