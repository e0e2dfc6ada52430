"""The programs of docs/python.md do what the page says."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

import lapgs_plugin as lapgs
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import render_transmittance
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.training.saved_settings import settings_from_manifest
from tests.cli.run_folder import write_run, write_scene
from tests.docs.documents import ROOT, blocks

PAGE = ROOT / "docs/python.md"
FILES = {block.title: block.text for block in blocks(PAGE) if block.title}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which the programs run, with a scene."""
    monkeypatch.chdir(tmp_path)
    return write_scene(tmp_path / "data/mine")


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene whose coarser level can be trained at a quarter of its size."""
    path = tmp_path_factory.mktemp("scenes") / "sample"
    make_sample_scene(path, width=160, height=128, views=5, points=200, progress=False)
    return path


def executed(name: str, text: str | None = None) -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": "program"}
    exec(compile(text or FILES[name], name, "exec"), names)
    return names


def test_every_program_has_a_test() -> None:
    assert FILES.keys() == {"read_a_run.py", "merge_a_run.py", "my_loop.py", "train_with_a_hook.py", "pyramids.py"}


def test_a_run_is_read(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(Path("runs/mine"), here)
    variables = executed("read_a_run.py")
    camera, images = variables["view"].camera, variables["levels"]
    up = lapgs.Pyramid().up(images.base, (camera.height, camera.width))
    torch.testing.assert_close(images.composed[0], up + images.residuals[0], rtol=0, atol=1e-5)  # 1.2e-7 seen
    torch.testing.assert_close(variables["sharper"], up + 1.5 * images.residuals[0], rtol=0, atol=1e-5)  # 1.2e-7 seen
    torch.testing.assert_close(variables["frame"], images.image.clamp(0, 1), rtol=0, atol=1e-5)  # 0 seen
    assert variables["coarse"].image.shape == images.base.shape
    assert torch.equal(GaussianField.load_ply("level_0.ply").means, variables["field"].means)
    assert capsys.readouterr().out.startswith("1 (28, 20)")


def test_a_run_is_merged(here: Path) -> None:
    write_run(Path("runs/mine"), here)
    executed("merge_a_run.py", FILES["merge_a_run.py"].replace("iterations=300", "iterations=2"))
    assert not GaussianField.load_ply("merged.ply").signed


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_the_loop_trains_and_continues(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hierarchy: str
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sample, "data/mine")
    program = executed("my_loop.py", FILES["my_loop.py"].replace("% 500", "% 2"))
    rasterize, calls = program["rasterize"], []

    def interrupted(*given: Any, **named: Any) -> Any:
        calls.append(given)
        if len(calls) == 16 + 10:  # in the second stage, after predictions of the four training views
            raise KeyboardInterrupt
        return rasterize(*given, **named)

    program["rasterize"] = interrupted
    with pytest.raises(KeyboardInterrupt):
        program["main"]("runs/mine", hierarchy, 32)
    assert lapgs.RunArchive.open("runs/mine").available_levels == (1,)
    assert Path("runs/mine/checkpoint.pt").exists()
    program["main"]("runs/mine", hierarchy, 32, resume=True)
    run = lapgs.RunArchive.open("runs/mine")
    assert run.manifest.complete
    assert run.field(0).signed == (hierarchy == "laplacian")
    assert not Path("runs/mine/checkpoint.pt").exists()
    view = lapgs.run_scene(run).train[0]
    with torch.no_grad():  # what the loop trained is what the run renders; worst seen 3e-7
        trained = program["render"](run.field(0), view)
    torch.testing.assert_close(lapgs.run_renderer(run).render(view.camera).image, trained, rtol=0, atol=1e-5)
    with pytest.raises(RunFolderError, match="not started by `lapgs train`"):
        settings_from_manifest(run.manifest)


def test_the_trainer_takes_a_hook_with_an_argument(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sample, "data/mine")
    program = executed("train_with_a_hook.py")
    for weight in (0.0, 9.0):
        program["main"](f"runs/{weight:g}", weight, iterations=40, sh_degree=0, appearance="none")
    without, filled = (lapgs.RunArchive.open(f"runs/{weight}") for weight in (0, 9))
    assert settings_from_manifest(filled.manifest).iterations == 40
    camera = lapgs.level_camera(lapgs.run_scene(filled).train[0].camera, 1)
    opacities = [1.0 - render_transmittance(lapgs.CpuRasterizer(), run.field(1), camera) for run in (without, filled)]
    assert opacities[1].mean() > opacities[0].mean() + 0.01  # 0.023 seen


def test_pyramids_are_used_alone() -> None:
    variables = executed("pyramids.py")
    torch.testing.assert_close(variables["composed"], variables["image"], rtol=0, atol=1e-5)
    expected = variables["image"] + variables["residual"]
    torch.testing.assert_close(variables["sharper"], expected, rtol=0, atol=1e-5)  # 2.4e-7 seen
    assert variables["coarse"].shape == variables["base"].shape == (3, 267, 532)


def test_names_on_the_page_are_names_of_the_package() -> None:
    text = PAGE.read_text(encoding="utf-8")
    table = text[text.index("| piece | for |") : text.index("This loop trains")]
    named = {name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)", row)}
    named |= set(re.findall(r"lapgs\.(\w+)", text))
    assert len(named) > 20
    assert named <= set(lapgs.__all__) & set(dir(lapgs))
    for piece, method in re.findall(r"`([A-Z]\w+)\.([a-z]\w+)", text):
        assert hasattr(getattr(lapgs, piece), method)
    for method in ("put", "prefetch", "get"):
        assert hasattr(lapgs.ImageStore, method)
