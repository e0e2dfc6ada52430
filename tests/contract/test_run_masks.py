"""Masks under `lapgs run`: what they hide changes no bit of a checkout's training."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lapgs_plugin.errors import SceneError, UserInputError
from tests.contract.stub_runs import STUBS, captured, drive, edited_graphdeco, loaded, run_hierarchy

SHORT = ("--iterations", 18, "--densify_from_iter", 3, "--densification_interval", 3, "--densify_until_iter", 12)


def _hide(scene: Path, copy: Path, seed: int) -> Path:
    """Copy a scene, with masks and with noise in what they hide."""
    shutil.copytree(scene, copy)
    random = np.random.default_rng(seed)
    (copy / "masks").mkdir()
    for file in sorted((copy / "images").iterdir()):
        image = cv2.imread(str(file))
        mask = np.full(image.shape[:2], 255, np.uint8)
        cv2.circle(mask, (20, 20), 13, 0, -1)
        image[mask == 0] = random.integers(0, 256, (int((mask == 0).sum()), 3))
        cv2.imwrite(str(file), image)
        cv2.imwrite(str(copy / "masks" / f"{file.name if seed else file.stem}.png"), mask)  # two of the spellings
    return copy


@pytest.mark.parametrize(("name", "hierarchy"), [("fastgs", "laplacian"), ("graphdeco", "nested")])
def test_what_masks_hide_changes_no_bit(name: str, hierarchy: str, scene: Path, tmp_path: Path) -> None:
    fields = []
    for seed in (0, 1):
        hidden, run = _hide(scene, tmp_path / f"scene_{seed}", seed), tmp_path / f"run_{seed}"
        archive, _ = run_hierarchy(STUBS[name], hidden, run, *SHORT, hierarchy=hierarchy)
        assert archive.manifest.scene.masks == "masks"
        fields.append(archive.field(0))
    assert torch.equal(fields[0].means, fields[1].means)
    assert torch.equal(fields[0].sh, fields[1].sh)
    if hierarchy == "laplacian":
        return
    whole_run = tmp_path / "whole"
    archive, _ = run_hierarchy(STUBS[name], tmp_path / "scene_0", whole_run, *SHORT, hierarchy=hierarchy, masks="none")
    whole = archive.field(0)
    assert len(whole) != len(fields[0]) or not torch.equal(whole.means, fields[0].means)


def test_masks_that_do_not_fit_end_before_anything_is_written(scene: Path, tmp_path: Path) -> None:
    copy, run = _hide(scene, tmp_path / "scene", 0), tmp_path / "run"
    next((copy / "masks").iterdir()).unlink()
    for kind, message, masks in (
        (SceneError, "1 of 12 photos have no mask", "auto"),
        (UserInputError, "--masks alpha: the checkout decides", "alpha"),
    ):
        with pytest.raises(kind, match=message):
            run_hierarchy(STUBS["graphdeco"], copy, run, *SHORT, masks=masks)
        assert not run.exists()


def test_a_map_that_is_rasterized_before_the_image_gets_no_photo(scene: Path, tmp_path: Path) -> None:
    """Not in the first iteration either, without a dry run."""
    call = "    rendered_image, radii, depth_"
    grey = """\
    red, green, _ = rasterizer(
        means3D=pc.get_xyz,
        means2D=screenspace_points,
        opacities=pc.get_opacity,
        colors_precomp=torch.ones_like(pc.get_xyz),
        scales=pc.get_scaling,
        rotations=pc.get_rotation,
    )[0]
    assert torch.equal(red, green)
"""
    script = edited_graphdeco(tmp_path / "c", "gaussian_renderer/__init__.py", call, grey + call)
    hidden = _hide(scene, tmp_path / "scene", 0)
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], hidden, tmp_path / "run", *SHORT, script=script) as adapter:
        drive(adapter, levels=1)
