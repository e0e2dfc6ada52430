"""Serve the page that browsers load, with a preview until the first picture.

Does not import torch, so that browsers can load the page while the process still imports the renderer.
"""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from PIL import Image

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.viewer.guard import Guard, guarded_server
from lapgs_plugin.viewer.preview import QUALITY, crop_to_aspect

PORTS_TRIED = 100
EDGE_COLOR = (255, 170, 0)
"""RGB of the edges of `--crop`."""


def free_port(host: str, port: int) -> int:
    """Find the first free port from `port` on.

    Raises:
        UserInputError: this machine does not have that address, or a hundred ports are taken.
    """
    for candidate in range(port, min(port + PORTS_TRIED, 65536)):
        try:
            with socket.create_server((host, candidate), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
                return candidate
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                reason = error.strerror or error
                raise UserInputError(
                    f"--host {host}: cannot listen there ({reason}); expected an address of this machine, such as "
                    "127.0.0.1, or 0.0.0.0 for all of them"
                ) from error
    raise UserInputError(f"the port {port} and the next {PORTS_TRIED - 1} are taken; choose another")


class Page:
    """Serve a web page until it is closed; also a context manager.

    Attributes:
        server: viser's server.
        port: the port that it is served on.
        status: a line above each client's panel, in Markdown.

    Args:
        host: address to listen on.
        port: port to listen on, or the next free one.
        label: title of the panel.
        preview: image for every client until `end_preview`; None for an empty page.

    Raises:
        UserInputError: see `free_port`.
        LapgsError: see `guarded_server`.
    """

    def __init__(self, host: str, port: int, label: str, preview: Image.Image | None = None) -> None:
        free = free_port(host, port)
        with (
            guarded_server(Guard(host)),
            contextlib.redirect_stdout(io.StringIO()),  # viser prints a table of addresses; we print one line
        ):
            self.server = viser.ViserServer(host=host, port=free, label=label, verbose=False)
        self.port = int(self.server.get_port())
        self._host = "localhost" if host in ("0.0.0.0", "127.0.0.1", "::") else f"[{host}]" if ":" in host else host
        # The button would share the run on the internet through another server.
        self.server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
        self._status: Any = self.server.gui.add_markdown(
            "Starting." if preview is None else "Preview of the run; loading."
        )
        self._preview, self._preview_lock = preview, threading.Lock()
        self.server.on_client_connect(self._send_preview)
        if self.port != port:
            print(f"port {port} is taken, using {self.port}")

    @property
    def address(self) -> str:
        """URL for a browser on this machine, or at the other end of a tunnel."""
        return f"http://{self._host}:{self.port}"

    @property
    def status(self) -> str:
        return str(self._status.content)

    @status.setter
    def status(self, text: str) -> None:
        if text != self._status.content:
            self._status.content = text

    def show_edges(self, edges: Sequence[Sequence[Sequence[float]]]) -> None:
        """Show line segments, two points (3,) in world units each, over the pictures."""
        if edges:
            self.server.scene.add_line_segments(
                "/crop", np.array(edges, np.float32), EDGE_COLOR, thickness=2.0, thickness_units="screen"
            )

    def end_preview(self) -> None:
        """Stop sending the preview, because pictures are rendered from now on."""
        with self._preview_lock:
            self._preview = None

    def _send_preview(self, client: viser.ClientHandle) -> None:
        with self._preview_lock:
            if self._preview is None:
                return
            # The browser stretches it to its window, and the client's first picture replaces it.
            image = crop_to_aspect(self._preview, client.camera.image_width / max(client.camera.image_height, 1))
            client.scene.set_background_image(np.asarray(image), format="jpeg", jpeg_quality=QUALITY)
            client.flush()

    def close(self) -> None:
        """Disconnect all clients and free the port."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
