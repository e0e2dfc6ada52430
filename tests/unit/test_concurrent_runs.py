"""Runs of a checkout beside each other: the port of its viewer, and its PLY files."""

from __future__ import annotations

import errno
import io
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from lapgs_plugin.checkouts.attachment import Attachment
from lapgs_plugin.checkouts.concurrent_runs import beside_other_runs
from lapgs_plugin.errors import LapgsError

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
    replacements = beside_other_runs(profile)
    assert [each.owner for each in replacements] == [PlyData, module]
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


def points(count: int) -> PlyData:
    return PlyData([PlyElement.describe(np.zeros(count, [("x", "f4"), ("y", "f4")]), "vertex")])


def alone() -> Attachment:
    profile: Any = SimpleNamespace(named=lambda names: [])
    return Attachment(beside_other_runs(profile))


def test_a_file_is_there_when_it_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, seen, header = tmp_path / "points3D.ply", [], PlyData.header

    def looked_for(ply: PlyData) -> Any:  # asked for when the file is open
        seen.append(path.exists())
        return header.fget(ply)

    monkeypatch.setattr(PlyData, "header", property(looked_for))
    before = vars(PlyData)["write"]
    with alone():
        points(3).write(str(path))
        assert PlyData.read(path)["vertex"].count == 3
        points(5).write(path)
        points(7).write(stream := io.BytesIO())
    assert vars(PlyData)["write"] is before
    assert seen == [False, True, True], "written beside the file that is there, and then put in its place"
    assert PlyData.read(path)["vertex"].count == 5
    assert PlyData.read(io.BytesIO(stream.getvalue()))["vertex"].count == 7
    assert [each.name for each in tmp_path.iterdir()] == ["points3D.ply"]


def test_a_file_that_cannot_be_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "points3D.ply"
    points(3).write(path)

    def broken(*_: Any) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(PlyElement, "_write", broken)
    with alone(), pytest.raises(LapgsError, match="the PLY file cannot be written"):
        points(5).write(path)
    assert PlyData.read(path)["vertex"].count == 3
    assert [each.name for each in tmp_path.iterdir()] == ["points3D.ply"]
