"""Give each rank the run folder: rank 0 writes it, the others read what it has written.

All ranks see one file system. A level is finished for all of them at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import read_manifest
from lapgs_plugin.training.ranks.group import ALONE, Ranks


class SharedArchive(RunArchive):
    """Write and read a run folder whose levels other ranks read as soon as they are finished."""

    ranks: Ranks = ALONE

    def finish_level(self, *values: Any, **more: Any) -> None:
        super().finish_level(*values, **more)
        self.ranks.wait()

    def finish_extension(self, *values: Any, **more: Any) -> None:
        super().finish_extension(*values, **more)
        self.ranks.wait()


class FollowedArchive(RunArchive):
    """Read the run folder that rank 0 writes; what would write it does nothing, or waits until rank 0 has."""

    ranks: Ranks = ALONE

    def finish_level(self, *values: Any, **more: Any) -> None:
        self._read_again()

    def finish_extension(self, *values: Any, **more: Any) -> None:
        self._read_again()

    def add_overhead(self, seconds: Mapping[str, float]) -> None:
        pass

    def change_settings(self, settings: Mapping[str, Any]) -> None:
        pass

    def append_history(self, entry: dict[str, Any]) -> None:
        pass

    def complete_history(self, entry: dict[str, Any]) -> None:
        pass

    def rewind_history(self, level: int, iteration: int) -> None:
        pass

    def write_vignetting(self, falloffs: Mapping[str, float]) -> None:
        pass

    def save_checkpoint(self, state: dict[str, Any], extends_to: int | None = None) -> None:
        pass

    def _read_again(self) -> None:
        self.ranks.wait()
        self._manifest = read_manifest(self.path())


def open_for(ranks: Ranks, path: Path, open_it: Callable[[type[RunArchive]], RunArchive]) -> RunArchive:
    """Return the run folder of a group.

    Args:
        ranks: the group.
        path: of the folder.
        open_it: makes or opens it for writing, given the class to do that with.
    """
    if ranks.size == 1:
        return open_it(RunArchive)
    ranks.wait()  # all have looked at the folder as it was
    if ranks.leads:
        archive = open_it(SharedArchive)
    ranks.wait()
    if not ranks.leads:
        archive = FollowedArchive.open(path)
    assert isinstance(archive, SharedArchive | FollowedArchive), "made with the class"
    archive.ranks = ranks
    return archive
