"""Options and messages that the commands share which render a run."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import option


@dataclass(frozen=True)
class RenderOptions:
    """Choose where a run's scene is, and where and with which rasterizer the run is rendered."""

    scene: Path | None = option(None, "Scene folder, if it was moved after training.")
    device: str = option("auto", "cuda, cpu, or auto: CUDA if there is a CUDA device, else the CPU.")
    rasterizer: str = option(
        "auto",
        "cpu, oracle, gsplat, or the module of an installed CUDA rasterizer such as diff_gaussian_rasterization. "
        "auto: the rasterizer that the run was trained with, else gsplat, else cpu.",
    )


def show_log() -> None:
    """Print on stderr which rasterizer renders a run, and why."""
    logging.basicConfig(format="lapgs: %(message)s")
    logging.getLogger("lapgs_plugin.rendering").setLevel(logging.INFO)


def refuse(options: Mapping[str, object], why: str) -> None:
    """Refuse options that would have no effect.

    Args:
        options: values by name; None or False for an option that was not given.
        why: the reason, as it follows the option's name.

    Raises:
        UserInputError: one was given.
    """
    for option_name, value in options.items():
        if value is not None and value is not False:
            raise UserInputError(f"{option_name} {why}; leave it out")
