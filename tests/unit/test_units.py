"""Test that scenes of any size load, train and render alike, and that what cannot be seen is said."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from lapgs_plugin.errors import SceneError, TrainingStoppedError, UserInputError
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.evaluation.stability import render_depth
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack, Rasterizer, RenderResult
from lapgs_plugin.fields.units import in_unit, unit_of_depth
from lapgs_plugin.hierarchy.inheritance import field_from_points
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.rig import Rig
from lapgs_plugin.rendering.run import run_renderer
from lapgs_plugin.reports.splat_page import write_splat_page
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.scenes.scene import Scene, load_scene
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.trainer import Trainer
from tests.training_runs import Said, StopAt, placed, plys, resume
from tests.training_scene import HEIGHT, WIDTH, blob_field, ring_camera, ring_scene

BLACK = torch.zeros(3)
SCALES = [1e-3, 0.05, 1.0, 20.0, 1e3]


def scaled(camera: Camera, scale: float) -> Camera:
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= scale
    return replace(camera, world_to_camera=pose)


def write_ring(folder: Path, scale: float = 1.0, points: np.ndarray | None = None) -> Path:
    """Write `ring_scene` as a transforms scene with its lengths times `scale`."""
    scene = ring_scene()
    (folder / "images").mkdir(parents=True)
    frames = []
    for view in sorted((*scene.train, *scene.test), key=lambda view: view.name):
        pixels = (view.image.permute(1, 2, 0) * 255).round().byte().numpy()
        Image.fromarray(pixels).save(folder / "images" / view.name)
        pose = np.linalg.inv(scaled(view.camera, scale).world_to_camera.double().numpy()) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": pose.tolist()})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": WIDTH * 0.9, "fl_y": WIDTH * 0.9, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames, "ply_file_path": "points.ply"}))
    points = scene.points.double().numpy() if points is None else points
    header = "".join(f"property double {axis}\n" for axis in "xyz")
    rows = "".join(" ".join(map(repr, map(float, row))) + "\n" for row in points * scale)
    (folder / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{header}end_header\n{rows}"
    )
    return folder


def settings_of(**options: Any) -> TrainSettings:
    return TrainSettings(**{"iterations": 30, "sh_degree": 1, "appearance": "none", **options})


def train(folder: Path, scene: Scene, monitor: Monitor | None = None, **options: Any) -> tuple[RunArchive, list[str]]:
    settings = settings_of(**options)
    manifest = Manifest(SceneReference.of(scene), rasterizer="cpu", **settings.for_manifest())
    said = Said()
    with RunArchive.create(folder, manifest) as archive:
        Trainer(PreparedRun.of(scene, settings, archive, placed(CpuRasterizer())), monitor=monitor or said).run()
    return RunArchive.open(folder), said.lines


@pytest.mark.parametrize(("hierarchy", "strategy"), [("laplacian", "3dgs"), ("nested", "mcmc")])
def test_a_scene_trains_and_renders_alike_in_any_units(hierarchy: str, strategy: str, tmp_path: Path) -> None:
    density = Densification(strategy, start=1, every=10, until=20)
    psnrs = {}
    for scale in (1e-3, 1.0, 1e3):
        scene = load_scene(write_ring(tmp_path / f"scene{scale}", scale), eval=True, progress=False)
        options = {"hierarchy": hierarchy, "split": "1/2,1/2", "densification": density, "levels": 2}
        archive, _ = train(tmp_path / f"run{scale}", scene, **options)
        renderer, camera = run_renderer(archive, "cpu"), scene.test[0].camera
        quality = psnr(renderer.frames([camera])[0], scene.test[0].image)
        base = archive.field(1)
        depth = render_depth(renderer.rasterizer, base, camera)
        middle = depth.depth[HEIGHT // 2, WIDTH // 2] / scale
        psnrs[scale] = quality, float(base.means.norm(dim=1).median()) / scale, float(middle)
    assert psnrs[1.0][0] > 12.0, "trained, and not black"
    for values in psnrs.values():
        assert values[0] == pytest.approx(psnrs[1.0][0], abs=0.1)  # 0.0004 seen
        assert values[1:] == pytest.approx(psnrs[1.0][1:], rel=0.02)  # 2e-5 seen


def test_corrections_of_poses_are_in_the_users_units(tmp_path: Path) -> None:
    """Corrections of poses are shifts in world units: those of a scene 64 times as large are 64 times as long."""
    shifts = []
    for scale in (1.0, 64.0):
        scene = load_scene(write_ring(tmp_path / f"scene{scale}", scale), eval=True, progress=False)
        archive, _ = train(tmp_path / f"run{scale}", scene, refine_poses=True, levels=1, iterations=24)
        poses = archive.poses(0)
        assert poses is not None
        shifts.append(torch.tensor([poses[name][3:] for name in sorted(poses)]))
    assert shifts[0].norm() > 0.0
    largest = float(shifts[0].abs().max())
    torch.testing.assert_close(shifts[1] / 64.0, shifts[0], rtol=0.0, atol=0.05 * largest)  # 0.002 * largest seen


def test_a_run_in_other_units_resumes_to_the_same_bits(tmp_path: Path) -> None:
    scene = load_scene(write_ring(tmp_path / "scene", 64.0), eval=True, progress=False)
    options = {"refine_poses": True, "levels": 2, "iterations": 24}
    whole, _ = train(tmp_path / "whole", scene, **options)
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "stopped", scene, StopAt(0, 9), **options)
    resumed = resume(tmp_path / "stopped", scene, settings_of(**options))
    assert plys(resumed) == plys(whole)
    assert resumed.poses(0) == whole.poses(0)


@pytest.mark.parametrize("scale", [*SCALES, 0.7, 1.9])
def test_the_unit_is_a_power_of_two_by_the_depth_of_points(scale: float, tmp_path: Path) -> None:
    scene = load_scene(write_ring(tmp_path / "scene", scale), progress=False)
    assert math.log2(scene.unit).is_integer()
    depths = torch.cat([view.camera.local(scene.points)[:, 2] for view in scene.train]) / scene.unit
    assert float(depths.median()) * (1 + 1e-5) >= 3.0
    assert float(depths.median()) < 6.0 * (1 + 1e-5)
    assert unit_of_depth(3.0) == unit_of_depth(5.99) == 1.0, "COLMAP's usual scenes are rendered as they are"
    assert SceneReference.of(scene).unit == scene.unit


@pytest.mark.parametrize("signed", [False, True])
def test_a_rasterizer_in_a_unit_renders_scaled_fields_as_the_others(signed: bool) -> None:
    field, camera, unit = replace(blob_field(), signed=signed), ring_camera(0.4), 1 / 64
    small = field.with_parameters({"means": field.means * unit, "log_scales": field.log_scales + math.log(unit)})
    fields = [one.with_parameters({k: v.requires_grad_() for k, v in one.parameters.items()}) for one in (field, small)]
    plain = CpuRasterizer()
    rasterizers, cameras = (plain, in_unit(plain, unit)), (camera, scaled(camera, unit))
    images = []
    for rasterizer, one, seen in zip(rasterizers, fields, cameras, strict=True):
        result = rasterizer(one, seen, background=BLACK)
        result.image.square().sum().backward()
        images.append(result.image.detach())
        assert torch.equal(rasterizer.render_image(one, seen, background=BLACK), result.image)
        assert torch.equal(rasterizer.render_images(one, [seen, seen], background=BLACK)[1], result.image)
    torch.testing.assert_close(images[1], images[0], rtol=1e-4, atol=1e-4)  # 2.4e-7 seen
    gradients = [one.means.grad for one in fields]
    assert gradients[0] is not None
    assert gradients[1] is not None
    error = (gradients[1] * unit - gradients[0]).norm() / gradients[0].norm()
    assert float(error) < 1e-3  # 4e-7 seen
    assert not plain(small, cameras[1], background=BLACK).image.any(), "all nearer than its near plane"
    assert in_unit(plain, 1.0) is plain


def test_batches_and_stacks_are_scaled_too() -> None:
    seen: list[Any] = []

    class Recording(CpuRasterizer):
        can_batch = mixes_sizes = can_stack = True

        def render_batch(self, field: GaussianField, cameras: Any, **_: Any) -> RenderResult:
            seen.append((field, *cameras))
            return RenderResult(*[torch.zeros(1)] * 4)

        def stack(self, fields: Any) -> FieldStack:
            seen.append(fields)
            return SimpleNamespace(render=lambda cameras, _: seen.append(cameras) or [])  # type: ignore[return-value]

    rasterizer: Rasterizer = in_unit(Recording(), 4.0)
    assert rasterizer.can_batch
    assert rasterizer.mixes_sizes
    assert rasterizer.can_stack
    field, camera = blob_field(5), ring_camera(0.0)
    rasterizer.render_batch(field, [camera, camera], background=BLACK)
    rasterizer.stack([field]).render([camera], None)
    (batched, first, second), (stacked,), (third,) = seen
    assert first is second is third, "a rasterizer knows a camera by its object"
    torch.testing.assert_close(first.position, camera.position / 4.0)
    for one in (batched, stacked):
        assert torch.equal(one.means, field.means / 4.0)
        torch.testing.assert_close(one.log_scales.exp(), field.log_scales.exp() / 4.0)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_what_cameras_look_at_does_not_depend_on_units(scale: float) -> None:
    cameras = [ring_camera(0.3 * i) for i in range(4)]
    plain, other = Rig.of(cameras), Rig.of([scaled(camera, scale) for camera in cameras])
    np.testing.assert_allclose(other.focus / scale, plain.focus, atol=1e-4)  # 2e-7 seen
    assert other.distance / scale == pytest.approx(plain.distance, rel=1e-4)  # 6e-8 seen


def test_a_page_draws_from_the_near_plane_of_the_run(tmp_path: Path) -> None:
    write_splat_page([blob_field(5)], tmp_path / "a.html", "a", [ring_camera(0.0)], (0.0, 0.0, 0.0), 0.2 / 16)
    page = (tmp_path / "a.html").read_text()
    assert '"near": 0.0125' in page
    assert "NEAR = START.near" in page


@pytest.mark.parametrize("jitter", [0.0, 1e-7])
def test_copies_of_a_point_are_no_neighbours(jitter: float) -> None:
    points = blob_field(200).means
    plain = field_from_points(points, torch.rand(200, 3), 0)
    generator = torch.Generator().manual_seed(0)
    copies = points.repeat(4, 1) + jitter * torch.randn(800, 3, generator=generator)
    repeated = field_from_points(copies, torch.rand(800, 3), 0)
    wrong = (repeated.log_scales - plain.log_scales.repeat(4, 1)).abs()
    assert float((wrong > 1e-3).float().mean()) < (0.1 if jitter else 1e-9)  # 0 to 0.03 seen: borders of places
    assert float(wrong.max()) < math.log(2.5)  # 0.62 seen


@pytest.mark.parametrize(
    ("points", "named"),
    [
        (np.zeros((1, 3)), "1 sparse point at 1 place"),
        (np.eye(3)[:2], "2 sparse points at 2 places"),
        (np.eye(3), "3 sparse points at 3 places"),
        (np.ones((50, 3)), "50 sparse points at 1 place"),
        (np.repeat(np.eye(3), 9, axis=0), "27 sparse points at 3 places"),
    ],
)
def test_points_at_too_few_places_are_refused(points: np.ndarray, named: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=f"{named}, expected points at 4 or more; "):
        load_scene(write_ring(tmp_path / "scene", points=points), progress=False)
    with pytest.raises(UserInputError, match=f"{named}, expected"):
        checkout_scene(points).check_points()


def test_a_first_view_without_a_gaussian_is_a_line(tmp_path: Path) -> None:
    scene = ring_scene()
    blind = replace(scene, points=scene.points + torch.tensor([0.0, 500.0, 0.0]))
    options = {"levels": 1, "iterations": 4}
    _, lines = train(tmp_path / "blind", blind, **options)
    (line,) = [each for each in lines if "none of 100 Gaussians is visible in view_" in each]
    assert "less than 0.2 in front of it" in line
    _, lines = train(tmp_path / "seen", scene, **options)
    assert not any("is visible" in each for each in lines)


def checkout_scene(points: np.ndarray, scale: float = 1.0) -> CheckoutScene:
    """Return a checkout's scene with the cameras of `ring_scene`."""

    def camera(index: int) -> Any:
        pose = scaled(ring_camera(0.8 * index), scale).world_to_camera
        fov = 2 * math.atan(0.5 / 0.9)
        return SimpleNamespace(world_view_transform=pose.T, FoVx=fov, FoVy=fov, image_name=f"view_{index}")

    cameras = [camera(index) for index in range(8)]
    scene = SimpleNamespace(getTrainCameras=lambda: cameras)
    return CheckoutScene(scene, SimpleNamespace(points=points * scale), ())


@pytest.mark.parametrize(
    ("scale", "away", "named"),
    [
        (1.0, 0.0, ""),
        (1e3, 0.0, ""),
        (0.01, 0.0, r"100 % of the points in view are nearer to the cameras than 0.2, .*scale poses and points by 1"),
        (1.0, 500.0, "no Gaussian will be visible at first in 8 of 8 training views, such as view_0"),
    ],
)
def test_a_checkout_is_told_of_points_that_its_rasterizer_does_not_draw(
    scale: float, away: float, named: str, caplog: pytest.LogCaptureFixture
) -> None:
    points = blob_field().means.numpy() + np.array([0.0, away, 0.0])
    checkout_scene(points, scale).check_points()
    lines = [record.getMessage() for record in caplog.records]
    assert [bool(re.search(named, line)) for line in lines[:1]] == [True] * bool(named)
