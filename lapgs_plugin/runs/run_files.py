"""Write and read the files of a run folder beside its levels: manifest, history, figures, checkpoint."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from lapgs_plugin.errors import RunFolderError, printable
from lapgs_plugin.files import FolderLock, one_line_errors, require_own_entries, write_text
from lapgs_plugin.runs.layout import (
    CAMERAS,
    CHECKPOINT,
    FORGET_EXTENSION,
    HISTORY,
    METRICS,
    STABILITY,
    VIGNETTING,
    exists,
)
from lapgs_plugin.runs.manifest import Manifest
from lapgs_plugin.runs.results import HistoryEntry, Metrics
from lapgs_plugin.runs.tensors import read_tensors, write_tensors
from lapgs_plugin.runs.trained_cameras import CameraTable, TrainedCameras
from lapgs_plugin.untrusted import checked, read_json, read_json_lines, shortened

if TYPE_CHECKING:
    from typing_extensions import Self

logger = logging.getLogger(__name__)


Falloffs = dict[str, Annotated[float, Field(ge=-20, le=0)]]
"""Brightness of the corners of views' photos in stops, by view: of those whose camera darkens them."""


class RunFiles:
    """Hold a run folder, its manifest and its lock; `archive.RunArchive` adds the levels."""

    def __init__(self, folder: Path, manifest: Manifest, lock: FolderLock | None) -> None:
        """Use `RunArchive.create` or `RunArchive.open`."""
        self._given, self._absolute = folder, folder.absolute()
        self._manifest = manifest
        self._lock = lock

    def close(self) -> None:
        """Release a folder that was locked for writing."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def manifest(self) -> Manifest:
        return self._manifest

    @property
    def available_levels(self) -> tuple[int, ...]:
        """The finished levels, coarsest first."""
        return tuple(record.level for record in self._manifest.records)

    @property
    def name(self) -> str:
        """The name of the run folder, for pages and terminals: with control characters as escapes."""
        return printable(self._absolute.name)

    @property
    def _folder(self) -> Path:
        """The folder as it was given, or its whole path if the program works in another folder since."""
        return self._given if self._given.absolute() == self._absolute else self._absolute

    def path(self, *parts: str) -> Path:
        """Return the path of the run folder as it was given, or of something in it; whole ones after `os.chdir`."""
        return self._folder.joinpath(*parts)

    def results(self, name: str) -> Path:
        """Return the path of an entry that a command writes without the lock, such as `layout.RENDERS`.

        Raises:
            RunFolderError: it is a link, or holds one.
        """
        require_own_entries(self._folder, [name])
        return self.path(name)

    def append_history(self, entry: dict[str, Any]) -> None:
        """Append one entry to the history: JSON with finite numbers.

        Args:
            entry: "level" and "iteration" within its stage; `lapgs report` draws "elapsed" (seconds of optimization in
                the run), "loss", "num_gaussians" and "psnr".

        Raises:
            UserInputError: it has no level or iteration, a value of another type, or a number that is not finite.
        """
        self._require_lock()
        checked(entry, HistoryEntry, "the history entry", advice="it could not be read again")
        line = json.dumps(entry, allow_nan=False) + "\n"
        path = self.path(HISTORY)
        with one_line_errors(path, training=True), path.open("a", encoding="utf-8") as stream:
            stream.write(line)

    def history(self) -> list[dict[str, Any]]:
        """Return all entries in the order they were added. A last line that a crash cut short is left out.

        Raises:
            RunFolderError: another line is damaged.
        """
        path = self.path(HISTORY)
        return read_json_lines(path, HistoryEntry, error=RunFolderError) if exists(path) else []

    def complete_history(self, entry: dict[str, Any]) -> None:
        """Add values to the last entry if it has the same level and iteration, else append them as an entry.

        Args:
            entry: as `append_history` takes it.
        """
        entries = self.history()
        if not entries or any(entries[-1][key] != entry[key] for key in ("level", "iteration")):
            self.append_history(entry)
            return
        self._require_lock()
        checked(entry, HistoryEntry, "the history entry", advice="it could not be read again")
        self._write_history([*entries[:-1], entries[-1] | entry])

    def rewind_history(self, level: int, iteration: int) -> None:
        """Remove the entries after an iteration of a level, which a resumed run adds again.

        Training starts with level L-1, so an entry with a lower level is later.
        """
        self._require_lock()
        kept = [entry for entry in self.history() if (-entry["level"], entry["iteration"]) <= (-level, iteration)]
        self._write_history(kept)

    def _write_history(self, entries: Iterable[Mapping[str, Any]]) -> None:
        text = "".join(json.dumps(entry, allow_nan=False) + "\n" for entry in entries)
        write_text(self.path(HISTORY), text, training=True)

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Replace the run's metrics: JSON with finite numbers. Needs no lock."""
        self._write_json(self.path(METRICS), metrics)

    def write_stability(self, figures: dict[str, Any]) -> None:
        """Replace the run's flicker metrics: JSON with finite numbers. Needs no lock."""
        self._write_json(self.path(STABILITY), figures)

    def metrics(self) -> dict[str, Any] | None:
        """Read the run's metrics; None if they were never measured.

        Raises:
            RunFolderError: the file is damaged.
        """
        path = self.path(METRICS)
        advice = "write it again with `lapgs eval`"
        return dict(read_json(path, Metrics, error=RunFolderError, advice=advice)) if exists(path) else None

    def write_cameras(self, cameras: TrainedCameras) -> None:
        """Replace the cameras of the run's views."""
        self._require_lock()
        self._write_json(self.path(CAMERAS), cameras.as_json(), training=True)

    def cameras(self) -> TrainedCameras | None:
        """Read the cameras of the run's views; None if they are those of its scene.

        Raises:
            RunFolderError: the file is damaged.
        """
        path = self.path(CAMERAS)
        if not exists(path):
            return None
        table = read_json(path, CameraTable, error=RunFolderError, advice="train again with --overwrite")
        return TrainedCameras.from_json(table, str(path))

    def write_vignetting(self, falloffs: Falloffs) -> None:
        """Replace the falloffs of views; without any, nothing is written."""
        self._require_lock()
        if falloffs:
            self._write_json(self.path(VIGNETTING), falloffs, training=True)

    def vignetting(self) -> Falloffs:
        """Read the falloffs of views, as `ops.vignetting` describes them; empty without.

        Raises:
            RunFolderError: the file is damaged.
        """
        path = self.path(VIGNETTING)
        if not exists(path):
            return {}
        falloffs: Falloffs = read_json(path, Falloffs, error=RunFolderError, advice="train again with --overwrite")
        return falloffs

    def save_checkpoint(self, state: dict[str, Any], extends_to: int | None = None) -> None:
        """Replace the checkpoint of the level in training.

        Args:
            state: tensors, numbers, text and None by name, and lists, tuples and dictionaries of them, such as
                state_dict() of an optimizer. `load_checkpoint` returns it with its tensors on the CPU.
            extends_to: of a finished run that is trained further, the number of iterations that it will have.

        Raises:
            UserInputError: something in the state cannot be read again; the old checkpoint stays.
        """
        self._require_lock()
        level = self._manifest.next_level
        of = {"level": 0, "extends_to": extends_to} if level is None else {"level": level}
        write_tensors(self.path(CHECKPOINT), {**of, "state": state})

    @property
    def extends_to(self) -> int | None:
        """Iterations to which an interrupted extension was to train the finished run; None if there is none.

        Raises:
            RunFolderError: the checkpoint cannot be read.
        """
        path = self.path(CHECKPOINT)
        if not self._manifest.complete or not exists(path):
            return None
        iterations = read_tensors(path, FORGET_EXTENSION).get("extends_to")
        return (
            iterations
            if type(iterations) is int and iterations > int(self._manifest.settings.get("iterations", 0))
            else None
        )

    def load_checkpoint(self) -> dict[str, Any] | None:
        """Read the checkpoint of the next level to train, its tensors on the CPU; None if there is none.

        That of a finished run is of its interrupted extension.

        Raises:
            RunFolderError: it cannot be read, or its level is neither finished nor the next.
        """
        path = self.path(CHECKPOINT)
        if not exists(path):
            return None
        advice = "delete it to continue from the last finished level"
        saved = read_tensors(path, advice)
        level, state = saved.get("level"), saved.get("state")
        if type(level) is not int or not isinstance(state, dict):
            contents = f"level {shortened(level)} and a state that is a {type(state).__name__}"
            raise RunFolderError(f"{path} holds {contents}, expected a number and a dictionary; {advice}")
        if level == self._manifest.next_level or (level == 0 and self.extends_to is not None):
            return state
        if level not in self.available_levels:
            raise RunFolderError(f"{path} is of level {level}, expected {self._manifest.next_level}; {advice}")
        # A run killed right after finishing a level leaves the checkpoint of that level.
        logger.warning("%s is of level %d, which is finished: it is not used", path, level)
        return None

    def _write_json(self, path: Path, values: dict[str, Any], training: bool = False) -> None:
        text = json.dumps(values, indent=2, allow_nan=False) + "\n"
        write_text(path, text, training=training)

    def _remove(self, *names: str) -> None:
        with one_line_errors(self._folder):
            for name in names:
                self.path(name).unlink(missing_ok=True)

    def _require_lock(self) -> None:
        if self._lock is None:
            raise RunFolderError(
                f"{self._folder} is open for reading, expected a folder open for writing; open it with "
                "RunArchive.open(folder, resume=True)"
            )
