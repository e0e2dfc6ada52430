"""Test backgrounds, transparent images, depths, exposures, and other options of checkouts in a hierarchy."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.figures import evaluate_run
from lapgs_plugin.rasterizers.signed_color import signed_degree
from lapgs_plugin.runs import training_figures
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes import load_scene
from tests.contract.stub_runs import (
    CHECKOUTS,
    KINDS,
    NAMES,
    SHORT,
    STUBS,
    STUBS_AND_KINDS,
    THIRDS,
    WHITE,
    StopAt,
    Stub,
    captured,
    composed_psnr,
    drive,
    drive_residuals,
    edited_graphdeco,
    loaded,
    run_hierarchy,
    run_residuals,
)


@pytest.fixture(scope="module")
def blender(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the sample scene as a Blender scene: transforms, RGBA without a background, train and test folders."""
    path = tmp_path_factory.mktemp("blender")
    source = load_scene(scene, eval=True, progress=False)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    for part, views in (("train", source.train), ("test", source.test)):
        (path / part).mkdir()
        frames = []
        for index, view in enumerate(views):
            pixels = (view.image.permute(1, 2, 0) * 255).round().byte().numpy()
            alpha = np.full((*pixels.shape[:2], 1), 255, np.uint8)
            alpha[:16] = 0
            Image.fromarray(np.concatenate([pixels, alpha], axis=2)).save(path / part / f"r_{index}.png")
            pose = torch.linalg.inv(view.camera.world_to_camera) @ flip
            frames.append({"file_path": f"./{part}/r_{index}", "transform_matrix": pose.tolist()})
        angle = 2 * float(np.arctan(source.train[0].camera.tan_half_fov[0]))
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (path / f"transforms_{part}.json").write_text(text, encoding="utf-8")
    names = ("x", "y", "z", "red", "green", "blue")
    vertices = np.zeros(len(source.points), dtype=[(name, "u1" if len(name) > 1 else "f4") for name in names])
    for name, column in zip(names, torch.cat([source.points, source.colors * 255], dim=1).T, strict=True):
        vertices[name] = column
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path / "points3d.ply"))
    return path


def rasterized(stub: Stub, scene: Path, folder: Path, *more: Any, **options: Any) -> list[Any]:
    """Collect the settings of every call of the checkout's rasterizer in the stages of a run."""
    found = []
    with captured(folder, []), loaded(stub, scene, folder, *more) as adapter:
        renderer = sys.modules["gaussian_renderer"]
        original = renderer.GaussianRasterizer

        def spy(raster_settings: Any) -> Any:
            if (folder / "manifest.json").exists():
                found.append(raster_settings)
            return original(raster_settings=raster_settings)

        renderer.GaussianRasterizer = spy
        drive_residuals(adapter, **options)
    return found


@pytest.mark.parametrize("name", NAMES)
def test_a_white_background_lies_behind_the_base_alone(name: str, scene: Path, tmp_path: Path) -> None:
    by_size: dict[int, set[tuple[float, ...]]] = {}
    degrees: dict[int, set[int]] = {}
    for settings in rasterized(STUBS[name], scene, tmp_path / "run", *WHITE, *SHORT, joint=0.0):
        by_size.setdefault(settings.image_width, set()).add(tuple(settings.bg.tolist()))
        degrees.setdefault(settings.image_width, set()).add(settings.sh_degree)
    assert by_size == {32: {(1.0, 1.0, 1.0)}, 64: {(0.0, 0.0, 0.0)}}
    assert degrees == {32: {0}, 64: {signed_degree(0)}}


@pytest.mark.parametrize("white", [False, True], ids=["black", "white"])
def test_transparent_scenes_render_as_reported(white: bool, blender: Path, tmp_path: Path) -> None:
    """The checkout blends Blender images over the background, and so do we when the run is rendered again."""
    more = (*SHORT, "--test_iterations", SHORT[1], *["--white_background"] * white)
    archive, result = run_residuals(STUBS["taming"], blender, tmp_path / "run", *more)
    assert (archive.manifest.scene.kind, archive.manifest.scene.background) == ("transforms", (float(white),) * 3)
    (reported,) = [float(line.split()[-1]) for line in result.lines if "Evaluating test" in line]
    assert composed_psnr(archive) == pytest.approx(reported, abs=1e-3)  # 8e-5 seen: predictions are float16


def test_grey_photos_are_refused_before_anything_is_written(scene: Path, tmp_path: Path) -> None:
    """The checkouts read one channel of grey images, and would fail in the first loss."""
    grey = tmp_path / "scene"
    shutil.copytree(scene, grey)
    for path in (grey / "images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    with pytest.raises(UserInputError, match=r"reads 1 channel\(s\) of it, expected 3; save the scene's images as RGB"):
        run_hierarchy(STUBS["graphdeco"], grey, tmp_path / "run", *SHORT)
    assert not (tmp_path / "run" / "manifest.json").exists()


def test_photos_on_end_between_photos_across(blender: Path, tmp_path: Path) -> None:
    """Evaluation plans by the scene's smallest size, as the run did by the checkout's cameras."""
    mixed = tmp_path / "scene"
    shutil.copytree(blender, mixed)
    for path in (mixed / "train" / "r_1.png", mixed / "test" / "r_0.png"):
        Image.open(path).transpose(Image.Transpose.ROTATE_90).save(path)
    archive, _ = run_hierarchy(STUBS["graphdeco"], mixed, tmp_path / "run", *SHORT)
    width, height = load_scene(mixed, progress=False).smallest_size
    assert width == height
    assert archive.manifest.records[-1].image_size == (width, height)
    assert evaluate_run(archive)["num_views"] == len(list((mixed / "test").iterdir()))


@pytest.mark.parametrize(("name", "hierarchy"), STUBS_AND_KINDS)
def test_transparent_images_train(name: str, hierarchy: str, blender: Path, tmp_path: Path) -> None:
    """graphdeco masks its renders by alpha at each level's size; the others see the background in the photo."""
    compared: list[tuple[Tensor, Tensor]] = []
    with captured(tmp_path, []), loaded(STUBS[name], blender, tmp_path / "run", *WHITE, *SHORT) as adapter:
        original = adapter.train.l1_loss

        def spy(image: Tensor, photo: Tensor) -> Tensor:
            compared.append((image.detach().clone(), photo.clone()))
            return original(image, photo)

        adapter.train.l1_loss = spy
        drive(adapter, hierarchy=hierarchy)
    assert RunArchive.open(tmp_path / "run").manifest.complete
    for image, photo in compared:
        clear = photo.shape[1] // 3 - 2  # without the rows of the pyramid's blur
        if name == "graphdeco":
            assert not image[:, :clear].any()
        else:
            assert (photo[:, :clear] == 1).all()


@pytest.fixture(scope="module")
def deep(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the sample scene with inverse depths, one of them with an implausible scale."""
    path = tmp_path_factory.mktemp("deep") / "scene"
    shutil.copytree(scene, path)
    (path / "depths").mkdir()
    params = {}
    for index, photo in enumerate(sorted((path / "images").iterdir())):
        stored = np.full((48, 64), 2**14, np.uint16)
        cv2.imwrite(str(path / "depths" / f"{photo.stem}.png"), stored)
        params[photo.stem] = {"scale": 100.0 if index == 1 else 1.0, "offset": 0.0}
    (path / "sparse" / "0" / "depth_params.json").write_text(json.dumps(params), encoding="utf-8")
    return path


def test_depths_supervise_the_base_alone(deep: Path, tmp_path: Path) -> None:
    _, result = run_residuals(STUBS["graphdeco"], deep, tmp_path / "run", *SHORT, "--depths", "depths")
    shown = [float(value) for value in re.findall(r"Depth Loss=([0-9.]+)", result.progress)]
    used = [value > 0 for value in shown]
    assert used[0]
    assert not used[-1]
    assert used == sorted(used, reverse=True), "first the base with depths, then the residual without"


def test_depths_supervise_every_nested_level(deep: Path, tmp_path: Path) -> None:
    _, result = run_hierarchy(STUBS["graphdeco"], deep, tmp_path / "run", *SHORT, "--depths", "depths")
    shown = [float(value) for value in re.findall(r"Depth Loss=([0-9.]+)", result.progress)]
    assert min(shown) > 0


def test_exposures_go_on_from_stage_to_stage(scene: Path, tmp_path: Path) -> None:
    """The residual saves at its first iteration, before it steps, what the base saves at its last one."""
    more = (*SHORT, "--train_test_exp", "--exposure_lr_init", 0.1, "--save_iterations")
    archive, _ = run_residuals(STUBS["graphdeco"], scene, tmp_path / "run", *more, 10)
    base = json.loads(archive.path("level_1", "exposure.json").read_text())
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "again", *more, 11) as adapter:
        at_first: dict[str, Any] = {}
        save = adapter.train.Scene.save

        def spy(self: Any, iteration: int) -> None:
            save(self, iteration)
            if iteration == 1:
                at_first.update(json.loads(Path(self.model_path, "exposure.json").read_text()))

        adapter.train.Scene.save = spy
        drive_residuals(adapter)
    assert at_first == base
    assert np.abs(np.array(list(base.values())) - np.eye(3, 4)).max() > 0.01, "they were trained"
    assert archive.exposure(1) is None, "the checkout's, which its render applies, not a compensation of lapgs train"


@pytest.mark.parametrize("hierarchy", KINDS)
def test_exposures_survive_a_stop(hierarchy: str, scene: Path, tmp_path: Path) -> None:
    """A stopped run continues with the exposures that the base ended with."""
    more = (*SHORT, "--train_test_exp", "--exposure_lr_init", 0.1)
    trained: list[Tensor] = []
    started: list[Tensor] = []

    def run(resume: bool) -> None:
        with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *more) as adapter:
            setup = adapter.train.GaussianModel.training_setup

            def spy(self: Any, training_args: Any) -> None:
                trained.append(self._exposure)
                started.append(self._exposure.detach().clone())
                setup(self, training_args)

            adapter.train.GaussianModel.training_setup = spy
            drive(adapter, hooks=() if resume else (StopAt(0),), resume=resume, hierarchy=hierarchy, **THIRDS)

    with pytest.raises(KeyboardInterrupt):
        run(resume=False)
    run(resume=True)
    assert torch.equal(started[1], trained[0].detach())
    assert (started[1] - torch.eye(3, 4)).abs().max() > 0.01, "they were trained"


@pytest.mark.parametrize("name", ["taming", "graphdeco"])
def test_sparse_adam_trains_a_hierarchy(name: str, scene: Path, tmp_path: Path) -> None:
    archive, result = run_hierarchy(STUBS[name], scene, tmp_path / "run", *SHORT, "--optimizer_type", "sparse_adam")
    assert archive.manifest.complete
    assert all(0 < loss < 1 for loss in result.losses)


def test_where_images_lie_changes_nothing(scene: Path, tmp_path: Path) -> None:
    """The place of images does not change the result, ours or the checkout's."""
    (_, memory), (_, disk), (_, told) = (
        run_residuals(STUBS["graphdeco"], scene, tmp_path / how, *SHORT, *more, images_on=where)
        for how, where, more in (
            ("memory", "memory", ()),
            ("disk", "disk", ()),
            ("told", "auto", ("--data_device", "cpu")),
        )
    )
    assert memory.losses == disk.losses == told.losses


def test_colours_evaluated_by_the_checkout_train_the_same(scene: Path, tmp_path: Path) -> None:
    """--convert_SHs_python applies to the base; for residuals it is off, since that code has no signed colour."""
    stub = Stub("graphdeco", "graphdeco-aa", STUBS["graphdeco"].options)
    (_, raster), (_, python) = (
        run_residuals(stub, scene, tmp_path / str(len(more)), *SHORT, *more) for more in ((), ("--convert_SHs_python",))
    )
    assert python.losses == pytest.approx(raster.losses, abs=1e-4)  # 0 seen


def test_widths_are_those_of_the_checkouts(scene: Path, tmp_path: Path) -> None:
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, "-r", 50)
    assert [record.image_size for record in archive.manifest.records] == [(25, 19), (50, 37)]
    assert archive.manifest.scene.resolution == "3dgs:50"


def test_a_viewer_sees_a_residual_around_grey(scene: Path, tmp_path: Path) -> None:
    sent: list[np.ndarray[Any, Any]] = []
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT) as adapter:
        gui = sys.modules["gaussian_renderer.network_gui"]
        camera = load_scene(scene, progress=False).train[0].camera
        tan_x, tan_y = camera.tan_half_fov
        pose = camera.world_to_camera.T.contiguous()
        projection = torch.zeros(4, 4)
        projection[0, 0], projection[1, 1], projection[2, 2], projection[3, 2] = 1 / tan_x, 1 / tan_y, 1.0, 1.0
        fov_x, fov_y = 2 * float(np.arctan(tan_x)), 2 * float(np.arctan(tan_y))
        viewer = sys.modules["scene.cameras"].MiniCam(20, 15, fov_y, fov_x, 0.01, 100, pose, pose @ projection.T)
        gui.conn = "somebody"
        gui.receive = lambda: (viewer, True, False, False, False, 1.0)
        gui.send = lambda pixels, verify: sent.append(np.frombuffer(pixels, np.uint8).reshape(15, 20, 3))
        drive_residuals(adapter)
    assert len(sent) == 30
    assert sent[0].std() > 10, "the base, as it is"
    assert (sent[10] == 127).all(), "a residual that is still empty"


def test_a_fork_without_an_option_for_held_out_views(scene: Path, tmp_path: Path) -> None:
    """As EAGLES, which always holds some out: the run folder says so by its scene."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    path = checkouts / "graphdeco" / "scene" / "__init__.py"
    text, script = path.read_text(encoding="utf-8"), checkouts / "graphdeco" / "train.py"
    assert "args.eval" in text
    path.write_text(text.replace("args.eval", "True"), encoding="utf-8")
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter:
        extract = adapter.train.ModelParams.extract

        def without(group: Any, args: Any) -> Any:
            options = extract(group, args)
            del options.eval
            return options

        adapter.train.ModelParams.extract = without
        drive(adapter, levels=1)
    assert RunArchive.open(tmp_path / "run").manifest.scene.eval


@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_a_level_says_if_it_lost_its_gaussians(
    hierarchy: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(training_figures, "FEW_LEFT", 100.0)
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", "--iterations", 12, hierarchy=hierarchy)
    first = archive.manifest.records[0]
    assert first.start_gaussians == 300
    assert f"level 1 ended with {first.num_gaussians} of the 300 Gaussians" in caplog.text


@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_a_level_says_if_it_changes_little(
    hierarchy: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name, value in {"SMALL_GAIN": 100.0, "LEAST_ITERATIONS": 1, "LEAST_VIEWS": 2}.items():
        monkeypatch.setattr(training_figures, name, value)
    run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", "--iterations", 12, hierarchy=hierarchy)
    assert "level 0 changes the PSNR of 2 held-out images by" in caplog.text


def test_a_scene_in_small_units_is_said(scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    small = Path(shutil.copytree(scene, tmp_path / "small"))
    model = pycolmap.Reconstruction(str(small / "sparse/0"))
    model.transform(pycolmap.Sim3d(1e-3, pycolmap.Rotation3d(), np.zeros(3)))
    model.write_binary(str(small / "sparse/0"))
    run_hierarchy(STUBS["graphdeco"], small, tmp_path / "run", "--iterations", 4, levels=1)
    lines = "\n".join(record.getMessage() for record in caplog.records)
    assert "nearer to the cameras than 0.2, the near plane" in lines
    assert "no Gaussian will be visible at first in 10 of 10 training views" in lines


def test_a_script_that_trains_on_two_scenes(scene: Path, big: Path, tmp_path: Path) -> None:
    """Photos of the first scene, which are smaller here, say nothing about the second one."""
    first, second = tmp_path / "first", tmp_path / "second"
    call = """    training(
        lp.extract(args),
        op.extract(args),
        pp.extract(args),
        args.test_iterations,
        args.save_iterations,
        args.checkpoint_iterations,
        args.start_checkpoint,
        args.debug_from,
    )
"""
    other = f"    args.source_path, args.model_path = {str(big)!r}, {str(second)!r}\n"
    script = edited_graphdeco(tmp_path / "copy", "train.py", call, call + other + call)
    with captured(first, []), loaded(STUBS["graphdeco"], scene, first, *SHORT, script=script) as adapter:
        drive(adapter)
    for folder, size in ((first, (64, 48)), (second, (96, 66))):
        assert [record.image_size for record in RunArchive.open(folder).manifest.records][-1] == size
