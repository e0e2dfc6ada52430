"""Test `lapgs export --lod`, and the formats spz4 and glb."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lapgs_plugin.errors import FieldError, UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.runs.archive import RunArchive
from tests.cli import run_folder
from tests.cli.run_folder import write_run, write_scene
from tests.cli.test_export import lapgs_export
from tests.folders import files_in
from tests.refusals import refuses
from tests.training_scene import blob_field
from tests.unit.test_gltf import attributes, read_glb
from tests.unit.test_sog import read_levels
from tests.unit.test_spz import in_our_axes, read_spz


@pytest.fixture
def nested(tmp_path: Path) -> Path:
    return write_run(tmp_path / "nested", write_scene(tmp_path / "scene"), nested=True)


def test_nested_levels_are_levels_of_detail(nested: Path) -> None:
    output = lapgs_export(nested, "--lod")
    folder = nested / "export" / "lod"
    assert re.search(r"lod-meta\.json: levels of 200, 250 Gaussians, [\d.]+ MB, streamed SOG", output)
    assert {name for name in files_in(folder) if "/" not in name} == {
        *("lod-meta.json", "level_0.spz", "level_1.spz", "level_0.glb", "level_1.glb")
    }
    meta, levels = read_levels(folder)
    assert meta["counts"] == [200, 250]
    for level in (0, 1):
        field = RunArchive.open(nested).field(level)
        spz, glb = (
            in_our_axes(read_spz(folder / f"level_{level}.spz")[0]),
            in_our_axes(read_glb(folder / f"level_{level}.glb")),
        )
        assert torch.equal(glb.means, field.means)
        torch.testing.assert_close(spz.means, field.means, atol=2e-6, rtol=0)
        streamed = torch.cat([part.means for part in levels[level]]).numpy()
        np.testing.assert_allclose(np.sort(streamed, axis=0), np.sort(field.means.numpy(), axis=0), atol=5e-4)


def test_a_run_with_residuals_has_the_merged_field_and_the_base(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
    refuses(UserInputError, "level 0 is a residual.* add --merge", lapgs_export, run, "--lod")
    assert "merged field:" in lapgs_export(run, "--lod", "--merge", "--iterations", 2)
    meta, _ = read_levels(run / "export" / "lod")
    assert meta["counts"] == [450, 250]


def antialias(run: Path) -> None:
    """Make a run one that gsplat trained with antialiasing."""
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["settings"] |= {"antialiased": True, "raster": {"antialiasing": True}}
    (run / "manifest.json").write_text(json.dumps(manifest | {"rasterizer": "gsplat"}))


def antialiased_files(folder: Path) -> list[bool]:
    """Return what the files of streamed SOG say, by level."""
    names = json.loads((folder / "lod-meta.json").read_text())["filenames"]
    return [json.loads((folder / name).read_text())["antialias"] for name in sorted(names)]


def test_files_say_that_a_run_was_trained_with_antialiasing(nested: Path, tmp_path: Path) -> None:
    lapgs_export(nested, "--lod")
    assert antialiased_files(nested / "export" / "lod") == [False, False]
    antialias(nested)
    lapgs_export(nested, "--lod")
    assert antialiased_files(nested / "export" / "lod") == [True, True]
    for file_format in ("spz", "spz4"):
        lapgs_export(nested, "--format", file_format)
        assert len(read_spz(nested / "export" / "level_0_field.spz", antialiased=True)[0]) == 200
    assert "antialiased: a viewer has to be told" in lapgs_export(nested, "--format", "ply")
    run = write_run(tmp_path / "run", write_scene(tmp_path / "other"))
    antialias(run)
    lapgs_export(run, "--lod", "--merge", "--iterations", 2)
    assert antialiased_files(run / "export" / "lod") == [False, True]  # the merged field is fitted without


def test_levels_of_detail_are_cropped(nested: Path) -> None:
    assert "training views" in lapgs_export(nested, "--lod", "--crop", "0,0,0,1")
    for level in (0, 1):
        positions = attributes(nested / "export" / "lod" / f"level_{level}.glb")["POSITION"]
        assert float(np.linalg.norm(positions, axis=1).max()) <= 1.0


def test_other_formats_of_a_level(nested: Path) -> None:
    lapgs_export(nested, "--format", "spz4", "--level", 0)
    lapgs_export(nested, "--format", "glb", "--level", 1)
    assert files_in(nested / "export") == {"level_0_field.spz", "level_1_base.glb"}
    assert (nested / "export" / "level_0_field.spz").read_bytes()[:8] == b"NGSP\4\0\0\0"
    assert len(read_glb(nested / "export" / "level_1_base.glb")) == 250


@pytest.mark.parametrize("how", ["none", "far"])
@pytest.mark.parametrize("options", [("--lod",), ("--format", "glb"), ("--format", "spz4"), ("--format", "spz")])
def test_no_level_is_written_if_the_format_cannot_hold_another(
    how: str, options: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Level 0 was pruned to nothing, or one of its Gaussians is too far away for SPZ."""

    def field(count: int, seed: int) -> GaussianField:
        blob = blob_field(count, seed)
        if count == 250:
            return blob
        return blob.kept(torch.arange(0)) if how == "none" else replace(blob, means=1e8 * blob.means)

    monkeypatch.setattr(run_folder, "blob_field", field)
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), nested=True)
    if ("glb" in options, how) == (True, "far") or (options[-1][:3], how) == ("spz", "none"):
        lapgs_export(run, *options)  # the format holds it
        assert len(files_in(run / "export")) == 2
        return
    facts = "level 0: the field has no Gaussians" if how == "none" else "level 0: a Gaussian is .* SPZ cannot hold it"
    refuses(FieldError, facts, lapgs_export, run, *options)
    assert not (run / "export").exists()


def test_mistakes(nested: Path, tmp_path: Path) -> None:
    for options in (["--format", "spz"], ["--html"], ["--level", 0]):
        refuses(UserInputError, f"{options[0]} does not go with --lod", lapgs_export, nested, "--lod", *options)
    single = write_run(tmp_path / "single", tmp_path / "scene", levels=1)
    refuses(UserInputError, "has 1 level, expected two or more for --lod", lapgs_export, single, "--lod")
    half = write_run(tmp_path / "half", tmp_path / "scene", finished=1, nested=True)
    refuses(UserInputError, "has 1 level, expected two or more for --lod", lapgs_export, half, "--lod")
    assert not any((run / "export").exists() for run in (nested, single, half))
