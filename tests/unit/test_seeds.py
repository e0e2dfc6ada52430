"""Test that the seed of a run is added to those that a script sets."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from lapgs_plugin.checkouts.seeds import moved_seeds
from lapgs_plugin.cli.app import app


def test_seeds_that_are_set_meanwhile_move() -> None:
    before = random.seed, np.random.seed, torch.manual_seed
    with moved_seeds(3):
        random.seed(0)
        np.random.seed(seed=0)
        torch.manual_seed(2**32 - 1)
        numbers = random.random(), np.random.random(), torch.rand(()).item()
    assert (random.seed, np.random.seed, torch.manual_seed) == before
    expected = torch.rand((), generator=torch.Generator().manual_seed(2)).item()
    assert numbers == (random.Random(3).random(), np.random.RandomState(3).random_sample(), expected)


def test_seeds_of_cuda_devices_alone_move_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many scripts set them after all others, once for one device and once for all of them; PyTorch by itself does."""
    seeded: dict[str, list[int]] = {"manual_seed": [], "manual_seed_all": []}
    for name, seeds in seeded.items():
        monkeypatch.setattr(torch.cuda, name, seeds.append)
    with moved_seeds(3):
        torch.cuda.manual_seed(7)
        torch.cuda.manual_seed_all(7)
        torch.manual_seed(7)
    torch.cuda.manual_seed(7)
    assert seeded == {"manual_seed": [10, 7], "manual_seed_all": [10, 10]}


def test_other_seeds_stay() -> None:
    with moved_seeds(3):
        random.seed("words")
        number = random.random()
        random.seed()
        assert random.random() != number
    assert number == random.Random("words").random()
    with moved_seeds(0):
        random.seed(7)
    assert random.random() == random.Random(7).random()


@pytest.mark.parametrize("seed", [0, 5])
def test_a_script_without_a_hierarchy_takes_the_seed_as_well(seed: int, tmp_path: Path) -> None:
    script = tmp_path / "train.py"
    script.write_text("import random\nif __name__ == '__main__':\n    random.seed(0)\n    print(random.random())\n")
    arguments = ["run", "--off", "--device", "cpu", *(["--seed", str(seed)] if seed else []), str(script)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert float(result.stdout.splitlines()[-1]) == random.Random(seed).random()
