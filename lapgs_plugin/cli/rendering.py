"""What the commands that render a run have in common: where, with what, and the line that says so."""

from __future__ import annotations

import logging
from typing import Annotated

import typer

from lapgs_plugin.errors import UserInputError

DeviceOption = Annotated[
    str, typer.Option(help="Where to render: cuda, cpu, or auto, which takes CUDA where there is any.")
]
RasterizerOption = Annotated[
    str,
    typer.Option(
        help="What renders: cpu, oracle, gsplat, or the module of an installed rasterizer such as "
        "diff_gaussian_rasterization. auto takes the one that the run was trained with, or else gsplat, or else cpu."
    ),
]


def show_log() -> None:
    """Let what renders a run, and why, appear on stderr."""
    logging.basicConfig(format="lapgs: %(message)s")
    logging.getLogger("lapgs_plugin.rendering").setLevel(logging.INFO)


def refuse(options: dict[str, object], why: str) -> None:
    """Say that options would have no effect.

    Args:
        options: by name; None for one that was not given.
        why: after the name.

    Raises:
        UserInputError: one was given.
    """
    for option, value in options.items():
        if value is not None:
            raise UserInputError(f"{option} {why}; leave it out")
