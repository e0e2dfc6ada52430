"""The map of the code names every room in the order of the layers, and only files that exist."""

from __future__ import annotations

import re

from tests.docs.documents import ROOT

try:
    import tomllib
except ModuleNotFoundError:  # before Python 3.11
    import tomli as tomllib

MAP = (ROOT / "lapgs_plugin/README.md").read_text(encoding="utf-8")


def test_every_room_stands_in_the_layer_that_imports_are_checked_against() -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    contract = tools["importlinter"]["contracts"][0]
    layers = [set(layer.replace("|", " ").split()) for layer in reversed(contract["layers"])]
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \| .+ \|$", MAP, re.MULTILINE)
    named = [{room for at, room in rows if int(at) == number} for number in range(1, len(layers) + 1)]
    assert named == layers
    assert [int(at) for at, _ in rows] == sorted(int(at) for at, _ in rows)


def test_every_file_on_the_map_exists() -> None:
    files = set(re.findall(r"`([\w./]+(?:\.py|\.toml|/))`", MAP)) - {"lapgs_plugin/"}
    assert len(files) > 30
    missing = [name for name in files if not (ROOT / "lapgs_plugin" / name).exists() and not (ROOT / name).exists()]
    assert missing == []
