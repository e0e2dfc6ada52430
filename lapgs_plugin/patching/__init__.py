"""Apply small anchored edits to the sources of CUDA extensions and revert them: the engine of `lapgs patch`.

`recipe` reads the edits of each extension from `patches/*.toml`, `tokens` finds places by tokens instead of lines,
`blocks` marks an edit in a file, `engine` plans the changes, and `files` writes all files or none. Training never
patches anything.
"""

from __future__ import annotations

from lapgs_plugin.patching.engine import (
    ALL_SETS,
    FileChange,
    SetStatus,
    State,
    Target,
    find_targets,
    plan_apply,
    plan_revert,
    status,
)
from lapgs_plugin.patching.files import alone, read_only, uncommitted, write_all
from lapgs_plugin.patching.recipe import Anchor, Check, Edit, Recipe, load_recipes

__all__ = [
    "ALL_SETS",
    "Anchor",
    "Check",
    "Edit",
    "FileChange",
    "Recipe",
    "SetStatus",
    "State",
    "Target",
    "alone",
    "find_targets",
    "load_recipes",
    "plan_apply",
    "plan_revert",
    "read_only",
    "status",
    "uncommitted",
    "write_all",
]
