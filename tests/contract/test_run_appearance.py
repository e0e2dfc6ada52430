"""`--appearance` under `lapgs run`: what a checkout learns of photos whose exposure differs."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.ops.bilateral_grid import uniform_grids
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.stages.appearance import identities
from tests.contract.stub_runs import KINDS, STUBS, Seeded, StopAt, run_hierarchy

LONGER = ("--iterations", 300)
FEW = ("--iterations", 45)


@pytest.fixture(scope="module")
def changing(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the sample scene with every second photo darker by a third."""
    path = tmp_path_factory.mktemp("changing") / "scene"
    shutil.copytree(scene, path)
    for file in sorted((path / "images").iterdir())[::2]:
        cv2.imwrite(str(file), (cv2.imread(str(file)) * (2 / 3)).round().astype(np.uint8))
    return path


@pytest.mark.parametrize("hierarchy", KINDS)
@pytest.mark.parametrize("choice", ["affine", "bilateral"])
def test_gains_of_photos_are_learned_at_every_level(
    choice: str, hierarchy: str, changing: Path, tmp_path: Path
) -> None:
    archive, _ = run_hierarchy(
        STUBS["graphdeco"], changing, tmp_path / "run", *LONGER, hierarchy=hierarchy, appearance=choice
    )
    dark = {file.stem for file in sorted((changing / "images").iterdir())[::2]}
    means = {}
    for level in (1, 0):
        learned = archive.exposure(level)
        assert learned is not None
        assert len(learned) == 10  # the training views
        gains = {Path(name).stem: np.diagonal(np.array(rows)[:, :3]).mean() for name, rows in learned.items()}
        means[level] = [np.mean([gains[n] for n in gains if (n in dark) == is_dark]) for is_dark in (True, False)]
        assert means[level][0] < means[level][1] - (0.05 if choice == "affine" else 0.005), (
            means
        )  # least seen: 0.15, 0.015
        assert (archive.grids(level) is None) == (choice == "affine")
    assert means[0][1] - means[0][0] > means[1][1] - means[1][0]  # the finer level goes on from the coarser one's


def test_grids_are_not_those_of_the_identity_and_a_stopped_run_continues_with_them(
    changing: Path, tmp_path: Path
) -> None:
    options = {"hierarchy": "laplacian", "appearance": "bilateral"}
    whole, _ = run_hierarchy(STUBS["graphdeco"], changing, tmp_path / "whole", *FEW, hooks=(Seeded(),), **options)
    stopped = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run_hierarchy(STUBS["graphdeco"], changing, stopped, *FEW, hooks=(Seeded(), StopAt(0)), **options)
    again, _ = run_hierarchy(STUBS["graphdeco"], changing, stopped, *FEW, hooks=(Seeded(),), resume=True, **options)
    mine, theirs = whole.grids(0), again.grids(0)
    assert mine is not None
    assert theirs is not None
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(grid, theirs[name]) for name, grid in mine.items())
    assert torch.equal(whole.field(0).sh, again.field(0).sh)
    (unchanged,) = uniform_grids(identities(1), (4, 4, 8))
    assert any((grid - unchanged).abs().max() > 1e-4 for grid in mine.values())


@pytest.mark.parametrize("name", ["fastgs", "taming"])
def test_checkouts_that_score_views_learn_appearance_too(name: str, changing: Path, tmp_path: Path) -> None:
    archive, result = run_hierarchy(
        STUBS[name], changing, tmp_path / "run", *FEW, hierarchy="nested", appearance="affine"
    )
    assert archive.exposure(0) is not None
    assert all(0 < loss < 1 for loss in result.losses)


def test_appearance_beside_exposures_of_the_checkout_is_refused(changing: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="--appearance affine with --train_test_exp: both learn"):
        run_hierarchy(STUBS["graphdeco"], changing, tmp_path / "run", *FEW, "--train_test_exp", appearance="affine")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"appearance": "auto"}, "--appearance auto: expected none, affine or bilateral"),
        (
            {"appearance": "affine", "hierarchy": "laplacian", "supervision": "gt_laplacian"},
            "--appearance affine with --supervision gt_laplacian",
        ),
        ({"appearance": "affine", "protocol": "paper"}, "--appearance affine with --protocol paper"),
    ],
)
def test_contradicting_choices_are_refused(given: dict[str, str], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        RunSettings(**given)  # type: ignore[arg-type]
