"""Test pruning at the end of densification against the run folder's own cameras and rasterizer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.pruning import blended_pixels, least_blended
from lapgs_plugin.rasterizers.choice import rasterizer_for
from lapgs_plugin.rendering.run import run_scene
from lapgs_plugin.runner import stage_pruning
from lapgs_plugin.runner.active_stage import ActiveStage
from tests.contract.stub_runs import (
    HALF,
    NAMES,
    STUBS,
    STUBS_AND_KINDS,
    THIRDS,
    captured,
    drive,
    loaded,
    run_hierarchy,
    run_residuals,
)

SHARE = 0.05
DENSE = (*HALF, "--densify_until_iter", 30)


@pytest.mark.parametrize(("name", "hierarchy"), STUBS_AND_KINDS)
def test_what_is_least_seen_goes(
    name: str, hierarchy: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[Tensor] = []
    fields: dict[int, tuple[GaussianField, GaussianField]] = {}
    prune = ActiveStage._prune

    def noting(pixels: Tensor, share: float) -> Tensor:
        measured.append(pixels)
        assert share == SHARE
        return least_blended(pixels, share)

    def watched(stage: ActiveStage, gaussians: Any) -> None:
        before = stage._adapter.snapshot(gaussians, signed=False)
        prune(stage, gaussians)
        fields[stage.stage.level] = before, stage._adapter.snapshot(gaussians, signed=False)

    monkeypatch.setattr(stage_pruning, "least_blended", noting)
    monkeypatch.setattr(ActiveStage, "_prune", watched)
    # Once the base is trained with the residual, it counts in the history as well: after the pruning.
    chosen = {"hierarchy": hierarchy, **({"joint": 0.25} if hierarchy == "laplacian" else {})}
    archive, _ = run_hierarchy(STUBS[name], scene, tmp_path / "run", *DENSE, prune=SHARE, **chosen, **THIRDS)
    assert archive.manifest.complete
    # Residuals each densify for themselves; one nested field densifies until iteration 30 of the run.
    expected_at = {1: 10, 0: 20} if hierarchy == "laplacian" else {0: 15}
    assert list(fields) == list(expected_at)
    rasterizer = rasterizer_for(archive.manifest, "cpu", archive.manifest.rasterizer).rasterizer
    views = run_scene(archive).train
    for (level, (before, after)), pixels in zip(fields.items(), measured, strict=True):
        gone = least_blended(pixels, SHARE)
        assert 0 < int(gone.sum()) < len(gone)
        for part in ("means", "log_scales", "opacity_logits", "sh"):
            assert torch.equal(getattr(after, part), getattr(before, part)[~gone]), part
        grey = torch.zeros(len(before), 1, 3, requires_grad=True)
        plain = GaussianField(before.means, before.quaternions, before.log_scales, before.opacity_logits, grey)
        cameras = [level_camera(view.camera, level) for view in views]
        images = (rasterizer(plain, camera, background=torch.zeros(3)).image for camera in cameras)
        expected = blended_pixels(images, grey)
        # The same sums in another order: worst relative difference 9.2e-6. Gaussians in some pixels differ by more:
        # where rounding, and so the processor, decides about alpha = 1/255, the last Gaussian, or which of two is in
        # front. (The bounds of `threshold_mask` leave 4 % of the pixels of 7000 Gaussians.) Worst seen with cameras and
        # parameters moved by one to five roundings, 16 to 60 times for each field: 2.6 % of the Gaussians, together
        # 2.6e-4 of the sum.
        decided = torch.isclose(pixels, expected, rtol=3e-5, atol=1e-6)
        assert decided.float().mean() > 0.95
        assert (pixels - expected).abs().sum() < 1e-3 * expected.sum()
    entries = [entry for entry in archive.history() if "num_gaussians" in entry]
    counts = {(entry["level"], entry["iteration"]): entry["num_gaussians"] for entry in entries}
    for level, first in expected_at.items():
        assert counts[level, first - 1] == len(fields[level][0])
        assert counts[level, first] == len(fields[level][1])


def test_pruning_needs_an_end_of_densification(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, folder, "--densify_until_iter", 90) as adapter,
        pytest.raises(UserInputError, match=r"--prune 0.05: .*--densify_until_iter 90, --iterations 90\)") as caught,
    ):
        drive(adapter, prune=SHARE)
    assert "\n" not in str(caught.value)
    assert not folder.exists()


def test_pruning_needs_a_method_that_takes_a_mask_alone(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """FSGS and CoR-GS also pass the iteration."""
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run") as adapter:
        monkeypatch.setattr(adapter.profile.model, "prune_points", lambda self, mask, iter, most=None: None)
        with pytest.raises(UserInputError, match=r"no prune_points\(\) that takes a mask alone \(.*'iter'\)"):
            drive(adapter, prune=SHARE)
    assert not (tmp_path / "run").exists()


def test_a_stage_that_is_not_pruned_says_so(scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """In 90 iterations densification ends at 18; in stages of 30 and 60 at 6 and 12, and it begins at 10."""
    folder, more = tmp_path / "run", ("--densify_from_iter", 10, "--densify_until_iter", 18)
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, folder, *more) as adapter:
        drive(adapter, prune=SHARE, hierarchy="laplacian", joint=0.0)
    (line,) = [record.getMessage() for record in caplog.records if "--prune" in record.getMessage()]
    assert line == "--prune 0.05: level 1 is not pruned: no densification ends in its iterations"


@pytest.mark.parametrize("name", NAMES)
def test_looking_changes_nothing(name: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If no Gaussian is pruned, the fields have the same bits as without --prune."""
    calls = []

    def none(pixels: Tensor, share: float) -> Tensor:
        calls.append(len(pixels))
        return torch.zeros_like(pixels, dtype=torch.bool)

    monkeypatch.setattr(stage_pruning, "least_blended", none)
    plys = []
    for share in (0.0, SHARE):
        archive, _ = run_residuals(STUBS[name], scene, tmp_path / str(share), *DENSE, prune=share, joint=0.25)
        plys.append([archive.field_path(level).read_bytes() for level in (1, 0)])
    assert plys[0] == plys[1]
    assert len(calls) == 2
