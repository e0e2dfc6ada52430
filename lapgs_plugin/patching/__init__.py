"""The engine behind `lapgs patch`: small anchored edits put into an extension's sources, and taken out again.

`recipe` reads what is known of each extension from `patches/*.toml`, `tokens` finds places by tokens instead of lines,
`blocks` is how an edit looks in a file, `engine` plans what changes, `files` looks before it writes and then writes all
files or none.
Nothing here runs unless it is called: training never patches anything.
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
