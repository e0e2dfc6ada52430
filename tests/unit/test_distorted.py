"""--distorted: lenses against pycolmap, renders along rays against formulas, runs, and what is refused."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner, Result

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import SceneError, TrainingStoppedError, UserInputError
from lapgs_plugin.fields.camera import PIXELS_OF_A_STRIP, Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.lens import Lens
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.rendering.run import path_cameras, run_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.exports.registry import find_export
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.lenses import lens_of
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.scenes.scene import load_cameras
from lapgs_plugin.training.preparation import TrainRequest, prepare
from lapgs_plugin.training.settings import TrainSettings
from lapgs_plugin.training.trainer import Trainer
from tests.bent_scene import FISHEYE, write_bent_scene, write_model
from tests.export_writers import Capture, synthetic, write_bundler, write_metashape, write_opensfm
from tests.refusals import refuses
from tests.training_runs import StopAt, plys
from tests.training_scene import blob_field, ring_camera

SIZE = (48, 36)
MODELS = {
    "SIMPLE_RADIAL": (-0.15,),
    "RADIAL": (-0.2, 0.04),
    "OPENCV": (-0.2, 0.05, 0.004, -0.003),
    "FULL_OPENCV": (-0.2, 0.05, 0.004, -0.003, 0.01, 0.02, -0.01, 0.003),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": (0.03,),
    "RADIAL_FISHEYE": (0.03, -0.02),
    "OPENCV_FISHEYE": (0.05, -0.02, 0.004, -0.001),
    "THIN_PRISM_FISHEYE": (0.05, -0.02, 0.0, 0.0, 0.004, -0.001, 0.0, 0.0),
}
"""Distortion of every lens that is known, by COLMAP's names."""
ONE_FOCAL = [name for name in MODELS if name.startswith(("SIMPLE", "RADIAL"))]


def of_colmap(model: str, size: tuple[int, int] = (64, 48), focal: float = 40.0) -> tuple[pycolmap.Camera, Camera]:
    """A camera of COLMAP, and ours."""
    focals = (focal, focal) if model in ONE_FOCAL else (focal, focal + 2.0)
    center = size[0] / 2 + 1.5, size[1] / 2 - 2.0
    params = [*(focals[:1] if model in ONE_FOCAL else focals), *center, *MODELS[model]]
    theirs = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)
    ours = Camera(
        *size, *focals, *center, torch.eye(4, dtype=torch.float64), lens_of(model, MODELS[model], "it", Path("here"))
    )
    return theirs, ours


@pytest.mark.parametrize("model", MODELS)
def test_lenses_project_as_colmaps(model: str) -> None:
    theirs, ours = of_colmap(model)
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points[:, 2] = 2.0 + points[:, 2].abs()
    pixels, valid = ours.projected(points)
    expected = torch.from_numpy(np.asarray(theirs.img_from_cam(points.numpy())))
    assert valid.double().mean() > 0.95
    torch.testing.assert_close(pixels[valid], expected[valid], rtol=0, atol=1e-9)  # worst 3e-14


@pytest.mark.parametrize("model", MODELS)
def test_rays_of_pixels_are_those_of_colmap(model: str) -> None:
    theirs, ours = of_colmap(model)
    rays, seen = ours.pixel_rays()
    rows, columns = np.nonzero(seen.numpy())
    assert seen.double().mean() > 0.95
    pixels = np.stack([columns, rows], 1) + 0.5
    again = np.asarray(theirs.img_from_cam(rays[seen].numpy()))
    np.testing.assert_allclose(again, pixels, rtol=0, atol=1e-4)  # worst 2e-11
    np.testing.assert_allclose(np.linalg.norm(rays[seen].numpy(), axis=1), 1.0)


@pytest.mark.parametrize("model", ["FULL_OPENCV", "OPENCV_FISHEYE"])
def test_rays_of_large_images_are_those_of_colmap(model: str) -> None:
    """Images whose rays are sought in several strips of rows."""
    theirs, ours = of_colmap(model, (301, 263), 180.0)
    rays, seen = ours.pixel_rays()
    assert ours.width * ours.height > 2 * PIXELS_OF_A_STRIP
    assert torch.equal(ours.lit_pixels(), seen)
    assert seen.double().mean() > 0.95
    rows, columns = np.nonzero(seen.numpy())
    again = np.asarray(theirs.img_from_cam(rays[seen].numpy()))
    np.testing.assert_allclose(again, np.stack([columns, rows], 1) + 0.5, rtol=0, atol=1e-4)  # worst 1e-10


def test_level_cameras_keep_the_lens() -> None:
    theirs, ours = of_colmap("OPENCV")
    half = ours.resized(32, 24)
    theirs.rescale(32, 24)
    points = torch.tensor([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.2]], dtype=torch.float64)
    expected = torch.from_numpy(np.asarray(theirs.img_from_cam(points.numpy())))
    torch.testing.assert_close(half.projected(points)[0], expected)


def test_fisheye_shows_nothing_beyond_90_degrees() -> None:
    camera = Camera(64, 64, 25.0, 25.0, 32.0, 32.0, torch.eye(4), Lens(True, (0.0,) * 4))
    rays, seen = camera.pixel_rays()
    rows, columns = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    angles = torch.hypot(rows - 32, columns - 32) / 25  # of an equidistant lens
    assert torch.equal(seen, angles < math.pi / 2)
    assert (rays[seen][:, 2] > 0).all()


def along_rays(field: GaussianField, camera: Camera, background: Tensor) -> Tensor:
    """The image by its definition: each pixel's ray meets each Gaussian where its density is largest."""
    covariances = torch.linalg.inv(precisions(field))
    rays, seen = camera.pixel_rays()
    rays = rays.to(field.means) @ camera.world_to_camera[:3, :3].to(field.means)  # (h, w, 3) in the world
    inverse = torch.linalg.inv(covariances)
    offsets = camera.position.to(field.means) - field.means  # (n, 3)
    along = -torch.einsum("hwi,nij,nj->nhw", rays, inverse, offsets) / torch.einsum(
        "hwi,nij,hwj->nhw", rays, inverse, rays
    )
    nearest = offsets[:, None, None] + along[..., None] * rays  # (n, h, w, 3)
    distances = torch.einsum("nhwi,nij,nhwj->nhw", nearest, inverse, nearest)
    alphas = (torch.sigmoid(field.opacity_logits)[:, None, None] * torch.exp(-distances / 2)).clamp_max(0.999)
    order = torch.argsort(camera.local(field.means)[:, 2])
    alphas = torch.where((alphas >= 1 / 255) & seen, alphas, 0.0)[order]
    colors = (0.5 + field.sh[order, 0] / math.sqrt(4 * math.pi)).clamp_min(0)  # (n, 3)
    before = torch.cat([torch.ones_like(alphas[:1]), (1 - alphas).cumprod(0)])
    return torch.einsum("nhw,nc->chw", alphas * before[:-1], colors) + before[-1] * background[:, None, None]


def precisions(field: GaussianField) -> Tensor:
    """Inverse covariances (n, 3, 3), by rotating the axes with quaternion products."""
    w, x, y, z = torch.nn.functional.normalize(field.quaternions, dim=1).unbind(1)
    turn = torch.stack([w, x, y, z], 1)
    columns = []
    for axis in torch.eye(3, dtype=field.means.dtype):
        vector = axis.expand(len(field), 3)
        twice = 2 * torch.linalg.cross(turn[:, 1:], vector)
        columns.append(vector + turn[:, :1] * twice + torch.linalg.cross(turn[:, 1:], twice))
    axes = torch.stack(columns, 2)  # (n, 3, 3) columns are the turned axes
    return axes @ torch.diag_embed(torch.exp(-2 * field.log_scales)) @ axes.mT


def small_field(count: int = 60) -> GaussianField:
    """Gaussians that are small enough for their ellipses, and faint enough to see through."""
    field = blob_field(count).to("cpu", torch.float64)
    return field.with_parameters({"log_scales": field.log_scales - 0.5, "opacity_logits": field.opacity_logits - 1.5})


@pytest.mark.parametrize("lens", [None, FISHEYE, Lens(False, (-0.2, 0.05, 0.0, 0.0, 0.0, 0.0), (0.01, -0.02))])
def test_cpu_rasterizer_renders_along_rays(lens: Lens | None) -> None:
    field, camera = small_field(), replace(ring_camera(0.4), lens=lens)
    background = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    result = CpuRasterizer(rays=True)(field, camera, background=background)
    expected = along_rays(field, camera, background)
    assert (result.image - expected).abs().max() < 0.006  # a pixel whose alpha is 1/255; worst 1e-7
    assert (result.image - expected).abs().mean() < 1e-6  # worst 2e-9
    assert (expected - background[:, None, None]).abs().mean() > 0.005


def test_gradients_along_rays_are_those_of_the_definition() -> None:
    camera, background = replace(ring_camera(0.4), lens=FISHEYE), torch.zeros(3, dtype=torch.float64)
    weights = torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(2)).double()
    gradients = []
    for render in (lambda f: CpuRasterizer(rays=True)(f, camera, background=background).image,
                   lambda f: along_rays(f, camera, background)):  # fmt: skip
        leaves = {name: value.clone().requires_grad_() for name, value in small_field().parameters.items()}
        (render(small_field().with_parameters(leaves)) * weights).sum().backward()
        gradients.append({name: leaf.grad for name, leaf in leaves.items()})
    for name, expected in gradients[1].items():
        assert expected is not None
        ours = gradients[0][name]
        assert ours is not None
        assert (ours - expected).norm() < 1e-3 * expected.norm(), name  # worst 4e-7


def test_large_gaussians_look_as_they_do_by_splatting() -> None:
    field, camera, background = blob_field(40), ring_camera(0.2, 112, 80), torch.zeros(3)
    splatted = OracleRasterizer()(field, camera, background=background).image
    rays = CpuRasterizer(rays=True)(field, camera, background=background)
    assert (rays.image - splatted).abs().mean() < 0.01  # worst 0.0034: blurred by a third of a pixel, linearised
    assert splatted.abs().mean() > 0.05


def test_lengths_of_gradients_by_centres_are_those_of_splatting() -> None:
    field, camera, lengths = blob_field(200), ring_camera(0.2, 112, 80), []
    weights = torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(1))
    for rasterizer in (OracleRasterizer(), CpuRasterizer(rays=True)):
        leaves = {name: value.clone().requires_grad_() for name, value in field.parameters.items()}
        result = rasterizer(field.with_parameters(leaves), camera, background=torch.zeros(3))
        (result.image * weights).sum().backward()
        assert result.means2d.grad is not None
        lengths.append(result.means2d.grad.norm(dim=1))
    assert torch.corrcoef(torch.stack(lengths))[0, 1] > 0.95  # worst 0.991: Gaussians along rays are not blurred
    assert 1.0 < lengths[1].sum() / lengths[0].sum() < 1.3  # 1.13


def test_nothing_in_front_of_a_camera_is_its_background() -> None:
    camera, background = replace(ring_camera(0.2), lens=FISHEYE), torch.tensor([0.1, 0.2, 0.3])
    for field in (blob_field(0), blob_field(5).with_parameters({"means": torch.full((5, 3), 100.0)})):
        leaves = {name: value.clone().requires_grad_() for name, value in field.parameters.items()}
        result = CpuRasterizer(rays=True)(field.with_parameters(leaves), camera, background=background)
        assert torch.equal(result.image, background[:, None, None].expand_as(result.image))
        result.image.sum().backward()  # type: ignore[no-untyped-call]  # torch's


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of a fisheye lens."""
    scene = tmp_path_factory.mktemp("scenes") / "bent"
    write_bent_scene(scene, size=SIZE, focal=24.0, views=32)
    return scene


def lapgs(*arguments: object) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def succeeds(*arguments: object) -> Result:
    result = lapgs(*arguments)
    assert result.exit_code == 0, result.output
    return result


def psnr_of(run: Path) -> float:
    succeeds("eval", run, "--device", "cpu")
    return float(json.loads((run / "metrics.json").read_text())["psnr"])


def as_pinhole(scene: Path, out: Path) -> Path:
    """The same photos, said to be a pinhole's."""
    shutil.copytree(scene, out)
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    camera = model.cameras[1]
    params = list(camera.params[:4])
    camera.model = pycolmap.CameraModelId.PINHOLE
    camera.params = params
    model.write(out / "sparse" / "0")
    return out


def test_a_lens_as_it_is_trains_better_than_as_a_pinhole(bent: Path, tmp_path: Path) -> None:
    options = ["--eval", "--levels", 1, "--iterations", 500, "--appearance", "none", "--strategy", "mcmc"]
    started = succeeds("train", bent, "-o", tmp_path / "bent", "--distorted", *options)
    assert "--distorted: 32 photos of fisheye and 0 of perspective lenses" in started.output
    succeeds("train", as_pinhole(bent, tmp_path / "scene"), "-o", tmp_path / "straight", *options)
    assert psnr_of(tmp_path / "bent") > psnr_of(tmp_path / "straight") + 1.0  # 22.97 and 20.67 dB


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_a_run_of_levels_is_continued_measured_and_rendered(bent: Path, tmp_path: Path, hierarchy: str) -> None:
    whole, part = tmp_path / "whole", tmp_path / "part"
    options = ["--eval", "--hierarchy", hierarchy, "--distorted"]
    succeeds("train", bent, "-o", whole, *options, "--iterations", 90)
    archive = RunArchive.open(whole)
    assert archive.manifest.scene.distorted
    assert archive.manifest.complete
    scene = run_scene(archive)
    assert all(view.camera.lens == FISHEYE for view in (*scene.train, *scene.test))
    assert psnr_of(whole) > 12.0  # 15.2 and 15.5
    assert all(camera.lens is None for camera in path_cameras(archive, "orbit", 3, 3, None))
    succeeds("render", whole, "--trajectory", "orbit", "--frames", 2, "--device", "cpu", "-o", tmp_path / "frames")
    settings = TrainSettings(iterations=90, hierarchy=hierarchy, distorted=True)
    with (
        prepare(TrainRequest(bent, part, settings, SceneOptions(eval=True))) as run,
        pytest.raises(TrainingStoppedError),
    ):
        Trainer(run, monitor=StopAt(0, 20)).run()
    succeeds("train", bent, "-o", part, "--resume")
    assert plys(RunArchive.open(part)) == plys(archive)


def test_pixels_without_a_ray_are_masked(tmp_path: Path) -> None:
    write_bent_scene(tmp_path, size=SIZE, focal=15.0, views=4)
    scene = load_scene(tmp_path, distorted=True, progress=False)
    mask = scene.train[0].mask
    assert mask is not None
    assert torch.equal(mask[0], scene.train[0].camera.pixel_rays()[1])
    assert 0.5 < mask.double().mean() < 1.0
    disk = load_scene(tmp_path, distorted=True, progress=False, hold=False, read=False)
    assert torch.equal(disk.train[0].mask, mask)  # type: ignore[arg-type]  # there is one


def test_photos_of_which_a_lens_shows_nothing_are_refused(tmp_path: Path) -> None:
    write_bent_scene(tmp_path, size=SIZE, focal=24.0, views=4)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    model.cameras[1].model = pycolmap.CameraModelId.OPENCV
    model.cameras[1].params = [24.0, 24.0, 400.0, 18.0, -5.0, 0.0, 0.0, 0.0]
    model.write(tmp_path / "sparse" / "0")
    refuses(SceneError, "00.png: its lens shows nothing to any pixel", load_scene, tmp_path, distorted=True)


def test_a_mask_that_hides_all_that_a_lens_shows_is_refused(tmp_path: Path) -> None:
    write_bent_scene(tmp_path, size=SIZE, focal=15.0, views=4)
    lit = load_scene(tmp_path, distorted=True, progress=False).train[0].camera.lit_pixels()
    for number in range(4):
        write_image(tmp_path / "masks" / f"{number:02d}.png", (~lit).float().expand(3, -1, -1))
    refuses(SceneError, "its mask hides all that its lens shows", load_scene, tmp_path, distorted=True)


def as_transforms(scene: Path, out: Path, lens: dict[str, object]) -> Path:
    """The scene as a transforms.json with these values."""
    shutil.copytree(scene / "images", out / "images")
    frames = []
    for name, image in (
        (image.name, image) for image in pycolmap.Reconstruction(scene / "sparse" / "0").images.values()
    ):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        frames.append({"file_path": f"images/{name}", "transform_matrix": (pose @ np.diag([1, -1, -1, 1])).tolist()})
    values = {"w": SIZE[0], "h": SIZE[1], "fl_x": 24.0, "fl_y": 24.0, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, **lens}
    (out / "transforms.json").write_text(json.dumps({**values, "frames": frames}))
    return out


def test_transforms_have_lenses_too(bent: Path, tmp_path: Path) -> None:
    k1, k2, _, _ = FISHEYE.radial
    fisheye = as_transforms(bent, tmp_path / "fisheye", {"camera_model": "OPENCV_FISHEYE", "k1": k1, "k2": k2})
    scene = load_scene(fisheye, distorted=True, progress=False, eval=True)
    assert scene.test
    assert all(view.camera.lens == FISHEYE for view in (*scene.train, *scene.test))
    terms = {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": 0.003}
    radial = as_transforms(bent, tmp_path / "radial", {"camera_model": "OPENCV", **terms})
    lens = load_scene(radial, distorted=True, progress=False).train[0].camera.lens
    assert lens == Lens(False, (-0.1, 0.02, 0.003, 0.0, 0.0, 0.0), (0.001, -0.002))
    fourth = as_transforms(bent, tmp_path / "fourth", {"camera_model": "OPENCV", "k1": 0.1, "k4": 0.2})
    refuses(SceneError, "k4 = 0.2.*trained on as it is.*expected", load_scene, fourth, distorted=True)


@pytest.mark.parametrize("write", [write_metashape, write_bundler, write_opensfm])
def test_exports_have_lenses_too(write: Callable[[Path, Capture], None], tmp_path: Path) -> None:
    write(tmp_path, synthetic(distorted=True))
    export = find_export(tmp_path)
    assert export is not None
    model, _ = export.read(tmp_path)
    by_name = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    cameras, _ = load_cameras(tmp_path, distorted=True)
    points = np.random.default_rng(0).uniform((-0.3, -0.3, 1), (0.3, 0.3, 1.5), (50, 3))
    for name, camera in cameras.items():
        assert camera.lens is not None
        ours = camera.projected(torch.from_numpy(points))[0]
        np.testing.assert_allclose(ours, by_name[name].img_from_cam(points), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "distortion", "facts"),
    [
        ("FOV", (0.5,), "lens model FOV.*expected one of.*OPENCV_FISHEYE.*calibrate.*lapgs prepare"),
        ("THIN_PRISM_FISHEYE", (0.1, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.02), "THIN_PRISM_FISHEYE with p1 and sy1"),
        ("EQUIRECTANGULAR", (), "EQUIRECTANGULAR.*cut its photos"),
        ("OPENCV", (math.nan, 0.0, 0.0, 0.0), "NaN or inf"),
    ],
)
def test_other_lenses_are_refused_by_name(model: str, distortion: Sequence[float], facts: str) -> None:
    refuses(SceneError, facts, lens_of, model, distortion, "cameras.bin: camera 1", Path("scene"))


def test_a_scene_of_an_unknown_lens_is_refused(bent: Path, tmp_path: Path) -> None:
    shutil.copytree(bent / "images", tmp_path / "images")
    write_model(tmp_path, [ring_camera(0.1 * i, *SIZE) for i in range(4)], "FOV", [0.9])
    refuses(SceneError, "camera 1 has the lens model FOV", load_scene, tmp_path, distorted=True)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        (["--strategy", "3dgs"], "--distorted with --strategy 3dgs"),
        (["--densify-threshold", "1e-4"], "only mcmc is tried"),
        (["--depth", "points"], "--distorted with --depth points"),
        (["--refine-poses"], "--distorted with --refine-poses"),
        (["--protocol", "paper"], "--distorted with --protocol paper"),
        (["--hierarchy", "nested", "--tiles", "1x2"], "--distorted with --tiles"),
        (["--rasterizer", "oracle"], "oracle renders pinholes alone.*choose gsplat or cpu"),
    ],
)
def test_what_does_not_go_with_lenses_is_refused(bent: Path, tmp_path: Path, options: list[str], facts: str) -> None:
    result = lapgs("train", bent, "-o", tmp_path / "run", "--distorted", *options)
    assert isinstance(result.exception, SystemExit | UserInputError), result.output
    line = str(result.exception) if isinstance(result.exception, UserInputError) else result.output
    assert re.search(facts, " ".join(line.split())), line
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_gsplat_without_a_gpu_is_refused(bent: Path, tmp_path: Path) -> None:
    result = lapgs("train", bent, "-o", tmp_path / "run", "--distorted", "--rasterizer", "gsplat")
    assert "--distorted needs gsplat's CUDA part" in str(result.exception) + result.output
    assert not (tmp_path / "run").exists()


def test_pinholes_need_no_option(bent: Path, tmp_path: Path) -> None:
    scene = as_pinhole(bent, tmp_path / "scene")
    refuses(SceneError, "no camera of it is distorted.*leave it out", load_scene, scene, distorted=True)
    refuses(SceneError, "OPENCV_FISHEYE.*lapgs prepare.*--distorted", load_scene, bent)


def test_auto_chooses_mcmc_in_short_runs() -> None:
    assert TrainSettings(iterations=300, distorted=True).densification.strategy == "mcmc"
    assert TrainSettings(iterations=300).densification.strategy == "3dgs"
