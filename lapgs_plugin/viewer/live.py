"""Show a run while it is trained.

The training thread draws the pictures between two iterations. So nothing is copied, and density control does not
interfere. The next picture waits until the pictures' share of the time is below the limit. An error here ends the view,
never the training.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from lapgs_plugin.errors import LapgsError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.rasterizers.choice import PlacedRasterizer, rasterizer_for
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.viewer.page import Page
from lapgs_plugin.viewer.pictures import ShownRun
from lapgs_plugin.viewer.poses import InitialView, SceneCameras
from lapgs_plugin.viewer.session import PictureBudget, ViewerContent
from lapgs_plugin.viewer.viewer import Viewer

logger = logging.getLogger(__name__)

DEFAULT_PERCENT = 1.5
"""Share of the training time for pictures, in percent, until the user changes it."""
MAX_PERCENT = 50.0
"""Largest such share."""

LIVE_BUDGET = PictureBudget(moving=0.02, still=0.06, ahead=False)
"""Time of a picture while the camera moves, and while it rests."""

MAX_CREDIT = 0.25
"""Most seconds of picture time saved up while no picture is needed; the first of a stage builds a new panel."""

PAUSE_POLL_SECONDS = 0.1


class LiveView(Watcher):
    """Show a run to all clients of a page. Close the page after the run.

    Attributes:
        viewer: draws for the clients.
        percent, pause: controls of the page.
        failed: whether an error has ended the view.

    Args:
        page: the page.
        device: of rendering, see `rasterizer_for`.
    """

    def __init__(self, page: Page, device: str = "auto") -> None:
        self._page, self._device = page, device
        self.viewer = Viewer(page, LIVE_BUDGET)
        self.failed = False
        self._archive: RunArchive | None = None
        self._placed: PlacedRasterizer | None = None
        self._cameras: SceneCameras | None = None
        self._begun = False  # whether clients have an initial view
        self._finished: dict[int, GaussianField] = {}
        self._credit, self._counted = 0.0, time.perf_counter()  # seconds for pictures, and the time of that balance
        gui = page.server.gui
        with gui.add_folder("Training"):
            self.percent = gui.add_slider(
                "percent of training time",
                min=0.0,
                max=MAX_PERCENT,
                step=0.5,
                initial_value=DEFAULT_PERCENT,
                hint="share of the training time for pictures",
            )
            self.pause = gui.add_checkbox("pause training", initial_value=False)

    def run_started(self, archive: RunArchive) -> None:
        with self._log_errors():
            self._archive, self._counted = archive, time.perf_counter()
            self._placed = rasterizer_for(archive.manifest, self._device)
            self._finished = {level: archive.field(level) for level in archive.available_levels}
            try:
                self._cameras = SceneCameras.of(archive)
            except LapgsError as error:
                logger.info("shown without the scene's cameras: %s", error)
            else:
                self.viewer.set_initial_view(self._cameras.start)
                self._begun = True

    def stage_started(self, stage: Stage) -> None:
        with self._log_errors():
            self._page.status = f"level {stage.level} begins"

    def wants_look(self) -> bool:
        if self.failed:
            return False
        share, now = self.percent.value / 100.0, time.perf_counter()
        self._credit = min(self._credit + share * (now - self._counted), MAX_CREDIT)
        self._counted = now
        if not self.viewer.watched:
            self.viewer.clear()  # frees the memory of its fields
            return False
        return self.pause.value or (share > 0.0 and self._credit > 0.0)

    def look(
        self,
        stage: Stage,
        iteration: int,
        fields: Callable[[], Mapping[int, GaussianField]],
        interrupted: Callable[[], bool],
    ) -> None:
        """Draw a picture, see `Watcher`; during a pause return when training continues or no client is connected."""
        begin = time.perf_counter()
        with self._log_errors():
            self._show(stage, iteration, fields())
            self.viewer.draw_next(patience=0.0)
            self._credit -= time.perf_counter() - begin
            while self.pause.value and self.viewer.watched and not interrupted():
                self.viewer.draw_next(PAUSE_POLL_SECONDS)
        self._counted = time.perf_counter()

    def stage_finished(self, stage: Stage, fields: Callable[[], Mapping[int, GaussianField]]) -> None:
        with self._log_errors():
            # Keep finished fields off the GPU while no client is connected.
            self._finished = {level: field.to("cpu") for level, field in {**self._finished, **fields()}.items()}
            self.viewer.clear()
            self._page.status = f"level {stage.level} is finished"

    def _show(self, stage: Stage, iteration: int, fields: Mapping[int, GaussianField]) -> None:
        assert self._archive is not None
        assert self._placed is not None, "a run starts before its stages"
        manifest, device = self._archive.manifest, self._placed.device
        self._finished = {level: field.to(device) for level, field in self._finished.items() if level not in fields}
        shown = {**self._finished, **{level: field.to(device) for level, field in fields.items()}}
        renderer = HierarchyRenderer.of(manifest, shown, self._placed.rasterizer)
        if not self._begun:
            self.viewer.set_initial_view(InitialView.of_field(shown[manifest.levels - 1]))
            self._begun = True
        rig = None if self._cameras is None else self._cameras.rig
        run = ShownRun.of(self._archive.name, renderer, rig)
        self.viewer.show(ViewerContent(run, None, self._cameras))
        self._page.status = (
            f"training level {stage.level} of {manifest.levels}: iteration {iteration:,} of {stage.iterations:,}, "
            f"{len(shown[stage.level]):,} Gaussians"
        )

    @contextmanager
    def _log_errors(self) -> Iterator[None]:
        """Log an error of the block and end the view."""
        try:
            yield
        except Exception as error:
            if not self.failed:
                logger.warning("the view has ended, training continues: %s", error, exc_info=True)
            self.failed = True
