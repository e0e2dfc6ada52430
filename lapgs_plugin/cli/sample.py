"""Make a procedural scene: `lapgs sample`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lapgs_plugin.cli.output import say, train_command

MINUTES_ON_A_CPU = "--iterations 2000"
"""Proposed options; the default for the scene's number of views would be ten thousand iterations."""


def sample(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Scene folder to write. It appears when complete.")],
    size: Annotated[str, typer.Option(help="Image size in pixels, WIDTHxHEIGHT.")] = "480x320",
    views: Annotated[int, typer.Option(help="Number of images. Image i does not depend on this number.")] = 40,
    points: Annotated[int, typer.Option(help="Number of sparse points, each seen by at least two views.")] = 4000,
    seed: Annotated[int, typer.Option(help="Seed of patterns and cameras. The same seed gives the same files.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the scene in OUT.")] = False,
) -> None:
    """Make a procedural scene to try everything on: a still life of test patterns in a round hall.

    The scene is a COLMAP folder with exact camera poses and noisy sparse points. Its patterns repeat at doubling
    frequencies with sharp edges, down to the size of a pixel at 480x320.
    """
    from lapgs_plugin.scenes.resolution import parse_size
    from lapgs_plugin.scenes.sample import make_sample_scene

    width, height = parse_size(size)
    make_sample_scene(
        out, width=width, height=height, views=views, points=points, seed=seed, overwrite=overwrite, progress=True
    )
    say(f"{out}: {views} images of {width}x{height}, {points} points")
    say(f"next: {train_command(out, MINUTES_ON_A_CPU)}")
