"""Unused memory of a GPU that density control gives back only where there is much of it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from lapgs_plugin.runner.kept_memory import keeping_memory

GIB = 2**30


def _on_gpu(monkeypatch: pytest.MonkeyPatch, reserved: int, allocated: int, *, there: bool = True) -> list[str]:
    emptied: list[str] = []
    values = {
        "is_available": lambda: there,
        "current_device": lambda: 0,
        "memory_reserved": lambda device: reserved,
        "memory_allocated": lambda device: allocated,
        "get_device_properties": lambda device: SimpleNamespace(total_memory=24 * GIB),
        "empty_cache": lambda: emptied.append("all"),
    }
    for name, value in values.items():
        monkeypatch.setattr(torch.cuda, name, value)
    return emptied


@pytest.mark.parametrize(("reserved", "there", "expected"), [(6, True, 0), (8, True, 2), (6, False, 2)])
def test_little_is_kept(monkeypatch: pytest.MonkeyPatch, reserved: int, there: bool, expected: int) -> None:
    emptied = _on_gpu(monkeypatch, reserved * GIB, 4 * GIB, there=there)
    original = torch.cuda.empty_cache
    with keeping_memory():
        torch.cuda.empty_cache()
        with keeping_memory():  # a method that calls another
            torch.cuda.empty_cache()
    assert len(emptied) == expected
    assert torch.cuda.empty_cache is original
    torch.cuda.empty_cache()
    assert len(emptied) == expected + 1


def test_it_is_restored_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    _on_gpu(monkeypatch, 6 * GIB, 4 * GIB)
    original = torch.cuda.empty_cache
    with pytest.raises(ValueError, match="of the checkout"), keeping_memory():
        raise ValueError("of the checkout")
    assert torch.cuda.empty_cache is original
