"""Test that `lapgs run --device cpu` trains real forks of 3DGS, at a tiny size."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.runs.archive import RunArchive
from tests.upstream.checkouts import assert_same_quality, checkout, run_lapgs

pytestmark = pytest.mark.upstream

SCHEDULE = (
    "--eval -r 4 --iterations 60 --densify_from_iter 5 --densification_interval 10 --densify_until_iter 30 "
    "--opacity_reset_interval 45 --percent_dense 0.05 --test_iterations -1"
)


@dataclass(frozen=True)
class Fork:
    """Describe how a fork is trained.

    Attributes:
        backbone: name of its adapter.
        script: relative to its root.
        options: of its script.
        residuals: whether it can be trained with residuals.
        same: whether its archived fields are what its render shows; a stand-in may blur otherwise.
    """

    backbone: str
    script: str = "train.py"
    options: str = ""
    residuals: bool = True
    same: bool = True


FORKS = {
    "LAPGS_DASHGAUSSIAN": Fork(
        "dashgaussian", "train_dash.py", "--densify_mode freq --resolution_mode freq --disable_viewer"
    ),
    "LAPGS_SPEEDY_SPLAT": Fork(
        "speedy_splat", options="--prune_from_iter 20 --prune_interval 15 --prune_until_iter 60"
    ),
    # Its last evaluation needs networks; the checkout of this test has it taken out.
    "LAPGS_MINI_SPLATTING": Fork(
        "mini_splatting",
        "ms/train.py",
        "--imp_metric outdoor --simp_iteration1 30 --simp_iteration2 45 --num_depth 2000",
    ),
    "LAPGS_EFFICIENTGS": Fork(
        "efficientgs",
        options="--no_gui --use_grad_norm --grad_norm_way s1 --prune_by_max_weight --prune_way p4 "
        "--oneupSHdegree_from_iter 35 --use_sparse_shs",
    ),
    "LAPGS_MIP_SPLATTING": Fork("mip_splatting", same=False),
    "LAPGS_3DGS_MCMC": Fork("graphdeco", options="--cap_max 3000 --init_type sfm"),
    # It shrinks photos in another way than `lapgs eval`, so the figures of full-size photos alone are comparable.
    "LAPGS_ABSGS": Fork("generic", same=False),
    "LAPGS_PIXEL_GS": Fork("graphdeco"),
    "LAPGS_2DGS": Fork("generic", residuals=False, same=False),
    "LAPGS_FASTER_GS": Fork("generic", options="--disable_viewer", residuals=False),
}


@pytest.mark.parametrize("kind", ["off", "nested", "laplacian"])
@pytest.mark.parametrize("variable", FORKS)
def test_a_fork_trains(variable: str, kind: str, scene: Path, tmp_path: Path) -> None:
    fork, root = FORKS[variable], checkout(variable)
    if kind == "laplacian" and not fork.residuals:
        pytest.skip("has no residuals; docs/checkouts.md says why")
    assert adapter_class(root).info.name == fork.backbone
    options = ["--off"] if kind == "off" else ["--hierarchy", kind, "--split", "1/3,2/3"]
    done = run_lapgs(root / fork.script, options, f"-s {scene} {SCHEDULE} {fork.options}".split(), tmp_path / "run")
    if kind == "off":
        assert (done.folder / "point_cloud/iteration_60").is_dir()
        return
    archive = RunArchive.open(done.folder)
    assert archive.manifest.complete
    assert [record.image_size for record in archive.manifest.records] == [(30, 20), (60, 40)]
    assert [record.signed for record in archive.manifest.records] == [False, kind == "laplacian"]
    for record in archive.manifest.records:
        assert record.num_gaussians == len(archive.field(record.level))
    if fork.same:
        assert_same_quality(archive)
