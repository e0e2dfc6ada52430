"""`lapgs export --merge`: an ordinary field that shows about what a run with residuals composes."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError, UserInputError
from lapgs_plugin.evaluation.metrics import color_fitted_psnr, psnr
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.interrupt import StopRequest
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.run import run_cameras, run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import EXPOSURE
from lapgs_plugin.training import merge, stage_start, trainer
from lapgs_plugin.training.merge import FAINT, first_field, merge_levels
from lapgs_plugin.training.prepared_run import PreparedRun
from tests.cli.run_folder import BACKGROUND, write_run, write_scene
from tests.cli.test_export import lapgs_export
from tests.folders import files_in
from tests.refusals import refuses


def _kept(run: Path, field: GaussianField) -> float:
    """Mean PSNR of a field against the run's composed images of the held-out views."""
    renderer, cameras = run_renderer(RunArchive.open(run)), run_cameras(RunArchive.open(run))[1].values()
    background, values = torch.tensor(BACKGROUND), []
    with torch.no_grad():
        for camera in cameras:
            image = CpuRasterizer()(field, camera, background=background).image
            values.append(psnr(image, renderer.render(camera).composed[0].clamp(0, 1)))
    return fmean(values)


def test_the_merged_field_keeps_most_of_the_image(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
    output = lapgs_export(run, "--merge", "--iterations", 60)
    assert files_in(run / "export") == {"merged.ply"}
    merged = GaussianField.load_ply(run / "export" / "merged.ply")
    assert not merged.signed
    kept, views, photo, before = re.findall(
        r"([0-9.]+) dB PSNR .* of (\d+) views .* photos ([0-9.]+) dB, where the run has ([0-9.]+)", output
    )[0]
    assert int(views) == 2
    assert float(kept) == pytest.approx(_kept(run, merged), abs=0.01)  # 0.0014 seen
    archive = RunArchive.open(run)
    started = _kept(run, first_field({level: archive.field(level) for level in (1, 0)}))
    assert float(kept) > started + 2  # seen 3.1
    assert float(photo) == pytest.approx(float(before), abs=0.5)  # seen 0.02


def test_a_run_that_compensates_exposure_is_compared_with_photos_after_a_colour_fit(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    run = write_run(tmp_path / "run", scene)
    identity = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    (run / "level_0" / EXPOSURE).write_text(json.dumps({"0.png": identity}))
    output = lapgs_export(run, "--merge", "--iterations", 2)
    (before,) = re.findall(r"where the run has ([0-9.]+), both after a colour fit", output)
    archive = RunArchive.open(run)
    renderer, photos = run_renderer(archive), run_scene(archive).test
    fitted = [color_fitted_psnr(renderer.images([view.camera], 0)[0].cpu(), view.image) for view in photos]
    assert float(before) == pytest.approx(fmean(fitted), abs=0.01)  # 3.8e-4 seen


def test_an_antialiased_run_is_merged_without_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only gsplat trains antialiased; the CPU rasterizer renders such a run and fits the field."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["settings"] |= {"antialiased": True, "raster": {"antialiasing": True}}
    (run / "manifest.json").write_text(json.dumps(manifest | {"rasterizer": "gsplat"}))
    assert "dB PSNR" in lapgs_export(run, "--merge", "--iterations", 2)


def test_a_long_merge_edits_the_field_as_little_as_a_short_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its opacities and sizes are right already, and nothing is to shake the positions."""
    settled = []

    def capture(run: PreparedRun, **_: Any) -> None:
        settled.append(run.settings.densification.options)
        raise UserInputError("far enough")

    monkeypatch.setattr(merge, "Trainer", capture)
    archive = RunArchive.open(write_run(tmp_path / "run", write_scene(tmp_path / "scene")))
    for iterations in (3_000, 30_000):
        refuses(UserInputError, "far enough", merge.merge_levels, archive, iterations=iterations)
    assert settled[0] == settled[1]
    assert (settled[0].opacity_weight, settled[0].scale_weight) == (0.0, 0.0)


def test_the_first_field_has_base_and_refined_residuals(tmp_path: Path) -> None:
    archive = RunArchive.open(write_run(tmp_path / "run", write_scene(tmp_path / "scene")))
    base, residual = archive.field(1), archive.field(0)
    field = first_field({1: base, 0: residual})
    assert not field.signed
    assert torch.equal(field.means, torch.cat([base.means, residual.means]))
    assert torch.equal(field.sh[: len(base)], base.sh)
    nearest = cdist(residual.means.numpy(), base.means.numpy()).argmin(axis=1)
    expected = base.sh.numpy()[nearest] + residual.sh.numpy()
    assert np.array_equal(field.sh[len(base) :].numpy(), expected)
    opacities = torch.sigmoid(field.opacity_logits[len(base) :])
    assert torch.allclose(opacities, FAINT * torch.sigmoid(residual.opacity_logits), atol=1e-5)


def test_a_page_of_a_run_with_residuals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), hold_out=False)
    # Renders that differ in brightness are what the field shall show: they are not compensated.
    monkeypatch.setattr(stage_start, "measure_exposure", lambda _: pytest.fail("exposure was measured"))
    output = lapgs_export(run, "--merge", "--html", "--iterations", 4)
    assert "of 2 views that it was not fitted to" in output
    assert "photos" not in output, "none are held out"
    assert files_in(run / "export") == {"scene.html"}


def test_a_fit_that_is_stopped_offers_no_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is in a temporary folder, and the command has no --resume."""
    request = StopRequest()
    request.requested = True
    monkeypatch.setattr(trainer, "stop_request", lambda: nullcontext(request))
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
    with pytest.raises(TrainingStoppedError, match="nothing is written; repeat the command") as stopped:
        lapgs_export(run, "--merge", "--out", tmp_path / "out")
    assert "--resume" not in str(stopped.value)
    assert not (tmp_path / "out").exists()


def test_runs_that_cannot_be_merged_are_one_line(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    nested = write_run(tmp_path / "nested", scene, nested=True)
    with pytest.raises(UserInputError, match="level 0 is an ordinary field already, which needs no --merge"):
        lapgs_export(nested, "--merge")
    refuses(UserInputError, "--iterations needs --merge", lapgs_export, nested, "--iterations", 10)
    refuses(UserInputError, "--level does not go with --merge", lapgs_export, nested, "--merge", "--level", 0)
    assert not (nested / "export").exists()
    with pytest.raises(RunFolderError, match="level 0 is not in this run"):
        lapgs_export(write_run(tmp_path / "half", scene, finished=1), "--merge")
    archive = RunArchive.open(write_run(tmp_path / "empty", scene))
    fields = {1: archive.field(1).kept(torch.zeros(250, dtype=torch.bool)), 0: archive.field(0)}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(RunArchive, "field", lambda self, level: fields[level])
        refuses(UserInputError, "level 1 has no Gaussians, expected some for --merge", merge_levels, archive)
