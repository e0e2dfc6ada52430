"""Refinement of poses: gradients by a camera's pose, corrections of a run's views, and how they are archived."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import RunFolderError, TrainingStoppedError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.pose import corrected, turned_gradient, with_pose_gradient
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.rendering.run import refined, run_cameras, run_scene
from lapgs_plugin.runs.archive import Poses, RunArchive
from lapgs_plugin.runs.layout import POSES
from lapgs_plugin.runs.neighbours import predicted_poses
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training import poses
from lapgs_plugin.training.checkpoint import TransformsState, check_transforms
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.poses import ViewPoses
from lapgs_plugin.training.settings import TrainSettings
from tests.cli.run_folder import write_run, write_scene
from tests.gsplat_on_cpu import GsplatOnCpu
from tests.training_runs import StopAt, resume, train
from tests.training_scene import blob_field, ring_camera, ring_scene

CORRECTION = (0.03, -0.05, 0.02, 0.1, -0.05, 0.03)


def test_correction_turns_a_camera_about_its_centre_and_moves_it_along_the_axes_of_the_world() -> None:
    camera = ring_camera(0.3).to(dtype=torch.float64)
    moved = corrected(camera, (0.0, 0.0, math.pi / 6, 1.0, 2.0, -3.0))
    expected = camera.position + torch.tensor([1.0, 2.0, -3.0])
    torch.testing.assert_close(moved.position, expected, atol=5e-6, rtol=0)  # worst seen 9e-7: its pose was float32
    about_z = torch.tensor([[math.cos(math.pi / 6), -0.5, 0], [0.5, math.cos(math.pi / 6), 0], [0, 0, 1]])
    expected = camera.world_to_camera[:3, :3] @ about_z.double()
    torch.testing.assert_close(moved.world_to_camera[:3, :3], expected, atol=1e-7, rtol=0)
    assert corrected(ring_camera(0.3), CORRECTION).world_to_camera.dtype == torch.float32


@pytest.mark.parametrize("rasterizer", [CpuRasterizer(), OracleRasterizer()], ids=["cpu", "oracle"])
@pytest.mark.parametrize("signed", [False, True])
def test_gradient_by_a_pose_is_that_of_finite_differences(rasterizer: Rasterizer, signed: bool) -> None:
    """In float64, at a correction that is not zero, of needles with colours that depend on direction."""
    generator = torch.Generator().manual_seed(0)
    field = blob_field(12).to(dtype=torch.float64)
    bands, stretch = (torch.randn(12, *shape, generator=generator).double() for shape in ((15, 3), (3,)))
    field = replace(
        field, sh=torch.cat([field.sh, 0.3 * bands], dim=1), log_scales=field.log_scales + 0.3 * stretch, signed=signed
    )
    camera = ring_camera(0.3, 24, 16).to(dtype=torch.float64)
    target, black = torch.rand(3, 16, 24, generator=generator).double(), torch.zeros(3).double()

    def loss(correction: Tensor, field: GaussianField) -> Tensor:
        moved = corrected(camera, correction.tolist())
        return (rasterizer(field, moved, background=black).image - target).square().sum()

    at, steps = torch.tensor(CORRECTION).double(), 1e-5 * torch.eye(6).double()
    expected = torch.stack([(loss(at + step, field) - loss(at - step, field)) / 2e-5 for step in steps])
    leaves = field.with_parameters({name: each.clone().requires_grad_() for name, each in field.parameters.items()})
    movement = torch.zeros(6).double().requires_grad_()
    watched = with_pose_gradient(leaves, movement, corrected(camera, CORRECTION).position, unit=2.0)
    loss(at, watched).backward()
    assert movement.grad is not None
    turn, shift = turned_gradient(at[None, :3], movement.grad[None, :3])[0], movement.grad[3:] / 2.0
    torch.testing.assert_close(torch.cat([turn, shift]), expected, atol=0, rtol=2e-6)  # worst seen 2e-7
    plain = field.with_parameters({name: each.clone().requires_grad_() for name, each in field.parameters.items()})
    loss(at, plain).backward()
    for mine, theirs in zip(leaves.parameters.values(), plain.parameters.values(), strict=True):
        torch.testing.assert_close(mine.grad, theirs.grad, atol=0, rtol=1e-12)


def gradient_by_pose(rasterizer: Rasterizer, device: str = "cpu") -> Tensor:
    """Of a fixed loss of a view, by turns and shifts (6,)."""
    generator = torch.Generator().manual_seed(1)
    blobs = blob_field(80)
    sh = torch.randn(80, 16, 3, generator=generator)
    shown = blobs.with_parameters({"sh": sh, "opacity_logits": blobs.opacity_logits.clamp_max(3)}).to(device)
    leaves = shown.with_parameters({name: each.requires_grad_() for name, each in shown.parameters.items()})
    camera, movement = ring_camera(0.3, 40, 29), torch.zeros(6, device=device, requires_grad=True)
    weights = torch.randn(3, 29, 40, generator=generator).to(device)
    watched = with_pose_gradient(leaves, movement, camera.position.to(device), unit=1.0)
    image = rasterizer(watched, camera, background=torch.zeros(3, device=device)).image
    (image * weights).sum().backward()
    assert movement.grad is not None
    return movement.grad.cpu()


@pytest.mark.usefixtures("gsplat_kernels")
@pytest.mark.parametrize("direct", [False, True])
def test_gradient_by_a_pose_through_gsplat_is_that_of_the_oracle(direct: bool) -> None:
    expected = gradient_by_pose(OracleRasterizer(three_sigma_cut=False))
    gradient = gradient_by_pose(GsplatOnCpu(direct, own_radii=True, absgrad=False))
    assert float((gradient - expected).abs().max() / expected.abs().max()) < 1e-3  # worst seen 3e-5


@pytest.mark.gpu
@pytest.mark.parametrize("options", [{}, {"direct": False}, {"packed": True}], ids=str)
def test_gradient_by_a_pose_on_a_gpu_is_that_of_the_oracle(options: dict[str, bool]) -> None:
    expected = gradient_by_pose(OracleRasterizer(three_sigma_cut=False))
    gradient = gradient_by_pose(GsplatRasterizer(**options), "cuda")  # type: ignore[arg-type]  # booleans all
    assert float((gradient - expected).abs().max() / expected.abs().max()) < 2e-2


def test_what_a_similarity_transform_of_the_scene_explains_is_removed() -> None:
    """A turn about the origin, a shift and a growth of the scene move all cameras, and leave all images as they are."""
    scene = ring_scene(train=7)
    turn, shift, growth = torch.tensor([2e-3, -1e-3, 3e-3]), torch.tensor([0.01, 0.02, -0.01]), 0.004
    own = 0.01 * torch.randn(7, 6, generator=torch.Generator().manual_seed(0))

    def left(own: Tensor) -> Tensor:
        start: Poses = {}
        for view, row in zip(scene.train, own, strict=True):
            centre = view.camera.position
            moved = torch.linalg.cross(turn, centre) + shift + growth * centre
            start[view.name] = (row + torch.cat([-turn, moved])).tolist()
        return torch.tensor([*without_common_part(scene, start).values()])

    assert left(torch.zeros(7, 6)).abs().max() < 1e-7  # worst seen 3e-9
    remaining = left(own)
    assert (remaining - own).abs().max() > 1e-3  # they have something in common, too
    torch.testing.assert_close(left(remaining), remaining, atol=1e-7, rtol=0)
    torch.testing.assert_close(remaining[:, 3:].mean(0), torch.zeros(3), atol=1e-7, rtol=0)


def some_poses(scene: Scene) -> ViewPoses:
    start = {
        view.name: [0.01 * number, -0.02, 0.03, 0.1, 0.05 * number, -0.1] for number, view in enumerate(scene.train)
    }
    return ViewPoses.create(scene.train, start, scene.extent, torch.device("cpu"), 0, 100)


def test_finished_fields_are_trained_at_refined_poses_which_learn_from_them() -> None:
    scene, settings = ring_scene(train=4, test=0, size=(64, 48)), TrainSettings()
    refined_poses, field, black = some_poses(scene), blob_field(80), torch.zeros(3)
    model = TrainableField.create(field, settings.rates, scene.extent)
    cameras = {view.name: view.camera for view in scene.train}
    joint = JointFields({1: model}, cameras, CpuRasterizer(), black, refined_poses, {})
    view, pyramid = scene.train[2], Pyramid()
    image = joint.predictions(pyramid).get(view.name)
    moved = corrected(level_camera(view.camera, 1), refined_poses.archived()[view.name])
    expected = pyramid.up(CpuRasterizer().render_image(field, moved, background=black), (48, 64))
    torch.testing.assert_close(image, expected, atol=1e-6, rtol=0)  # equal here
    image.square().sum().backward()
    assert refined_poses.transforms.grad is not None
    assert [bool(row.any()) for row in refined_poses.transforms.grad] == [False, False, True, False]


def test_cameras_are_at_the_poses_that_were_restored() -> None:
    scene = ring_scene(train=4, test=0)
    refined_poses, view = some_poses(scene), scene.train[1]
    before = refined_poses.camera(view.name, view.camera)
    state = refined_poses.state()
    refined_poses.restore({**state, "transforms": torch.zeros_like(state["transforms"])})
    after = refined_poses.camera(view.name, view.camera)
    torch.testing.assert_close(after.world_to_camera, view.camera.world_to_camera, atol=1e-6, rtol=0)  # equal here
    assert (before.world_to_camera - after.world_to_camera).abs().max() > 1e-3


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_run_refines_poses_and_resumes_to_the_same_bits(tmp_path: Path, hierarchy: str) -> None:
    scene = perturbed(ring_scene(train=8, test=0), 0.02)
    settings = TrainSettings(iterations=96, hierarchy=hierarchy, sh_degree=1, refine_poses=True)
    whole = train(tmp_path / "whole", scene, settings)
    refined_to = [whole.poses(level) for level in (1, 0)]
    assert all(each is not None and max(map(abs, each["view_0.png"])) > 0 for each in refined_to)
    assert refined_to[0] != refined_to[1]  # the base's corrections were refined further
    for stop_at in ((1, 30), (0, 45)):  # level 0 trains jointly from its iteration 36 on
        folder = tmp_path / f"stopped_{stop_at[0]}"
        with pytest.raises(TrainingStoppedError):
            train(folder, scene, settings, monitor=StopAt(*stop_at))
        again = resume(folder, scene, settings)
        assert [again.poses(level) for level in (1, 0)] == refined_to
        assert all((again.field(level).means == whole.field(level).means).all() for level in (0, 1))


def test_refinement_finds_true_poses_and_sharpens_held_out_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poses, "FIRST_RATE", 0.15)  # a short run of tiny images
    truth = ring_scene(train=16, test=2, size=(32, 24))
    scene = perturbed(truth, 0.03)
    psnr, shift = {}, {}
    for refine in (False, True):
        settings = TrainSettings(iterations=700, levels=1, sh_degree=0, accumulate_views=1, refine_poses=refine)
        archive = train(tmp_path / str(refine), scene, settings)
        psnr[refine], shift[refine] = archive.history()[-1]["psnr"], shift_of_points(scene, truth, archive)
    assert shift[False] == shift_of_points(scene, truth) > 1.0
    assert shift[True] < 0.5 * shift[False]
    assert psnr[True] > psnr[False] + 1.0


def test_archived_corrections_move_training_cameras_and_no_others(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path))
    train_before, test_before = run_cameras(RunArchive.open(run))
    name = sorted(train_before)[1]
    moved = {each: [0.0] * 6 for each in train_before} | {name: [0.0, 0.0, 0.0, 0.5, -0.25, 1.0]}
    (run / "level_0" / POSES).write_text(json.dumps(moved))
    archive = RunArchive.open(run)
    train_after, test_after = run_cameras(archive)
    shift = train_after[name].position - train_before[name].position
    torch.testing.assert_close(shift, torch.tensor([0.5, -0.25, 1.0]), atol=5e-6, rtol=0)  # worst seen 1e-7
    loaded = run_scene(archive)
    for views, cameras in ((loaded.train, train_after), (loaded.test, test_after)):
        assert all((view.camera.world_to_camera == cameras[view.name].world_to_camera).all() for view in views)
    before, after = {**train_before, **test_before}, {**train_after, **test_after}
    for other in before.keys() - {name}:
        torch.testing.assert_close(after[other].world_to_camera, before[other].world_to_camera, atol=1e-6, rtol=0)


def test_held_out_views_move_with_their_neighbours_where_corrections_change_slowly() -> None:
    waves = [[math.sin(i / 4), math.cos(i / 5), 0.2, 30 * math.cos(i / 4), 0.0, -9.0] for i in range(20)]
    slow = {f"{2 * index:03d}.png": [0.01 * each for each in row] for index, row in enumerate(waves)}
    predicted = predicted_poses(slow, ["013.png", "004.png"])
    assert predicted["013.png"] == pytest.approx(np.mean([slow["012.png"], slow["014.png"]], axis=0), rel=1e-9)
    assert predicted["004.png"] == pytest.approx(slow["004.png"], rel=1e-9)  # 0 seen
    jumping = {name: [(-1.0) ** index * each for each in row] for index, (name, row) in enumerate(slow.items())}
    assert predicted_poses(jumping, ["013.png"]) == {}
    assert predicted_poses({}, ["013.png"]) == {}
    scene = ring_scene(train=6, test=2)
    poses = {view.name: [0.0, 0.0, 0.0, 0.3, 0.1, 0.01 * index] for index, view in enumerate(scene.train)}
    views = ViewPoses.create(scene.train, poses, scene.extent, torch.device("cpu"), 0, 100)
    camera = scene.test[1].camera
    shift = views.camera(scene.test[1].name, camera).position - camera.position
    torch.testing.assert_close(shift[:2], torch.tensor([0.3, 0.1]), atol=5e-6, rtol=0)  # 9.7e-8 seen
    assert views.camera(scene.test[1].name, camera) is views.camera(scene.test[1].name, camera)


def test_damaged_corrections_are_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path))
    (run / "level_0" / POSES).write_text(json.dumps({"01.png": [0.0, 0.0]}))
    with pytest.raises(RunFolderError, match=r"poses\.json.*train again with --overwrite"):
        run_cameras(RunArchive.open(run))


def test_a_checkpoint_of_other_views_is_refused(tmp_path: Path) -> None:
    shape, path = torch.Size([8, 6]), tmp_path / "checkpoint.pt"
    state = TransformsState(transforms=torch.zeros(7, 6), gradient=None, moments={})
    for found in (state, {**state, "transforms": torch.zeros(())}, None):
        with pytest.raises(RunFolderError, match="poses is not the state of transforms for 8 views"):
            check_transforms(found, shape, "poses", path)
    check_transforms({**state, "transforms": torch.zeros(8, 6)}, shape, "poses", path)


def test_refinement_is_refused_where_it_is_not_offered(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="--refine-poses True with --protocol paper"):
        TrainSettings(refine_poses=True, protocol="paper")
    error = CliRunner().invoke(app, ["run", "--refine-poses", "train.py", "-s", "scene"]).exception
    assert isinstance(error, UserInputError)
    assert str(error) == "no such option: --refine-poses; options of the script go after it, see `lapgs run --help`"


def without_common_part(scene: Scene, start: Poses) -> Poses:
    """Corrections after a step without a gradient."""
    views = ViewPoses.create(scene.train, start, scene.extent, torch.device("cpu"), 0, len(scene.train))
    views.transforms.grad = torch.zeros_like(views.transforms)
    views.after_step(len(scene.train), 1)
    return views.archived()


def perturbed(scene: Scene, noise: float) -> Scene:
    """The scene with wrong poses of its training views, as far as no similarity transform explains it."""
    count = len(scene.train)
    rows = noise * torch.randn(count, 6, generator=torch.Generator().manual_seed(5))
    start = {view.name: row.tolist() for view, row in zip(scene.train, rows, strict=True)}
    wrong = without_common_part(scene, start)
    return replace(
        scene, train=tuple(replace(view, camera=corrected(view.camera, wrong[view.name])) for view in scene.train)
    )


def shift_of_points(scene: Scene, truth: Scene, archive: RunArchive | None = None) -> float:
    """Mean distance in pixels between the scene's points at the training views' poses and at the true ones."""
    cameras = {view.name: view.camera for view in scene.train}
    cameras = cameras if archive is None else refined(archive, cameras)
    distances = []
    for view in truth.train:
        mine, true = (_projected(camera, truth.points) for camera in (cameras[view.name], view.camera))
        distances.append((mine - true).norm(dim=-1).mean())
    return float(torch.stack(distances).mean())


def _projected(camera: Camera, points: Tensor) -> Tensor:
    seen = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return camera.fx * seen[:, :2] / seen[:, 2:]
