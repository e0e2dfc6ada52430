"""Watching a run while it is trained.

Pictures are drawn by the thread that trains, between two iterations, so nothing is copied, nothing races with density
control, and what watching costs is known exactly: pictures wait until so much time has passed that they are the share
of it that was allowed. Whatever fails here ends the watching, never the training.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from lapgs_plugin.errors import LapgsError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.rasterizers.choice import PlacedRasterizer, rasterizer_for
from lapgs_plugin.rendering.compose import HierarchyRenderer
from lapgs_plugin.rendering.rig import Rig
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.viewer.page import Page
from lapgs_plugin.viewer.pictures import ShownRun
from lapgs_plugin.viewer.server import Viewer
from lapgs_plugin.viewer.session import Exhibit, Pace
from lapgs_plugin.viewer.start import start_at, start_outside

logger = logging.getLogger(__name__)

DEFAULT_PERCENT, MOST_PERCENT = 1.5, 50.0
"""Of the time of training that pictures may take."""

LIVE_PACE = Pace(moving=0.02, still=0.06, ahead=False)
"""What a picture takes: at 1.5 % that is one every 1.3 s while somebody moves, and every 4 s otherwise."""

MOST_SAVED = 0.25
"""Seconds of pictures that can be saved up while nobody wants any: the first of a stage brings a new panel."""

PAUSE_PATIENCE = 0.1


class LiveView(Watcher):
    """Shows a run to whoever loads a page. Close the page when the run has ended.

    Args:
        page: that browsers load.
        device: where pictures are rendered, as `rasterizer_for` takes it.
    """

    def __init__(self, page: Page, device: str = "auto") -> None:
        self._page, self._device = page, device
        self._viewer = Viewer(page, LIVE_PACE)
        self._failed = False
        self._archive: RunArchive | None = None
        self._placed: PlacedRasterizer | None = None
        self._cameras: dict[str, Camera] = {}
        self._rig: Rig | None = None
        self._begun = False  # clients know where to begin
        self._finished: dict[int, GaussianField] = {}
        self._credit, self._counted = 0.0, time.perf_counter()  # seconds to spend, and as of when
        gui = page.server.gui
        with gui.add_folder("Training"):
            self._percent = gui.add_slider(
                "percent of its time",
                min=0.0,
                max=MOST_PERCENT,
                step=0.5,
                initial_value=DEFAULT_PERCENT,
                hint="how much of the time of training may go into pictures",
            )
            self._pause = gui.add_checkbox("pause training", initial_value=False)

    def run_started(self, archive: RunArchive) -> None:
        with self._harmless():
            self._archive, self._counted = archive, time.perf_counter()
            self._placed = rasterizer_for(archive.manifest, self._device)
            self._finished = {level: archive.field(level) for level in archive.available_levels}
            try:
                train, test = run_cameras(archive)
            except LapgsError as error:
                logger.info("watching without the scene's cameras: %s", error)
            else:
                self._cameras, self._rig = {**test, **train}, Rig.of(list(train.values()))
                self._viewer.begin_at(start_at(next(iter(self._cameras.values())), self._rig))
                self._begun = True

    def stage_started(self, stage: Stage) -> None:
        with self._harmless():
            self._page.status = f"level {stage.level} begins"

    def wants_look(self) -> bool:
        if self._failed:
            return False
        share, now = self._percent.value / 100.0, time.perf_counter()
        self._credit = min(self._credit + share * (now - self._counted), MOST_SAVED)
        self._counted = now
        if not self._viewer.watched:
            self._viewer.forget()  # it holds the memory of a field
            return False
        return self._pause.value or (share > 0.0 and self._credit > 0.0)

    def look(
        self,
        stage: Stage,
        iteration: int,
        fields: Callable[[], Mapping[int, GaussianField]],
        interrupted: Callable[[], bool],
    ) -> None:
        """As in `Watcher`. While training is paused it returns when it is let go on, or nobody watches any more."""
        begin = time.perf_counter()
        with self._harmless():
            self._show(stage, iteration, fields())
            self._viewer.draw_next(patience=0.0)
            self._credit -= time.perf_counter() - begin
            while self._pause.value and self._viewer.watched and not interrupted():
                self._viewer.draw_next(PAUSE_PATIENCE)
        self._counted = time.perf_counter()

    def stage_finished(self, stage: Stage, fields: Callable[[], Mapping[int, GaussianField]]) -> None:
        with self._harmless():
            # They leave a GPU while nobody looks.
            self._finished = {level: field.to("cpu") for level, field in {**self._finished, **fields()}.items()}
            self._viewer.forget()
            self._page.status = f"level {stage.level} is finished"

    def _show(self, stage: Stage, iteration: int, fields: Mapping[int, GaussianField]) -> None:
        assert self._archive is not None
        assert self._placed is not None, "a run starts before its stages"
        manifest, device = self._archive.manifest, self._placed.device
        self._finished = {level: field.to(device) for level, field in self._finished.items() if level not in fields}
        shown = {**self._finished, **{level: field.to(device) for level, field in fields.items()}}
        renderer = HierarchyRenderer.of(manifest, shown, self._placed.rasterizer)
        if not self._begun:
            self._viewer.begin_at(start_outside(shown[manifest.levels - 1]))
            self._begun = True
        self._viewer.show(
            Exhibit(ShownRun.of(self._archive.path().name, renderer, self._rig), None, self._cameras, self._rig)
        )
        self._page.status = (
            f"training level {stage.level} of {manifest.levels}: iteration {iteration:,} of {stage.iterations:,}, "
            f"{len(shown[stage.level]):,} Gaussians"
        )

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """Let nothing that fails inside reach who trains."""
        try:
            yield
        except Exception as error:
            if not self._failed:
                logger.warning("nobody can watch any more, training goes on: %s", error, exc_info=True)
            self._failed = True
