"""Rows of visible Gaussians updated by their mask, against the statements as they are."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from lapgs_plugin.checkouts.masked_statements import keeps_masks
from lapgs_plugin.ops.masked_updates import update_rows
from lapgs_plugin.ops.masked_updates.in_torch import Update
from lapgs_plugin.runner import visible_rows
from lapgs_plugin.runner.visible_rows import VisibleRows
from tests.devices import DEVICES

MODEL = """
import torch

class Model:
    def __init__(self, count, device="cpu"):
        self.largest, self.weight = torch.zeros(count, device=device), torch.zeros(count, 1, device=device)
        self.sums, self.sums_abs, self.peak, self.views = (torch.zeros(count, 1, device=device) for _ in range(4))
    def add_densification_stats(self, points, update_filter, pixels):
        self.sums[update_filter] += torch.norm(points.grad[update_filter, :2], dim=-1, keepdim=True)
        self.sums_abs[update_filter] += torch.norm(points.grad[update_filter, 2:],
                                                   dim=-1, keepdim=True) * pixels[update_filter]
        self.peak[update_filter] = torch.max(self.peak[update_filter],
                                             torch.norm(points.grad[update_filter, 2:], dim=-1, keepdim=True))
        self.views[update_filter] += 1

def render(values):
    radii = values.int()
    return {"radii": radii, "visibility_filter": (radii > 0).nonzero(), "image": values}

def training(model, views, render):
    with torch.no_grad():
        for values, points, weight in views:
            package = render(values)
            shown, radii = package["visibility_filter"], package["radii"]
            model.weight[shown] = torch.maximum(weight[shown], model.weight[shown])
            if len(radii) > 0:
                # Largest radii
                model.largest[shown] = torch.max(model.largest[shown], radii[shown])
                model.add_densification_stats(points, shown, weight)
"""

CALL = """
import torch

OTHER = torch.tensor([1.0, 2.0, 3.0])

class Model:
    def __init__(self):
        self.largest, self.views, self.sums = torch.zeros(3), torch.zeros(3), torch.zeros(3)
    def add_densification_stats(self, points, visible, wide=None):
        BODY

def render(radii):
    return (radii > 0).nonzero()

def training(model, shown, package):
    radii = package["radii"]
    model.largest[shown] = torch.max(model.largest[shown], radii[shown])
    model.add_densification_stats(CALL)
"""
ADDED = "self.views[visible] += 1; self.sums[visible] += points[visible]"

FLOATS = st.one_of(st.floats(-1e3, 1e3, width=32), st.sampled_from([math.nan, math.inf]))


class _Counted:
    """Count the updates that were done by a mask."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[bool] = []
        monkeypatch.setattr(visible_rows, "update_rows", self._update)

    def _update(self, *arguments: Any) -> bool:
        self.done.append(update_rows(*arguments))
        return self.done[-1]


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> _Counted:
    return _Counted(monkeypatch)


def _changed(module: ModuleType) -> SimpleNamespace:
    """Return the functions of a module as `lapgs run` changes them."""
    rows = VisibleRows()
    methods = {"add_densification_stats": module.Model.add_densification_stats}
    rows.note_caller(module.training, {"render"}, methods)
    loop = rows.updating(module.training, methods)
    model = type("Model", (module.Model,), {})
    model.add_densification_stats = rows.updating(module.Model.add_densification_stats)  # type: ignore[attr-defined]
    by_loop = rows.is_for_masks(loop.__code__)
    return SimpleNamespace(training=loop, Model=model, render=rows.in_renderer(module.render, lambda: by_loop))


def _views(count: int, device: str) -> list[Any]:
    generator = torch.Generator().manual_seed(count)

    def normal(columns: tuple[int, ...]) -> Tensor:
        return torch.randn(count, *columns, generator=generator).to(device)

    points = [SimpleNamespace(grad=normal((4,))) for _ in range(3)]
    return [(3 * normal(()), each, normal((1,))) for each in points]


def _state(model: Any) -> list[np.ndarray[Any, Any]]:
    return [value.cpu().numpy().view(np.int32) for value in vars(model).values()]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_a_loop_gathers_the_same(
    load_module: Callable[[str], ModuleType], counted: _Counted, device: str, count: int
) -> None:
    """To the bit, and its renderer returns masks, so that nothing is listed."""
    module, views = load_module(MODEL), _views(count, device)
    changed = _changed(module)
    assert changed.render(views[0][0])["visibility_filter"].dtype is torch.bool
    states = []
    for functions in (module, changed):
        model = functions.Model(count, device)
        functions.training(model, views, functions.render)
        states.append(_state(model))
    assert all(map(np.array_equal, *states))
    assert counted.done == 6 * [True]  # weights, radii with statistics; three views


@pytest.mark.parametrize(
    ("body", "call", "updates"),
    [
        (ADDED, 'package["points"], shown, None', 1),
        (f"'Say what it does.'; {ADDED}", 'package["points"], shown, radii', 1),
        (ADDED, 'package["points"], shown', 2),
        (ADDED, 'package["points"], visible=shown, wide=None', 2),
        (ADDED, 'package["points"].abs(), shown, None', 2),
        (ADDED, 'package["points"], shown & shown, None', 2),
        (ADDED, 'package["points"], package["shown"], None', 2),
        (ADDED, "*[package[name] for name in ('points', 'shown')], None", 2),
        ("self.views[visible] += OTHER[visible]", 'package["points"], shown, None', 2),
        (f"{ADDED}; self.views += 1", 'package["points"], shown, None', 2),
        ("self.views[visible] += 1; self.sums[wide] += 1", 'package["points"], shown, ~shown', 3),
        ("pass", 'package["points"], shown, None', 1),
    ],
)
def test_a_method_that_only_updates_is_part_of_the_update_before(
    load_module: Callable[[str], ModuleType], counted: _Counted, body: str, call: str, updates: int
) -> None:
    module = load_module(CALL.replace("BODY", body).replace("CALL", call))
    shown = torch.tensor([True, False, True])
    package = {"radii": torch.tensor([3, 2, 1]).int(), "points": torch.tensor([1.0, -2.0, -3.0]), "shown": shown}
    states = []
    for functions in (module, _changed(module)):
        model = functions.Model()
        for _ in range(2):
            functions.training(model, shown, package)
        states.append(_state(model))
    assert all(map(np.array_equal, *states))
    assert len(counted.done) == 2 * updates
    assert all(counted.done)


def test_another_method_of_that_name_is_called(load_module: Callable[[str], ModuleType], counted: _Counted) -> None:
    changed = _changed(load_module(CALL.replace("BODY", ADDED).replace("CALL", "radii, shown, None")))
    called: list[int] = []
    own = changed.Model()
    own.add_densification_stats = lambda *arguments: called.append(len(arguments))
    derived = type("Derived", (changed.Model,), {"add_densification_stats": lambda *arguments: called.append(4)})()
    shown, radii = torch.tensor([True, False, True]), torch.tensor([3, 2, 1]).int()
    for model in (own, derived):
        changed.training(model, shown, {"radii": radii})
        assert model.largest.tolist() == [3, 0, 1]
        assert model.views.tolist() == [0, 0, 0]
    assert called == [3, 4]
    assert not counted.done


@settings(deadline=None)
@given(
    st.integers(1, 40).flatmap(
        lambda n: st.tuples(
            arrays(np.float32, (n, 5), elements=FLOATS),
            arrays(bool, n),
            arrays(np.int32, n, elements=st.integers(0, 99)),
        )
    )
)
def test_values_of_any_kind(drawn: tuple[Any, Any, Any]) -> None:
    values, mask, radii = map(torch.from_numpy, drawn)
    before, points = values[:, 4].contiguous(), values[:, :4].contiguous()
    for as_column in (False, True):

        def rows(value: Tensor, as_column: bool = as_column) -> Tensor:
            return value.reshape(-1, 1).clone() if as_column else value.clone()

        cases: list[tuple[bool, Any]] = [(True, rows(radii)), (False, rows(radii)), (False, 3), (False, 0.1)]
        cases += [(False, rows(points[:, 0])), (True, rows(points[:, 1] + 0.0))]
        for takes_largest, source in cases:
            ours, plain = rows(before), rows(before)
            assert update_rows(mask, [Update(ours, takes_largest, source)])
            value = source if isinstance(source, (int, float)) else source[mask]
            plain[mask] = torch.max(plain[mask], value) if takes_largest else plain[mask] + value
            torch.testing.assert_close(ours, plain, rtol=0, atol=0, equal_nan=True)
    for first, last in ((None, 2), (3, None)):
        ours, plain = (before.reshape(-1, 1).clone() for _ in range(2))
        assert update_rows(mask, [Update(ours, False, points, (first, last))])
        plain[mask] += torch.norm(points[mask, first:last], dim=-1, keepdim=True)
        torch.testing.assert_close(ours, plain, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("kind", ["indices", "column", "uint8", "float64", "strided"])
def test_what_does_not_fit_is_done_as_written(
    load_module: Callable[[str], ModuleType], counted: _Counted, kind: str
) -> None:
    module, count = load_module(MODEL), 50
    points, mask = SimpleNamespace(grad=torch.randn(count, 4)), torch.randn(count) > 0
    pixels = torch.rand(count, 1)
    if kind == "strided":
        points.grad = torch.randn(4, count).T
    others = {"indices": mask.nonzero()[:, 0], "column": mask.nonzero(), "uint8": mask}
    states = []
    for functions in (module, _changed(module)):
        model = functions.Model(count)
        if kind == "float64":
            model.views = model.views.double()
        functions.Model.add_densification_stats(model, points, others.get(kind, mask), pixels)
        states.append([value.numpy() for value in vars(model).values()])
    assert all(map(np.array_equal, *states))
    assert counted.done == [kind == "uint8"]


def test_updates_that_depend_on_each_other_or_have_gradients() -> None:
    mask, rows = torch.tensor([True, False]), torch.ones(2)
    points = torch.ones(2, 4)
    for updates in (
        [Update(rows, False, rows)],
        [Update(rows, False, 1), Update(torch.zeros(2), True, rows)],
        [Update(rows, False, 1), Update(rows, True, 5)],
        [Update(points[0, :2], False, points[1, :2])],
        [Update(rows, False, 1), Update(torch.zeros(2), False, torch.ones(3))],
        [Update(rows, False, torch.ones(2, requires_grad=True))],
        [Update(rows[:, None], False, points, (0, 3))],
        [Update(rows, False, points, (0, 2))],
        [Update(rows, False, True)],
        [Update(rows, False, None)],
    ):
        assert not update_rows(mask, updates)
    assert rows.tolist() == [1, 1]
    with torch.no_grad():
        assert update_rows(mask, [Update(rows, False, torch.ones(2, requires_grad=True))])
    assert rows.tolist() == [2, 1]


def test_updates_of_the_same_size_are_looked_at_again() -> None:
    mask, rows, points = torch.tensor([True, False, True]), torch.ones(3, 1), torch.ones(3, 4)

    def done(target: Any = rows, source: Any = points, columns: Any = (0, 2), factor: Any = None) -> bool:
        return update_rows(mask, [Update(target, False, source, columns, factor), Update(torch.ones(3), False, 1)])

    with torch.no_grad():
        for _ in range(2):
            assert done()
            assert not done(target=torch.ones(3, 1, dtype=torch.float64))
            assert not done(target=torch.ones(3))
            assert not done(target=torch.ones(3, 2)[:, :1])
            assert not done(factor=[1.0])
            assert not done(source=points.int())
            assert not done(source=torch.ones(4, 3).T)
            assert not done(source=[1.0, 1.0, 1.0], columns=None)
            assert not done(columns=(0, 3))
            assert not done(factor=rows)
            assert done(source=1, columns=None)
            assert not done(source=True, columns=None)
            assert done(source=torch.nn.Parameter(points))
    assert not done(source=torch.nn.Parameter(points))
    updated = 1 + 2 * (1 + 2 * 2**0.5)
    assert rows[:, 0].tolist() == pytest.approx([updated, 1, updated], rel=1e-6)


@pytest.mark.parametrize(
    "statement",
    [
        "model.sums[shown] += torch.norm(points[shown, :2], dim=-1)",
        "model.sums[shown] += torch.norm(points[other, :2], dim=-1, keepdim=True)",
        "model.sums[shown] += torch.norm(points[shown, :n], dim=-1, keepdim=True)",
        "model.sums[shown] -= 1",
        "model.sums[shown] = torch.max(model.views[shown], radii[shown])",
        "model.sums[shown] = torch.max(model.sums[shown], radii)",
        "model.sums[shown] = torch.max(model.sums[shown], radii[other])",
        "model.sums()[shown] += 1",
        "model.sums[shown, 0] += 1",
        "model.sums[shown] += n",
        "shown[shown] += 1",
    ],
)
def test_other_statements_are_left(load_module: Callable[[str], ModuleType], statement: str) -> None:
    module = load_module(f"import torch\ndef f(model, points, radii, shown, other, n):\n    {statement}\n")
    assert VisibleRows().updating(module.f) is module.f


def test_functions_that_are_left(load_module: Callable[[str], ModuleType]) -> None:
    body = "class Model:\n    def f(self, shown):\n        {}[shown] += 1\n"
    rows = VisibleRows()
    assert rows.updating(len) is len
    private = load_module("import torch\n" + body.format("self.__sums")).Model.f
    assert rows.updating(private) is private
    without_torch = load_module(body.format("self.sums")).Model.f
    assert rows.updating(without_torch) is without_torch
    other_torch = load_module("torch = None\n" + body.format("self.sums")).Model.f
    assert rows.updating(other_torch) is other_torch


def test_errors_name_the_line_as_written(load_module: Callable[[str], ModuleType]) -> None:
    module = load_module(MODEL)
    model = _changed(module).Model(3)
    with pytest.raises(TypeError, match="NoneType") as caught:
        model.add_densification_stats(SimpleNamespace(grad=None), torch.ones(3, dtype=torch.bool), None)
    lines = MODEL.split("\n")
    assert lines[caught.traceback[-1].lineno].strip().startswith("self.sums[update_filter] +=")


STATISTICS = "def add_densification_stats(self, points, update_filter):\n    self.views[update_filter] += 1\n"
PACKAGE = 'package = render(view)\nimage, shown = package["image"], package["visibility_filter"]\n'


@pytest.mark.parametrize(
    ("lines", "statistics", "expected"),
    [
        ("a.b[shown] += 1\n", STATISTICS, True),
        ("model.add_densification_stats(points, shown)\n", STATISTICS, True),
        ("model.add_densification_stats(points, shown)\n", STATISTICS + "    print(update_filter)\n", False),
        ("model.add_densification_stats(shown, points)\n", STATISTICS, True),  # that parameter is not used
        ("model.add_densification_stats(points, update_filter=shown)\n", STATISTICS, False),
        ("model.add_densification_stats(*points, shown)\n", STATISTICS, False),
        ("model.other(points, shown)\n", STATISTICS, False),
        ("a.b[shown] += 1\nprint(shown.sum())\n", STATISTICS, False),
        ("a.b[shown] = 1\n", STATISTICS, False),
        ("kept.append(package)\n", STATISTICS, False),
        ("report(package['visibility_filter'])\n", STATISTICS, False),
        ("for name in names: print(package[name])\n", STATISTICS, False),
        ("show(render(view)['image'])\n", STATISTICS, True),
        ("show(render(view))\n", STATISTICS, False),
        ("show(render(view)['visibility_filter'])\n", STATISTICS, False),
        ("module.render(view).values()\n", STATISTICS, False),
        ("draw = render if fast else module.other\nshow(draw(view)['visibility_filter'])\n", STATISTICS, False),
        ("draw = module.render\nshow(draw(view)['visibility_filter'])\n", STATISTICS, False),
        ("show(partial(render, view)()['visibility_filter'])\n", STATISTICS, False),
        ("show(functools.partial(render, view)()['visibility_filter'])\n", STATISTICS, False),
        ("for other in map(render, views): show(other['visibility_filter'])\n", STATISTICS, False),
        ("training_report(model, render, (view,))\n", STATISTICS, True),  # its renders are not this function's
        ("training_report(model, view, by=render)\n", STATISTICS, True),
    ],
)
def test_where_masks_take_the_places_of_indices(lines: str, statistics: str, expected: bool) -> None:
    body = "".join(f"    {line}\n" for line in (PACKAGE + lines).splitlines())
    training, method = (ast.parse(text).body[0] for text in (f"def training(view, model):\n{body}", statistics))
    assert isinstance(training, ast.FunctionDef)
    assert isinstance(method, ast.FunctionDef)
    assert keeps_masks(training, {"render"}, {method.name: method}) == expected


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ('total += render(view)["image"].mean()', True),
        ('package = render(view)\ntotal += package["image"].mean()', True),
        ('package = render(view)\ntotal += package["visibility_filter"].sum()', False),
        ("package = render(view)\nreturn package", False),
    ],
)
def test_score_functions_that_list_no_gaussians(lines: str, expected: bool) -> None:
    body = "".join(f"    {line}\n" for line in lines.splitlines())
    function = ast.parse(f"def score(view, total):\n{body}").body[0]
    assert isinstance(function, ast.FunctionDef)
    assert keeps_masks(function, {"render"}, {}) == expected


def test_indices_that_a_renderer_uses_itself_stay(load_module: Callable[[str], ModuleType]) -> None:
    source = """
def render(radii):
    shown = (radii > 0).nonzero()
    return {"visibility_filter": shown, "first": shown[0, 0]}
"""
    render = load_module(source).render
    radii = torch.tensor([0, 2, 0, 1])
    results = VisibleRows().in_renderer(render, lambda: True)(radii)
    assert results["visibility_filter"].tolist() == [[1], [3]]
    assert results["first"] == 1
