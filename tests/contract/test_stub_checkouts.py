"""Test that the stub checkouts train by themselves."""

from __future__ import annotations

from pathlib import Path

import pytest

from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.fields.gaussian_field import GaussianField
from tests.contract.stub_runs import STUBS, Stub, run_bare

VARIANTS = [
    *STUBS.values(),
    Stub("graphdeco", "graphdeco-aa", (*STUBS["graphdeco"].options, "--antialiasing", "--white_background")),
]


@pytest.mark.parametrize("stub", VARIANTS, ids=lambda stub: stub.stand_in)
def test_a_stub_trains_and_saves(stub: Stub, scene: Path, tmp_path: Path) -> None:
    result = run_bare(stub, scene, tmp_path / "run", "--densify_until_iter", 35, "--save_iterations", 20)
    assert adapter_class(stub.script.parent).info.name == stub.name
    first, *_, last = result.losses
    assert last < 0.9 * first, result.losses  # 0.54 to 0.82 seen
    early, late = (tmp_path / "run" / "point_cloud" / f"iteration_{i}" / "point_cloud.ply" for i in (20, 90))
    assert len(GaussianField.load_ply(early)) >= 300
    assert len(GaussianField.load_ply(late)) > 300
