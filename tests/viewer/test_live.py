"""Test the live view: pictures arrive, the result keeps its bits, and no error of the view ends training."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.training.settings import Densification, TrainSettings
from tests import training_runs
from tests.training_scene import ring_scene

pytest.importorskip("viser", reason="needs the extra 'viewer'")

from lapgs_plugin.viewer import live
from lapgs_plugin.viewer.live import LiveView
from lapgs_plugin.viewer.page import Page
from lapgs_plugin.viewer.viewer import Viewer
from tests.viewer.wire import WireClient, wire_client
from tests.waiting import wait_for as wait_so_long

PATIENCE = 60.0
wait_for = partial(wait_so_long, seconds=PATIENCE)


@pytest.fixture
def page() -> Iterator[Page]:
    with Page("127.0.0.1", 8850, "run") as page:
        yield page


def train(folder: Path, watcher: Watcher, iterations: int, hierarchy: str = "laplacian") -> RunArchive:
    calm = Densification(start=20, every=20)
    settings = TrainSettings(iterations=iterations, hierarchy=hierarchy, sh_degree=1, densification=calm)
    return training_runs.train(folder, ring_scene(), settings, watcher=watcher)


class Watched(LiveView):
    """Trains only to the second iteration of a stage before `go` is set."""

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self.go = threading.Event()
        self.looks = 0

    def wants_look(self) -> bool:
        self.go.wait(PATIENCE)
        return super().wants_look()

    def look(self, *args: object) -> None:  # type: ignore[override]  # counts
        self.looks += 1
        super().look(*args)  # type: ignore[arg-type]


def watched_run(
    folder: Path,
    page: Page,
    watcher: Watched,
    client_does: Callable[[WireClient], None],
    iterations: int = 150,
    **options: str,
) -> RunArchive:
    """Train in a thread while a client is connected."""
    result: list[RunArchive] = []
    thread = threading.Thread(target=lambda: result.append(train(folder, watcher, iterations, **options)))
    thread.start()
    try:
        with wire_client(page.address) as client:
            wait_for(lambda: watcher.viewer.watched)
            watcher.go.set()
            client_does(client)
    finally:
        watcher.go.set()
        thread.join(PATIENCE)
    assert len(result) == 1, "training did not come to its end"
    return result[0]


def same_bits(one: RunArchive, other: RunArchive) -> bool:
    return all(
        torch.equal(a, b)
        for level in (1, 0)
        for a, b in zip(one.field(level).parameters.values(), other.field(level).parameters.values(), strict=True)
    )


@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_pictures_of_every_stage_come_and_the_result_has_the_same_bits(
    page: Page, tmp_path: Path, hierarchy: str
) -> None:
    watcher = Watched(page)
    watcher.percent.value = 50.0

    def look(client: WireClient) -> None:
        wait_for(lambda: client.listen(0.05) > 0 and any("training level 0 of 2" in text for text in client.words))

    archive = watched_run(tmp_path / "watched", page, watcher, look, hierarchy=hierarchy)
    assert watcher.looks > 3
    assert all(record.overhead_seconds["view"] > 0 for record in archive.manifest.records)
    assert same_bits(archive, train(tmp_path / "alone", Watcher(), 150, hierarchy))


def test_a_browser_that_is_closed_and_one_that_comes_back(page: Page, tmp_path: Path) -> None:
    watcher = Watched(page)
    watcher.percent.value = 50.0

    def look(client: WireClient) -> None:
        assert client.listen(PATIENCE, pictures=1) == 1
        client.connection.close()
        wait_for(lambda: not watcher.viewer.watched)
        with wire_client(page.address) as again:
            assert again.listen(PATIENCE, pictures=1) == 1

    watched_run(tmp_path / "run", page, watcher, look, iterations=300)


def test_a_browser_that_leaves_before_it_was_noticed_watches_no_more(page: Page) -> None:
    """viser calls back in threads: that of the connection may come after that of its end."""
    viewer, noticed, ended = Viewer(page), threading.Event(), threading.Event()

    def late(client: Any) -> None:
        ended.wait(PATIENCE)
        viewer._connect(client)
        noticed.set()

    def at_once(client: Any) -> None:
        viewer._disconnect(client)
        ended.set()

    page.server._client_connect_cb[:], page.server._client_disconnect_cb[:] = [late], [at_once]
    with wire_client(page.address):
        wait_for(lambda: bool(page.server.get_clients()))
    assert noticed.wait(PATIENCE)
    assert not viewer.watched
    with wire_client(page.address):
        wait_for(lambda: viewer.watched)


def test_a_pause_holds_training_until_it_is_ended_or_nobody_watches(page: Page, tmp_path: Path) -> None:
    watcher = Watched(page)
    watcher.pause.value = True

    def look(client: WireClient) -> None:
        assert client.listen(PATIENCE, pictures=1) == 1
        status = page.status
        assert "iteration 1 of" in status
        client.look_from(0.5, 0.0, -4.0)  # pictures arrive while training is paused
        assert client.listen(PATIENCE, pictures=1) == 1
        assert page.status == status
        watcher.pause.value = False
        wait_for(lambda: client.listen(0.05) >= 0 and "iteration 1 of" not in page.status)
        watcher.pause.value = True

    watched_run(tmp_path / "run", page, watcher, look)  # it ends although it is paused: the client has left


def test_training_can_be_stopped_while_paused(page: Page) -> None:
    watcher = LiveView(page)
    watcher.pause.value = True
    asked: list[bool] = []
    with wire_client(page.address):
        wait_for(lambda: watcher.viewer.watched)
        stage = ring_stage()
        watcher._show = lambda *_: None  # type: ignore[method-assign]
        watcher.look(stage, 1, dict, lambda: asked.append(True) or len(asked) > 2)  # type: ignore[func-returns-value]
    assert len(asked) == 3


def ring_stage() -> Stage:
    return Stage(level=0, image_size=(56, 40), iterations=10, signed=False)


@pytest.mark.parametrize("broken", ["draw_next", "show", "set_initial_view"])
def test_a_viewer_that_fails_ends_watching_not_training(
    page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, broken: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no more memory for pictures")

    monkeypatch.setattr(Viewer, broken, fail)
    watcher = Watched(page)
    archive = watched_run(tmp_path / "run", page, watcher, lambda client: wait_for(lambda: watcher.failed), 30)
    assert archive.manifest.complete
    assert watcher.looks <= 1
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["the view has ended, training continues: no more memory for pictures"]


@pytest.mark.parametrize("percent", [2.0, 10.0, 50.0])
def test_pictures_take_no_more_than_their_share(page: Page, monkeypatch: pytest.MonkeyPatch, percent: float) -> None:
    """Simulate a clock: iterations of 3 ms, pictures of 1 to 40 ms."""
    clock = Clock()
    monkeypatch.setattr(live.time, "perf_counter", clock)
    watcher = LiveView(page)
    watcher.percent.value = percent
    durations = itertools.cycle([0.001, 0.04, 0.013])
    monkeypatch.setattr(watcher, "_show", lambda *_: clock.sleep(next(durations)))
    monkeypatch.setattr(watcher.viewer, "draw_next", lambda patience: True)
    monkeypatch.setattr(Viewer, "watched", True)
    looking = training = 0.0
    for iteration in range(20_000):
        clock.sleep(0.003)
        training += 0.003
        if watcher.wants_look():
            before = clock()
            watcher.look(ring_stage(), iteration, dict, lambda: False)
            looking += clock() - before
    share = percent / 100.0
    last = 0.04  # the last picture's time is not compensated yet
    assert looking <= share * (training + looking) + last
    assert looking >= 0.9 * share * training


def test_a_share_of_zero_draws_nothing(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    watcher = LiveView(page)
    monkeypatch.setattr(Viewer, "watched", True)
    assert watcher.wants_look()
    watcher.percent.value = 0.0
    assert not watcher.wants_look()


class Clock:
    def __init__(self) -> None:
        self._now = 100.0

    def __call__(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += seconds
