"""Test work that threads do ahead: results in order, few at a time, and errors of the first item."""

from __future__ import annotations

import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from lapgs_plugin.runs.image_store import ImageStore
from lapgs_plugin.scenes import parallel
from lapgs_plugin.scenes.parallel import ahead, readers_of


class Picture:
    """Stands for a large result; weak references count those that are kept."""

    def __init__(self, number: int) -> None:
        self.number = number


@pytest.fixture(autouse=True)
def _processors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_processors", lambda: 4)


@pytest.mark.parametrize("most", [1, 3, 100])
def test_results_come_in_order(most: int) -> None:
    assert [one.number for one in ahead(Picture, range(50), most=most)] == list(range(50))
    assert list(ahead(Picture, [], most=most)) == []


@pytest.mark.parametrize("most", [1, 3])
def test_few_results_are_kept(most: int) -> None:
    made: list[weakref.ref[Picture]] = []
    lock = threading.Lock()

    def make(number: int) -> Picture:
        picture = Picture(number)
        with lock:
            made.append(weakref.ref(picture))
        return picture

    most_kept = 0
    for picture in ahead(make, range(40), most=most):
        with lock:
            most_kept = max(most_kept, sum(reference() is not None for reference in made))
        assert picture.number < 40
    assert most_kept <= most + 1, "with the one that was yielded"


def test_several_items_are_worked_on_at_once() -> None:
    """Both wait for each other, so that neither would return alone."""
    meeting = threading.Barrier(2, timeout=20)
    assert list(ahead(lambda _: meeting.wait() >= 0, range(4), most=2)) == [True] * 4


def torch_threads(_: object = None) -> int:
    """Return how many threads PyTorch's next operation may use, after one that may use several."""
    torch.ones(200_000).exp_()
    return torch.get_num_threads()


def test_torch_threads_are_limited_in_the_pools_alone(tmp_path: Path) -> None:
    """Threads that start later have as many as before."""
    torch.set_num_threads(3)
    numbers, store = list(ahead(torch_threads, range(40), most=4)), ImageStore("disk", "float32", folder=tmp_path)
    store.put_reader("a", (3, 1, 1), lambda: torch.full((3, 1, 1), float(torch_threads())))
    assert {*numbers, int(store.get("a").max())} == {1}
    store.close()
    with ThreadPoolExecutor(1) as later:
        assert later.submit(torch_threads).result() == torch_threads() == 3


def test_the_error_of_the_first_item_is_raised_after_the_results_before_it() -> None:
    def work(number: int) -> int:
        if number in (3, 4):
            raise ValueError(number)
        return number

    results = ahead(work, range(10), most=4)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="3"):
        next(results)


def test_items_that_nobody_asks_for_are_left() -> None:
    done: list[int] = []
    results = ahead(done.append, range(1000), most=2)
    next(results)
    results.close()  # type: ignore[attr-defined]
    assert len(done) <= 3


def test_large_images_have_fewer_readers() -> None:
    """Each decodes at most 24 bytes a pixel, and all together 4 GiB."""
    assert readers_of([(640, 480)] * 3) == 16
    assert readers_of([(640, 480), (8192, 5461)]) == 4 * 2**30 // (24 * 8192 * 5461) == 4
    assert readers_of([(30_000, 20_000)]) == 1
    assert readers_of([]) == 16
