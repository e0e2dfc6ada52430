"""Test that the stub checkouts train by themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from torch import Tensor

from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.fields.gaussian_field import GaussianField
from tests.contract.stub_runs import ITERATIONS, NAMES, SAVING, STUBS, Result, Stub, run_bare


@pytest.mark.parametrize("name", NAMES)
def test_a_stub_trains_and_saves(name: str, bare_run: Callable[[str], tuple[Result, Tensor]]) -> None:
    assert adapter_class(STUBS[name].script.parent).info.name == name
    trains_and_saves(bare_run(name)[0])


def test_a_stub_trains_on_the_rasterizer_of_another(scene: Path, tmp_path: Path) -> None:
    stub = Stub("graphdeco", "graphdeco-aa", (*STUBS["graphdeco"].options, "--antialiasing", "--white_background"))
    trains_and_saves(run_bare(stub, scene, tmp_path / "run", "--densify_until_iter", 35, *SAVING))


def trains_and_saves(result: Result) -> None:
    first, *_, last = result.losses
    assert last < 0.9 * first, result.losses  # 0.54 to 0.82 seen
    early, late = (result.folder / "point_cloud" / f"iteration_{i}" / "point_cloud.ply" for i in (40, ITERATIONS))
    assert len(GaussianField.load_ply(early)) >= 300
    assert len(GaussianField.load_ply(late)) > 300
