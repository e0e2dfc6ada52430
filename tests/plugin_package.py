"""Install a tiny package with entry points: its metadata and a module in a folder on the path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lapgs_plugin.adapters.registry import BACKBONES
from lapgs_plugin.cli.app import INSTALLED
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.rasterizers.choice import RASTERIZERS
from lapgs_plugin.registry import Registry
from lapgs_plugin.reports.folders import FOLDER_REPORTS
from lapgs_plugin.scenes.exports.registry import SCENE_READERS
from lapgs_plugin.training.strategies import STRATEGIES

REGISTRIES: tuple[Registry[Any], ...] = (
    BACKBONES,
    SUPERVISIONS,
    RASTERIZERS,
    STRATEGIES,
    FOLDER_REPORTS,
    INSTALLED,
    SCENE_READERS,
)
"""All that other packages can add to, but hooks."""


def install_package(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, entry_points: str, source: str) -> None:
    """Install a distribution `name` with one module `name`, until the end of a test.

    Args:
        folder: where it goes.
        entry_points: contents of its entry_points.txt.
        source: contents of its module.
    """
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    (folder / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(folder)
    for registry in REGISTRIES:  # each remembers the entry points that it has found
        monkeypatch.delitem(vars(registry), "entries", raising=False)
        monkeypatch.setitem(vars(registry), "entries", type(registry).entries.func(registry))
