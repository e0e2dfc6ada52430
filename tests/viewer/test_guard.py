"""Test which requests a page accepts: those of its own browsers, not foreign ones or garbage."""

from __future__ import annotations

import http.client
import re
import socket
import struct
from collections.abc import Iterator
from contextlib import closing
from urllib.parse import urlsplit

import pytest

viser = pytest.importorskip("viser", reason="needs the extra 'viewer'")

from websockets.datastructures import Headers  # noqa: E402  # needs viser
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.http11 import Request  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from lapgs_plugin.viewer.guard import MAX_LOGGED, Guard, guarded_server  # noqa: E402
from lapgs_plugin.viewer.page import Page  # noqa: E402
from tests.viewer.wire import wire_client  # noqa: E402
from tests.waiting import wait_for  # noqa: E402

OWN_NAME = socket.gethostname().lower()


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with Page("127.0.0.1", 8760, "run") as page:
        yield page


@pytest.fixture(scope="module")
def open_page() -> Iterator[Page]:
    """Serve a page on all addresses."""
    with Page("0.0.0.0", 8770, "run") as page:
        yield page


def get(page: Page, path: str = "/", **headers: str) -> tuple[int, str]:
    """Return status and text of a plain request; Host is the page's own by default."""
    with closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)) as connection:
        connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
        for name, value in {"Host": f"localhost:{page.port}", **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        return response.status, response.read().decode()


def shake_hands(page: Page, host: str, origin: str | None) -> int:
    """Return the status of a web socket's handshake."""
    with socket.create_connection(("127.0.0.1", page.port)) as stream:
        try:
            protocol = f"viser-v{viser.__version__}"
            with connect(f"ws://{host}", sock=stream, origin=origin, subprotocols=[protocol]) as client:  # type: ignore[arg-type, list-item]
                assert len(client.recv(timeout=20)) > 0, "a page's first messages"
                return 101
        except InvalidStatus as refused:
            return refused.response.status_code


# A browser sends the Host of the address it opened, and for web sockets an Origin of the same name.
GOOD_HOSTS = ["localhost:PORT", "127.0.0.1:PORT", "[::1]:PORT", "LOCALHOST:PORT", "localhost:9123", "127.0.0.1:9123"]
FOREIGN_HOSTS = [
    "evil.example:PORT",
    "evil.example",
    "localhost.evil.example:PORT",
    "192.0.2.7:PORT",
    "[2001:db8::7]:80",
]
FOREIGN_ORIGINS = [
    *("http://evil.example", "https://evil.example:PORT", "null", "http://localhost", "http://localhost:9123"),
    *("http://localhost:PORT.evil.example", "http://127.0.0.1:PORT", "ftp://localhost:PORT", "file://"),
]


@pytest.mark.parametrize(("host", "known"), [*((h, True) for h in GOOD_HOSTS), *((h, False) for h in FOREIGN_HOSTS)])
def test_only_names_of_this_machine_or_of_a_tunnel_are_answered(page: Page, host: str, known: bool) -> None:
    """DNS rebinding gives foreign names this machine's address."""
    host, upgraded = host.replace("PORT", str(page.port)), 101 if known else 403
    status, text = get(page, Host=host)
    assert status == (200 if known else 403)
    assert ("<html" if known else host) in text
    assert get(page, Host=host, Origin=f"http://{host}")[0] == status
    assert shake_hands(page, host, f"http://{host}") == upgraded
    assert shake_hands(page, host, None) == upgraded  # a program


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
def test_a_foreign_page_is_refused(page: Page, origin: str) -> None:
    origin = origin.replace("PORT", str(page.port))
    assert get(page, Origin=origin)[0] == 403
    assert shake_hands(page, f"localhost:{page.port}", origin) == 403


def test_on_all_addresses_any_address_is_accepted_but_no_foreign_name(open_page: Page) -> None:
    for host in (f"192.0.2.7:{open_page.port}", f"[2001:db8::7]:{open_page.port}", f"{OWN_NAME}:{open_page.port}"):
        assert get(open_page, Host=host)[0] == 200, host
        assert shake_hands(open_page, host, f"http://{host}") == 101
        assert shake_hands(open_page, host, "http://evil.example") == 403
    assert get(open_page, Host=f"evil.example:{open_page.port}")[0] == 403


def test_the_given_host_is_accepted_with_its_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.7", 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: entries)
    monkeypatch.setattr(socket, "getfqdn", lambda: "gpu.lab.example")
    guard = Guard("Viewer.Example")

    def accepts(host: str) -> bool:
        return guard.refusal(Request("/", Headers({"Host": host}))) is None

    wait_for(lambda: accepts("gpu.lab.example"))
    assert all(map(accepts, ("viewer.example", "192.0.2.7", "localhost", "[::1]", OWN_NAME)))
    assert not any(map(accepts, ("example", "192.0.2.8", "evil.example")))


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/" + "a" * 7000, 414),
        ("/" + "a" * 300, 400),  # longer than a file system's names
        ("/%00", 404),
        ("/../../etc/passwd", 404),
        ("/%2e%2e/%2e%2e/etc/passwd", 404),
        ("/nothing", 404),
    ],
)
def test_invalid_paths_are_refused(page: Page, path: str, expected: int, caplog: pytest.LogCaptureFixture) -> None:
    assert get(page, path)[0] == expected
    assert not caplog.records


@pytest.mark.parametrize("host", ["", "localhost:PORT, evil", "a@localhost:PORT", "localhost:PORT/x", "[localhost]"])
def test_an_invalid_host_is_refused(page: Page, host: str) -> None:
    assert get(page, Host=host.replace("PORT", str(page.port)))[0] in (400, 403)


GARBAGE = [
    b"\x00\xff\xfe" * 1000,
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # the beginning of TLS
    b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/1.0\r\n\r\n",
    b"GET / HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nAccept-Encoding: a\r\nAccept-Encoding: b\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: local",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: x\r\n\r\n",
    b"GET " + b"/a" * 20000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: \xff\xfe\r\nOrigin: \xff\r\n\r\n",
    b"",
]


@pytest.mark.parametrize("reset", [False, True])
def test_garbage_leaves_the_page_up_and_no_traceback(
    page: Page, reset: bool, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    for garbage in GARBAGE:
        with socket.create_connection(("127.0.0.1", page.port), timeout=20) as stream:
            stream.sendall(garbage)
            if reset:
                stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                continue
            stream.shutdown(socket.SHUT_WR)
            answer = b""
            while part := stream.recv(65536):
                answer += part
        assert answer[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 403", b"HTTP/1.1 426"), garbage
    assert get(page)[0] == 200
    assert shake_hands(page, f"localhost:{page.port}", None) == 101
    assert not any(record.exc_info for record in caplog.records)
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err


def test_a_client_that_sends_no_messages_is_one_line(page: Page, caplog: pytest.LogCaptureFixture) -> None:
    for garbage in (b"\xff\xfe", "text", b""):
        with wire_client(page.address) as client:
            client.connection.send(garbage)
            wait_for(lambda: "a browser was disconnected" in caplog.text)
        assert [record.exc_info for record in caplog.records] == [None]
        assert "\n" not in caplog.records[0].getMessage()
        caplog.clear()
    assert get(page)[0] == 200


def test_refusals_are_logged_once_each_and_limited(caplog: pytest.LogCaptureFixture) -> None:
    with Page("127.0.0.1", 8790, "run") as page:
        for name in ("\x9bevil", "evil", "evil", *(f"evil{number}" for number in range(20))):
            assert get(page, Origin=f"http://{name}.example")[0] == 403
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == len(set(lines)) == MAX_LOGGED
    assert lines[1].startswith("the viewer refused a browser: a page of 'http://evil.example' may not")
    assert re.fullmatch(r"[\x20-\x7e]*", "".join(lines))


def test_a_server_that_was_not_guarded_is_an_error() -> None:
    with pytest.raises(Exception, match="cannot be guarded"), guarded_server(Guard("127.0.0.1")):
        pass


def test_other_pages_cannot_embed_ours(page: Page) -> None:
    with closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)) as connection:
        connection.request("GET", "/")
        assert connection.getresponse().headers["Content-Security-Policy"] == "frame-ancestors 'self'"


def test_an_ipv6_address_can_be_opened() -> None:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            pass
    except OSError:
        pytest.skip("no IPv6 here")
    with Page("::1", 8780, "run") as page:
        assert urlsplit(page.address).hostname == "::1"
        with closing(http.client.HTTPConnection("::1", page.port, timeout=20)) as connection:
            connection.request("GET", "/")
            assert connection.getresponse().status == 200
