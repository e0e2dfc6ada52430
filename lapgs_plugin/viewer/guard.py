"""Refuse clients that come from foreign web pages, because the page shows a run and can pause its training.

Browsers let any page open a web socket to any address, and send the page's address as Origin. A page whose name
resolves to this machine (DNS rebinding) has a matching Origin, but its name is the Host. So Host must be a name of this
machine, and Origin, if present, must be equal to Host. This does not stop programs other than browsers, which can send
any headers.
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

MAX_PATH = 2048
"""Most characters of a path; the page's own paths have less than a hundred."""

MAX_LOGGED = 10
"""Most refusals in the log, so that a page that keeps trying does not fill it."""

_AUTHORITY = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[^\s:/?#@\[\]]+)(:\d{1,5})?", re.IGNORECASE | re.ASCII)

ProcessRequest = Callable[[ServerConnection, Request], Response | None]


class Guard:
    """Decide by which names a browser may address this machine.

    - Always by localhost and the loopback addresses, with any port, because a tunnel has its own port.
    - If other machines may connect, also by `host`, its addresses, and the names of this machine.
    - If `host` stands for all addresses, also by any address. A numeric address cannot be a page's name, and a machine
      behind a router or in a container does not know its own address.

    Args:
        host: address or name that the viewer listens on.
    """

    def __init__(self, host: str) -> None:
        self._logged: set[str] = set()
        addresses = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None)}
        self._names = {"localhost", host.lower(), *addresses}
        self._any_address = any(ipaddress.ip_address(address).is_unspecified for address in addresses)
        if all(ipaddress.ip_address(address).is_loopback for address in addresses):
            return
        own = socket.gethostname().lower()
        self._names |= {own, own.partition(".")[0], own.partition(".")[0] + ".local"}
        # A name server may take seconds to answer.
        threading.Thread(target=lambda: self._names.add(socket.getfqdn().lower()), daemon=True).start()

    def refusal(self, request: Request) -> tuple[HTTPStatus, str] | None:
        """Return status and reason for refusing a request; None to accept it."""
        if len(request.path) > MAX_PATH:
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
        """Log a refusal, unless it was logged before or there were many."""
        if reason not in self._logged and len(self._logged) < MAX_LOGGED:
            self._logged.add(reason)
            logger.warning("the viewer refused a browser: %s", reason)

    def _knows(self, name: str) -> bool:
        address = _address(name.strip("[]"))
        if address is None:
            return name in self._names
        return address.is_loopback or self._any_address or str(address) in self._names


@contextmanager
def guarded_server(guard: Guard) -> Iterator[None]:
    """Guard the web socket server that viser starts inside the block.

    viser has no hook for this. So `serve` of websockets, by which viser starts its server, is replaced in the block.

    Raises:
        LapgsError: no server was started this way, so it is not guarded and must be closed.
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
        """Refuse a browser's request as the guard says, or answer it as viser does."""
        refusal = guard.refusal(request)
        if refusal is not None:
            status, reason = refusal
            if status == HTTPStatus.FORBIDDEN:
                guard.log(reason)
            return connection.respond(status, f"{reason}\n")
        try:
            response = None if answer is None else answer(connection, request)
        except (OSError, ValueError, LookupError):  # an invalid file name, or a repeated header
            return connection.respond(HTTPStatus.BAD_REQUEST, "there can be no such file\n")
        if response is not None:
            # Other pages must not embed ours to get its buttons pressed.
            response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"
        return response

    return process_request


def _clients_logger() -> logging.Logger:
    """Return a logger for websockets without tracebacks for clients that send garbage or disconnect."""
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
    """Log an error outside of a connection's own code in one line."""
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
