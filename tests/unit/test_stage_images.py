"""The images of a stage: predictions that are cached and dropped, or rendered in joint training."""

from __future__ import annotations

from collections.abc import Sequence
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


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_cached_predictions_are_dropped_with_their_files(where: str, tmp_path: Path) -> None:
    run = staged_run(tmp_path / "run", images_on=where)
    folder = run.archive.path(CACHE)
    folder.mkdir()  # of a run that was killed
    with run.archive, run.image_cache():
        assert not folder.exists()
        images = StageImages(run, run.plan[0], SIZES, eight_bit=False, masked=False, exact=True)
        cached = images.cache(1, "train", SIZES, lambda name: noise(level_size(SIZES[name], 1), ord(name)))
        images.predictions = images.held_out = cached
        assert folder.exists() == (where == "disk")
        assert len(cached.store) == len(SIZES)
        images.drop_predictions()
        assert images.predictions is images.held_out is None
        assert len(cached.store) == 0
        folder.mkdir(exist_ok=True)  # as of a stage that failed
    assert not folder.exists()


def test_rendered_predictions_are_up_of_the_composed_levels() -> None:
    renders = {level: noise(level_size((99, 67), level), level).requires_grad_() for level in (2, 1)}

    def render(level: int, names: Sequence[str]) -> Tensor:
        return renders[level] if len(names) == 1 else torch.stack([renders[level]] * len(names))

    pyramid = Pyramid()
    rendered = RenderedPredictions((2, 1), render, SIZES, pyramid)
    expected = pyramid.up(pyramid.up(renders[2], (34, 50)) + renders[1], (67, 99))
    assert torch.allclose(rendered.get("a"), expected, atol=1e-6)  # 2.4e-7 seen
    assert torch.allclose(rendered.get("a", "b"), torch.stack([expected] * 2), atol=1e-6)
    own = noise((99, 67), 9)
    assert torch.allclose(rendered.adder(["a"])(own), own + expected, atol=1e-6)
    weights = noise((99, 67), 7)
    gradients, wanted = (
        torch.autograd.grad((image * weights).sum(), list(renders.values())) for image in (rendered.get("a"), expected)
    )
    for gradient, other in zip(gradients, wanted, strict=True):
        assert torch.allclose(gradient, other, atol=1e-5)  # 1e-6 seen


@pytest.mark.parametrize("masked", [False, True])
def test_photos_may_be_levels_of_8_bits(masked: bool, tmp_path: Path) -> None:
    levels = (255 * noise((99, 67), 0)).round().to(torch.uint8)
    channels_last = levels.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    mask = noise((99, 67), 1)[:1] > 0.3 if masked else None
    run = staged_run(tmp_path / "run")
    with run.archive, run.image_cache():
        for stage in run.plan:
            stored = []
            for photo in (channels_last, levels / 255):
                images = StageImages(run, stage, SIZES, eight_bit=False, masked=masked, exact=True)
                images.photos.put("a", photo, mask)
                stored.append(images.photos.get("a")[0])
                images.close()
            assert torch.equal(*stored)
