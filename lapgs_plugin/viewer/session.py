"""Handle one client: its camera, its panel, and its pictures."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.images import as_bytes
from lapgs_plugin.viewer.controls import Controls
from lapgs_plugin.viewer.pacing import TARGET_SECONDS, Pacing
from lapgs_plugin.viewer.pictures import Picture, PictureSettings, ShownRun, draw
from lapgs_plugin.viewer.poses import InitialView, Pose, SceneCameras, orbit_distance

MAX_SIDE = 2048
"""Longest side of a picture in pixels; browsers stretch it to larger windows."""

PATH_FILE = "path.json"

HANDLE_DEPTH = 10.0
"""Depth of the ball on the divider in units of the near plane."""
HANDLE_HEIGHT = 0.5
"""Height of the ball over the middle in units of half the window's height."""
HANDLE_RADIUS = 0.03
"""Radius of the ball in units of half the window's height."""

JPEG_MOVING, JPEG_STILL = 75, 92
REPORT_SECONDS = 0.3
"""Least seconds between two updates of the figures during motion."""


@dataclass(frozen=True)
class ViewerContent:
    """The content of all clients' pages: a run, a second one to compare it with, and the scene's cameras if known."""

    run: ShownRun
    other: ShownRun | None
    cameras: SceneCameras | None


@dataclass(frozen=True)
class PictureBudget:
    """Limits of the time of pictures, in seconds.

    Attributes:
        moving: seconds of a picture during motion.
        still: seconds of a picture at rest.
        ahead: draw the next picture while the last one is encoded and sent.
    """

    moving: float = TARGET_SECONDS
    still: float = math.inf
    ahead: bool = True


class Session:
    """Handle a connected client. viser's threads call its callbacks, the viewer's thread draws its pictures.

    Args:
        client: viser's handle.
        budget: limits of its pictures.
        sender: encodes and sends pictures.
        wake: called when a picture may be needed.
    """

    def __init__(
        self, client: viser.ClientHandle, budget: PictureBudget, sender: Executor, wake: Callable[[], None]
    ) -> None:
        self._client = client
        self._budget, self._sender = budget, sender
        self._wake = wake
        self._pacing = Pacing(budget.moving, budget.still)
        self._sending: Future[None] | None = None
        self._lock = threading.Lock()
        self._content: ViewerContent | None = None
        self._cameras: SceneCameras | None = None
        self._coming: ViewerContent | None = None  # content of the next picture
        self._controls: Controls | None = None
        self._handle: viser.IcosphereHandle | None = None
        self._last_report = 0.0
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._kept: list[Camera] = []
        self._left = False
        client.camera.on_update(lambda _: self._change())
        self._change()

    def show(self, content: ViewerContent) -> None:
        """Show this content from the next picture on."""
        with self._lock:
            self._coming = content
            self._pacing.renew(time.perf_counter())

    def clear(self) -> None:
        """Drop the content; the last picture stays."""
        with self._lock:
            self._content = self._coming = None

    def move_to(self, start: InitialView) -> None:
        """Move the client's camera to a view."""
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = start.up
            camera.fov = start.fov
            camera.position = start.position
            camera.look_at = start.look_at

    def due(self) -> float | None:
        """Return the time of the next picture, by time.perf_counter(); None when none is needed."""
        with self._lock:
            return None if self._content is self._coming is None else self._pacing.due()

    def disconnect(self) -> None:
        """Stop sending, because the client has disconnected; a picture being drawn is dropped."""
        self._left = True

    def draw(self) -> None:
        """Draw the next picture and send it."""
        begin = time.perf_counter()
        with self._lock:
            scale = self._pacing.begin()
            content, self._coming = self._coming or self._content, None
            self._content = content
        if content is None:  # cleared since the picture became due
            return
        controls = self._update_panel(content)
        picture = self._draw(content, controls.settings, scale)
        if self._left:
            return
        self._send(as_bytes(picture.image), JPEG_STILL if scale >= 1.0 else JPEG_MOVING)
        seconds = time.perf_counter() - begin
        with self._lock:
            self._pacing.end(scale, seconds)
        now = time.perf_counter()
        if scale >= 1.0 or now - self._last_report > REPORT_SECONDS:
            self._last_report = now
            controls.report(picture, seconds)

    def _update_panel(self, content: ViewerContent) -> Controls:
        """Update the panel to the content."""
        same_cameras = content.cameras is self._cameras
        self._cameras = content.cameras
        if not same_cameras:
            for frustum in self._frustums:
                frustum.remove()
            self._frustums = []
        if self._controls is None or not (same_cameras and self._controls.fits(content.run, content.other)):
            self._controls = Controls(
                self._client,
                content.run,
                content.other,
                [] if content.cameras is None else list(content.cameras.by_view),
                before=self._controls,
                changed=self._change,
                go_to=self._go_to,
                show_cameras=self._show_cameras,
                keep=self._keep,
                save=self._save,
            )
            if content.other is not None and self._handle is None:
                self._handle = self._add_handle()
            self._place_handle()
            self._show_cameras(self._controls.shows_cameras)
        return self._controls

    def _pose(self) -> Pose:
        camera = self._client.camera
        return Pose(np.asarray(camera.wxyz), np.asarray(camera.position), float(camera.fov))

    def _draw(self, content: ViewerContent, settings: PictureSettings, scale: float) -> Picture:
        camera, pose = self._client.camera, self._pose()
        width, height = max(camera.image_width, 1), max(camera.image_height, 1)
        share = scale * min(1.0, MAX_SIDE / max(width, height))
        size = max(round(share * width), 1), max(round(share * height), 1)
        distance = float(np.linalg.norm(np.asarray(camera.look_at) - pose.position))
        return draw(content.run, content.other, pose.camera(*size), settings, distance=distance, zoom=1.0 / share)

    def _send(self, pixels: NDArray[np.uint8], quality: int) -> None:
        if self._sending is not None:
            self._sending.result()  # at most one picture ahead: a later one shows a newer camera
        self._sending = self._sender.submit(self._encode_and_send, pixels, quality)
        if not self._budget.ahead:
            self._sending.result()

    def _encode_and_send(self, pixels: NDArray[np.uint8], quality: int) -> None:
        if self._left:
            return
        self._client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=quality)
        self._client.flush()  # otherwise viser collects messages for up to 1/60 s

    def _change(self) -> None:
        with self._lock:
            self._pacing.change(time.perf_counter())
        self._place_handle()
        self._wake()

    def _add_handle(self) -> viser.IcosphereHandle:
        """Add a ball to drag the divider by; dragging an object of the scene does not turn the camera."""
        handle = self._client.scene.add_icosphere("/divider", color=(255, 255, 255), cast_shadow=False)

        @handle.on_drag("left")
        async def _(event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
            if self._controls is not None:
                self._controls.divider = float(event.end_screen_pos[0])

        return handle

    def _place_handle(self) -> None:
        """Keep the ball on the divider, at constant size, for every camera."""
        if self._handle is None or self._controls is None:
            return
        split = self._controls.settings.divider
        self._handle.visible = split is not None
        if split is None:
            return
        camera, pose = self._client.camera, self._pose()
        depth = HANDLE_DEPTH * camera.near
        half_height = depth * math.tan(0.5 * pose.fov)
        half_width = half_height * camera.image_width / max(camera.image_height, 1)
        in_camera = np.array([(2.0 * split - 1.0) * half_width, HANDLE_HEIGHT * half_height, depth])
        self._handle.position = pose.position + pose.rotation @ in_camera
        self._handle.scale = HANDLE_RADIUS * half_height

    def _go_to(self, index: int) -> None:
        """Move to a camera of the scene."""
        assert self._cameras is not None
        pose = Pose.of(list(self._cameras.by_view.values())[index])
        camera = self._client.camera
        with self._client.atomic():
            camera.fov = pose.fov
            camera.position = pose.position
            camera.wxyz = pose.wxyz
            camera.look_at = pose.position + orbit_distance(pose.position, self._cameras.rig) * pose.rotation[:, 2]

    def _keep(self) -> int:
        """Store the current view for a path."""
        camera = self._client.camera
        self._kept.append(self._pose().camera(camera.image_width, camera.image_height))
        return len(self._kept)

    def _save(self) -> None:
        """Download the stored views as a file for `lapgs render --trajectory`."""
        from lapgs_plugin.rendering.trajectory import trajectory_json, with_size  # imports scipy.interpolate

        if self._kept:
            size = self._kept[0].width, self._kept[0].height  # the window's size may have changed
            text = json.dumps(trajectory_json([with_size(camera, size) for camera in self._kept]), indent=1)
            self._client.send_file_download(PATH_FILE, text.encode(), save_immediately=True)

    def _show_cameras(self, wanted: bool) -> None:
        if wanted and not self._frustums:
            self._frustums = self._add_frustums()
        for frustum in self._frustums:
            frustum.visible = wanted

    def _add_frustums(self) -> list[viser.CameraFrustumHandle]:
        assert self._cameras is not None
        frustums = []
        for index, (name, camera) in enumerate(self._cameras.by_view.items()):
            pose = Pose.of(camera)
            frustum = self._client.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=pose.fov,
                aspect=camera.width / camera.height,
                scale=0.05 * self._cameras.rig.distance,
                thickness=0.001 * self._cameras.rig.distance,
                color=(240, 150, 40),
                wxyz=pose.wxyz,
                position=pose.position,
            )

            @frustum.on_click
            def _(_: object, index: int = index) -> None:
                self._go_to(index)

            frustums.append(frustum)
        return frustums
