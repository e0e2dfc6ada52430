"""Functions that read one kind of file, for cases in which a whole command would take most of the time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any


def scene(path: str, resolution: str) -> None:
    from lapgs_plugin.scenes import load_scene

    load_scene(Path(path), resolution=resolution, progress=False)


def field(path: str) -> None:
    from lapgs_plugin.fields.gaussian_field import GaussianField, count_gaussians

    assert count_gaussians(path) == len(GaussianField.load_ply(path))


def trajectory(path: str) -> None:
    from lapgs_plugin.rendering.trajectory import read_trajectory

    read_trajectory(Path(path))


def recipes(folder: str) -> None:
    from lapgs_plugin.patching.recipe import load_recipes

    load_recipes(Path(folder))


def misbehave(how: str) -> None:
    """What no command may do, for tests of the harness."""
    import os
    import time

    import numpy as np

    from lapgs_plugin.errors import UserInputError

    if how == "nameless":
        raise UserInputError("it is damaged")
    if how == "raise":
        raise KeyError("scale_0")
    if how == "follow":
        Path("ascii/field.ply").write_text("through a link")
    if how == "abort":
        os.abort()
    if how == "exit":
        raise SystemExit(1)
    if how == "sleep":
        time.sleep(100)
    while how == "compute":
        pass
    if how == "grow":
        np.ones(1_500_000_000, np.uint8)
    if how == "ask":
        try:
            np.ones(10**11, np.uint8)
        except MemoryError as error:
            raise UserInputError("field.ply is too large") from error


READERS: dict[str, Callable[..., Any]] = {
    "read-scene": scene,
    "read-field": field,
    "read-trajectory": trajectory,
    "read-recipes": recipes,
    "misbehave": misbehave,
}
