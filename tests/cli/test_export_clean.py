"""Test `lapgs export --clean` and `--crop`: the files, the printed figures, the refusals."""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
import torch

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.evaluation import cleaning
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rasterizers.choice import PlacedRasterizer, is_antialiased, rasterizer_for
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest
from tests.cli import run_folder
from tests.cli.run_folder import BACKGROUND, write_run, write_scene
from tests.cli.test_export import lapgs_export
from tests.cli.test_export_lod import antialias
from tests.folders import files_in
from tests.refusals import refuses
from tests.training_scene import blob_field, ring_camera

LINE = r"removed (?:([\d,]+) floaters?)?(?: and )?(?:([\d,]+) outside)? of (\d+) Gaussians; PSNR of 8 training views "
LINE += r"([\d.]+) dB before, ([\d.]+) dB after"


def lines(output: str) -> dict[str, tuple[str, ...]]:
    return {name: tuple(figures) for name, *figures in re.findall(rf"^(level \d|merged field): {LINE}$", output, re.M)}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", write_scene(tmp_path / "scene"))


@pytest.fixture
def nested(tmp_path: Path) -> Path:
    return write_run(tmp_path / "nested", write_scene(tmp_path / "scene"), nested=True)


def test_a_cropped_level_has_the_gaussians_inside(nested: Path, tmp_path: Path) -> None:
    output = lapgs_export(nested, "--crop", "0,0,0,1.2")
    assert files_in(nested / "export") == {"level_1_base.ply", "level_0_field.ply"}
    for level, name in ((1, "level_1_base"), (0, "level_0_field")):
        field = RunArchive.open(nested).field(level)
        inside = np.linalg.norm(field.means.numpy(), axis=1) <= 1.2
        cropped = GaussianField.load_ply(nested / "export" / f"{name}.ply")
        np.testing.assert_array_equal(cropped.means.numpy(), field.means.numpy()[inside])
        np.testing.assert_array_equal(cropped.sh.numpy(), field.sh.numpy()[inside])
        _, outside, count, _, _ = lines(output)[f"level {level}"]
        assert (int(outside), int(count)) == (int((~inside).sum()), len(field))


def test_the_printed_psnr_is_that_of_the_training_views(nested: Path) -> None:
    output = lapgs_export(nested, "--crop", "-1,-1,-1,1,1,1", "--level", 0)
    assert files_in(nested / "export") == {"level_0_field.ply"}
    cropped = GaussianField.load_ply(nested / "export" / "level_0_field.ply")
    scene = run_scene(RunArchive.open(nested))
    assert len(scene.train) == 8
    *_, before, after = lines(output)["level 0"]
    for printed, field in ((before, RunArchive.open(nested).field(0)), (after, cropped)):
        with torch.no_grad():
            images = [
                CpuRasterizer()(field, view.camera, background=torch.tensor(BACKGROUND)).image for view in scene.train
            ]
        expected = fmean(psnr(image, view.image) for image, view in zip(images, scene.train, strict=True))
        assert float(printed) == pytest.approx(expected, abs=0.0051)  # two decimals are printed


def test_residuals_are_measured_composed(run: Path) -> None:
    output = lapgs_export(run, "--clean")
    assert lines(output).keys() == {"level 1", "level 0"}
    scene, renderer = run_scene(RunArchive.open(run)), run_renderer(RunArchive.open(run))
    expected = fmean(psnr(renderer.images([view.camera], 0)[0], view.image) for view in scene.train)
    floaters, outside, count, before, _ = lines(output)["level 0"]
    assert (outside, count) == ("", "200")
    assert float(before) == pytest.approx(expected, abs=0.0051)
    assert len(GaussianField.load_ply(run / "export" / "level_0_residual.ply")) == 200 - int(floaters)


def test_the_merged_field_and_its_page_are_cleaned(run: Path) -> None:
    output = lapgs_export(run, "--merge", "--iterations", 2, "--clean", "--crop", "0,0,0,1")
    assert lines(output).keys() == {"merged field"}
    merged = GaussianField.load_ply(run / "export" / "merged.ply")
    assert float(merged.means.norm(dim=1).max()) <= 1.0
    floaters, outside, count, *_ = lines(output)["merged field"]
    assert int(count) == 450
    assert len(merged) == 450 - int(floaters) - int(outside)


def test_the_merged_field_is_measured_as_it_is_fitted_without_antialiasing(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a CPU nothing renders with antialiasing, so the test looks at what is asked for."""
    asked: list[bool] = []

    def choose(manifest: Manifest) -> PlacedRasterizer:
        asked.append(is_antialiased(manifest))
        return rasterizer_for(manifest)

    monkeypatch.setattr(cleaning, "rasterizer_for", choose)
    antialias(run)
    lapgs_export(run, "--clean")
    lapgs_export(run, "--merge", "--iterations", 1, "--clean")
    assert asked == [True, False]


def test_a_page_of_a_cropped_level(nested: Path, tmp_path: Path) -> None:
    assert "level 0" in lines(lapgs_export(nested, "--html", "--out", tmp_path / "all", "--crop", "0,0,0,9"))
    lapgs_export(nested, "--html", "--out", tmp_path / "some", "--crop", "0,0,0,0.8")
    sizes = [(tmp_path / name / "scene.html").stat().st_size for name in ("some", "all")]
    assert sizes[0] < sizes[1]


def test_an_unfinished_run_is_cleaned_as_far_as_it_is(tmp_path: Path) -> None:
    run = write_run(tmp_path / "half", write_scene(tmp_path / "scene"), finished=1)
    assert lines(lapgs_export(run, "--crop", "0,0,0,1")).keys() == {"level 1"}


def dense_or_floating(count: int, seed: int) -> GaussianField:
    """An opaque ball as the base, of 250 Gaussians; as the residual, ten specks before the second camera alone."""
    field = blob_field(count, seed)
    if count == 250:
        return replace(field, log_scales=torch.full((count, 3), -0.5), opacity_logits=torch.full((count,), 6.0))
    before_camera = 0.9 * ring_camera(2 * math.pi / 10).position
    few = replace(field, means=before_camera + 0.02 * field.means, log_scales=torch.full((count, 3), -2.5))
    return replace(few, opacity_logits=torch.full((count,), -3.0)).kept(torch.arange(10))  # none hides another


@pytest.mark.parametrize("crop", [(), ("--crop", "0,0,0,20")])
@pytest.mark.parametrize("how", [(), ("--level", 0), ("--format", "glb")])
def test_a_level_of_nothing_but_floaters_is_refused(
    crop: tuple[str, ...], how: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_folder, "blob_field", dense_or_floating)
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
    inside = " inside of --crop 0,0,0,20" if crop else ""
    facts = f"--clean: all 10 Gaussians of level 0{inside} are floaters, expected some that are not; .* without"
    refuses(UserInputError, facts, lapgs_export, run, "--clean", *crop, *how)
    assert not (run / "export").exists()
    lapgs_export(run, "--clean", "--level", 1)
    assert files_in(run / "export") == {"level_1_base.ply"}


def test_mistakes(run: Path, tmp_path: Path) -> None:
    nothing = refuses(
        UserInputError, "--crop 50,50,50,1: none of the 250 .* level 1", lapgs_export, run, "--crop", "50,50,50,1"
    )
    assert "most are in the box" in nothing
    refuses(UserInputError, "--crop 1,2: expected six numbers", lapgs_export, run, "--crop", "1,2")
    assert not (run / "export").exists()
    refuses(UserInputError, "--scene needs --merge, --html, --clean or --crop", lapgs_export, run, "--scene", tmp_path)
    moved = tmp_path / "moved"
    shutil.move(tmp_path / "scene", moved)
    refuses(RunFolderError, "say where it is now with --scene", lapgs_export, run, "--clean")
    assert "level 0" in lines(lapgs_export(run, "--clean", "--scene", moved))
