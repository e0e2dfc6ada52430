"""The `lapgs` command."""

from __future__ import annotations


def main() -> None:
    """Entry point of the console script."""
    import time

    began = time.monotonic()
    from lapgs_plugin.interrupt import install

    install()  # before anything that takes time to import
    import gc
    import os

    ranks = "TORCHELASTIC_RUN_ID" in os.environ
    if ranks:  # C++ reports of ranks that are gone; torch reads it when it is imported
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")
    if "LAPGS_RANK_REPORTS" in os.environ or (ranks and os.environ.get("RANK") != "0"):
        from lapgs_plugin.interrupt import be_silent

        be_silent()  # the command that started this rank, or under torchrun rank 0, says how it ended

    # Importing torch makes a million objects and no garbage. Collections would take a tenth of the time until a command
    # begins.
    gc.set_threshold(10_000)
    # Before torch starts its threads: they must not spin on the cores that our kernels need (jit.threads).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from lapgs_plugin.cli.app import run

    run(began)
