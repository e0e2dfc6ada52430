"""Refinement of poses: gradients by a camera's pose, corrections of a run's views, and how they are archived."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.pose import corrected, turned_gradient, with_pose_gradient
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.rendering.run import refined, run_cameras, run_scene
from lapgs_plugin.runs.archive import Poses, RunArchive
from lapgs_plugin.scenes.scene import Scene, load_cameras
from lapgs_plugin.training.poses import ViewPoses
from lapgs_plugin.training.settings import TrainSettings
from tests.cli.run_folder import write_run, write_scene
from tests.training_scene import blob_field, ring_camera, ring_scene
from tests.unit.test_exposure import train

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
        poses = ViewPoses.create(scene.train, start, scene.extent, torch.device("cpu"), 0, 100)
        poses.transforms.grad = torch.zeros_like(poses.transforms)
        poses.after_step(7, 1)
        return torch.tensor([*poses.archived().values()])

    assert left(torch.zeros(7, 6)).abs().max() < 1e-7  # worst seen 4e-9
    remaining = left(own)
    assert (remaining - own).abs().max() > 1e-3  # they have something in common, too
    torch.testing.assert_close(left(remaining), remaining, atol=1e-7, rtol=0)
    torch.testing.assert_close(remaining[:, 3:].mean(0), torch.zeros(3), atol=1e-7, rtol=0)


def perturbed(scene: Scene, noise: float) -> Scene:
    """The scene with wrong poses of its training views, as far as no similarity transform explains it."""
    count = len(scene.train)
    rows = noise * torch.randn(count, 6, generator=torch.Generator().manual_seed(5))
    start = {view.name: row.tolist() for view, row in zip(scene.train, rows, strict=True)}
    poses = ViewPoses.create(scene.train, start, scene.extent, torch.device("cpu"), 0, 1)
    poses.transforms.grad = torch.zeros_like(poses.transforms)
    poses.after_step(count, 1)
    wrong = poses.archived()
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
