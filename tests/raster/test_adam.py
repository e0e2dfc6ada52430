"""FieldAdam against torch.optim.Adam, under gsplat's densification, and through a saved state."""

from __future__ import annotations

import copy
import io
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from gsplat.strategy.ops import duplicate, remove
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.ops.adam.in_torch import AdamSlot, step_torch
from lapgs_plugin.ops.adam.on_cpu import FieldAdam

SH_SHAPE = (37, 16, 3)


def sh_scale(dtype: torch.dtype = torch.float32) -> Tensor:
    scale = torch.full(SH_SHAPE[1:], 1 / 20, dtype=dtype)
    scale[0] = 1
    return scale


def gradients(shape: tuple[int, ...], steps: int, dtype: torch.dtype) -> Iterator[Tensor]:
    """Yield gradients like those of training: of very different sizes, and zero for rows that no view saw."""
    generator = torch.Generator().manual_seed(1)
    for _ in range(steps):
        row = (shape[0],) + (1,) * (len(shape) - 1)
        size = 10.0 ** torch.randint(-9, 1, row, generator=generator).to(dtype)
        seen = torch.rand(row, generator=generator) < 0.7
        yield torch.randn(shape, generator=generator, dtype=dtype) * size * seen


def parameter(shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(2)))


def descend(optimizer: torch.optim.Optimizer, values: list[Tensor]) -> Tensor:
    """Return the optimizer's one parameter after a step on each gradient."""
    param: Tensor = optimizer.param_groups[0]["params"][0]
    for gradient in values:
        param.grad = gradient.clone()
        optimizer.step()
    return param.detach()


def difference_from_torch(shape: tuple[int, ...], steps: int, dtype: torch.dtype, lr: float, eps: float) -> float:
    """Return the largest difference of the parameters after some steps, in units of lr."""
    values = list(gradients(shape, steps, dtype))
    ours = descend(FieldAdam([parameter(shape, dtype)], lr=lr, eps=eps), values)
    theirs = descend(torch.optim.Adam([parameter(shape, dtype)], lr=lr, eps=eps, foreach=False), values)
    return ((ours - theirs).abs().max() / lr).item()


@pytest.mark.parametrize("shape", [(37,), (37, 3), (5000, 4), SH_SHAPE], ids=str)
def test_equals_torch_adam_over_many_steps(shape: tuple[int, ...]) -> None:
    # Rounding alone, summed over 300 steps. Worst seen: 9e-14 and 7.2e-5.
    assert difference_from_torch(shape, 300, torch.float64, lr=1e-2, eps=1e-15) < 1e-12
    assert difference_from_torch(shape, 300, torch.float32, lr=1e-2, eps=1e-15) < 3e-4


def stepped(values: list[Tensor], rates: tuple[float, float], views: int = 1) -> Tensor:
    """Return the tensor after a step of the PyTorch version on each gradient."""
    start = parameter(SH_SHAPE, torch.float64).detach()
    slot = AdamSlot(start.clone(), *(torch.zeros_like(start) for _ in range(3)), 0, *rates)
    for done, gradient in enumerate(values, start=1):
        step_torch([slot._replace(gradient=gradient, step=done * views)], views)
    return slot.values


def test_the_version_in_plain_pytorch_is_torch_adam_by_columns() -> None:
    values = list(gradients(SH_SHAPE, 50, torch.float64))
    ours = stepped(values, (1e-2, 5e-4))
    for columns, lr in ((slice(0, 1), 1e-2), (slice(1, None), 5e-4)):
        part = torch.nn.Parameter(parameter(SH_SHAPE, torch.float64).detach()[:, columns].clone())
        theirs = descend(torch.optim.Adam([part], lr=lr, eps=1e-15), [value[:, columns] for value in values])
        torch.testing.assert_close(ours[:, columns], theirs, rtol=0, atol=1e-12 * lr * len(values))  # worst seen: 2e-13


@pytest.mark.parametrize("views", [1, 4])
def test_equals_the_version_in_plain_pytorch_for_several_views(views: int) -> None:
    values = list(gradients(SH_SHAPE, 50, torch.float64))
    optimizer = FieldAdam([parameter(SH_SHAPE, torch.float64)], lr=1e-2, column_scale=sh_scale(torch.float64))
    optimizer.param_groups[0]["views"] = views
    expected = stepped(values, (1e-2, 5e-4), views)
    torch.testing.assert_close(descend(optimizer, values), expected, rtol=0, atol=1e-12)  # worst seen: 4e-16


@settings(deadline=None, max_examples=30)
@given(
    shape=st.lists(st.integers(1, 20), min_size=1, max_size=3).map(tuple),
    lr=st.floats(1e-6, 1),
    eps=st.sampled_from([1e-15, 1e-8, 0.1]),
)
def test_equals_torch_adam_for_any_shape(shape: tuple[int, ...], lr: float, eps: float) -> None:
    assert difference_from_torch(shape, 5, torch.float64, lr, eps) < 1e-9  # worst seen: 9e-12


def test_columns_that_become_active_later_train_as_if_they_always_had_been() -> None:
    """Follow the SH schedule: bands above the current degree have zero gradients until it rises."""
    values = list(gradients(SH_SHAPE, 40, torch.float32))
    schedule = [1] * 10 + [4] * 10 + [9] * 10 + [16] * 10
    for value, active in zip(values, schedule, strict=True):
        value[:, active:] = 0
    plain = FieldAdam([parameter(SH_SHAPE)], lr=1e-2, column_scale=sh_scale())
    skipping = FieldAdam([parameter(SH_SHAPE)], lr=1e-2, column_scale=sh_scale())
    for value, active in zip(values, schedule, strict=True):
        skipping.param_groups[0]["active_columns"] = active
        assert torch.equal(descend(skipping, [value]), descend(plain, [value]))


def test_inactive_columns_are_left_alone() -> None:
    param = parameter(SH_SHAPE)
    before = param.detach().clone()
    optimizer = FieldAdam([{"params": [param], "active_columns": 4}], lr=1e-2)
    descend(optimizer, list(gradients(SH_SHAPE, 3, torch.float32)))
    assert torch.equal(param[:, 4:], before[:, 4:])
    assert not optimizer.state[param]["exp_avg"][:, 4:].any()
    assert not torch.equal(param[:, :4], before[:, :4])


def test_same_bits_for_any_number_of_threads() -> None:
    values = list(gradients((9000, 3), 5, torch.float32))
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(descend(FieldAdam([parameter((9000, 3))], lr=1e-2), values))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def saved_and_loaded(state: dict[str, Any]) -> dict[str, Any]:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    loaded: dict[str, Any] = torch.load(buffer, weights_only=True)
    return loaded


def test_resuming_from_a_saved_state_gives_the_same_bits() -> None:
    values = list(gradients(SH_SHAPE, 20, torch.float32))
    group = {"params": [parameter(SH_SHAPE)], "active_columns": 9}
    through = FieldAdam([group], lr=1e-2, column_scale=sh_scale())
    descend(through, values[:10])
    halfway = copy.deepcopy(through.param_groups[0]["params"][0])
    resumed = FieldAdam([halfway], lr=1.0)
    resumed.load_state_dict(saved_and_loaded(through.state_dict()))
    assert torch.equal(descend(through, values[10:]), descend(resumed, values[10:]))


@pytest.mark.parametrize("order", [(torch.optim.Adam, FieldAdam), (FieldAdam, torch.optim.Adam)])
def test_state_is_that_of_torch_adam(order: tuple[type[Any], type[Any]]) -> None:
    values = list(gradients((37, 3), 20, torch.float64))
    options: dict[str, Any] = {"lr": 1e-2, "eps": 1e-15}
    expected = descend(torch.optim.Adam([parameter((37, 3), torch.float64)], **options), values)
    first = order[0]([parameter((37, 3), torch.float64)], **options)
    param = torch.nn.Parameter(descend(first, values[:10]).clone())
    second = order[1]([param], **options)
    second.state[param] = copy.deepcopy(first.state_dict()["state"][0])
    torch.testing.assert_close(descend(second, values[10:]), expected, rtol=0, atol=1e-14)  # 1.1e-16 seen


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gsplat_can_duplicate_and_remove_gaussians(dtype: torch.dtype) -> None:
    """After densification the survivors continue as before; copies start with empty moments."""
    n = SH_SHAPE[0]
    params: dict[str, torch.nn.Parameter] = {"means": parameter((n, 3), dtype), "sh": parameter(SH_SHAPE, dtype)}
    ours: dict[str, torch.optim.Optimizer] = {
        "means": FieldAdam([params["means"]], lr=1e-2),
        "sh": FieldAdam([params["sh"]], lr=1e-2, column_scale=sh_scale(dtype)),
    }
    untouched = {name: copy.deepcopy(optimizer) for name, optimizer in ours.items()}
    values = {name: list(gradients(tuple(p.shape), 8, dtype)) for name, p in params.items()}
    for name in params:
        descend(ours[name], values[name][:4])
        descend(untouched[name], values[name][:4])
    copied, dropped = torch.zeros(n, dtype=torch.bool), torch.zeros(n + 3, dtype=torch.bool)
    copied[[2, 5, 30]] = True
    dropped[[0, 5, 20, n + 1]] = True
    duplicate(params, ours, {}, copied)
    for name, param in params.items():
        assert not ours[name].state[param]["exp_avg"][n:].any()
    remove(params, ours, {}, dropped)
    kept = ~dropped[:n]
    for name, param in params.items():
        (expected,) = untouched[name].param_groups[0]["params"]
        for value in values[name][4:]:
            descend(untouched[name], [value])
            descend(ours[name], [torch.cat([value[kept], value[:2]])])
        assert len(param) == n - 1
        assert torch.equal(param[: n - 3], expected[kept])


def test_a_parameter_without_gradient_or_without_rows_is_left_alone() -> None:
    param, empty = parameter((4, 3)), torch.nn.Parameter(torch.zeros(0, 3))
    before = param.detach().clone()
    empty.grad = torch.zeros(0, 3)
    optimizer = FieldAdam([param, empty], lr=1.0)
    optimizer.step()
    assert torch.equal(param, before)
    assert param not in optimizer.state


@pytest.mark.parametrize(
    ("param", "options", "message"),
    [
        (torch.zeros(4, 3), {"lr": -1.0}, "lr -1.0"),
        (
            torch.zeros(4, 3),
            {"column_scale": torch.ones(4)},
            r"column_scale has shape \(4,\), expected one row's: \(3,\)",
        ),
        (torch.zeros(4, 3), {"active_columns": 4}, "active_columns 4"),
        (torch.zeros(4), {"active_columns": 1}, "active_columns 1"),
        (torch.zeros(4, 3).half(), {}, "torch.float16"),
        (torch.zeros(3, 4).T, {}, "contiguous"),
    ],
)
def test_refuses_what_it_cannot_optimize(param: Tensor, options: dict[str, Any], message: str) -> None:
    param.requires_grad_()
    param.grad = torch.zeros_like(param)
    with pytest.raises(UserInputError, match=message):
        FieldAdam([{"params": [param], **options}], lr=options.get("lr", 1e-2)).step()
