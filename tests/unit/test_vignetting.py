"""Vignetting: the op, the measure, and runs on photos whose corners are darker."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError
from lapgs_plugin.evaluation.figures import PhotoLook, photo_looks
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.ops.mixed_sizes import own_part, stack_padded
from lapgs_plugin.ops.vignetting import vignette
from lapgs_plugin.rendering.run import run_renderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CHECKPOINT, VIGNETTING
from lapgs_plugin.scenes.exposure import sparse_colors
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.scenes.vignetting import measure_vignetting
from lapgs_plugin.training.settings import TrainSettings
from tests.training_runs import StopAt, resume, train
from tests.training_scene import panned_scene, ring_scene

STOPS = -0.6


def photographed(image: Tensor, stops: float) -> Tensor:
    """Darken an image (3, h, w) pixel by pixel, as the definition says."""
    _, height, width = image.shape
    out = image.clone()
    for row in range(height):
        for column in range(width):
            across, down = column + 0.5 - width / 2, row + 0.5 - height / 2
            out[:, row, column] *= 2 ** (stops * (across**2 + down**2) / ((width / 2) ** 2 + (height / 2) ** 2))
    return out


def with_falloff(scene: Scene, stops: float, every: int = 1) -> Scene:
    """Return a scene whose photos, or every so many of them, have darker corners."""
    train, test = (
        tuple(
            replace(view, image=photographed(view.image, stops)) if index % every == 0 else view
            for index, view in enumerate(views)
        )
        for views in (scene.train, scene.test)
    )
    return replace(scene, train=train, test=test)


def random_image(seed: int, height: int, width: int) -> Tensor:
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_images_are_darkened_by_the_squared_distance_from_the_middle() -> None:
    images = [random_image(0, 9, 14), random_image(1, 10, 13)]
    for image in images:
        torch.testing.assert_close(vignette(image, [STOPS]), photographed(image, STOPS), atol=1e-14, rtol=0)  # 2e-16
    together = vignette(stack_padded(images), [STOPS, 0.0], [(14, 9), (13, 10)])
    torch.testing.assert_close(own_part(together[0], (14, 9)), photographed(images[0], STOPS), atol=1e-14, rtol=0)
    torch.testing.assert_close(own_part(together[1], (13, 10)), images[1], atol=0, rtol=0)
    assert vignette(images[0], [0.0]) is images[0]
    assert torch.autograd.gradcheck(lambda image: vignette(image, [STOPS]), images[0].requires_grad_())


def measured(scene: Scene) -> dict[str, float]:
    return measure_vignetting(scene, sparse_colors(scene))


def test_falloff_of_a_camera_is_measured_for_all_of_its_views() -> None:
    scene = with_falloff(panned_scene(), STOPS)
    falloffs = measured(scene)
    assert set(falloffs) == {view.name for view in (*scene.train, *scene.test)}
    np.testing.assert_allclose([*falloffs.values()], STOPS, atol=0.02)  # -0.599 seen
    gains = [2.0 ** (0.3 * (index % 3)) for index in range(len(scene.train))]
    exposed = [replace(view, image=gain * view.image) for gain, view in zip(gains, scene.train, strict=True)]
    falloffs = measured(replace(scene, train=tuple(exposed)))
    np.testing.assert_allclose([*falloffs.values()], STOPS, atol=0.02)  # -0.599 seen


@pytest.mark.parametrize(
    "changed",
    [
        lambda scene: scene,  # no falloff
        lambda scene: with_falloff(scene, -STOPS),  # no lens brightens the corners
        lambda scene: with_falloff(scene, 10 * STOPS),  # or darkens them so much
        lambda scene: with_falloff(scene, STOPS, every=2),  # parts of the photos do not agree
        lambda scene: replace(with_falloff(scene, STOPS), train=with_falloff(scene, STOPS).train[:15]),
        lambda scene: replace(with_falloff(scene, STOPS), colors=torch.full_like(scene.colors, 0.5)),  # random points
    ],
)
def test_falloff_is_not_taken_without_evidence(changed: object) -> None:
    assert callable(changed)
    assert measured(changed(panned_scene())) == {}


def test_second_camera_has_its_own() -> None:
    scene = panned_scene()
    darker = with_falloff(scene, STOPS)
    other = [
        replace(view, name=f"other/{view.name}", camera=replace(view.camera, fx=1.0001 * view.camera.fx))
        for view in scene.train
    ]
    falloffs = measured(replace(darker, train=(*darker.train, *other)))
    assert set(falloffs) == {view.name for view in (*darker.train, *darker.test)}


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_levels_are_trained_without_the_falloff_and_held_out_photos_are_compared_with_it(
    hierarchy: str, tmp_path: Path
) -> None:
    clean = panned_scene()
    scene, psnrs = with_falloff(clean, STOPS), {}
    for choice in ("none", "affine"):
        settings = TrainSettings(iterations=600, hierarchy=hierarchy, appearance=choice, sh_degree=0)
        archive = train(tmp_path / choice, scene, settings)
        renderer, looks = run_renderer(archive, "cpu", "cpu"), photo_looks(archive, [view.name for view in scene.test])
        renders = [renderer.render(view.camera).composed[0] for view in scene.test]
        psnrs[choice] = np.mean(
            [
                (psnr(render, bare.image), psnr(looks[view.name].of(render), view.image))
                for render, bare, view in zip(renders, clean.test, scene.test, strict=True)
            ],
            axis=0,
        )
        assert bool(archive.vignetting()) == (choice == "affine")
    of_scene, of_photos = psnrs["affine"] - psnrs["none"]
    assert of_scene > 10, psnrs  # least seen 17.2
    assert of_photos > 10, psnrs  # least seen 15.6


def test_views_set_aside_are_compared_with_it(tmp_path: Path) -> None:
    scene = panned_scene()
    settings = TrainSettings(iterations=600, levels=1, appearance="affine", sh_degree=0, stop="auto")
    psnrs = []
    for stops in (0.0, STOPS):
        with pytest.raises(TrainingStoppedError):
            train(tmp_path / f"{stops}", with_falloff(scene, stops), settings, monitor=StopAt(0, 150))
        state = torch.load(tmp_path / f"{stops}" / CHECKPOINT, weights_only=True)["state"]
        psnrs.append(np.mean(state["gains"]["looks"][-1][1]))
    assert psnrs[1] > psnrs[0]  # errors are darker, too: 36.0 and 30.6 dB seen, 25.0 for images without the falloff


def test_stopped_run_continues_with_its_falloff_to_the_same_bits(tmp_path: Path) -> None:
    scene = with_falloff(panned_scene(), STOPS)
    settings = TrainSettings(iterations=60, appearance="affine", sh_degree=0)
    whole = train(tmp_path / "whole", scene, settings)
    for stop_at in ((1, 10), (0, 10)):
        folder = tmp_path / f"stopped_{stop_at[0]}"
        with pytest.raises(TrainingStoppedError):
            train(folder, scene, settings, monitor=StopAt(*stop_at))
        again = resume(folder, scene, settings)
        assert again.vignetting() == whole.vignetting() != {}
        assert (again.field(0).means == whole.field(0).means).all()


def test_auto_leaves_photos_of_the_same_exposure_as_they_are(tmp_path: Path) -> None:
    scene = with_falloff(panned_scene(), STOPS)
    archive = train(tmp_path / "run", scene, TrainSettings(iterations=12, levels=1, sh_degree=0))
    assert archive.exposure(0) is None
    assert archive.vignetting() == {}


def test_damaged_falloffs_are_refused(tmp_path: Path) -> None:
    archive = train(tmp_path / "run", ring_scene(), TrainSettings(iterations=12, levels=1, sh_degree=0))
    assert archive.vignetting() == {}
    for damaged in ('"dark"', "1.5", "-1e9", "NaN"):
        archive.path(VIGNETTING).write_text(f'{{"view_1.png": {damaged}}}')
        with pytest.raises(RunFolderError, match=r"vignetting\.json.*train again with --overwrite"):
            RunArchive.open(tmp_path / "run").vignetting()


def test_a_photo_is_darkened_by_its_lens_before_its_exposure_transforms_it() -> None:
    image = torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(0))
    exposure = torch.tensor([[1.2, 0.1, 0.0, 0.3], [0.0, 0.9, 0.0, -0.1], [0.05, 0.0, 1.1, 0.2]])
    darkened = (image * vignette(torch.ones_like(image), [0.8])).double().numpy()
    expected = (
        np.einsum("ij,jhw->ihw", exposure[:, :3].double(), darkened) + exposure[:, 3, None, None].double().numpy()
    )
    np.testing.assert_allclose(PhotoLook(0.8, exposure).of(image), expected, atol=1e-6)  # 1.7e-7 seen
