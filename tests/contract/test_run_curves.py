"""Test `lapgs run --test-every`: held-out PSNR during a checkout's training, which changes no field."""

from __future__ import annotations

from pathlib import Path

import pytest

from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from tests.contract.stub_runs import SHORT, STUBS, STUBS_AND_KINDS, THIRDS, run_hierarchy

OFTEN = ("--densify_from_iter", 0, "--densification_interval", 3, "--densify_until_iter", 30)
EVERY = 4


def rendered(archive: RunArchive, level: int) -> float:
    """Return held-out PSNR of a finished level at full resolution, without the checkout's code."""
    renderer = run_renderer(archive, device="cpu", rasterizer="cpu")
    values = []
    for view in run_scene(archive).test:
        image = renderer.render(view.camera, level).composed[level]
        values.append(psnr(to_full_size(image, view.camera.size, level, renderer.pyramid), view.image))
    return sum(values) / len(values)


@pytest.mark.parametrize(
    ("name", "hierarchy", "supervision"),
    [*((*pair, "reconstructed") for pair in STUBS_AND_KINDS), ("graphdeco", "laplacian", "gt_laplacian")],
)
def test_curves_leave_no_trace(scene: Path, tmp_path: Path, name: str, hierarchy: str, supervision: str) -> None:
    runs = {}
    for every in (None, EVERY):
        folder = tmp_path / str(every)
        options = {"hierarchy": hierarchy, "supervision": supervision, "joint": 0.0, **THIRDS}
        runs[every], _ = run_hierarchy(STUBS[name], scene, folder, *SHORT, *OFTEN, test_every=every, **options)
    plain, measured = runs[None], runs[EVERY]
    for level in (1, 0):
        assert measured.field_path(level).read_bytes() == plain.field_path(level).read_bytes()
    noted = [entry for entry in measured.history() if "psnr" in entry]
    assert [(entry["level"], entry["iteration"]) for entry in noted] == [
        *((1, i) for i in (4, 8, 10)),
        *((0, i) for i in (4, 8, 12, 16, 20)),
    ]
    times = [entry["elapsed"] for entry in noted if "elapsed" in entry]
    assert len(times) == len(noted) - 2  # entries at the ends of stages
    assert times == sorted(times)
    ends = {entry["level"]: entry["psnr"] for entry in noted if "elapsed" not in entry}
    for level, value in ends.items():
        # Photos are 8-bit, predictions float16, and Taming's opacities archived with a limit: 0.05 dB seen.
        assert value == pytest.approx(rendered(measured, level), abs=0.1)
    assert "evaluation" in measured.manifest.record(1).overhead_seconds
