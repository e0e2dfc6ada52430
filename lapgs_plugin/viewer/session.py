"""One client: its camera, its panel, and the pictures it is sent."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.rendering.rig import Rig
from lapgs_plugin.viewer.controls import Controls
from lapgs_plugin.viewer.navigation import Pose
from lapgs_plugin.viewer.pacing import TARGET_SECONDS, Pacing
from lapgs_plugin.viewer.pictures import Picture, PictureSettings, ShownRun, as_bytes, draw
from lapgs_plugin.viewer.start import Start, turning_distance

MAX_SIDE = 2048
"""Longest side of a picture in pixels; the browser stretches it to larger windows."""

PATH_FILE = "path.json"

HANDLE_DEPTH, HANDLE_HEIGHT, HANDLE_RADIUS = 10.0, 0.5, 0.03
"""Of the ball on the divider: its depth in nearest visible depths, then shares of half the window's height."""

JPEG_MOVING, JPEG_STILL = 75, 92
REPORT_SECONDS = 0.3
"""The figures change no oftener than this while the picture moves."""


@dataclass(frozen=True)
class Exhibit:
    """What every client looks at.

    Attributes:
        run: the hierarchy.
        other: what it is compared with, None without.
        cameras: of the scene by view name; empty where they are not known.
        rig: of these cameras, None without.
    """

    run: ShownRun
    other: ShownRun | None
    cameras: Mapping[str, Camera]
    rig: Rig | None


@dataclass(frozen=True)
class Pace:
    """What a picture may take, in seconds, and what may go on beside it.

    Attributes:
        moving: while something moves.
        still: when nothing does.
        ahead: draw the next picture while the last one is made a JPEG of and sent.
    """

    moving: float = TARGET_SECONDS
    still: float = math.inf
    ahead: bool = True


class Session:
    """A connected client. Its callbacks come from viser's threads, its pictures are drawn by the viewer's.

    Args:
        client: viser's handle.
        pace: of its pictures.
        sender: makes JPEGs and sends them.
        wake: called when there may be something to draw.
    """

    def __init__(self, client: viser.ClientHandle, pace: Pace, sender: Executor, wake: Callable[[], None]) -> None:
        self._client = client
        self._pace, self._sender = pace, sender
        self._wake = wake
        self._pacing = Pacing(pace.moving, pace.still)
        self._sending: Future[None] | None = None
        self._lock = threading.Lock()
        self._exhibit: Exhibit | None = None
        self._cameras: Mapping[str, Camera] = {}
        self._rig: Rig | None = None
        self._coming: Exhibit | None = None  # what the next picture shows
        self._controls: Controls | None = None
        self._handle: viser.IcosphereHandle | None = None
        self._last_report = 0.0
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._kept: list[Camera] = []
        self._left = False
        client.camera.on_update(lambda _: self._change())
        self._change()

    def show(self, exhibit: Exhibit) -> None:
        """Look at this from the next picture on."""
        with self._lock:
            self._coming = exhibit
            self._pacing.renew(time.perf_counter())

    def forget(self) -> None:
        """Let go of what was shown; the picture stays."""
        with self._lock:
            self._exhibit = self._coming = None

    def stand_at(self, start: Start) -> None:
        """Begin there."""
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = start.up
            camera.fov = start.fov
            camera.position = start.position
            camera.look_at = start.look_at

    def due(self) -> float | None:
        """When its next picture is to be drawn, by time.perf_counter(); None for not before something changes."""
        with self._lock:
            return None if self._exhibit is self._coming is None else self._pacing.due()

    def leave(self) -> None:
        """The client has disconnected: nothing is sent any more, and what is being drawn is dropped."""
        self._left = True

    def draw(self) -> None:
        """Draw the next picture and send it."""
        begin = time.perf_counter()
        with self._lock:
            scale = self._pacing.begin()
            exhibit, self._coming = self._coming or self._exhibit, None
            self._exhibit = exhibit
        if exhibit is None:  # forgotten since somebody found it due
            return
        controls = self._adopt(exhibit)
        picture = self._draw(exhibit, controls.settings, scale)
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

    def _adopt(self, exhibit: Exhibit) -> Controls:
        """Make the panel that of the exhibit."""
        self._cameras, self._rig = exhibit.cameras, exhibit.rig
        if self._controls is None or not self._controls.fits(exhibit.run, exhibit.other):
            self._controls = Controls(
                self._client,
                exhibit.run,
                exhibit.other,
                list(exhibit.cameras),
                before=self._controls,
                changed=self._change,
                go_to=self._go_to,
                show_cameras=self._show_cameras,
                keep=self._keep,
                save=self._save,
            )
            if exhibit.other is not None and self._handle is None:
                self._handle = self._add_handle()
            self._place_handle()
        return self._controls

    def _pose(self) -> Pose:
        camera = self._client.camera
        return Pose(np.asarray(camera.wxyz), np.asarray(camera.position), float(camera.fov))

    def _draw(self, exhibit: Exhibit, settings: PictureSettings, scale: float) -> Picture:
        camera, pose = self._client.camera, self._pose()
        width, height = max(camera.image_width, 1), max(camera.image_height, 1)
        share = scale * min(1.0, MAX_SIDE / max(width, height))
        size = max(round(share * width), 1), max(round(share * height), 1)
        distance = float(np.linalg.norm(np.asarray(camera.look_at) - pose.position))
        return draw(exhibit.run, exhibit.other, pose.camera(*size), settings, distance=distance, zoom=1.0 / share)

    def _send(self, pixels: NDArray[np.uint8], quality: int) -> None:
        if self._sending is not None:
            self._sending.result()  # one picture ahead, no more: a later one shows where the camera is by then
        self._sending = self._sender.submit(self._encode_and_send, pixels, quality)
        if not self._pace.ahead:
            self._sending.result()

    def _encode_and_send(self, pixels: NDArray[np.uint8], quality: int) -> None:
        if self._left:
            return
        self._client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=quality)
        self._client.flush()  # or viser collects messages for up to 1/60 s

    def _change(self) -> None:
        with self._lock:
            self._pacing.change(time.perf_counter())
        self._place_handle()
        self._wake()

    def _add_handle(self) -> viser.IcosphereHandle:
        """A ball on the divider, to drag it by: a drag that begins on a thing of the scene does not turn the camera."""
        handle = self._client.scene.add_icosphere("/divider", color=(255, 255, 255), cast_shadow=False)

        @handle.on_drag("left")
        async def _(event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
            if self._controls is not None:
                self._controls.divider = float(event.end_screen_pos[0])

        return handle

    def _place_handle(self) -> None:
        """Keep the ball on the divider, at the same size, wherever the camera goes."""
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
        self._handle.position = pose.position + viser.transforms.SO3(pose.wxyz).as_matrix() @ in_camera
        self._handle.scale = HANDLE_RADIUS * half_height

    def _go_to(self, index: int) -> None:
        """Stand where a camera of the scene stands."""
        assert self._rig is not None, "there are cameras"
        pose = Pose.of(list(self._cameras.values())[index])
        camera = self._client.camera
        with self._client.atomic():
            camera.fov = pose.fov
            camera.position = pose.position
            camera.wxyz = pose.wxyz
            ahead = viser.transforms.SO3(pose.wxyz).as_matrix()[:, 2]
            camera.look_at = pose.position + turning_distance(pose.position, self._rig) * ahead

    def _keep(self) -> int:
        """Remember the view for a path."""
        camera = self._client.camera
        self._kept.append(self._pose().camera(camera.image_width, camera.image_height))
        return len(self._kept)

    def _save(self) -> None:
        """Hand out the views that were kept as a file for `lapgs render --trajectory`."""
        from lapgs_plugin.rendering.trajectory import trajectory_json, with_size  # brings scipy.interpolate

        if self._kept:
            size = self._kept[0].width, self._kept[0].height  # windows change
            text = json.dumps(trajectory_json([with_size(camera, size) for camera in self._kept]), indent=1)
            self._client.send_file_download(PATH_FILE, text.encode(), save_immediately=True)

    def _clicked(self, index: int, _: object) -> None:
        self._go_to(index)

    def _show_cameras(self, wanted: bool) -> None:
        if wanted and not self._frustums:
            self._frustums = self._add_frustums()
        for frustum in self._frustums:
            frustum.visible = wanted

    def _add_frustums(self) -> list[viser.CameraFrustumHandle]:
        assert self._rig is not None, "there are cameras"
        frustums = []
        for index, (name, camera) in enumerate(self._cameras.items()):
            pose = Pose.of(camera)
            frustum = self._client.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=pose.fov,
                aspect=camera.width / camera.height,
                scale=0.05 * self._rig.distance,
                thickness=0.001 * self._rig.distance,
                color=(240, 150, 40),
                wxyz=pose.wxyz,
                position=pose.position,
            )
            frustum.on_click(partial(self._clicked, index))
            frustums.append(frustum)
        return frustums
