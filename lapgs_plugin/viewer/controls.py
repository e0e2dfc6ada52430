"""Build the panel of one client, which shows and changes its settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import viser

from lapgs_plugin.viewer.pictures import Picture, PictureSettings, ShownRun

MAX_GAIN, GAIN_STEP = 3.0, 0.05
COMPOSITION = "composition"
BY_SIZE = "by distance and window"

SHEET_WIDTH = 576
"""Width in pixels below which viser shows its panel as a sheet over the picture."""
FLAT = 2.1
"""Width over height of a phone in landscape."""
MARGIN = 15
"""CSS pixels between the controls of a narrow window and its border."""


class Controls:
    """Build and read the panel of one client.

    Args:
        client: the client.
        run: the run that is shown.
        other: the run on the right of the split view, or None.
        views: names of the scene's cameras.
        before: the panel to replace, because the levels or the cameras changed; its choices are kept.
        changed: called when a new picture is needed.
        go_to: called with the index of a camera to move to.
        show_cameras: called with whether to show the cameras' frustums.
        keep: called to store the current view; returns the number of stored views.
        save: called to download the stored views.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        run: ShownRun,
        other: ShownRun | None,
        views: Sequence[str],
        *,
        before: Controls | None,
        changed: Callable[[], None],
        go_to: Callable[[int], None],
        show_cameras: Callable[[bool], None],
        keep: Callable[[], int],
        save: Callable[[], None],
    ) -> None:
        self._gui = client.gui
        self._run = run
        self._changed = changed
        self._parts: list[Any] = []
        self._frustums: Any = None
        self._view: Any = None
        if before is not None:
            before.close()
        with self._room(client.camera):
            with self._folder("Bands"):
                self._bands = {level: self._add_band(level) for level in run.counts}
            with self._folder("Picture"):
                self._show = self._add_choice("Show", [COMPOSITION, *map(self._band_name, run.counts)])
                self._level = self._add_choice("Detail", [*(f"level {level}" for level in sorted(run.counts)), BY_SIZE])
                self._split, self._divider = self._add_split(other)
            if views:
                with self._folder("Cameras"):
                    self._add_cameras(views, before, go_to, show_cameras)
            with self._folder("Path"):
                self._kept = self._add_path(keep, save)
            with self._folder("Figures"):
                self._figures = self._gui.add_markdown("")
        if before is not None:
            self._copy_choices(before)

    def close(self) -> None:
        """Remove the panel from the page."""
        for part in reversed(self._parts):
            part.remove()

    def fits(self, run: ShownRun, other: ShownRun | None) -> bool:
        """Return whether the panel fits these runs. If so, it shows them from now on."""
        if run.counts.keys() != self._run.counts.keys() or (other is None) != (self._split is None):
            return False
        self._run = run
        return True

    @property
    def settings(self) -> PictureSettings:
        """The current choices."""
        gains = {level: gain.value if drawn.value else 0.0 for level, (drawn, gain) in self._bands.items()}
        shown = {self._band_name(level): level for level in self._run.counts}
        level = None if self._level.value == BY_SIZE else int(self._level.value.removeprefix("level "))
        divider = self.divider if self._split is not None and self._split.value else None
        return PictureSettings(gains, shown.get(self._show.value), level, divider)

    @property
    def shows_cameras(self) -> bool:
        """Whether the cameras' frustums are chosen."""
        return self._frustums is not None and bool(self._frustums.value)

    @property
    def divider(self) -> float:
        """Position of the divider as a share of the picture's width, also while it is hidden."""
        return 0.5 if self._divider is None else float(self._divider.value)

    @divider.setter
    def divider(self, share: float) -> None:
        assert self._divider is not None, "there is a second run"
        self._divider.value = min(max(share, 0.0), 1.0)

    def report(self, picture: Picture, seconds: float) -> None:
        """Show the times of a picture, and the seconds from its request until it was sent."""
        height, width = picture.image.shape[1:]
        rows = ["| band | Gaussians | ms |", "|:--|--:|--:|"]
        for level, count in self._run.counts.items():
            lap = picture.milliseconds.get(level)
            rows.append(f"| {self._band_name(level)} | {count:,} | {'-' if lap is None else f'{lap:.1f}'} |")
        line = (
            f"{width} x {height} in {1e3 * seconds:.0f} ms, level {picture.level}, {self._run.renderer.rasterizer.name}"
        )
        self._figures.content = "\n".join([*rows, "", line])

    def _room(self, camera: viser.CameraHandle) -> AbstractContextManager[Any]:
        """Return the container of the controls: the main panel, or in a narrow window a minimized one."""
        width, height = camera.image_width, camera.image_height  # device pixels, up to three a CSS pixel on phones
        if max(height, SHEET_WIDTH) <= width <= FLAT * height:
            return nullcontext()
        panel = self._gui.add_panel()
        panel.float(x=-MARGIN, y=-MARGIN)  # lower right: viser's own messages come at the upper left
        panel.minimize()
        self._gui.main_panel.minimize()
        self._parts.append(panel)
        tab: AbstractContextManager[Any] = panel.add_tab("Controls")
        return tab

    def _folder(self, name: str) -> Any:
        """Add a titled group of controls, which goes with the panel."""
        folder = self._gui.add_folder(name)
        self._parts.append(folder)
        return folder

    def _copy_choices(self, before: Controls) -> None:
        """Take over the choices of another panel, as far as this one has them."""
        for level, handles in self._bands.items():
            if level in before._bands:
                for handle, old in zip(handles, before._bands[level], strict=True):
                    handle.value = old.value
        was_finest = before._level.value == before._level.options[0]
        for choice, old in ((self._show, before._show), (self._level, before._level)):
            if old.value in choice.options and not (choice is self._level and was_finest):
                choice.value = old.value
        self._kept.content = before._kept.content
        if self._split is not None and before._split is not None:
            self._split.value, self.divider = before._split.value, before.divider

    def _add_band(self, level: int) -> tuple[Any, Any]:
        drawn = self._gui.add_checkbox(self._band_name(level), initial_value=True)
        gain = self._gui.add_slider(
            f"gain {level}", min=0.0, max=MAX_GAIN, step=GAIN_STEP, initial_value=1.0, marks=(0.0, 1.0, 2.0, 3.0)
        )
        return self._watched(drawn), self._watched(gain)

    def _add_choice(self, label: str, choices: Sequence[str]) -> Any:
        return self._watched(self._gui.add_dropdown(label, tuple(choices), initial_value=choices[0]))

    def _add_split(self, other: ShownRun | None) -> tuple[Any, Any]:
        if other is None:
            return None, None
        split = self._gui.add_checkbox("split", initial_value=True, hint=f"{self._run.name} | {other.name}")
        divider = self._gui.add_slider("divider", min=0.0, max=1.0, step=0.005, initial_value=0.5)
        return self._watched(split), self._watched(divider)

    def _watched(self, handle: Any) -> Any:
        handle.on_update(lambda _: self._changed())
        return handle

    def _add_cameras(
        self,
        views: Sequence[str],
        before: Controls | None,
        go_to: Callable[[int], None],
        show_cameras: Callable[[bool], None],
    ) -> None:
        # The choices of the panel before are initial values: setting the view would move the camera.
        shown = before is not None and before.shows_cameras
        self._frustums = frustums = self._gui.add_checkbox("frustums", initial_value=shown)
        frustums.on_update(lambda _: show_cameras(frustums.value))
        last = None if before is None or before._view is None else before._view.value
        first = last if last in views else views[0]
        chosen: Any = self._gui.add_dropdown("view", tuple(views), initial_value=first)
        self._view = chosen
        step = self._gui.add_button_group("go", ("previous", "here", "next"))

        def go_on(_: object) -> None:
            offset = {"previous": -1, "here": 0, "next": 1}[step.value]
            index = (views.index(chosen.value) + offset) % len(views)
            if offset == 0:
                go_to(index)
            else:
                chosen.value = views[index]  # calls `on_update`, which moves the camera

        step.on_click(go_on)
        chosen.on_update(lambda _: go_to(views.index(chosen.value)))

    def _add_path(self, keep: Callable[[], int], save: Callable[[], None]) -> Any:
        count = self._gui.add_markdown("Keep views to render a clip through them.")
        buttons = self._gui.add_button_group("views", ("keep", "save"))

        def keep_or_save(_: object) -> None:
            if buttons.value == "keep":
                count.content = f"{keep()} views kept"
            else:
                save()

        buttons.on_click(keep_or_save)
        return count

    def _band_name(self, level: int) -> str:
        if self._run.renderer.levels == 1:
            return "level 0"
        base = level == self._run.renderer.levels - 1
        return f"level {level}, {'base' if base else 'field' if self._run.renderer.nested else 'residual'}"
