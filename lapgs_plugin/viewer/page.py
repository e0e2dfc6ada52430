"""The page that browsers load: its port, and what stands on it before anything is drawn.

Nothing here needs torch, so a browser can load the page while the process still imports what draws.
"""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import threading
from types import TracebackType
from typing import Any

import numpy as np
import viser
from PIL import Image

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.interrupt import signals_held
from lapgs_plugin.viewer.guard import Guard, guarded_server
from lapgs_plugin.viewer.preview import QUALITY, fitted

PORTS_TRIED = 100


def free_port(host: str, port: int) -> int:
    """The first free port from `port` on.

    Raises:
        UserInputError: this machine has no such address, or all of a hundred ports are taken.
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
    """A page that is served from the moment it is made; close it, or use it as a context manager.

    Attributes:
        server: viser's, for what stands on the page.
        port: where it is served.
        status: a line above each client's panel, Markdown.

    Args:
        host: address to listen on.
        port: where to listen; the next free one where it is taken.
        label: title of the panel.
        preview: what every client sees until `end_preview`; None leaves the page empty.

    Raises:
        UserInputError: as `free_port`.
        LapgsError: as `guarded_server`.
    """

    def __init__(self, host: str, port: int, label: str, preview: Image.Image | None = None) -> None:
        found = free_port(host, port)
        with (
            signals_held(),  # they are for the main thread alone
            guarded_server(Guard(host)),
            contextlib.redirect_stdout(io.StringIO()),  # viser prints a table of its addresses; we say one line
        ):
            self.server = viser.ViserServer(host=host, port=found, label=label, verbose=False)
        self.port = int(self.server.get_port())
        self._host = "localhost" if host in ("0.0.0.0", "127.0.0.1", "::") else f"[{host}]" if ":" in host else host
        # The button would offer the run to the internet by way of somebody else's server.
        self.server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
        self._status: Any = self.server.gui.add_markdown(
            "Starting." if preview is None else "As it was when it was trained; loading."
        )
        self._preview, self._preview_lock = preview, threading.Lock()
        self.server.on_client_connect(self._send_preview)
        if self.port != port:
            print(f"port {port} is taken, using {self.port}")

    @property
    def address(self) -> str:
        """For a browser on this machine, or at the other end of a tunnel."""
        return f"http://{self._host}:{self.port}"

    @property
    def status(self) -> str:
        return str(self._status.content)

    @status.setter
    def status(self, text: str) -> None:
        if text != self._status.content:
            self._status.content = text

    def end_preview(self) -> None:
        """Rendered pictures come from now on: the preview is sent to nobody any more, nor after one of them."""
        with self._preview_lock:
            self._preview = None

    def _send_preview(self, client: viser.ClientHandle) -> None:
        with self._preview_lock:
            if self._preview is None:
                return
            # The browser stretches it to its window. As the client's own picture it is replaced by the next one.
            image = fitted(self._preview, client.camera.image_width / max(client.camera.image_height, 1))
            client.scene.set_background_image(np.asarray(image), format="jpeg", jpeg_quality=QUALITY)
            client.flush()

    def close(self) -> None:
        """Disconnect everybody and free the port."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
