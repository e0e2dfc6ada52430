"""Test `lapgs import-run` on folders in other programs' layouts: images are those of the other program."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import typer
from numpy.lib.recfunctions import append_fields
from plyfile import PlyData, PlyElement
from torch import Tensor

from lapgs_plugin.cli.evaluate import evaluate
from lapgs_plugin.cli.import_run import import_run
from lapgs_plugin.cli.render import render
from lapgs_plugin.cli.report import report
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import BARE_RECORD
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.run import run_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.images import read_image
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_scene
from tests.folders import files_in
from tests.refusals import refuses
from tests.training_scene import blob_field

app = typer.Typer()
for command, function in (("import-run", import_run), ("render", render), ("eval", evaluate), ("report", report)):
    app.command(command)(function)

FASTGS = "diff_gaussian_rasterization_fastgs"
lapgs = succeeding(app, columns=100)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), size=(57, 41))


@dataclass
class Foreign:
    """Write a folder as a 3DGS codebase or the release does; options go into cfg_args."""

    folder: Path
    scene: Path

    def options(self, **changes: Any) -> None:
        values = {
            **{"sh_degree": 0, "source_path": str(self.scene), "model_path": "output/x", "images": "images"},
            **{"resolution": -1, "white_background": False, "data_device": "cuda", "eval": True},
            **changes,
        }
        self.folder.mkdir(exist_ok=True, parents=True)
        text = ", ".join(f"{name}={value!r}" for name, value in values.items())
        (self.folder / "cfg_args").write_text(f"Namespace({text})")

    def field(self, folder: str, iteration: int, field: GaussianField) -> GaussianField:
        path = self.folder / folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        path.parent.mkdir(parents=True)
        replace(field, signed=False).save_ply(path)  # their files lack our mark
        return field

    def info(self, level: int, seconds: float, peak: int) -> None:
        (self.folder / f"L{level}" / "TRAIN_INFO").write_text(
            f"Training Time: {seconds:.2f} seconds, {seconds / 60:.2f} minutes\nGS Number: 1\nPeak GS number: {peak}\n"
            "Peak GPU allocated: 12.00 MB\n"
        )


@pytest.fixture
def foreign(tmp_path: Path, scene: Path) -> Foreign:
    output = Foreign(tmp_path / "output", scene)
    output.options()
    return output


def release_up(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Upsample as the release does: bilinear with half-pixel centres, then the blur."""
    taps = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
    kernel = torch.outer(taps, taps).expand(3, 1, 5, 5)
    larger = F.interpolate(image[None], size=size, mode="bilinear", align_corners=False)
    return F.conv2d(F.pad(larger, (2, 2, 2, 2), mode="reflect"), kernel, groups=3)[0]


def test_a_hierarchy_of_the_release_is_rendered_as_its_script_does(foreign: Foreign, tmp_path: Path) -> None:
    # Colours above 1 in the base and below -1 in the residual make the clamps visible.
    base = foreign.field("L1", 100, replace(blob_field(seed=1), sh=4 * blob_field(seed=1).sh))
    residual = replace(foreign.field("L0", 200, replace(blob_field(seed=2), sh=4 * blob_field(seed=2).sh)), signed=True)
    run = tmp_path / "run"
    lapgs("import-run", foreign.folder, "-o", run, "--backbone", "fastgs", "--set", "mult=1.0")
    lapgs("render", run, "--format", "exr")

    view = run_scene(RunArchive.open(run)).test[0]
    assert view.camera.size == (57, 41)
    cpu, black = CpuRasterizer(), torch.zeros(3)
    coarse = cpu(base, view.camera.resized(29, 21), background=black).image
    fine = cpu(residual, view.camera, background=black).image
    assert coarse.max() > 1.1
    assert fine.min() < -1.1
    expected = release_up(coarse.clamp(0, 1), (41, 57)) + fine.clamp(-1, 1)
    written = read_image(run / "renders" / "test" / "photos" / "00_composed.exr")
    np.testing.assert_allclose(written, expected, atol=1e-5)  # worst seen 8e-7


def test_filters_of_mip_splatting_are_applied(foreign: Foreign, tmp_path: Path) -> None:
    """As its render does: filters widen Gaussians, and dim them so that what they cover stays."""
    field = foreign.field("", 700, blob_field(90, seed=1))
    (path,) = foreign.folder.glob("point_cloud/*/point_cloud.ply")
    filters = np.linspace(0.0, 0.2, 90, dtype=np.float32)
    data = PlyData.read(path)["vertex"].data
    PlyData([PlyElement.describe(append_fields(data, "filter_3D", filters, usemask=False), "vertex")]).write(path)
    lapgs("import-run", foreign.folder, "-o", tmp_path / "run", "--backbone", "mip_splatting")
    imported = RunArchive.open(tmp_path / "run").field(0)
    before = field.log_scales.double().exp().square()
    after = before + torch.from_numpy(filters).double().square()[:, None]
    torch.testing.assert_close(imported.log_scales.double(), after.sqrt().log(), atol=1e-5, rtol=0)  # 1.6e-7 seen
    opacities = field.opacity_logits.double().sigmoid() * (before.prod(1) / after.prod(1)).sqrt()
    torch.testing.assert_close(imported.opacity_logits.double().sigmoid(), opacities, atol=1e-5, rtol=0)  # 2.2e-7 seen
    assert opacities[-1] < 0.9 * field.opacity_logits[-1].sigmoid()


def test_opacities_that_taming_3dgs_saves_as_they_are(foreign: Foreign, tmp_path: Path) -> None:
    """After half of its training they are absolute values, which may be above 1, and no logits."""
    stored = torch.linspace(-0.1, 1.2, 90)
    foreign.field("", 700, replace(blob_field(90, seed=1), opacity_logits=stored))
    lapgs("import-run", foreign.folder, "-o", tmp_path / "run", "--backbone", "taming")
    opacities = RunArchive.open(tmp_path / "run").field(0).opacity_logits.sigmoid()
    torch.testing.assert_close(opacities, stored.abs().clamp(max=1), atol=1e-5, rtol=0)  # 1.1e-6 seen


def test_figures_of_the_release_count_from_its_first_stage(foreign: Foreign, tmp_path: Path) -> None:
    foreign.field("L1", 100, blob_field(200, seed=1))
    foreign.field("L0", 200, blob_field(150, seed=2))
    foreign.info(1, 10.5, 260)
    foreign.info(0, 35.75, 260)  # the peak is the first stage's
    output = lapgs("import-run", foreign.folder, "--backbone", "taming")
    archive = RunArchive.open(foreign.folder / "lapgs")
    assert [record.level for record in archive.manifest.records] == [1, 0]
    assert [record.signed for record in archive.manifest.records] == [False, True]
    assert [record.train_seconds for record in archive.manifest.records] == [10.5, 25.25]
    assert [record.peak_gaussians for record in archive.manifest.records] == [260, 150]
    assert [record.image_size for record in archive.manifest.records] == [(29, 21), (57, 41)]
    assert "not recorded" not in output
    lapgs("eval", foreign.folder / "lapgs")
    lapgs("report", foreign.folder / "lapgs")
    metrics = json.loads((foreign.folder / "lapgs" / "metrics.json").read_text())
    assert metrics["train_seconds"] == 35.75
    assert metrics["rasterizer"] == "cpu" or torch.cuda.is_available()


def test_a_plain_run_is_one_level_and_its_last_field_is_taken(foreign: Foreign) -> None:
    foreign.field("", 700, blob_field(90, seed=1))
    last = foreign.field("", 3000, blob_field(120, seed=2))
    output = lapgs("import-run", foreign.folder, "--backbone", "fastgs")
    assert "training time is not recorded" in output
    archive = RunArchive.open(foreign.folder / "lapgs")
    assert archive.manifest.levels == 1
    assert archive.manifest.records[0].iterations == 3000
    assert archive.manifest.rasterizer == FASTGS
    assert archive.manifest.settings["raster"] == {"mult": 0.5}
    for name, value in archive.field(0).parameters.items():
        assert torch.equal(value, last.parameters[name])
    assert files_in(foreign.folder / "point_cloud") == {f"iteration_{i}/point_cloud.ply" for i in (700, 3000)}
    lapgs("render", foreign.folder / "lapgs")
    lapgs("report", foreign.folder / "lapgs")  # without any history

    lapgs("import-run", foreign.folder, "--backbone", "fastgs", "--iteration", 700, "--overwrite")
    assert RunArchive.open(foreign.folder / "lapgs").manifest.records[0].num_gaussians == 90


def test_opacities_that_taming_keeps_without_a_sigmoid(foreign: Foreign) -> None:
    logits = torch.linspace(-5, 5, 50)
    field = blob_field(50)
    linear = torch.sigmoid(logits) * torch.tensor([1.0, -1.0]).repeat(25).where(logits < -3, 1.0)
    foreign.field("", 30000, replace(field, opacity_logits=linear))
    lapgs("import-run", foreign.folder, "--backbone", "taming")
    read = RunArchive.open(foreign.folder / "lapgs").field(0).opacity_logits
    torch.testing.assert_close(read, logits, rtol=0, atol=1e-4)  # worst seen 5e-6
    lapgs("import-run", foreign.folder, "--backbone", "fastgs", "--overwrite")  # which has no such setting
    assert torch.equal(RunArchive.open(foreign.folder / "lapgs").field(0).opacity_logits, linear)


def test_an_interrupted_hierarchy_is_what_it_is(foreign: Foreign) -> None:
    foreign.field("L1", 100, blob_field())
    (foreign.folder / "L0").mkdir()
    lapgs("import-run", foreign.folder, "--backbone", "fastgs")
    manifest = RunArchive.open(foreign.folder / "lapgs").manifest
    assert (manifest.levels, len(manifest.records), manifest.complete) == (2, 1, False)


def test_what_the_folder_tells_of_its_codebase(foreign: Foreign) -> None:
    foreign.field("", 30, blob_field())
    with pytest.raises(
        UserInputError, match=r"does not say which backbone trained it, expected one of .*fastgs, graphdeco"
    ):
        lapgs("import-run", foreign.folder)
    (foreign.folder / "runtime_breakdown.json").write_text('{"backbone": "taming", "config": {"blur_up": true}}')
    lapgs("import-run", foreign.folder)
    assert RunArchive.open(foreign.folder / "lapgs").manifest.settings["backbone"]["name"] == "taming"
    foreign.options(depths="", train_test_exp=False)
    lapgs("import-run", foreign.folder, "--overwrite", "--set", "antialiasing=true")
    manifest = RunArchive.open(foreign.folder / "lapgs").manifest
    assert manifest.settings["backbone"]["name"] == "graphdeco"
    assert manifest.settings["raster"] == {"antialiasing": True}
    foreign.options(kernel_size=0.3)
    lapgs("import-run", foreign.folder, "--overwrite", "--backbone", "mip_splatting")
    assert RunArchive.open(foreign.folder / "lapgs").manifest.settings["raster"] == {"kernel_size": 0.3}
    lapgs("import-run", foreign.folder, "--overwrite", "--backbone", "mip_splatting", "--set", "kernel_size=0.2")
    assert RunArchive.open(foreign.folder / "lapgs").manifest.settings["raster"] == {"kernel_size": 0.2}
    foreign.options(depths="", train_test_exp=False)
    noted = {"iterations": 30, "num_gaussians": 8, "peak_gaussians": 8, "mean_gaussians": 8.0, "memory_bytes": {}}
    noted |= {"backbone": "fastgs", "train_seconds": 5.0, "saving_seconds": 0.0, "timeline": []}
    (foreign.folder / BARE_RECORD).write_text(json.dumps(noted))
    lapgs("import-run", foreign.folder, "--overwrite")
    assert RunArchive.open(foreign.folder / "lapgs").manifest.settings["backbone"]["name"] == "fastgs"
    (foreign.folder / BARE_RECORD).write_text(json.dumps({**noted, "backbone": "generic"}))
    lapgs("import-run", foreign.folder, "--overwrite")  # as `lapgs bench` does with a fork that has no adapter
    assert RunArchive.open(foreign.folder / "lapgs").manifest.settings["backbone"]["name"] == "generic"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Namespace(a=__import__('os').system('touch HERE'))", "is not readable"),
        ("dict(sh_degree=3)", "is not readable"),
        ("Namespace(**{'sh_degree': 3})", "is not readable"),
        ("Namespace(sh_degree=3", "is not readable"),
        ("Namespace(sh_degree=3)", "lacks source_path"),
        ("[" * 5000, "is not readable"),
    ],
)
def test_options_are_read_and_never_executed(foreign: Foreign, text: str, message: str) -> None:
    (foreign.folder / "cfg_args").write_text(text.replace("HERE", str(foreign.folder / "executed")))
    refuses(RunFolderError, message, lapgs, "import-run", foreign.folder)
    assert not (foreign.folder / "executed").exists()


def test_what_cannot_be_rendered_as_it_was_is_refused(foreign: Foreign, tmp_path: Path) -> None:
    def refused(message: str, *arguments: object) -> None:
        with pytest.raises((UserInputError, RunFolderError), match=message) as caught:
            lapgs("import-run", foreign.folder, "--backbone", "fastgs", *arguments)
        assert "\n" not in str(caught.value)
        assert not (foreign.folder / "lapgs").exists()

    refused("holds no point_cloud folder")
    (foreign.folder / "point_cloud").mkdir()
    refused(r"point_cloud holds no iteration_<n>/point_cloud.ply; expected")
    (foreign.folder / "point_cloud").rmdir()
    foreign.field("L0", 10, blob_field())
    (foreign.folder / "L1").mkdir()
    refused(r"holds L0, expected point_cloud/, or L<n>/point_cloud/ of the coarsest")
    foreign.field("L1", 10, blob_field())
    refused("holds fields of iterations 10, expected 7;", "--iteration", 7)
    refused("^--backbone nerf, expected one of .*fastgs", "--backbone", "nerf")
    refused(r"--set mult=big: expected NAME=NUMBER", "--set", "mult=big")
    refused(r"--set debug=True: expected one of .*, mult=NUMBER", "--set", "debug=true")
    refused(r"--set antialiasing=1.0", "--set", "antialiasing=1")
    refused("is not there; give the scene's folder with -s", "-s", tmp_path / "nowhere")
    foreign.options(white_background=True)
    refused("--white_background, which the release adds again")
    foreign.options(train_test_exp=True)
    refused("--train_test_exp")
    foreign.options()
    (foreign.folder / "runtime_breakdown.json").write_text('{"config": {"blur_up": false}}')
    refused("without --blur_up")
    (foreign.folder / "runtime_breakdown.json").unlink()
    ply = foreign.folder / "L0" / "point_cloud" / "iteration_10" / "point_cloud.ply"
    ply.write_bytes(ply.read_bytes()[:-100])
    refused("point_cloud.ply: it is cut short")
    (foreign.folder / "cfg_args").unlink()
    refused("cfg_args does not exist")


def test_a_scene_that_moved_and_a_folder_that_is_taken(foreign: Foreign, scene: Path) -> None:
    foreign.field("", 30, blob_field())
    foreign.options(source_path="/not/there/any/more")
    refuses(RunFolderError, "say where it is now with -s", lapgs, "import-run", foreign.folder, "--backbone", "fastgs")
    lapgs("import-run", foreign.folder, "--backbone", "fastgs", "-s", scene)
    with pytest.raises(RunFolderError, match="already holds a run"):
        lapgs("import-run", foreign.folder, "--backbone", "fastgs", "-s", scene)
