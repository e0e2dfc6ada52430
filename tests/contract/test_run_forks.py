"""Forks of 3DGS train what `lapgs run` says: each level's images, composed residuals, the Gaussians in the archive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from lapgs_plugin.adapters.registry import recognise
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from tests.contract.stub_runs import CHECKOUTS, FORKS, KINDS, THIRDS, captured, drive, loaded

NAMES = tuple(FORKS)


@dataclass
class Seen:
    """Hold what the training loop of a fork did.

    Attributes:
        losses: iteration, render and target of each call of the loss.
        counts: iteration and number of Gaussians at the start of each iteration, in order.
        pruned: iterations in which Gaussians were pruned by scores.
        made_anew: iterations in which the Gaussians were replaced by points.
        schedulers: budgets and numbers of Gaussians at the start of DashGaussian's schedulers.
    """

    losses: list[tuple[int, Tensor, Tensor]] = field(default_factory=list)
    counts: list[tuple[int, int]] = field(default_factory=list)
    pruned: list[int] = field(default_factory=list)
    made_anew: list[int] = field(default_factory=list)
    schedulers: list[tuple[int, int]] = field(default_factory=list)

    @property
    def now(self) -> int:
        return len(self.counts)


def watch(adapter: Any, seen: Seen) -> None:
    """Look at the calls of a fork below everything that `lapgs run` replaces."""
    train, model = adapter.train, adapter.profile.model
    loss, update = train.l1_loss, model.update_learning_rate

    def l1_loss(image: Tensor, target: Tensor) -> Tensor:
        seen.losses.append((seen.now, image.detach().clone(), target.detach().clone()))
        return loss(image, target)

    def update_learning_rate(self: Any, iteration: int) -> Any:
        seen.counts.append((iteration, len(self._xyz)))
        return update(self, iteration)

    def noting(owner: Any, name: str, notes: list[int]) -> None:
        original: Callable[..., Any] = getattr(owner, name)

        @wraps(original)
        def method(*args: Any, **kwargs: Any) -> Any:
            notes.append(seen.now)
            return original(*args, **kwargs)

        setattr(owner, name, method)

    train.l1_loss, model.update_learning_rate = l1_loss, update_learning_rate
    if hasattr(model, "prune_gaussians"):
        noting(model, "prune_gaussians", seen.pruned)
    if hasattr(model, "reinitial_pts"):
        noting(model, "reinitial_pts", seen.made_anew)


@pytest.fixture(scope="module")
def run_of(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], tuple[RunArchive, Seen]]:
    """Return a function that trains a fork once, with two levels of 30 and 60 iterations."""
    done: dict[tuple[str, str], tuple[RunArchive, Seen]] = {}

    def run(name: str, kind: str) -> tuple[RunArchive, Seen]:
        if (name, kind) not in done:
            folder, seen = tmp_path_factory.mktemp(f"{name}-{kind}") / "run", Seen()
            with captured(folder, []), loaded(FORKS[name], scene, folder) as adapter:
                watch(adapter, seen)
                drive(adapter, hierarchy=kind, joint=0.0, **THIRDS)
            seen.losses = [entry for entry in seen.losses if entry[0] > seen.now - 90]
            done[name, kind] = RunArchive.open(folder), seen
        return done[name, kind]

    return run


@pytest.mark.parametrize("name", NAMES)
def test_a_fork_is_recognised(name: str) -> None:
    adapter = recognise(CHECKOUTS / name)
    assert adapter is not None
    assert adapter.info.name.startswith(name)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_the_images_of_each_level_reach_the_loss(
    name: str, kind: str, run_of: Callable[[str, str], tuple[RunArchive, Seen]]
) -> None:
    archive, seen = run_of(name, kind)
    assert [record.image_size for record in archive.manifest.records] == [(32, 24), (64, 48)]
    base, finest = seen.losses[:30], seen.losses[30:]
    assert len(finest) == 60
    assert all(image.shape == target.shape for _, image, target in seen.losses)
    photos = [view.image for view in run_scene(archive).train]
    # In one call DashGaussian's own schedule holds, which halves all images until iteration 40.
    whole = finest[11:] if (name, kind) == ("dash", "nested") else finest
    assert {target.shape[1:] for _, _, target in whole} == {(48, 64)}
    for _, _, target in whole[:3]:
        assert min(float((target - photo).abs().max()) for photo in photos) < 1e-6
    # DashGaussian shrinks the images of the base further.
    assert max(target.shape[2] for _, _, target in base) == 32
    small = [Pyramid("camera").down(photo) for photo in photos]
    for _, _, target in [entry for entry in base if entry[2].shape[2] == 32][:3]:
        assert min(float((target - photo).abs().max()) for photo in small) < 1 / 255  # 8 bits


@pytest.mark.parametrize("name", NAMES)
def test_a_residual_is_composed_before_the_loss(
    name: str, run_of: Callable[[str, str], tuple[RunArchive, Seen]]
) -> None:
    """In its first iteration a residual has no colour: the image is the base's prediction, rendered here by itself."""
    archive, seen = run_of(name, "laplacian")
    assert [record.signed for record in archive.manifest.records] == [False, True]
    _, image, target = seen.losses[30]
    renderer = run_renderer(archive, device="cpu", rasterizer="cpu")
    views = run_scene(archive).train
    view = min(views, key=lambda each: float((each.image - target).abs().max()))
    prediction = Pyramid("camera").up(renderer.render(view.camera).composed[1], (48, 64))
    assert float((image - prediction).abs().max()) < 0.02  # 8 bits of cached predictions
    assert float((image - image.mean()).abs().max()) > 0.1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_the_archived_gaussians_are_those_of_the_last_iteration(
    name: str, kind: str, run_of: Callable[[str, str], tuple[RunArchive, Seen]]
) -> None:
    archive, seen = run_of(name, kind)
    counts = seen.counts[-90:]
    last = {1: counts[29][1], 0: counts[89][1]}
    if kind == "nested":
        last[1] = counts[30][1]  # one call: what the base's last iteration changed is the next one's start
    for record in archive.manifest.records:
        assert record.num_gaussians == len(archive.field(record.level)) == last[record.level]
