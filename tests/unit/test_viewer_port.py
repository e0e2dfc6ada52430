"""The port of a checkout's viewer, which another run may have."""

from __future__ import annotations

import errno
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from lapgs_plugin.checkouts.attachment import Attachment
from lapgs_plugin.checkouts.viewer_port import sharing_ports

GUI = """
import socket

listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)

def init(wish_host, wish_port):
    listener.bind((wish_host, wish_port))
    listener.listen()
"""


@pytest.fixture
def gui(load_module: Callable[[str], ModuleType]) -> Iterator[ModuleType]:
    module = load_module(GUI)
    module.__name__ = "gaussian_renderer.network_gui"
    with closing(module.listener):
        yield module


def listening(module: ModuleType) -> Attachment:
    others = SimpleNamespace(__name__="scene", init=None), SimpleNamespace(__name__="utils.network_gui", init=None)
    profile: Any = SimpleNamespace(named=lambda names: [(each, *names) for each in (*others, module)])
    replacements = sharing_ports(profile)
    assert [each.owner for each in replacements] == [module]
    return Attachment(replacements)


def test_a_port_that_is_free_is_taken(gui: ModuleType, caplog: pytest.LogCaptureFixture) -> None:
    with closing(socket.socket()) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
    with listening(gui), caplog.at_level(logging.WARNING):
        gui.init("127.0.0.1", port)
    assert gui.listener.getsockname()[1] == port
    assert not caplog.messages


def test_a_port_that_is_taken_does_not_end_a_run(gui: ModuleType, caplog: pytest.LogCaptureFixture) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as other, listening(gui), caplog.at_level(logging.WARNING):
        taken = other.getsockname()[1]
        gui.init("127.0.0.1", taken)
        port = gui.listener.getsockname()[1]
        assert port not in (0, taken)
        with closing(socket.create_connection(("127.0.0.1", port), timeout=10)):
            pass
    told = f"port {taken} is taken, perhaps by another run; the checkout's viewer finds this run at {port}"
    assert caplog.messages == [told]


def test_other_errors_are_the_scripts(gui: ModuleType) -> None:
    with listening(gui), pytest.raises(OSError, match="address") as caught:
        gui.init("203.0.113.1", 0)  # of nobody's machine: RFC 5737
    assert caught.value.errno == errno.EADDRNOTAVAIL
