"""Refuse clients that a foreign web page sent: the page shows a run and can pause its training.

A browser lets any page open a web socket to any address, and says in Origin which page it was. A page whose name is
made to lead to this machine (DNS rebinding) has an Origin that fits, but its name stands in Host. So Host has to be a
name of this machine, and Origin, where there is one, the same as Host. Neither stops a program: whoever reaches the
port without a browser may claim anything.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from lapgs_plugin.errors import LapgsError

logger = logging.getLogger(__name__)

LONGEST_PATH = 2048
"""Characters of a path; the page's own files have less than a hundred."""

MOST_LINES = 10
"""Refusals that are logged: a page that tries again and again shall not fill a log."""

_AUTHORITY = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[^\s:/?#@\[\]]+)(:\d{1,5})?", re.IGNORECASE | re.ASCII)

ProcessRequest = Callable[[ServerConnection, Request], Response | None]


class Guard:
    """Which names a browser may know this machine by.

    - Always localhost and the loopback addresses, with any port: a tunnel has another one than the viewer.
    - If others are let in: `host`, the addresses that it stands for, and the names of this machine.
    - On all addresses: any address besides. One that a browser shows has not been looked up, so it cannot be a page's
      name, and behind a router or in a container the machine does not know its own.

    Args:
        host: address or name that the viewer listens on.
    """

    def __init__(self, host: str) -> None:
        self._logged: set[str] = set()
        addresses = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None)}
        self._names = {"localhost", host.lower(), *addresses}
        self._any_address = any(ipaddress.ip_address(each).is_unspecified for each in addresses)
        if all(ipaddress.ip_address(each).is_loopback for each in addresses):
            return
        own = socket.gethostname().lower()
        self._names |= {own, own.partition(".")[0], own.partition(".")[0] + ".local"}
        # A name server may take seconds to tell.
        threading.Thread(target=lambda: self._names.add(socket.getfqdn().lower()), daemon=True).start()

    def refusal(self, request: Request) -> tuple[HTTPStatus, str] | None:
        """Status and reason for a request that is not answered; None for others."""
        if len(request.path) > LONGEST_PATH:
            return HTTPStatus.REQUEST_URI_TOO_LONG, f"the path has {len(request.path)} characters"
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or len(origins) > 1 or (authority := _AUTHORITY.fullmatch(hosts[0])) is None:
            return HTTPStatus.BAD_REQUEST, "expected one Host, such as localhost:8080, and at most one Origin"
        if not self._knows(authority["name"].lower()):
            return HTTPStatus.FORBIDDEN, (
                f"{hosts[0]!a} is no name of this machine that the viewer knows; open http://localhost:PORT, "
                "or start it with --host NAME, or with --host 0.0.0.0 and open the machine's address"
            )
        if origins and origins[0].lower() not in {f"{scheme}://{hosts[0].lower()}" for scheme in ("http", "https")}:
            return HTTPStatus.FORBIDDEN, f"a page of {origins[0]!a} may not look into the viewer at {hosts[0]!a}"
        return None

    def log(self, reason: str) -> None:
        """Write a line about a refusal, unless it was written before or there have been many."""
        if reason not in self._logged and len(self._logged) < MOST_LINES:
            self._logged.add(reason)
            logger.warning("the viewer refused a browser: %s", reason)

    def _knows(self, name: str) -> bool:
        address = _address(name.strip("[]"))
        if address is None:
            return name in self._names
        return address.is_loopback or self._any_address or str(address) in self._names


@contextmanager
def guarded_server(guard: Guard) -> Iterator[None]:
    """Guard the server of web sockets that viser starts inside the block.

    viser offers no hook for it, so the function by which it starts its server is replaced while it does: `serve` of
    websockets, whose own hooks do the work.

    Raises:
        LapgsError: no server was started this way. It is not guarded then and has to be closed.
    """
    module: Any = websockets.asyncio.server
    original = module.serve
    calls = 0

    def serve(*args: Any, process_request: ProcessRequest | None = None, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        asyncio.get_running_loop().set_exception_handler(_log_exception)
        return original(*args, process_request=_guarded(guard, process_request), logger=_clients_logger(), **options)

    module.serve = serve
    try:
        yield
    finally:
        module.serve = original
    if not calls:
        raise LapgsError("this version of viser starts its server in a way that cannot be guarded; install viser 1.1")


def _guarded(guard: Guard, answer: ProcessRequest | None) -> ProcessRequest:
    def process_request(connection: ServerConnection, request: Request) -> Response | None:
        refusal = guard.refusal(request)
        if refusal is not None:
            status, reason = refusal
            if status == HTTPStatus.FORBIDDEN:
                guard.log(reason)
            return connection.respond(status, f"{reason}\n")
        try:
            response = None if answer is None else answer(connection, request)
        except (OSError, ValueError, LookupError):  # a name that no file can have, a header twice
            return connection.respond(HTTPStatus.BAD_REQUEST, "there can be no such file\n")
        if response is not None:
            # Pages that show ours inside of them could make somebody press its buttons.
            response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"
        return response

    return process_request


def _clients_logger() -> logging.Logger:
    """A logger for websockets, which would write a traceback for each client that sends garbage or goes away."""
    clients = logging.getLogger(f"{__name__}.clients")
    clients.setLevel(logging.WARNING)
    clients.addFilter(_one_line)
    return clients


def _one_line(record: logging.LogRecord) -> bool:
    if record.getMessage() == "opening handshake failed":
        return False
    if record.exc_info and record.exc_info[1] is not None:
        record.msg, record.args = "a browser was disconnected: %s", (_summary(record.exc_info[1]),)
        record.exc_info = None
    return True


def _log_exception(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """What a message of a client led to outside of its connection, in one line."""
    error = context.get("exception")
    logger.warning("a browser's message failed: %s", context["message"] if error is None else _summary(error))
    logger.debug("the same with its traceback", exc_info=error)


def _summary(error: BaseException) -> str:
    return f"{type(error).__name__}: {ascii(str(error))[1:-1][:200]}"


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None
