"""The peak of a GPU's memory, from a stand-in of the driver's statistics."""

from __future__ import annotations

import pytest
import torch

from lapgs_plugin.runs.profiling import PeakMemory


class Statistics:
    """Stand in for `torch.cuda`'s statistics."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.used = self.highest = 0
        monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: self.highest)
        monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", self._reset)

    def _reset(self, device: torch.device) -> None:
        self.highest = self.used

    def use(self, *amounts: int) -> None:
        for self.used in amounts:
            self.highest = max(self.highest, self.used)


@pytest.mark.parametrize(
    ("first", "then", "expected"),
    [
        ((500, 300), (400, 200), {"peak": 500, "images": 60}),
        ((500, 300), (700, 200), {"peak": 700, "images": 40}),
        ((500,), (400,), {"peak": 500, "images": 40}),  # still as much when the images had gone
    ],
)
def test_images_are_those_of_the_highest_peak(
    first: tuple[int, ...], then: tuple[int, ...], expected: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    statistics = Statistics(monkeypatch)
    statistics.use(900, 100)  # of the stage before
    peak = PeakMemory(torch.device("cuda"))
    statistics.use(*first)
    peak.note(images=60)
    statistics.use(*then)
    assert peak.note(images=40) == expected


def test_a_cpu_has_none() -> None:
    assert PeakMemory(torch.device("cpu")).note(images=60) == {}
