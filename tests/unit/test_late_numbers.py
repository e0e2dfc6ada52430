"""Numbers that a training loop only logs, read when they are shown, against the loop as it is."""

from __future__ import annotations

import operator
import re
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from lapgs_plugin.checkouts.rewriting import tree_of
from lapgs_plugin.runner import late_numbers
from lapgs_plugin.runner.late_numbers import LateNumber, read, reading_late

OPERATIONS = [operator.add, operator.sub, operator.mul, operator.truediv]
NUMBERS = st.floats(0.125, 100.0)


@given(st.lists(st.tuples(st.sampled_from(OPERATIONS), NUMBERS, st.booleans(), st.booleans()), max_size=150), NUMBERS)
def test_arithmetic_is_that_of_numbers(steps: list[tuple[Any, float, bool, bool]], first: float) -> None:
    late: Any = LateNumber(lambda: first)
    plain = first
    for operation, value, swapped, is_late in steps:
        other: Any = LateNumber(lambda value=value: value) if is_late else value
        try:
            plain = operation(value, plain) if swapped else operation(plain, value)
        except (ZeroDivisionError, OverflowError):
            return
        late = operation(other, late) if swapped else operation(late, other)
    assert float(late) == plain or np.isnan(plain)
    assert f"{-late:.7f} {late}" == f"{-plain:.7f} {plain}"


def test_nothing_is_read_before_it_is_shown() -> None:
    read: list[int] = []
    mean: Any = 0.0
    for i in range(20):
        late = LateNumber(lambda i=i: float(read.append(i) or i))  # type: ignore[func-returns-value, misc]
        mean = 0.4 * late + 0.6 * mean
    assert not read
    assert f"{mean:.1f}" == "17.5"  # 19 - 0.6 / 0.4
    assert sorted(read) == list(range(20))
    assert float(mean) == float(mean)
    assert len(read) == 20  # each is read once


def test_few_numbers_are_pending() -> None:
    """A sum that is never shown would keep all of its numbers, and be too deep to compute at the end."""
    total: Any = 0.0
    for _ in range(20_000):
        total += LateNumber(lambda: 1.0)
    assert total.pending <= late_numbers.MOST_PENDING + 1
    assert float(total) == 20_000


@contextmanager
def counting(operations: Counter[str]) -> Iterator[None]:
    class Counting(TorchDispatchMode):
        def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            operations[function.overloadpacket.__name__] += 1
            return function(*args, **kwargs or {})

    with Counting():
        yield


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
@pytest.mark.parametrize("inference", [False, True])
def test_numbers_of_tensors(dtype: torch.dtype, shape: tuple[int, ...], inference: bool) -> None:
    """Of tensors that change afterwards, read in any order, many before the first is waited for and one by one."""
    generator = torch.Generator().manual_seed(0)
    weight = torch.ones((), dtype=dtype, requires_grad=True)
    for count in (1, 3, 200, 64, 65):
        plain, late = [], []
        with torch.inference_mode(inference):
            for i in range(count):
                tensor = torch.randn(shape, generator=generator).to(dtype)
                tensor = tensor * weight if i % 2 else tensor
                plain.append(tensor.item())
                late.append(read(tensor))
                with torch.no_grad():
                    tensor += 1.0
                plain.append(tensor.item())
                late.append(read(tensor))
        order = torch.randperm(2 * count, generator=generator).tolist()
        assert [float(late[i]) for i in order] == [plain[i] for i in order]


def test_few_operations_read_many_numbers() -> None:
    losses, operations = torch.rand(50, requires_grad=True).unbind(), Counter[str]()
    with counting(operations):
        numbers = [read(loss) for loss in losses for _ in range(3)]  # in a mean, and twice in a report
    assert operations["copy_"] == 50
    with counting(operations):
        assert [float(number) for number in numbers] == [loss.item() for loss in losses for _ in range(3)]
    assert operations["_local_scalar_dense"] == 150, "those of the test"


def test_other_numbers_are_not_late() -> None:
    assert type(read(torch.tensor(3))) is int
    assert read(np.float32(0.5)) == 0.5
    with pytest.raises(RuntimeError):
        read(torch.zeros(2))


def test_loggers_take_it() -> None:
    late: Any = LateNumber(lambda: 1.5)
    assert np.isscalar(late)
    assert float(np.array([late]).squeeze()) == 1.5
    assert f"{late:.3g}" == "1.5"
    assert str(late) == "1.5"
    assert torch.equal(torch.tensor([2.0]) * late, torch.tensor([3.0]))
    assert torch.equal(late - torch.tensor([2.0]), torch.tensor([-0.5]))


LOOP = '''
import time

total = 0.0

class Writer:
    def add_scalar(self, tag, value, step):
        shown.append((tag, float(value), step))

class Event:
    made = []
    def __init__(self, enable_timing=False):
        self.time = None
        Event.made.append(self)
    def record(self, stream=None):
        clock[0] += 1
        self.time = clock[0]
    def synchronize(self):
        waits.append("event")
    def elapsed_time(self, other):
        return float(other.time - self.time)

class torch:
    class cuda:
        Event = Event
        @staticmethod
        def synchronize():
            waits.append("all")

shown, waits, clock = [], [], [0]

def report(writer, elapsed, loss, *, step):
    if writer:
        writer.add_scalar("iter_time", elapsed, step)
        writer.add_scalar("loss", loss, step)

def keep(value):
    shown.append(("kept", value))

def training(losses, writer=None, *, verbose=True):
    """Train."""
    start = torch.cuda.Event(enable_timing=True)
    end = torch.cuda.Event(enable_timing=True)
    mean, total_time, last = 0.0, 0.0, None
    for i, loss in enumerate(losses):
        start.record()
        end.record(stream=None)
        value = loss.item()
        mean = 0.4 * value + 0.6 * mean
        torch.cuda.synchronize()
        elapsed = start.elapsed_time(end)
        total_time += elapsed / 1e3
        report(writer, elapsed, loss=loss.item(), step=i)
        if i % 10 == 9:
            shown.append(f"{mean:.7f}")
            keep(mean)
            if value > 1e9:
                raise ValueError(value)
        last = value
    print("total: {}".format(total_time) if verbose else "")
    return last
'''


@pytest.fixture
def loop(load_module: Callable[[str], ModuleType]) -> ModuleType:
    return load_module(LOOP)


def losses(count: int) -> list[torch.Tensor]:
    return list(torch.rand(count, generator=torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("writes", [False, True])
def test_a_loop_shows_the_same(loop: ModuleType, writes: bool, capsys: pytest.CaptureFixture[str]) -> None:
    shown = []
    for training in (loop.training, reading_late(loop.training)):
        loop.shown.clear(), loop.clock.clear(), loop.clock.append(0)
        returned = training(losses(35), loop.Writer() if writes else None)
        shown.append((returned, list(loop.shown), capsys.readouterr().out))
        assert all(type(each[1]) is float for each in loop.shown if isinstance(each, tuple))
    assert shown[0] == shown[1]
    assert type(shown[1][0]) is float, "what a function returns is no late number"


def test_the_loop_does_not_wait(loop: ModuleType) -> None:
    training = reading_late(loop.training)
    assert training is not loop.training
    training(losses(9), verbose=False)
    assert not loop.waits
    loop.Event.made.clear()
    loop.training(losses(9), verbose=False)
    assert loop.waits == ["all"] * 9
    assert len(loop.Event.made) == 2


def test_it_is_the_same_function(loop: ModuleType) -> None:
    training = reading_late(loop.training)
    names = "__name__", "__qualname__", "__doc__", "__module__", "__defaults__", "__kwdefaults__", "__globals__"
    for name in names:
        assert getattr(training, name) == getattr(loop.training, name)
    bad = [torch.tensor(2e9)] * 10
    lines = []
    for each in (loop.training, training):
        with pytest.raises(ValueError, match=re.escape("2000000000.0")) as caught:
            each(bad)
        lines.append([(frame.name, frame.lineno) for frame in traceback.extract_tb(caught.tb)][1:])
    assert lines[0] == lines[1]


@pytest.mark.parametrize(
    "change",
    [
        ("    for i, loss", "    begun = time.time()\n    for i, loss"),
        ("        start.record()", "        begun = time.perf_counter()\n        start.record()"),
    ],
)
def test_waiting_for_a_clock_stays(load_module: Callable[[str], ModuleType], change: tuple[str, str]) -> None:
    """Of the processor, read in the loop; outside of it, it does not matter."""
    loop = load_module(LOOP.replace(*change))
    reading_late(loop.training)(losses(3), verbose=False)
    assert loop.waits == (["all"] * 3 if "perf_counter" in change[1] else [])


def test_waiting_for_anything_else_stays(load_module: Callable[[str], ModuleType]) -> None:
    """As for a copy to the processor that the script started itself."""
    text = LOOP.replace("        value = loss.item()", "        torch.cuda.synchronize()\n        value = loss.item()")
    loop = load_module(text)
    reading_late(loop.training)(losses(3), verbose=False)
    assert loop.waits == ["all"] * 3


@pytest.mark.parametrize(
    ("old", "new", "waits"),
    [
        # An event that others hold, too, is not made anew; its time is read at once, when it has ended.
        ("end = torch.cuda.Event(enable_timing=True)", "end = others.end", ["event"] * 3),
        ("        end.record(stream=None)", "        others.record(end)", ["event"] * 3),
        # A function that does more than to show a time gets it at once.
        ('writer.add_scalar("iter_time", elapsed, step)', "waits.append(elapsed)", ["event"] * 3),
        ("mean, total_time, last = 0.0, 0.0, None", "global total\n    mean, total_time, last = 0.0, 0.0, None", []),
    ],
)
def test_what_others_see_is_not_late(
    load_module: Callable[[str], ModuleType], old: str, new: str, waits: list[str]
) -> None:
    text = LOOP.replace(old, new).replace("total_time +=", "total +=" if "global" in new else "total_time +=")
    loop = load_module(text)
    loop.others = SimpleNamespace(end=loop.Event(), record=loop.Event.record)
    reading_late(loop.training)(losses(3), verbose=False)
    assert loop.waits == (waits if "global" not in new else ["event"] * 3)
    assert type(loop.total) is float


@pytest.mark.parametrize(
    "text",
    [
        "import functools\n@functools.cache\ndef training(loss):\n    print(loss.item())\n",
        "def training(loss):\n    return loss.item()\n",
        "def training(loss):\n    if loss.item() > 0:\n        return [loss.item()]\n",
        "class training:\n    pass\n",
    ],
)
def test_others_stay_as_they_are(load_module: Callable[[str], ModuleType], text: str) -> None:
    training = load_module(text).training
    assert reading_late(training) is training


def test_a_closure_has_no_tree() -> None:
    def closure() -> Any:
        return losses

    assert tree_of(closure) is None
    assert tree_of(losses) is not None
    assert tree_of(len) is None


def test_a_sum_that_is_squared_is_not_late(
    load_module: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "def training(losses):\n    total = 0.0\n    for loss in losses:\n        total += loss.item()\n"
        "        total **= 2\n        print(f'{total:.6f}')\n"
    )
    training = load_module(text).training
    training(losses(3))
    expected = capsys.readouterr().out
    reading_late(training)(losses(3))
    assert capsys.readouterr().out == expected
