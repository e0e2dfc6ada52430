"""Drive a checkout with the backbone, the hook and the supervision of an installed package."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path

import pytest

from lapgs_plugin.adapters.registry import adapter_class, known_extensions
from lapgs_plugin.cli.doctor import current_folder
from lapgs_plugin.runs.archive import RunArchive
from tests.contract.stub_runs import CHECKOUTS, Stub, captured, drive_residuals, loaded
from tests.plugin_package import install_package

ENTRIES = """\
[lapgs_plugin.backbones]
tiny = tiny_backbone:TinyAdapter
[lapgs_plugin.hooks]
counting = tiny_backbone:Counting
[lapgs_plugin.supervisions]
photo = tiny_backbone:PHOTO
"""
SOURCE = """\
from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.hierarchy.supervision import Reconstructed
from lapgs_plugin.hooks import StageHook

PHOTO = Reconstructed()
STAGES = []


class Counting(StageHook):
    def on_stage_end(self, stage):
        STAGES.append(stage.level)


class TinyAdapter(BackboneAdapter):
    info = BackboneInfo(
        name="tiny",
        title="TinyGS",
        rasterizer="diff_gaussian_rasterization",
        stand_in="graphdeco-aa",
        own_files=("utils/tiny_utils.py",),
    )

    def render(self, call, view, gaussians, background):
        self.train.render(view, gaussians, call.pipe, background, separate_sh=False, use_trained_exp=False)

    def raster_settings(self, call):
        return {"antialiasing": call.pipe.antialiasing}

    def level_view(self, view, original, size, signed):
        view.alpha_mask = None
"""


def test_a_packages_backbone_drives_its_checkout(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(CHECKOUTS / "shared", tmp_path / "shared")
    checkout = Path(shutil.copytree(CHECKOUTS / "graphdeco", tmp_path / "checkout"))
    assert adapter_class(checkout).info.name == "graphdeco"
    (checkout / "utils" / "tiny_utils.py").touch()
    install_package(tmp_path / "site", monkeypatch, "tiny_backbone", ENTRIES, SOURCE)
    assert adapter_class(checkout).info.title == "TinyGS"
    assert adapter_class(CHECKOUTS / "graphdeco").info.name == "graphdeco", "others are recognised as before"
    assert "a checkout of TinyGS or a fork of it" in current_folder(checkout, has_gpu=False).detail
    assert known_extensions()["diff_gaussian_rasterization"].endswith("TinyGS")

    plys = {}
    for name, place, options in (
        ("tiny", checkout, {"supervision": "photo"}),
        ("graphdeco", CHECKOUTS / "graphdeco", {}),
    ):
        folder, stub = tmp_path / name, Stub(name, "graphdeco-aa", ("--disable_viewer",))
        with captured(folder, []), loaded(stub, scene, folder, script=place / "train.py") as adapter:
            drive_residuals(adapter, **options)
        archive = RunArchive.open(folder)
        assert archive.manifest.complete
        assert archive.manifest.settings["backbone"]["name"] == name
        plys[name] = archive.field_path(1).read_bytes()
    assert plys["tiny"] == plys["graphdeco"], "the same code, driven by another adapter"
    assert RunArchive.open(tmp_path / "tiny").manifest.supervision == "photo"
    assert importlib.import_module("tiny_backbone").STAGES == [1, 0, 1, 0]
