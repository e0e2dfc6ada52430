"""The viewer: its port, its clients, and the one thread that draws for all of them."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
import threading
import time

import viser

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.rendering.rig import Vector
from lapgs_plugin.viewer.navigation import Start
from lapgs_plugin.viewer.session import Exhibit, Session

PORTS_TRIED = 100

logger = logging.getLogger(__name__)


def free_port(host: str, port: int) -> int:
    """The first free port from `port` on.

    Raises:
        UserInputError: this machine has no such address, or all of a hundred ports are taken.
    """
    for candidate in range(port, min(port + PORTS_TRIED, 65536)):
        try:
            with socket.create_server((host, candidate)):
                return candidate
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                reason = error.strerror or error
                raise UserInputError(
                    f"--host {host}: cannot listen there ({reason}); expected an address of this machine, such as "
                    "127.0.0.1, or 0.0.0.0 for all of them"
                ) from error
    raise UserInputError(f"--port {port}: it and the next {PORTS_TRIED - 1} are taken; choose another")


class Viewer:
    """Serves a run to any number of browsers.

    Args:
        exhibit: what they look at.
        start: where they begin.
        host: address to listen on.
        port: where to listen; free.
    """

    def __init__(self, exhibit: Exhibit, start: Start, host: str, port: int) -> None:
        self._exhibit = exhibit
        self._sessions: dict[int, Session] = {}
        self._awake = threading.Condition()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table of its addresses; we say one line
            self._server = viser.ViserServer(host=host, port=port, label=exhibit.run.name, verbose=False)
        self.port = int(self._server.get_port())
        # The button would offer the run to the internet by way of somebody else's server.
        self._server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
        self._server.scene.set_up_direction(start.up)
        first = self._server.initial_camera
        first.position, first.look_at, first.up = _triple(start.position), _triple(start.look_at), _triple(start.up)
        first.fov = start.fov
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def serve(self, stop: threading.Event | None = None) -> None:
        """Draw for whoever is connected, until `stop` is set or the process is interrupted."""
        while stop is None or not stop.is_set():
            session = self._next_session()
            if session is not None:
                self._draw(session)

    def close(self) -> None:
        """Disconnect everybody and free the port."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _draw(self, session: Session) -> None:
        """One client's picture; what goes wrong with it, such as too little memory, ends that client alone."""
        try:
            session.draw()
        except Exception:
            logger.exception("a picture could not be drawn; that browser gets no more until its page is loaded again")
            with self._awake:
                self._sessions = {each: other for each, other in self._sessions.items() if other is not session}

    def _next_session(self, patience: float = 0.25) -> Session | None:
        """Who has waited longest for a picture; None when nobody wanted one for `patience` seconds."""
        deadline = time.perf_counter() + patience
        with self._awake:
            while (now := time.perf_counter()) < deadline:
                waiting = [(due, session) for session in self._sessions.values() if (due := session.due()) is not None]
                due, session = min(waiting, key=lambda pair: pair[0], default=(deadline, None))
                if due <= now and session is not None:
                    return session
                self._awake.wait(min(due, deadline) - now)
        return None

    def _connect(self, client: viser.ClientHandle) -> None:
        session = Session(client, self._exhibit, self._wake)
        with self._awake:
            self._sessions[client.client_id] = session
            self._awake.notify()

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._awake:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.leave()

    def _wake(self) -> None:
        with self._awake:
            self._awake.notify()


def _triple(vector: Vector) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
