"""The `lapgs` command."""

from __future__ import annotations


def main() -> None:
    """Entry point of the console script."""
    from lapgs_plugin.interrupt import install

    install()  # before anything that takes time to import
    import os

    # Before torch starts its threads: they must not spin on the cores that our kernels need (reference_raster.threads).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from lapgs_plugin.cli.app import run

    run()
