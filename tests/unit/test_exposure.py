"""Compensation of exposure: the op, the measure, the transforms of a run, and PSNR after a colour fit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError, UserInputError
from lapgs_plugin.evaluation.figures import evaluate_run
from lapgs_plugin.evaluation.lpips import LpipsRequest
from lapgs_plugin.evaluation.metrics import color_fitted_psnr, fit_colors, psnr
from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.reference_raster import OracleRasterizer
from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import EXPOSURE
from lapgs_plugin.runs.neighbours import predicted_exposures
from lapgs_plugin.scenes.exposure import measure_exposure, sparse_colors
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.stages.appearance import DIFFERENT, ViewColors, from_gains, identities
from lapgs_plugin.training.settings import TrainSettings
from tests.cli.run_folder import write_run, write_scene
from tests.training_runs import StopAt, resume, train
from tests.training_scene import blob_field, ring_camera, ring_scene

STOPS = (0.0, 0.9, -0.7, 0.4, -0.5, 0.2)


def test_transform_and_its_gradients_are_the_closed_form() -> None:
    generator = torch.Generator().manual_seed(0)
    image, by_out = (torch.randn(2, 3, 5, 7, generator=generator, dtype=torch.float64) for _ in range(2))
    transform = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)
    leaves = image.clone().requires_grad_(), transform.clone().requires_grad_()
    out = transform_colors(*leaves)
    expected = np.einsum("bij,bjhw->bihw", transform[:, :, :3], image) + transform[:, :, 3, None, None].numpy()
    np.testing.assert_allclose(out.detach(), expected, atol=1e-14)  # 0 seen
    by_image, by_transform = torch.autograd.grad(out, leaves, by_out)
    np.testing.assert_allclose(by_image, np.einsum("bij,bihw->bjhw", transform[:, :, :3], by_out), atol=1e-14)  # 0 seen
    ones = torch.cat([image, torch.ones_like(image[:, :1])], dim=1)
    np.testing.assert_allclose(by_transform, np.einsum("bihw,bjhw->bij", by_out, ones), atol=1e-13)  # 3.6e-15 seen
    assert torch.autograd.gradcheck(transform_colors, leaves)
    one = transform_colors(image[0], transform[0])
    torch.testing.assert_close(one, out[0].detach(), atol=1e-14, rtol=0)  # 0 seen


def test_measure_finds_the_gains_of_photos() -> None:
    scene = wall_scene(STOPS)
    measured = measure_exposure(scene, sparse_colors(scene))
    expected = torch.tensor(STOPS) - torch.tensor(STOPS).median()
    torch.testing.assert_close(measured.gains, expected[:, None].repeat(1, 3), atol=0.03, rtol=0)  # worst seen 0.005
    assert measured.spread > 0.4
    alike_scene = wall_scene((0.0,) * 6)
    alike = measure_exposure(alike_scene, sparse_colors(alike_scene))
    assert alike.spread < 0.01
    assert alike.gains.abs().max() < 0.03
    assert DIFFERENT > 0.01
    grey = replace(scene, colors=torch.full_like(scene.points, 0.5))  # as those that a scene without points gets
    assert measure_exposure(grey, sparse_colors(grey)).spread == 0


def wall_scene(stops: tuple[float, ...]) -> Scene:
    """A smoothly coloured plane z = 0 seen from cameras before it, rendered by intersecting rays with it."""
    scene = ring_scene(train=len(stops))
    cameras = [ring_camera(0.2 * index - 0.5) for index in range(len(stops))]
    generator = torch.Generator().manual_seed(1)
    points = torch.cat([2 * torch.rand(500, 2, generator=generator) - 1, torch.zeros(500, 1)], dim=1)

    def color(points: Tensor) -> Tensor:
        waves = torch.tensor([[2.0, 1.0], [-1.5, 2.0], [1.0, -2.5]])
        return 0.25 + 0.1 * torch.sin(points[..., :2] @ waves.T)

    views = []
    for view, camera, stop in zip(scene.train, cameras, stops, strict=True):
        rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        rays = torch.stack([columns + 0.5 - camera.cx, rows + 0.5 - camera.cy, torch.full(rows.shape, camera.fx)], -1)
        rays = rays @ camera.world_to_camera[:3, :3]  # to the world's axes
        places = camera.position - rays * (camera.position[2] / rays[..., 2])[..., None]
        views.append(replace(view, camera=camera, image=(color(places) * 2**stop).permute(2, 0, 1).contiguous()))
    return replace(scene, train=tuple(views), points=points, colors=color(points))


def test_transforms_learn_the_gains_of_photos_and_their_mean_stays_the_identity() -> None:
    gains = torch.tensor([[0.8, 1.0, 1.3], [1.0, 1.3, 0.9], [1.2, 0.7, 0.8]])
    names, image = ["a", "b", "c"], random_image(0)
    exposures = ViewColors.create(names, identities(3), torch.device("cpu"), 0, 600)
    start = exposures.transforms.detach().clone()
    for iteration in range(1, 601):
        view = (iteration - 1) % 3
        (exposures.apply([names[view]], image) - gains[view, :, None, None] * image).abs().mean().backward()
        exposures.after_step(iteration, 1)
        assert iteration != 2 or (exposures.transforms == start).all()  # one step in each pass over the views
    expected = torch.cat([torch.diag_embed(gains), torch.zeros(3, 3, 1)], dim=2)
    torch.testing.assert_close(exposures.transforms, expected, atol=0.02, rtol=0)  # worst seen 4e-4
    torch.testing.assert_close(exposures.transforms.mean(0), torch.eye(3, 4), atol=1e-6, rtol=0)


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_run_learns_the_exposure_of_its_photos_and_resumes_to_the_same_bits(tmp_path: Path, hierarchy: str) -> None:
    scene = wall_scene(STOPS)
    settings = TrainSettings(iterations=60, hierarchy=hierarchy, appearance="affine", sh_degree=0)
    whole = train(tmp_path / "whole", scene, settings)
    archived = whole.exposure(0)
    assert archived is not None
    gains = torch.tensor([archived[view.name] for view in scene.train])[:, :, :3].diagonal(dim1=1, dim2=2).mean(1)
    assert torch.corrcoef(torch.stack([gains.log2(), torch.tensor(STOPS)]))[0, 1] > 0.98
    torch.testing.assert_close(
        torch.tensor([*archived.values()]).mean(0), torch.eye(3, 4), atol=1e-5, rtol=0
    )  # worst seen 1e-7
    for stop_at in ((1, 20), (0, 10)):
        folder = tmp_path / f"stopped_{stop_at[0]}"
        with pytest.raises(TrainingStoppedError):
            train(folder, scene, settings, monitor=StopAt(*stop_at))
        assert resume(folder, scene, settings).exposure(0) == archived
        for level in (0, 1):
            mine, theirs = (RunArchive.open(path).field(level).means for path in (folder, tmp_path / "whole"))
            assert (mine == theirs).all()


def test_compensation_beats_none_where_exposure_changes_and_is_left_out_where_it_does_not(tmp_path: Path) -> None:
    psnrs = {}
    for choice in ("affine", "none"):
        archive = train(
            tmp_path / choice, wall_scene(STOPS), TrainSettings(iterations=200, appearance=choice, levels=1)
        )
        assert (archive.exposure(0) is None) == (choice == "none")
        psnrs[choice] = archive.history()[-1]["loss"]
    assert psnrs["affine"] < 0.8 * psnrs["none"]  # worst seen 0.6 of it
    archive = train(tmp_path / "auto", wall_scene((0.0,) * 6), TrainSettings(iterations=12))
    assert archive.exposure(0) is None
    archive = train(tmp_path / "changing", wall_scene(STOPS), TrainSettings(iterations=12))
    assert archive.exposure(0) is not None


def test_damaged_transforms_are_refused(tmp_path: Path) -> None:
    settings = TrainSettings(iterations=12, appearance="affine", levels=1)
    archive = train(tmp_path / "run", ring_scene(), settings)
    path = archive.path("level_0", EXPOSURE)
    path.write_text(json.dumps({"view_1.png": [[1.0, 0.0]]}))
    with pytest.raises(RunFolderError, match=r"view_colors\.json.*train again with --overwrite"):
        RunArchive.open(tmp_path / "run").exposure(0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"appearance": "on"}, "--appearance on: expected auto, none, affine or bilateral"),
        (
            {"appearance": "affine", "supervision": "gt_laplacian"},
            "--appearance affine with --supervision gt_laplacian",
        ),
        ({"appearance": "bilateral", "protocol": "paper"}, "--appearance bilateral with --protocol paper"),
    ],
)
def test_contradicting_choices_are_refused(given: dict[str, str], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        TrainSettings(**given)  # type: ignore[arg-type]


def random_image(seed: int) -> Tensor:
    return torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(seed))


def test_color_fit_is_least_squares_and_measured_on_the_other_half() -> None:
    image, noise = 0.2 + 0.5 * random_image(0), 0.01 * random_image(1)
    mix = torch.tensor([[0.7, 0.1, 0.0, 0.05], [0.0, 0.9, 0.05, 0.0], [0.1, 0.0, 0.6, 0.1]])
    target = transform_colors(image, mix) + noise
    design = np.concatenate([image.flatten(1).numpy(), np.ones((1, 600))]).T.astype(np.float64)
    expected = np.linalg.lstsq(design, target.flatten(1).numpy().T.astype(np.float64), rcond=None)[0].T
    np.testing.assert_allclose(fit_colors(image, target), expected, atol=2e-4)  # worst seen 3e-5, by the tiny weight
    assert color_fitted_psnr(image, target) > psnr(image, target) + 15
    spoiled = target.clone()
    spoiled[..., 15:] = random_image(2)[..., 15:]  # the right half, which the fit does not see
    right = transform_colors(image[..., 15:], fit_colors(image[..., :15], target[..., :15]).float())
    assert color_fitted_psnr(image, spoiled) == pytest.approx(psnr(right, spoiled[..., 15:]), abs=1e-3)


def test_color_fit_counts_pixels_inside_of_masks() -> None:
    image, mask = random_image(0), torch.ones(1, 20, 30, dtype=torch.bool)
    target = 0.5 * image
    target[:, :10], mask[:, :10] = 1.0, False
    assert color_fitted_psnr(image, target, mask) > 60 > color_fitted_psnr(image, target)


def test_color_fit_of_one_color_stays_near_the_identity() -> None:
    grey = torch.full((3, 4, 6), 0.5)
    assert color_fitted_psnr(grey, grey) > 60
    assert psnr(transform_colors(grey, fit_colors(grey, grey * 1.2).float()), grey * 1.2) > 60
    empty = torch.zeros(1, 4, 6, dtype=torch.bool)
    torch.testing.assert_close(fit_colors(grey, grey, empty), identities(1)[0].double())


def test_gradients_reach_the_field_through_the_transform() -> None:
    """Finite differences in float64, through the oracle, of a view's loss by colours, opacities and the transform."""
    field = blob_field(6).to(dtype=torch.float64)
    camera = ring_camera(0.3, 12, 8).to(dtype=torch.float64)
    target = random_image(3)[:, :8, :12].double()
    transform = torch.tensor([[0.7, 0.1, 0.0, 0.05], [0.0, 1.2, 0.05, 0.0], [0.1, 0.0, 0.9, 0.1]], dtype=torch.float64)

    def loss(sh: Tensor, logits: Tensor, transform: Tensor) -> Tensor:
        shown = replace(field, sh=sh, opacity_logits=logits)
        image = OracleRasterizer()(shown, camera, background=torch.zeros(3, dtype=torch.float64)).image
        return (transform_colors(image, transform) - target).square().mean()

    leaves = [each.clone().requires_grad_() for each in (field.sh, field.opacity_logits, transform)]
    assert torch.autograd.gradcheck(loss, leaves, check_undefined_grad=False, fast_mode=True)


def test_several_views_are_transformed_as_each_is() -> None:
    names, images = ["a", "b", "c"], torch.stack([random_image(seed) for seed in (0, 1)])
    exposures = ViewColors.create(names, from_gains(0.3 * random_image(2)[0, :3, :3]), torch.device("cpu"), 0, 1)
    together = exposures.apply(["c", "a"], images)
    by_all = gradient_of(exposures, together)
    alone = torch.stack([exposures.apply([name], image) for name, image in zip(["c", "a"], images, strict=True)])
    by_each = gradient_of(exposures, alone)
    torch.testing.assert_close(together, alone, atol=1e-6, rtol=0)  # 0 seen
    torch.testing.assert_close(by_all, by_each, atol=1e-6, rtol=0)  # 0 seen
    assert by_all[1].abs().max() == 0
    assert by_all[0].abs().max() > 0


def gradient_of(exposures: ViewColors, images: Tensor) -> Tensor:
    """Return the gradient of the mean square of images by all transforms, which had none before."""
    images.square().mean().backward()
    gradient = exposures.transforms.grad
    assert gradient is not None
    added = gradient.clone()
    gradient.zero_()
    return added


def transforms_of(stops: Sequence[float]) -> dict[str, list[list[float]]]:
    """Return transforms that multiply by 2 to the power of stops, by names in their order."""
    return {f"{2 * index:03d}.jpg": (2.0**stop * np.eye(3, 4)).tolist() for index, stop in enumerate(stops)}


def test_neighbours_predict_exposure_that_changes_slowly() -> None:
    slow = transforms_of(np.sin(np.arange(30) / 5))
    predicted = predicted_exposures(slow, ["013.jpg", "000.jpg", "999.jpg"])
    expected = (np.array(slow["012.jpg"]) + np.array(slow["014.jpg"])) / 2
    np.testing.assert_allclose(predicted["013.jpg"], expected, rtol=1e-6)  # 2.5e-8 seen
    np.testing.assert_allclose(predicted["000.jpg"], slow["000.jpg"], rtol=1e-6)  # a training photo has its own
    np.testing.assert_allclose(predicted["999.jpg"], slow["058.jpg"], rtol=1e-6)  # behind the last one


def test_neighbours_say_nothing_where_exposure_jumps() -> None:
    assert predicted_exposures(transforms_of(0.5 * (-1.0) ** np.arange(30)), ["013.jpg"]) == {}
    assert predicted_exposures(transforms_of([0.1, 0.2]), ["001.jpg"]) == {}


def test_evaluation_measures_renders_with_the_predicted_exposure(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    run = write_run(tmp_path / "run", scene)
    plain = evaluate_run(RunArchive.open(run), RenderOptions(rasterizer="cpu"), LpipsRequest(()))
    learned = {f"photos/{name}.png": (1.25 * np.eye(3, 4)).tolist() for name in ("01", "07", "09", "10")}
    (run / "level_0" / EXPOSURE).write_text(json.dumps(learned))
    archive = RunArchive.open(run)
    brighter = evaluate_run(archive, RenderOptions(rasterizer="cpu"), LpipsRequest(()))
    assert brighter["exposure_predicted"]
    assert not plain["exposure_predicted"]
    renderer, (view,) = run_renderer(archive, "cpu", "cpu"), run_scene(archive).test[:1]
    image = 1.25 * renderer.render(view.camera).composed[0].numpy()
    error = np.square(np.clip(image, 0, 1) - view.image.numpy()).mean()
    (figures,) = (each for each in brighter["views"] if each["name"] == view.name)
    assert figures["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)  # 3.8e-7 seen
