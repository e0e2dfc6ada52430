"""Follow a run folder that may still be written, and show its new levels."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from lapgs_plugin.errors import LapgsError, RunFolderError, SceneError, counted
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import MANIFEST
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rasterizers.choice import PlacedRasterizer, rasterizer_for
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.rendering.rig import Rig
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.viewer.page import Page
from lapgs_plugin.viewer.pictures import PictureSettings, ShownRun, draw
from lapgs_plugin.viewer.poses import InitialView, SceneCameras
from lapgs_plugin.viewer.preview import read_preview, save_preview
from lapgs_plugin.viewer.session import ViewerContent
from lapgs_plugin.viewer.viewer import Viewer

POLL_SECONDS = 1.0
"""Seconds between two checks for changes."""

Stamp = tuple[int, int] | None  # time of the last change in nanoseconds, and size of a file; None without a file


def load_rasterizer(placed: PlacedRasterizer) -> None:
    """Render a tiny picture to load the renderer: on a GPU its context, kernels and compilers.

    Errors are ignored, because the first real picture reports them.
    """
    camera = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, torch.eye(4))
    ahead = torch.tensor([[0.0, 0.0, 1.0]])
    base = GaussianField(ahead, torch.eye(4)[:1], ahead - 3.0, torch.zeros(1), torch.zeros(1, 16, 3))
    with contextlib.suppress(Exception):
        base = base.to(placed.device)
        HierarchyRenderer({1: base, 0: replace(base, signed=True)}, 2, Pyramid(), placed.rasterizer).render(camera)


class FollowedRun:
    """Read the levels of a run that can be shown: finished, undamaged, from the coarsest on without gaps.

    Attributes:
        options: folder of the scene, rasterizer and device.
        archive: as last read.
        shown: the run; None while it has no level.
        problem: a line about the first missing or damaged level; None without any.

    Raises:
        RunFolderError: there is no run, it has another version, or its coarsest level is damaged.
        UserInputError, MissingExtraError: see `rasterizer_for`.
    """

    def __init__(self, folder: Path, options: RenderOptions) -> None:
        self._folder, self._name = folder, folder.absolute().name
        self.options = options
        self._fields: dict[int, tuple[Stamp, GaussianField]] = {}
        self._placed: PlacedRasterizer | None = None
        self._created = ""
        self._stamps: dict[Path, Stamp] = {}
        self._rig: Rig | None = None
        self.archive: RunArchive
        self.shown: ShownRun | None = None
        self.problem: str | None = None
        self._read()
        if self.problem is not None and self.shown is None:
            raise RunFolderError(self.problem)

    def refresh(self) -> bool:
        """Read changes, and return whether there were any.

        Raises:
            RunFolderError: the run is missing or damaged; the earlier state is kept.
        """
        if all(_stamp(path) == stamp for path, stamp in self._stamps.items()):
            return False
        self._read()
        return True

    def set_cameras(self, rig: Rig | None) -> None:
        """Set the training cameras; None if they are not known."""
        self._rig = rig
        if self.shown is not None:
            self.shown = ShownRun.of(self.shown.name, self.shown.renderer, rig)

    def status(self) -> str:
        """Describe in one line which levels are shown and which are missing."""
        manifest = self.archive.manifest
        levels = ", ".join(str(level) for level in self.shown.counts) if self.shown else "nothing"
        if self.problem is not None:
            return f"{self.problem}; showing level {levels} of {manifest.levels}"
        if manifest.complete:
            return f"{self._name}: {counted(manifest.levels, 'level')}"
        return f"{self._name} is not complete: showing level {levels} of {manifest.levels}; others will follow"

    def _read(self) -> None:
        stamps = {self._folder / MANIFEST: _stamp(self._folder / MANIFEST)}
        archive = RunArchive.open(self._folder, check=False)
        manifest = archive.manifest
        if self._placed is None or manifest.created != self._created:
            self._placed = rasterizer_for(manifest, self.options.device, self.options.rasterizer)
            self._created = manifest.created
            self._fields = {}
            if self._placed.device.type == "cuda":  # while the fields are read
                threading.Thread(target=load_rasterizer, args=(self._placed,), daemon=True).start()
        fields: dict[int, GaussianField] = {}
        self.problem = None
        for level in archive.available_levels:
            path = archive.field_path(level)
            stamp = stamps[path] = _stamp(path)
            try:
                if level not in self._fields or self._fields[level][0] != stamp:
                    self._fields[level] = stamp, archive.field(level).to(self._placed.device)
            except RunFolderError as error:
                self.problem = str(error)
                break
            fields[level] = self._fields[level][1]
        self.archive, self._stamps = archive, stamps
        self.shown = None
        if fields:
            renderer = HierarchyRenderer.of(manifest, fields, self._placed.rasterizer)
            self.shown = ShownRun.of(archive.name, renderer, self._rig)


class RunFollower:
    """Keep a viewer and the status on its page up to date with a run, and with a second one if there is one.

    `report` is called with each new line of status.
    """

    def __init__(
        self, viewer: Viewer, page: Page, run: FollowedRun, other: FollowedRun | None, report: Callable[[str], None]
    ) -> None:
        self._viewer, self._page, self._report = viewer, page, report
        self._runs = [run] if other is None else [run, other]
        self._cameras: SceneCameras | None = None
        self._created = ""  # time of the training whose cameras were read
        self._said: set[str] = set()
        self._placed_clients = False

    def begin(self) -> None:
        """Read the cameras and show the available levels.

        Raises:
            RunFolderError, SceneError: the given scene is not the run's.
        """
        self._read_cameras()
        self._show()

    def warm_up(self) -> None:
        """Render a small picture to load the renderer, unless a client already waits for one."""
        shown = self._runs[0].shown
        if shown is None or self._viewer.watched:
            return
        draw(shown, None, self._start(shown).camera(32, 32), PictureSettings(), distance=1.0, zoom=1.0)

    def save_preview(self) -> None:
        """Save a preview for the next viewer, if there is none and all levels are shown."""
        archive, shown = self._runs[0].archive, self._runs[0].shown  # `watch` may replace them in the meantime
        if shown is None or len(shown.counts) < len(archive.manifest.records):
            return
        if read_preview(archive.path()) is None:
            save_preview(archive, shown, self._start(shown))

    def watch(self, stop: threading.Event) -> None:
        """Show changes until `stop` is set."""
        while not stop.wait(POLL_SECONDS):
            changed, problems = False, []
            for run in self._runs:
                try:
                    changed |= run.refresh()
                except LapgsError as error:  # a run that is removed or restarted stays visible
                    problems.append(str(error))
            try:
                if changed:
                    self._show()
            except LapgsError as error:
                problems.append(str(error))
            if problems:
                self._set_status("; ".join(problems))

    def _read_cameras(self) -> None:
        """Read the cameras of the first run; arguments and errors as `begin`."""
        archive, scene = self._runs[0].archive, self._runs[0].options.scene
        self._created, self._cameras = archive.manifest.created, None
        try:
            self._cameras = SceneCameras.of(archive, scene)
        except (RunFolderError, SceneError) as error:
            if scene is not None:
                raise
            self._report(f"without the scene's cameras: {error}")
        for run in self._runs:
            run.set_cameras(None if self._cameras is None else self._cameras.rig)

    def _show(self) -> None:
        if self._runs[0].archive.manifest.created != self._created:  # trained again, maybe on another scene
            before = self._cameras
            self._read_cameras()
            self._placed_clients &= self._cameras is not None and self._cameras.begins_as(before)
        self._set_status("; ".join(run.status() for run in self._runs))
        shown, *others = [run.shown for run in self._runs]
        if shown is None:
            return
        if not self._placed_clients:
            self._placed_clients = True
            self._viewer.set_initial_view(self._start(shown))
        self._viewer.show(ViewerContent(shown, others[0] if others else None, self._cameras))

    def _start(self, shown: ShownRun) -> InitialView:
        if self._cameras is None:
            return InitialView.of_field(shown.renderer.fields[shown.renderer.levels - 1])
        return self._cameras.start

    def _set_status(self, line: str) -> None:
        self._page.status = line
        if line not in self._said:
            self._said.add(line)
            self._report(line)


def _stamp(path: Path) -> Stamp:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
