"""Depth: maps of every format and unit, points with and without tracks, the loss and its gradients, whole runs."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import SceneError, TrainingStoppedError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.rasterizer import Rasterizer, render_depths, render_inverse_depths
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.depth import (
    DepthMaps,
    DepthTargets,
    depth_size,
    fit_scale_and_shift,
    load_depth,
    resolve_depth,
)
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.normals import load_normals
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.scenes.sample.raycast import camera_rays, first_hits
from lapgs_plugin.scenes.sample.world import build_world
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.stages.geometry import StageGeometry, depth_loss, depth_scale, depth_weight, mean_inverse_depth
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.settings import TrainSettings
from lapgs_plugin.training.trainer import Trainer
from tests.cli.run_folder import write_scene
from tests.devices import DEVICES
from tests.refusals import refuses
from tests.training_runs import StopAt, make_archive, placed, plys
from tests.training_scene import blob_field, ring_camera, ring_scene
from tests.unit.test_exposure import wall_scene

SIZE = (96, 64)
VIEWS = 6


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample scene without depth."""
    folder = tmp_path_factory.mktemp("depth") / "sample"
    make_sample_scene(folder, width=SIZE[0], height=SIZE[1], views=VIEWS, points=600, progress=False)
    return folder


@pytest.fixture
def scene(sample: Path, tmp_path: Path) -> Path:
    """A copy of the sample scene that a test may change."""
    shutil.copytree(sample, tmp_path / "scene")
    return tmp_path / "scene"


def true_depth(camera: Camera) -> NDArray[np.float32]:
    """Depths (h, w) of the sample scene along the optical axis, by intersecting rays with its solids."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    origin, directions = camera_rays(camera, np.stack([columns.ravel(), rows.ravel()]) + 0.5)
    distance, _ = first_hits(build_world(0), origin, directions)
    depth = distance * (camera.world_to_camera[2, :3].numpy() @ directions)
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def npy(header: str) -> bytes:
    """The beginning of an .npy file of format 1.0, by NumPy's description of it."""
    line = header.ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line


def loaded(path: Path, setting: str = "auto") -> tuple[DepthTargets, Scene, list[str]]:
    """The depth of a scene, the scene, and what was said."""
    scene, lines = load_scene(path, progress=False), list[str]()
    depth = load_depth(scene, resolve_depth(path, setting), "images", lines.append)
    assert depth is not None
    return depth, scene, lines


def write_maps(folder: Path, scene: Scene, kind: str = "mm") -> None:
    """Write the true depth of all views in a format: 16-bit millimetres, EXR and NPY in other units, inverse depth."""
    folder.mkdir()
    for view in scene.train:
        depth, file = true_depth(view.camera), folder / view.name
        if kind == "mm":
            cv2.imwrite(str(file), np.rint(1000 * depth).astype(np.uint16))
        elif kind == "exr":
            write_image(file.with_suffix(".exr"), torch.from_numpy(0.4 * depth).expand(3, -1, -1))
        elif kind == "npy":
            np.save(file.with_suffix(".npy"), 12.5 * depth.astype(np.float64)[None])
        else:
            cv2.imwrite(str(file), np.rint(50_000 * (1 / depth + 0.2)).astype(np.uint16))


def worst(depth: DepthTargets, scene: Scene) -> float:
    """The largest median error of the inverse depth of a view, relative to it."""
    errors = []
    for view in (view for view in scene.train if view.name in depth.names):
        true = torch.from_numpy(true_depth(view.camera))
        errors.append(float((depth.inverse(view.name, view.camera.size) * true - 1).abs().nanmedian()))
    return max(errors)


@pytest.mark.parametrize("kind", ["mm", "exr", "npy", "inverse"])
def test_maps_of_any_format_and_unit_are_brought_to_the_depth_of_the_scene(scene: Path, kind: str) -> None:
    write_maps(scene / "depth", load_scene(scene, progress=False), kind)
    depth, loaded_scene, lines = loaded(scene)
    assert len(depth.names) == VIEWS
    assert worst(depth, loaded_scene) < 0.01  # worst seen 0.0019
    assert lines == [
        f"depth ({scene / 'depth'}): 6 of 6 training photos have a map, read as "
        f"{'inverse depth' if kind == 'inverse' else 'depth'}; 6 scales and shifts fitted to the points that the "
        "photos see"
    ]


def test_maps_that_cannot_be_used_are_named_and_the_others_are(scene: Path) -> None:
    write_maps(scene / "depth", load_scene(scene, progress=False))
    folder = scene / "depth"
    (folder / "0000.png").unlink()
    (folder / "0001.png").write_bytes(b"no image")
    cv2.imwrite(str(folder / "0002.png"), np.full((64, 64), 3000, np.uint16))  # another aspect ratio
    cv2.imwrite(str(folder / "0003.png"), np.zeros(SIZE[::-1], np.uint16))
    depth, loaded_scene, lines = loaded(scene)
    assert [*depth.names] == ["0004.png", "0005.png"]
    assert worst(depth, loaded_scene) < 0.01  # worst seen 0.0018
    assert len(lines) == 2
    assert lines[0].startswith(f"depth: 3 maps not used, the first: {folder / '0001.png'}")
    assert lines[0].endswith("(and 2 more)")
    assert "2 of 6 training photos have a map" in lines[1]


def test_maps_that_disagree_with_the_points_are_named(scene: Path) -> None:
    write_maps(scene / "depth", load_scene(scene, progress=False))
    folder, random = scene / "depth", np.random.default_rng(0)
    cv2.imwrite(str(folder / "0001.png"), np.full(SIZE[::-1], 65535, np.uint16))
    cv2.imwrite(str(folder / "0004.png"), random.integers(1000, 9000, SIZE[::-1]).astype(np.uint16))
    depth, loaded_scene, lines = loaded(scene)
    assert [*depth.names] == ["0000.png", "0002.png", "0003.png", "0005.png"]
    assert worst(depth, loaded_scene) < 0.01  # worst seen 0.0019
    assert lines[1].startswith("depth: 2 maps not used, because the points")
    assert lines[1].endswith("that of 0001.png")
    for file in folder.iterdir():
        cv2.imwrite(str(file), np.full(SIZE[::-1], 65535, np.uint16))
    refuses(SceneError, "none of 6 depth maps agrees with the points", loaded, scene)


@pytest.mark.parametrize(
    ("write", "facts"),
    [
        (lambda file: file.write_bytes(b"no image"), "none of 1 map of depth can be used"),
        (lambda file: cv2.imwrite(str(file), np.full((64, 64), 3000, np.uint16)), "64x64 pixels, its photo 96x64"),
        (lambda file: cv2.imwrite(str(file), np.zeros(SIZE[::-1], np.uint16)), "fewer than 32 of its pixels are valid"),
        (lambda file: cv2.imwrite(str(file), np.zeros((*SIZE[::-1], 3), np.uint8)), "a picture in colours"),
        (lambda file: np.save(file.with_suffix(".npy"), np.array(["text"])), "expected numbers"),
        (lambda file: np.save(file.with_suffix(".npy"), np.array([{}])), "cannot be read"),
        (lambda file: np.save(file.with_suffix(".npy"), np.ones((2, 64, 96))), "expected height and width"),
        (lambda file: np.save(file.with_suffix(".npy"), np.full(SIZE[::-1], np.nan)), "fewer than 32"),
        (lambda file: file.with_suffix(".npy").write_bytes(b"\x93NUMPY"), "cannot be read"),
        (lambda file: (file.parent / "other.png").write_bytes(b""), "no depth map of any of the 6 training photos"),
    ],
)
def test_only_unusable_maps_are_an_error_of_one_line(scene: Path, write: object, facts: str) -> None:
    (scene / "depth").mkdir()
    assert callable(write)
    write(scene / "depth" / "0000.png")
    assert "--depth none" in refuses(SceneError, facts, loaded, scene)
    result = CliRunner().invoke(
        app, ["train", str(scene), "-o", str(scene / "run"), "--iterations", "20", "--depth", "auto"]
    )
    assert isinstance(result.exception, SceneError)
    assert result.exception.exit_code == 2
    assert not (scene / "run").exists()


@pytest.mark.parametrize(
    ("start", "facts"),
    [
        (b"PK\x03\x04", "begins with b'PK.*expected NumPy's .npy format"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (64, 96"), "header is damaged"),
        (npy("{'descr': '<f4', 1: False, 'shape': (64, 96)}"), "header is damaged"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (True, 96)}"), "header is damaged"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (10000000000000000000000, 96)}"), "header is damaged"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (4611686018427387904, 96)}"), "header is damaged"),
    ],
)
def test_damaged_arrays_are_an_error_of_one_line(scene: Path, start: bytes, facts: str) -> None:
    (scene / "depth").mkdir()
    (scene / "depth" / "0000.npy").write_bytes(start + bytes(4 * SIZE[0] * SIZE[1]))
    refuses(SceneError, facts, loaded, scene)
    refuses(SceneError, facts, load_normals, load_scene(scene, progress=False), "depth", print)


def test_a_scene_chooses_the_folder_or_none(scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert resolve_depth(scene, "auto") == "none"
    assert f"no depth maps in {scene}, so depth is not supervised" in caplog.text
    assert resolve_depth(scene, "points") == "points"
    (scene / "lowres_depth").mkdir()
    caplog.clear()
    assert resolve_depth(scene, "auto") == "lowres_depth"
    assert not caplog.text
    (scene / "depth").mkdir()
    assert resolve_depth(scene, "auto") == "depth"
    (tmp_path / "maps").mkdir()
    assert resolve_depth(scene, str(tmp_path / "maps")) == str(tmp_path / "maps")
    refuses(UserInputError, "--depth map: no such folder", resolve_depth, scene, "map")


def test_masks_and_smaller_maps(scene: Path) -> None:
    write_maps(scene / "depth", load_scene(scene, progress=False))
    (scene / "masks").mkdir()
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, :48] = 0
    for file in sorted((scene / "images").iterdir()):
        cv2.imwrite(str(scene / "masks" / f"{file.stem}.png"), mask)
        small = cv2.imread(str(scene / "depth" / file.name), cv2.IMREAD_UNCHANGED)[::2, ::2]
        cv2.imwrite(str(scene / "depth" / file.name), small)
    depth, loaded_scene, _ = loaded(scene)
    inverse = depth.inverse("0000.png", SIZE)
    assert inverse[:, :48].isnan().all()
    assert not inverse[:, 48:].isnan().any()
    assert worst(depth, loaded_scene) < 0.03  # worst seen 0.006
    assert depth.inverse("0000.png", (24, 16)).shape == (16, 24)


def test_points_are_those_of_tracks_at_their_depth(scene: Path) -> None:
    depth, loaded_scene, lines = loaded(scene, "points")
    assert len(depth.names) == VIEWS
    assert worst(depth, loaded_scene) < 0.01  # worst seen 0.006: the points have noise
    assert lines[0].startswith("depth (points): 6 of 6 training photos see points")
    assert depth_size(SIZE) == SIZE


def test_hidden_points_without_tracks_are_left_out() -> None:
    scene, camera = ring_scene(), ring_camera(0.0)
    spread = 0.02 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    near, far = ((1 + 0.25 * z) * camera.position + spread for z in (-3.0, -4.5))  # on one line of sight
    points = torch.cat([near, far])
    view = replace(scene.train[0], camera=camera)
    scene = replace(scene, points=points, colors=torch.rand(400, 3), train=(view,), kind="transforms")
    depth = load_depth(scene, "points", "images", [].append)
    assert depth is not None
    inverse = depth.inverse(scene.train[0].name, camera.size)
    depths = camera.local(near)[:, 2]
    assert float(1 / inverse[~inverse.isnan()].min()) < 1.1 * float(depths.max())
    grey = replace(scene, colors=torch.full_like(points, 0.5))
    refuses(SceneError, "--depth points: no training photo", load_depth, grey, "points", "images", print)


def test_depth_file_path_of_nerfstudio_is_in_its_units(tmp_path: Path) -> None:
    write_scene(tmp_path)
    values = json.loads((tmp_path / "transforms.json").read_text())
    for index, frame in enumerate(values["frames"]):
        frame["depth_file_path"] = f"sensor/d_{index}.png"
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    (tmp_path / "sensor").mkdir()
    for index in range(len(values["frames"])):
        cv2.imwrite(str(tmp_path / "sensor" / f"d_{index}.png"), np.full((20, 28), 2500 + index, np.uint16))
    assert resolve_depth(tmp_path, "auto") == "transforms"
    depth, scene, lines = loaded(tmp_path)
    for index, view in enumerate(scene.train):
        inverse = depth.inverse(view.name, view.camera.size)
        torch.testing.assert_close(1 / inverse, torch.full_like(inverse, 2.5 + 0.001 * index))
    assert "nerfstudio's units" in lines[0]
    shutil.move(tmp_path / "sensor", tmp_path / "depth")
    for index, view in enumerate(scene.train):
        (tmp_path / "depth" / f"d_{index}.png").rename(tmp_path / "depth" / f"{Path(view.name).stem}.png")
    refuses(SceneError, "the scale of these depth maps is not known", loaded, tmp_path, "depth")


def test_scale_and_shift_are_found_despite_outliers() -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(500, generator=generator) + 0.2
    wanted = 0.3 * values + 0.05
    wanted[::5] = 3 * torch.rand(100, generator=generator)
    valid = torch.ones(500, dtype=torch.bool)
    fit = fit_scale_and_shift(values, wanted, valid)
    torch.testing.assert_close(fit, torch.tensor([0.3, 0.05]), atol=2e-3, rtol=0)  # 1.1e-4 seen
    even = fit_scale_and_shift(torch.full((40,), 2.0), torch.full((40,), 0.5), torch.ones(40, dtype=torch.bool))
    torch.testing.assert_close(even, torch.tensor([0.25, 0.0]))
    assert not fit_scale_and_shift(values, -wanted, valid).any()
    assert not fit_scale_and_shift(values, wanted, torch.arange(500) < 31).any()


def depth_gradients(rasterizer: Rasterizer, device: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """Gradients of a depth loss by the parameters of a field."""
    field = blob_field(120).to(device, dtype)
    leaves = {name: value.detach().clone().requires_grad_() for name, value in field.parameters.items()}
    camera = ring_camera(0.3)
    target = (0.2 + 0.1 * torch.rand(camera.height, camera.width, generator=torch.Generator().manual_seed(3))).to(dtype)
    target[::3] = torch.nan
    inverse = mean_inverse_depth(*render_inverse_depths(rasterizer, field.with_parameters(leaves), camera))
    target = target.to(device)
    depth_loss(inverse, target, depth_scale(target)).backward()  # type: ignore[no-untyped-call]  # torch's
    return {name: leaf.grad.cpu().double() for name, leaf in leaves.items() if name != "sh" and leaf.grad is not None}


@pytest.mark.parametrize("device", DEVICES)
def test_gradients_are_those_of_the_oracle_in_double_precision(device: str) -> None:
    own = depth_gradients(CpuRasterizer() if device == "cpu" else GsplatRasterizer(), device, torch.float32)
    exact = depth_gradients(OracleRasterizer(), "cpu", torch.float64)
    assert len(own) == 4
    for name in own:
        error = float((own[name] - exact[name]).norm() / exact[name].norm())
        # Worst seen 2.1e-6 on a CPU; on a GPU 7.8e-3: in one of the two, three pixels have an opacity below 1/255.
        assert error < (1e-4 if device == "cpu" else 2e-2), name


def test_gaussians_behind_the_camera_have_finite_gradients() -> None:
    field, camera = blob_field(50), ring_camera(0.0)
    means = field.means.clone()
    means[0] = camera.position
    means[1] = 2 * camera.position
    leaf = means.requires_grad_()
    inverse, opacity = render_inverse_depths(CpuRasterizer(), field.with_parameters({"means": leaf}), camera)
    assert opacity.max() <= 1 + 1e-6
    inverse.sum().backward()  # type: ignore[no-untyped-call]  # torch's
    assert leaf.grad is not None
    assert leaf.grad.isfinite().all()
    assert not leaf.grad[:2].any()


def test_weight_falls_over_the_levels_that_have_depth() -> None:
    nested = StagePlan.create((64, 48), 100, 2, hierarchy="nested")
    first, last = depth_weight(nested, nested[1], 0), depth_weight(nested, nested[0], 50)
    assert (first, last) == (1.0, pytest.approx(0.01))
    assert depth_weight(nested, nested[1], 50) == pytest.approx(0.1) == depth_weight(nested, nested[0], 0)
    residuals = StagePlan.create((64, 48), 100, 2)
    assert depth_weight(residuals, residuals[1], 50) == pytest.approx(0.01)


def test_views_without_depth_have_no_loss() -> None:
    targets = {"a": torch.full((40, 56), 0.25), "c": torch.full((40, 56), torch.nan)}
    stage, field, camera = StageGeometry(CpuRasterizer(), targets, {}, {}), blob_field(50), ring_camera(0.0)
    own = stage.loss([2], ["a"], [camera], field, 1.0)
    assert own is not None
    assert float(own) > 0
    torch.testing.assert_close(stage.loss([2], ["a"], [camera], field, 0.25), own / 4)
    assert stage.loss([2], ["b"], [camera], field, 1.0) is None
    assert stage.loss([1], ["a"], [camera], field, 1.0) is None
    assert stage.loss([2], ["c"], [camera], field, 1.0) == 0.0
    both = stage.loss([2, 4], ["a", "b"], [camera, camera], field, 1.0)
    torch.testing.assert_close(both, own / 2)


def wall_depth(scene: Scene) -> DepthMaps:
    """The closed form of the depth of `wall_scene`: that of the plane z = 0."""
    maps = {}
    for view in scene.train:
        camera = view.camera
        normal = camera.world_to_camera[:3, 2]  # of the plane, in the camera's axes
        rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
        maps[view.name] = (normal[0] * x + normal[1] * y + normal[2]) / (normal @ camera.world_to_camera[:3, 3])
    return DepthMaps(maps)


def trained(path: Path, scene: Scene, settings: TrainSettings, depth: DepthTargets | None, **options: object) -> Path:
    """Train a run with depth, or go on with one."""
    resumes = path.exists()
    archive = RunArchive.open(path, resume=True) if resumes else make_archive(path, settings)
    with archive:
        run = PreparedRun.of(scene, settings, archive, placed(CpuRasterizer()), resumes=resumes, depth=depth)
        Trainer(run, **options).run()  # type: ignore[arg-type]
    return path


@pytest.mark.parametrize(("hierarchy", "levels"), [("laplacian", 1), ("nested", 2), ("laplacian", 2)])
def test_a_plane_at_known_depth_is_found(tmp_path: Path, hierarchy: str, levels: int) -> None:
    scene = wall_scene((0.0,) * 3)
    points = 3 * torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) - 1.5
    scene = replace(scene, points=points, colors=torch.full_like(points, 0.5))
    settings = TrainSettings(iterations=1200, hierarchy=hierarchy, levels=levels, appearance="none")
    depth, errors = wall_depth(scene), []
    for name, given in (("without", None), ("with", depth)):
        archive = RunArchive.open(trained(tmp_path / name, scene, settings, given))
        field = archive.field(levels - 1 if hierarchy == "laplacian" else 0)
        worst_view = 0.0
        for view in scene.train:
            blended, opacity = render_depths(CpuRasterizer(), field, view.camera)
            relative = blended / opacity * depth.maps[view.name] - 1
            worst_view = max(worst_view, float(relative.abs().nanmedian()))
        errors.append(worst_view)
    assert errors[1] < 0.6 * errors[0]  # worst seen 0.37


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_a_stopped_run_continues_to_the_same_bits(tmp_path: Path, hierarchy: str) -> None:
    scene = wall_scene((0.0,) * 3)
    settings, depth = TrainSettings(iterations=60, hierarchy=hierarchy), wall_depth(scene)
    whole = trained(tmp_path / "whole", scene, settings, depth)
    with pytest.raises(TrainingStoppedError):
        trained(tmp_path / "parts", scene, settings, depth, monitor=StopAt(1, 15))
    parts = trained(tmp_path / "parts", scene, settings, depth)
    assert plys(RunArchive.open(whole)) == plys(RunArchive.open(parts))
    without = trained(tmp_path / "without", scene, settings, None)
    assert plys(RunArchive.open(whole))[0] != plys(RunArchive.open(without))[0]


def test_train_reads_depth_and_keeps_the_choice(scene: Path, tmp_path: Path) -> None:
    write_maps(scene / "depth", load_scene(scene, progress=False))
    call = ["train", str(scene), "--iterations", "40", "--levels", "1"]
    outs = [tmp_path / name for name in ("auto", "none", "points")]
    for out in outs:
        result = CliRunner().invoke(app, [*call, "-o", str(out), "--depth", out.name])
        assert result.exit_code == 0, result.output
    assert len({(out / "level_0" / "point_cloud.ply").read_bytes() for out in outs}) == 3
    saved = [RunArchive.open(out).manifest.settings["depth"] for out in outs]
    assert saved == ["depth", "none", "points"]
    assert 'depth = "depth"' in (outs[0] / "run.toml").read_text()
    other = CliRunner().invoke(app, [*call, "-o", str(outs[0]), "--resume", "--depth", "none"])
    assert "--depth asks for none" in str(other.exception)
    paper = CliRunner().invoke(app, [*call[:-2], "-o", str(tmp_path / "p"), "--protocol", "paper", "--depth", "points"])
    assert "--depth points with --protocol paper" in str(paper.exception)
