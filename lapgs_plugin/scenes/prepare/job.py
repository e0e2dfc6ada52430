"""Hold the folders, photos and settings that all steps share, and keep unfinished work for a repeated call."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from lapgs_plugin.errors import LapgsError, UserInputError
from lapgs_plugin.files import atomic_write, require_own_entries
from lapgs_plugin.scenes.masks import MASKS
from lapgs_plugin.scenes.parallel import ProgressCallback, bar, in_threads
from lapgs_plugin.scenes.prepare.photos import Photos
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from lapgs_plugin.untrusted import read_json

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

WORK = ".prepare"
"""Folder of unfinished work inside of the scene's."""
MAX_DECODERS = 4  # a decoded 50-megapixel photo takes 600 MB


@dataclass(frozen=True)
class Job:
    """Share the folders of an unfinished scene, its photos and its settings between steps.

    Attributes:
        work: folder of unfinished work.
        source: the photos, or the video.
        settings: of the user.
        progress: show a bar for each step on stderr.
        seconds: wall time of each finished step by its title.
    """

    work: Path
    source: Photos
    settings: PrepareSettings
    progress: bool
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def photos(self) -> Path:
        """Folder of the photos that COLMAP reads."""
        return self.work / "photos" if self.source.needs_copies else self.source.folder

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the photos, once those of a video are there."""
        if self.source.clip is None:
            return tuple(self.source.files)
        return tuple(sorted(file.name for file in self.photos.iterdir()))

    def photo(self, name: str) -> Path:
        """Return the file of a photo: the user's, which errors should name, or the copy that COLMAP reads instead."""
        is_copy = self.source.clip is not None or name in self.source.converted
        return self.photos / name if is_copy else self.source.files[name]

    @property
    def masks(self) -> Path:
        """Folder of the masks. It is missing without masks."""
        return self.work / MASKS

    @property
    def database(self) -> Path:
        """COLMAP's database of features and matches."""
        return self.work / "database.db"

    @property
    def scene(self) -> Path:
        """Folder of the scene until it is whole."""
        return self.work / "scene"

    def bar(self, title: str, unit: str) -> AbstractContextManager[ProgressCallback]:
        """Show a bar if wanted; yield the callback for finished items and their total."""
        return bar(title, unit, self.progress)

    @contextmanager
    def timed(self, title: str) -> Iterator[None]:
        """Record the seconds of a step that succeeds."""
        start = time.perf_counter()
        yield
        self.seconds[title] = time.perf_counter() - start

    def each_photo(self, title: str, work: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
        """Apply `work` to all items in threads and record the time."""
        with self.timed(title):
            return in_threads(title, "photos", work, items, most=MAX_DECODERS, progress=self.progress)


@contextmanager
def opened_work(work: Path, settings: dict[str, Any], overwrite: bool) -> Iterator[None]:
    """Make the work folder, or reuse one of the same photos and settings. A new one is removed if the block fails."""
    require_own_entries(work.parent, [work.name])
    file = work / "settings.json"
    if file.is_file():
        before = read_json(file, dict[str, Any], advice=f"delete {work} to start over")
        changed = [key for key in settings if before.get(key) != settings[key]]
        if not changed:
            yield
            return
        if not overwrite:
            raise UserInputError(
                f"{work}: unfinished work with other {', '.join(changed)}; repeat the command as it was to "
                "finish it, or start over with --overwrite"
            )
    if work.exists():
        shutil.rmtree(work)
    work.mkdir(parents=True)
    with atomic_write(file) as stream:
        stream.write(json.dumps(settings).encode())
    try:
        yield
    except LapgsError:
        shutil.rmtree(work)
        with suppress(OSError):  # it held something before
            work.parent.rmdir()
        raise
