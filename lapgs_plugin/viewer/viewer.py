"""Draw for all clients of a page."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import viser

from lapgs_plugin.viewer.page import Page
from lapgs_plugin.viewer.poses import InitialView
from lapgs_plugin.viewer.session import PictureBudget, Session, ViewerContent

logger = logging.getLogger(__name__)


class Viewer:
    """Draw for any number of clients, one picture after the other, in the calling thread.

    Args:
        page: the page; clients may be connected already.
        budget: limits of the pictures.
    """

    def __init__(self, page: Page, budget: PictureBudget | None = None) -> None:
        self._page, self._budget = page, budget or PictureBudget()
        self._sender = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lapgs-jpeg")
        self._content: ViewerContent | None = None
        self._start: InitialView | None = None
        self._sessions: dict[int, Session] = {}
        self._awake = threading.Condition()
        page.server.on_client_connect(self._connect)
        page.server.on_client_disconnect(self._disconnect)

    def set_initial_view(self, start: InitialView) -> None:
        """Set the view that new clients begin with, and move connected clients there."""
        server = self._page.server
        server.scene.set_up_direction(start.up)
        first = server.initial_camera
        first.position, first.look_at, first.up, first.fov = start.position, start.look_at, start.up, start.fov
        with self._awake:
            self._start = start
            sessions = list(self._sessions.values())
        for session in sessions:
            session.move_to(start)

    def show(self, content: ViewerContent) -> None:
        """Show this content from the next picture on."""
        with self._awake:
            self._content = content
            for session in self._sessions.values():
                session.show(content)
            self._awake.notify()

    def clear(self) -> None:
        """Drop the content; nothing is drawn until there is a new one."""
        with self._awake:
            self._content = None
            for session in self._sessions.values():
                session.clear()

    def serve(self, stop: threading.Event | None = None, at_rest: Callable[[], None] | None = None) -> None:
        """Draw for all clients until `stop` is set or the process is interrupted.

        Args:
            at_rest: called once, when pictures were drawn and none is needed.
        """
        drawn = False
        while stop is None or not stop.is_set():
            if self.draw_next(patience=0.25):
                drawn = True
            elif drawn and at_rest is not None:
                at_rest()
                at_rest = None

    def draw_next(self, patience: float) -> bool:
        """Draw for the client that has waited longest; False if none needed a picture within `patience` seconds."""
        session = self._next_session(patience)
        if session is not None:
            self._draw(session)
        return session is not None

    @property
    def watched(self) -> bool:
        """Whether a client is connected."""
        return bool(self._sessions)

    def _draw(self, session: Session) -> None:
        """Draw one client's picture; an error, such as too little memory, ends this client alone."""
        self._page.end_preview()
        try:
            session.draw()
        except Exception:
            logger.exception("a picture could not be drawn; that browser gets no more until its page is loaded again")
            with self._awake:
                self._sessions = {number: other for number, other in self._sessions.items() if other is not session}

    def _next_session(self, patience: float) -> Session | None:
        """Return the client that has waited longest; None if none needed a picture within `patience` seconds."""
        deadline = time.perf_counter() + patience
        with self._awake:
            while True:
                now = time.perf_counter()
                waiting = [(due, session) for session in self._sessions.values() if (due := session.due()) is not None]
                due, session = min(waiting, key=lambda pair: pair[0], default=(deadline, None))
                if due <= now and session is not None:
                    return session
                if now >= deadline:
                    return None
                self._awake.wait(min(due, deadline) - now)

    def _connect(self, client: viser.ClientHandle) -> None:
        session = Session(client, self._budget, self._sender, self._wake)
        with self._awake:
            self._sessions[client.client_id] = session
            if self._content is not None:
                session.show(self._content)
            start = self._start
        # viser calls this in another thread than `_disconnect`, which may be over if the client left at once.
        if client.client_id not in self._page.server.get_clients():
            self._disconnect(client)
            return
        if start is not None:
            session.move_to(start)
        self._wake()

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._awake:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.disconnect()

    def _wake(self) -> None:
        with self._awake:
            self._awake.notify()
