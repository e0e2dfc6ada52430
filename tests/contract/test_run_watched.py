"""Test watchers of a run: the fields that they see, when, and that the run does not change."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import torch

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.watcher import Watcher
from tests.contract.stub_runs import HALF, STUBS, STUBS_AND_KINDS, run_hierarchy

EVERY = 4
SHORT = (*HALF, "--densify_until_iter", 40)


class Diary(Watcher):
    """Look after every fourth iteration and note the fields."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.counts: list[int] = []
        self.last: dict[int, GaussianField] = {}
        self._asked = 0

    def run_started(self, archive: RunArchive) -> None:
        self.lines.append(f"run {archive.manifest.levels}")

    def stage_started(self, stage: Stage) -> None:
        self.lines.append(f"stage {stage.level}")
        self._asked = 0

    def wants_look(self) -> bool:
        self._asked += 1
        return self._asked % EVERY == 0

    def look(
        self,
        stage: Stage,
        iteration: int,
        fields: Callable[[], Mapping[int, GaussianField]],
        interrupted: Callable[[], bool],
    ) -> None:
        seen = fields()
        assert not any(tensor.requires_grad for field in seen.values() for tensor in field.parameters.values())
        assert seen[stage.level].signed == stage.signed
        assert not interrupted()
        self.lines.append(f"iteration {iteration} of level {stage.level}: {sorted(seen)}")
        self.counts.append(len(seen[stage.level]))
        self.last = dict(seen)

    def stage_finished(self, stage: Stage, fields: Callable[[], Mapping[int, GaussianField]]) -> None:
        self.lines.append(f"finished {stage.level}: {sorted(fields())}")
        self.last = dict(fields())


@pytest.mark.parametrize(("name", "hierarchy"), STUBS_AND_KINDS)
def test_a_watcher_sees_every_stage_and_changes_nothing(
    name: str, hierarchy: str, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    diary = Diary()
    with caplog.at_level(logging.WARNING):
        watched, _ = run_hierarchy(STUBS[name], scene, tmp_path / "watched", *SHORT, watcher=diary, hierarchy=hierarchy)
        said = len(caplog.records)
        alone, _ = run_hierarchy(STUBS[name], scene, tmp_path / "alone", *SHORT, hierarchy=hierarchy)
    assert len(caplog.records) == 2 * said  # looking warns of nothing that archiving does not
    first, coarse, lines = diary.lines.index("stage 1"), diary.lines.index("stage 0"), diary.lines
    assert lines[0] == "run 2"
    assert lines[first + 1] == f"iteration {EVERY - 1} of level 1: [1]"
    assert lines[coarse - 1] == "finished 1: [1]"
    assert lines[coarse + 1] == f"iteration {EVERY - 1} of level 0: [0]"
    # The base of a residual was trained jointly at the end.
    assert lines[-1] == f"finished 0: {[0] if hierarchy == 'nested' else [0, 1]}"
    assert max(diary.counts) > min(diary.counts)
    for level in (1, 0):
        for a, b in zip(watched.field(level).parameters.values(), alone.field(level).parameters.values(), strict=True):
            assert torch.equal(a, b)
        assert watched.manifest.record(level).overhead_seconds["view"] > 0
    for level, field in diary.last.items():
        assert torch.equal(field.means, watched.field(level).means)


def test_the_viewer_shows_a_checkout_on_the_cpu(scene: Path, tmp_path: Path) -> None:
    """The real watcher works inside `cuda_on_cpu` with a client that looks at every stage."""
    pytest.importorskip("viser", reason="needs the extra 'viewer'")
    from lapgs_plugin.viewer.live import LiveView
    from lapgs_plugin.viewer.page import Page
    from tests.viewer.wire import wire_client

    with Page("127.0.0.1", 8950, "run") as page:
        watcher = LiveView(page, "cpu")
        watcher.percent.value = 50.0
        words, pictures = list[str](), list[int]()

        def look() -> None:
            with wire_client(page.address) as client:
                connected.set()
                while not done.is_set():
                    client.listen(0.1)
                words.extend(client.words)
                pictures.append(len(client.pictures))

        connected, done = threading.Event(), threading.Event()
        thread = threading.Thread(target=look)
        thread.start()
        connected.wait(30)
        run_hierarchy(STUBS["fastgs"], scene, tmp_path / "run", watcher=watcher)
        done.set()
        thread.join(30)
    assert pictures[0] >= 2
    assert any("training level 0 of 2: iteration" in text for text in words)
    assert not watcher.failed
