"""Say what works instead of `lapgs run` for scripts that train otherwise than 3DGS's. Executes nothing."""

from __future__ import annotations

from collections.abc import Collection
from itertools import chain
from pathlib import Path

PREFIXES = {"ns-": "nerfstudio"}
"""Beginnings of commands of trainers by their package."""

KNOWN = {
    "nerfstudio": "nerfstudio's trainers make data, model and loop of a configuration, and splatfacto enlarges its "
    "images itself (--pipeline.model.num-downscales, --pipeline.model.resolution-schedule); `lapgs train DATA` trains "
    "the folder that they read, and `lapgs help python` shows how a loop of your own trains levels",
    "gsplat": "of the scripts around gsplat, simple_trainer.py and those with its class are trained by `lapgs run "
    "simple_trainer.py default ...`; `lapgs train SCENE` trains with gsplat without a checkout, and `lapgs help "
    "python` shows how a loop of your own trains levels",
}
"""What to do by the package that a script imports."""

OWN_LOOP = (
    "`lapgs train SCENE` trains without a checkout, `lapgs help python` shows how a loop of your own trains levels, "
    "`lapgs run --off` runs the script as it is"
)


def advice_for(packages: Collection[str]) -> str:
    """Return what works for a script that imports some packages and is not one of 3DGS."""
    return next((advice for package, advice in KNOWN.items() if package in packages), OWN_LOOP)


def known_trainer(path: Path) -> str | None:
    """Return what works for a command, such as ns-train, or for the folder of a trainer's sources; None for others."""
    commands = (package for prefix, package in PREFIXES.items() if path.name.startswith(prefix))
    folders = (package for package in KNOWN if (path / package / "__init__.py").is_file())
    package = next(chain(folders, commands), None)
    return None if package is None else KNOWN[package]
