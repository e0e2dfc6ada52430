"""The images of a stage: predictions that are cached and dropped, or rendered in joint training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.hierarchy.plan import StagePlan, level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.runs.layout import CACHE
from lapgs_plugin.stages.images import StageImages
from lapgs_plugin.stages.joint import RenderedPredictions
from lapgs_plugin.stages.run import StagedRun
from lapgs_plugin.training.settings import TrainSettings
from tests.training_runs import make_archive

SIZES = {"a": (99, 67), "b": (99, 67)}


def staged_run(folder: Path, **options: Any) -> StagedRun:
    settings = TrainSettings(iterations=30, levels=3, sh_degree=0, **options)
    plan = StagePlan.create((99, 67), 30, 3)
    return StagedRun(settings, plan, make_archive(folder, settings), torch.device("cpu"))


def noise(size: tuple[int, int], seed: int) -> Tensor:
    return torch.rand(3, size[1], size[0], generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("place", ["memory", "disk"])
def test_cached_predictions_are_upsampled_and_dropped_with_their_files(place: str, tmp_path: Path) -> None:
    run = staged_run(tmp_path / "run", images_on=place)
    folder = run.archive.path(CACHE)
    with run.archive, run.image_cache():
        images = StageImages(run, run.plan[0], SIZES, eight_bit=False, masked=False, exact=True)
        small = {name: noise(level_size(size, 1), seed) for seed, (name, size) in enumerate(SIZES.items())}
        cached = images.cache(1, "train", SIZES, small.__getitem__)
        images.predictions = images.held_out = cached
        assert folder.exists() == (place == "disk")
        for name in SIZES:
            assert torch.allclose(cached.get(name), Pyramid().up(small[name], (67, 99)), atol=1e-6)  # 1.2e-7 seen
        images.drop_predictions()
        assert images.predictions is images.held_out is None
        assert len(cached.store) == 0
        images.close()
        if place == "disk":
            (folder / "left").write_bytes(b"of a stage that fails")
    assert not folder.exists()


def test_files_of_a_killed_run_are_removed(tmp_path: Path) -> None:
    run = staged_run(tmp_path / "run")
    folder = run.archive.path(CACHE)
    folder.mkdir()
    with run.archive, run.image_cache():
        assert not folder.exists()


def test_rendered_predictions_are_up_of_the_composed_levels(tmp_path: Path) -> None:
    """They equal cached ones of the same renders, and gradients reach every level."""
    renders = {level: noise(level_size((99, 67), level), level).requires_grad_() for level in (2, 1)}
    calls: list[tuple[int, tuple[str, ...]]] = []

    def render(level: int, names: Any) -> Tensor:
        calls.append((level, tuple(names)))
        return renders[level] if len(names) == 1 else torch.stack([renders[level]] * len(names))

    pyramid = Pyramid()
    rendered = RenderedPredictions((2, 1), render, SIZES, pyramid)
    composed = pyramid.up(renders[2], (34, 50)) + renders[1]
    expected = pyramid.up(composed, (67, 99))
    assert torch.allclose(rendered.get("a"), expected, atol=1e-6)  # 2.4e-7 seen
    assert torch.allclose(rendered.get("a", "b"), torch.stack([expected] * 2), atol=1e-6)
    own = noise((99, 67), 9)
    assert torch.allclose(rendered.adder(["a"])(own), own + expected, atol=1e-6)
    assert calls == [(2, ("a",)), (1, ("a",)), (2, ("a", "b")), (1, ("a", "b")), (2, ("a",)), (1, ("a",))]
    weights = noise((99, 67), 7)
    gradients = torch.autograd.grad((rendered.get("a") * weights).sum(), [renders[2], renders[1]])
    for gradient, wanted in zip(
        gradients, torch.autograd.grad((expected * weights).sum(), [renders[2], renders[1]]), strict=True
    ):
        assert torch.allclose(gradient, wanted, atol=1e-5)
