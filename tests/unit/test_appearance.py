"""Bilateral grids: slicing, their optimization, and runs with `--appearance bilateral`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError
from lapgs_plugin.evaluation.metrics import fit_colors, psnr
from lapgs_plugin.ops.bilateral_grid import add_variation, slice_grids, uniform_grids
from lapgs_plugin.ops.bilateral_grid.in_torch import total_variation
from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.ops.mixed_sizes import own_part, stack_padded
from lapgs_plugin.rendering.run import run_renderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import GRIDS
from lapgs_plugin.runs.tensors import write_tensors
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.stages.appearance import FIRST_RATE, LAST_RATE, ViewAppearance, ViewColors, ViewGrids, identities
from lapgs_plugin.training.settings import TrainSettings
from tests.training_runs import StopAt, resume, train
from tests.training_scene import panned_scene, ring_scene

SHORT = TrainSettings(iterations=60, appearance="bilateral", sh_degree=0)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def sliced_by_loops(image: NDArray[np.float64], grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slice a grid (y, x, l, 12) for an image (3, h, w) one pixel and node at a time."""
    _, height, width = image.shape
    *nodes, _ = grid.shape
    out = np.zeros_like(image)
    for row in range(height):
        for column in range(width):
            pixel = image[:, row, column]
            bright = 0.299 * pixel[0] + 0.587 * pixel[1] + 0.114 * pixel[2]
            places = [
                min(max(share, 0.0), 1.0) * (count - 1)
                for share, count in zip(((row + 0.5) / height, (column + 0.5) / width, bright), nodes, strict=True)
            ]
            transform = np.zeros(12)
            for node in np.ndindex(*nodes):
                near = [max(0.0, 1.0 - abs(place - index)) for place, index in zip(places, node, strict=True)]
                transform += math.prod(near) * grid[node]
            a = transform.reshape(3, 4)
            out[:, row, column] = a[:, :3] @ pixel + a[:, 3]
    return out


def test_slices_are_those_of_loops_over_pixels_and_nodes() -> None:
    images = 1.4 * random(2, 3, 5, 7) - 0.2  # beyond black and white, too
    grids = random(2, 3, 5, 4, 12, seed=1)
    out = slice_grids(images, grids)
    for image, grid, mine in zip(images, grids, out, strict=True):
        np.testing.assert_allclose(mine, sliced_by_loops(image.numpy(), grid.numpy()), atol=1e-12)  # 4.4e-16 seen
        torch.testing.assert_close(slice_grids(image, grid), mine, atol=0, rtol=0)


def test_gradients_of_a_slice_are_finite_differences() -> None:
    image, grid = random(3, 4, 5).requires_grad_(), random(2, 3, 3, 12, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(slice_grids, (image, grid))


def test_views_of_several_sizes_are_sliced_as_each_is() -> None:
    images = [random(3, 9, 14), random(3, 10, 13, seed=2)]
    grids = random(2, 4, 5, 8, 12, seed=3)
    together = slice_grids(stack_padded(images), grids, [(14, 9), (13, 10)])
    for image, grid, mine, size in zip(images, grids, together, [(14, 9), (13, 10)], strict=True):
        torch.testing.assert_close(own_part(mine, size), slice_grids(image, grid), atol=1e-14, rtol=0)  # 0 seen


def test_uniform_grids_are_colour_transforms_and_those_of_the_identity_change_nothing() -> None:
    images, transforms = random(2, 3, 20, 30).float(), random(2, 3, 4, seed=1).float()
    same = slice_grids(images, uniform_grids(transforms, (4, 5, 8)))
    torch.testing.assert_close(same, transform_colors(images, transforms), atol=2e-6, rtol=0)  # 4.8e-7 seen
    unchanged = slice_grids(images, uniform_grids(identities(2), (16, 16, 8)))
    torch.testing.assert_close(unchanged, images, atol=1e-6, rtol=0)  # 1.2e-7 seen
    assert total_variation(uniform_grids(transforms, (4, 5, 8))) < 1e-12


def test_total_variation_is_the_mean_of_slopes_summed_over_grids() -> None:
    grids = random(3, 5, 6, 4, 12)
    a = grids.numpy()
    expected = sum(
        np.square((grid.shape[axis] - 1) * np.diff(grid, axis=axis)).mean() for grid in a for axis in (0, 1, 2)
    )
    np.testing.assert_allclose(total_variation(grids), expected, rtol=1e-12)
    assert torch.autograd.gradcheck(total_variation, grids.requires_grad_())
    before = random(3, 5, 6, 4, 12, seed=1)
    after = before.clone()
    add_variation(grids.detach(), after, 0.3)
    (by_grids,) = torch.autograd.grad(total_variation(grids), grids)
    torch.testing.assert_close(after, before + 0.3 * by_grids, atol=1e-12, rtol=0)  # 7e-15 seen


def test_grids_learn_tones_of_single_photos_and_the_mean_at_each_brightness_stays_the_identity() -> None:
    names, passes = ["a", "b", "c"], 300
    image = random(3, 24, 32).float()
    curves = [lambda x: x**0.7, lambda x: 2 * x - x**0.7, lambda x: x]  # their mean is the identity
    falloff = vignetting(24, 32) / vignetting(24, 32).mean()
    photos = [curve(image) * falloff for curve in curves]
    grids = ViewGrids.create(names, ViewGrids.uniform(identities(3), (256, 256)), torch.device("cpu"), 0, 3 * passes)
    before = [float((image - photo).abs().mean()) for photo in photos]
    for iteration in range(1, 3 * passes + 1):
        view = (iteration - 1) % 3
        (grids.apply([names[view]], image) - photos[view]).abs().mean().backward()
        grids.after_step(iteration, 1)
    after = [
        float((grids.apply([name], image).detach() - photo).abs().mean())
        for name, photo in zip(names, photos, strict=True)
    ]
    assert all(late < 0.9 * early for early, late in zip(before, after, strict=True)), (before, after)
    common = grids.transforms.detach().mean(dim=(0, 1, 2))
    torch.testing.assert_close(common, torch.eye(3, 4).flatten().expand(8, 12), atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", [ViewGrids, ViewColors])
def test_gradients_of_views_are_added_up_also_of_one_that_is_twice_in_a_launch(kind: type[ViewAppearance]) -> None:
    images, start = random(3, 3, 20, 30).float(), kind.uniform(identities(4), (64, 48))
    learned = kind.create(["a", "b", "c", "d"], start, torch.device("cpu"), 0, 8)
    leaf = start.clone().requires_grad_()
    operation = slice_grids if kind is ViewGrids else transform_colors
    for names, of in ((("b", "d", "b"), [1, 3, 1]), (("a", "b", "d"), [0, 1, 3])):
        with torch.no_grad():  # as scores of Gaussians look at views between launches
            learned.apply(["c"], images[0])
        learned.apply(names, images).square().sum().backward()
        operation(images, leaf[of]).square().sum().backward()
    assert leaf.grad is not None
    torch.testing.assert_close(learned.transforms.grad, leaf.grad, atol=0, rtol=1e-5)  # equal
    assert not learned.transforms.grad[2].any()


def test_what_all_photos_share_over_the_image_stays_and_what_they_share_at_a_brightness_goes() -> None:
    start = ViewGrids.uniform(identities(3), (256, 256))  # (3, 9, 9, 8, 12)
    falloff, tones = vignetting(9, 9) - vignetting(9, 9).mean(), torch.linspace(-0.2, 0.3, 8)
    start[..., 0] += falloff[..., None] + tones
    grids = ViewGrids.create(["a", "b", "c"], start, torch.device("cpu"), 0, 30_000)
    grids.apply(["a"], random(3, 4, 5).float()).mean().backward()
    grids.after_step(3, 1)
    learned = grids.transforms.detach()[..., 0]
    torch.testing.assert_close(learned, (1 + falloff)[..., None].expand(3, 9, 9, 8), atol=1e-3, rtol=0)  # 3.6e-5 seen


def vignetting(height: int, width: int) -> Tensor:
    """Return a lens's falloff (h, w): 1 in the middle, 0.6 in the corners."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    return 1 - 0.2 * (x * x + y * y)


def test_steps_grow_in_the_beginning_and_shrink_to_the_end() -> None:
    grids = ViewGrids.create(["a"], ViewGrids.uniform(identities(1), (5, 4)), torch.device("cpu"), 0, 3000)
    sizes = {}
    for iteration in (1, 50, 100, 3000):
        grids.apply(["a"], random(3, 4, 5).float()).sum().backward()
        grids.after_step(iteration, 1)
        sizes[iteration] = grids._adam.param_groups[0]["lr"]
    ratio = LAST_RATE / FIRST_RATE
    assert sizes[1] == pytest.approx(0.01 * FIRST_RATE, rel=0.01)
    assert sizes[50] == pytest.approx(0.5 * FIRST_RATE * ratio ** (50 / 3000))
    assert sizes[100] == pytest.approx(FIRST_RATE * ratio ** (1 / 30))
    assert sizes[3000] == pytest.approx(LAST_RATE)


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_stopped_run_continues_to_the_same_bits(hierarchy: str, tmp_path: Path) -> None:
    scene, settings = unlike(ring_scene()), replace(SHORT, hierarchy=hierarchy)
    whole = train(tmp_path / "whole", scene, settings)
    learned = whole.grids(0)
    assert learned is not None
    assert set(learned) == {view.name for view in scene.train}
    assert any((grid != uniform_grids(identities(1), (4, 4, 8))[0]).any() for grid in learned.values())
    for stop_at in ((1, 20), (0, 10)):
        folder = tmp_path / f"stopped_{stop_at[0]}"
        with pytest.raises(TrainingStoppedError):
            train(folder, scene, settings, monitor=StopAt(*stop_at))
        again = resume(folder, scene, settings)
        assert again.exposure(0) == whole.exposure(0)
        assert all((grid == learned[name]).all() for name, grid in (again.grids(0) or {}).items())
        for level in (0, 1):
            assert (again.field(level).means == whole.field(level).means).all()
            assert (again.field(level).sh == whole.field(level).sh).all()


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_scene_behind_shaded_and_toned_photos_is_recovered_better_than_by_colour_transforms(
    hierarchy: str, tmp_path: Path
) -> None:
    clean = panned_scene()
    scene = unlike(clean)  # held-out photos stay as the scene looks without a camera's faults
    psnrs = {}
    for choice in ("none", "affine", "bilateral"):
        settings = TrainSettings(iterations=1200, hierarchy=hierarchy, appearance=choice, sh_degree=0)
        psnrs[choice] = fitted_psnr(train(tmp_path / choice, scene, settings), scene)
    assert psnrs["bilateral"] > max(psnrs["affine"], psnrs["none"]) + 1, psnrs  # least seen 2.1


def fitted_psnr(archive: RunArchive, scene: Scene) -> float:
    """Return the mean PSNR of the held-out views after a colour fit."""
    renderer, psnrs = run_renderer(archive, "cpu", "cpu"), []
    for view in scene.test:
        image = renderer.render(view.camera).composed[0]
        psnrs.append(psnr(transform_colors(image, fit_colors(image, view.image).float()), view.image))
    return fmean(psnrs)


def unlike(scene: Scene) -> Scene:
    """Return a scene whose training photos differ in their tone curves, and in which side of them is darker."""
    views = []
    for index, view in enumerate(scene.train):
        power = 0.8 if index % 2 else 1.2
        shade = torch.linspace(0.6, 1.2, view.camera.width)
        image = view.image.clamp(0, 1) ** power * (shade if index // 2 % 2 else shade.flip(0))
        views.append(replace(view, image=image))
    return replace(scene, train=tuple(views))


def test_damaged_grids_are_refused(tmp_path: Path) -> None:
    archive = train(tmp_path / "run", ring_scene(), replace(SHORT, iterations=12, levels=1))
    path = archive.path("level_0", GRIDS)
    write_tensors(path, {"view_1.png": torch.zeros(4, 4, 8, 11)})
    with pytest.raises(RunFolderError, match=r"view_1\.png is no bilateral grid.*train again with --overwrite"):
        RunArchive.open(tmp_path / "run").grids(0)
    path.write_bytes(b"no tensors")
    with pytest.raises(RunFolderError, match=r"view_grids\.pt cannot be read.*train again with --overwrite"):
        RunArchive.open(tmp_path / "run").grids(0)


def test_level_whose_grids_are_gone_is_not_continued(tmp_path: Path) -> None:
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "run", ring_scene(), SHORT, monitor=StopAt(0, 10))
    archive = RunArchive.open(tmp_path / "run")
    archive.path("level_1", GRIDS).unlink()
    with pytest.raises(RunFolderError, match=r"level_1/view_grids\.pt does not exist.*--overwrite"):
        resume(tmp_path / "run", ring_scene(), SHORT)
