"""Masks: what they hide changes nothing, at any level, in both hierarchies; files of masks and their mistakes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import RunFolderError, SceneError, UserInputError
from lapgs_plugin.evaluation.metrics import psnr, ssim
from lapgs_plugin.hierarchy.masks import fill_outside, masked_gaussian
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.hooks import StageContext, SupervisionLoss
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.rendering.run import run_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training.settings import TrainSettings
from tests.refusals import refuses
from tests.training_runs import train
from tests.training_scene import HEIGHT, WIDTH, ring_scene

SIDE = 37


def _mask(height: int = SIDE, width: int = SIDE) -> Tensor:
    """A disc with a hole, (1, h, w)."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    distance = torch.hypot(rows - 0.45 * height, columns - 0.55 * width)
    return ((distance < 0.4 * height) & (distance > 0.1 * height))[None]


def _noise(seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(3, SIDE, SIDE, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("grid", ["camera", "even"])
def test_a_coarse_pixel_counts_only_what_is_inside(grid: str) -> None:
    mask, inside = _mask(), torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)[:, None, None]
    image = torch.where(mask, inside, _noise(0))
    levels = masked_gaussian(Pyramid(grid), image, mask, 4)
    for level, weight in levels:
        assert 0 < float(weight.mean()) < 1
        counted = (weight > 0).expand_as(level)
        assert torch.allclose(level[counted], inside.expand_as(level)[counted], atol=1e-12)  # seen 3e-16
        # Beyond the mask the image goes on from the inside; there it is rounded to 8 bits.
        assert torch.allclose(level, inside.expand_as(level), atol=0.51 / 255)
    other = masked_gaussian(Pyramid(grid), torch.where(mask, inside, _noise(1)), mask, 4)
    assert all(
        torch.equal(one[0], two[0]) and torch.equal(one[1], two[1]) for one, two in zip(levels, other, strict=True)
    )


def test_levels_are_normalised_averages_as_opencv_computes_them() -> None:
    image, mask = _noise(2), _mask()
    plane = image[0].numpy() * mask[0].numpy()
    sums, weights = cv2.pyrDown(cv2.pyrDown(plane)), cv2.pyrDown(cv2.pyrDown(mask[0].numpy().astype(np.float64)))
    level, weight = masked_gaussian(Pyramid("even"), image, mask, 3)[2]
    counted = weights > 1e-9
    assert np.abs(level[0].numpy()[counted] - sums[counted] / weights[counted]).max() < 1e-9
    assert np.abs(weight[0].numpy() - weights).max() <= 0.5 / 255 + 1e-12


def test_masked_pixels_have_no_loss_no_gradient_and_no_part_in_ssim() -> None:
    mask, target, prediction = _mask().double(), _noise(3), _noise(4).requires_grad_()

    def loss(prediction: Tensor) -> Tensor:
        return photometric_loss_torch(fill_outside(prediction, target, mask), target)

    total = loss(prediction)
    (gradient,) = torch.autograd.grad(total, prediction)
    hidden = (mask == 0).expand_as(gradient)
    assert torch.count_nonzero(gradient[hidden]) == 0
    assert torch.count_nonzero(gradient[~hidden]) == int((~hidden).sum())
    changed = torch.where(hidden, _noise(5), prediction.detach())
    assert torch.equal(loss(changed), total)
    step = 1e-6 * _noise(6)
    with torch.no_grad():
        slope = (loss(prediction + step) - loss(prediction - step)) / 2
    assert float(slope) == pytest.approx(float((gradient * step).sum()), rel=1e-5)  # 2.4e-9 seen


@pytest.mark.parametrize("name", list(SUPERVISIONS))
def test_every_supervision_honours_masks(name: str) -> None:
    mask, image = _mask().float(), _noise(0, torch.float32).requires_grad_()
    below, coarse = _noise(1, torch.float32), _noise(2, torch.float32)
    context = StageContext(Stage(0, 10, (SIDE, SIDE), True), 1, "a", _noise(3, torch.float32), below, coarse, mask)
    SupervisionLoss(SUPERVISIONS[name]).loss(context, image).backward()
    assert image.grad is not None
    assert torch.equal(image.grad != 0, (mask > 0).expand_as(image))


@pytest.mark.parametrize("text", ["{", "[]", '{"frames": []}'])
def test_a_damaged_transforms_file_beside_a_colmap_model_names_no_masks(tmp_path: Path, text: str) -> None:
    make_sample_scene(tmp_path / "scene", width=48, height=32, views=3, points=40, progress=False)
    (tmp_path / "scene" / "transforms.json").write_text(text)
    scene = load_scene(tmp_path / "scene", progress=False)
    assert scene.kind == "colmap"
    assert not any(view.masked for view in scene.train)


def _hiding(scene: Scene, seed: int) -> Scene:
    """The scene with masks, and noise in what they hide."""
    mask, generator = _mask(HEIGHT, WIDTH), torch.Generator().manual_seed(seed)

    def masked(view):  # type: ignore[no-untyped-def]
        noise = torch.rand(view.image.shape, generator=generator)
        return replace(view, image=torch.where(mask, view.image, (noise * 255).round() / 255), mask=mask)

    train, test = (tuple(masked(view) for view in views) for views in (scene.train, scene.test))
    return replace(scene, train=train, test=test)


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_what_masks_hide_changes_no_bit_of_a_run(hierarchy: str, tmp_path: Path) -> None:
    settings = TrainSettings(iterations=24, levels=2, hierarchy=hierarchy, sh_degree=0)
    fields, measured = [], []
    for seed in (0, 1):
        archive = train(tmp_path / str(seed), _hiding(ring_scene(), seed), settings)
        fields.append(archive.field(0))
        measured.append([entry["psnr"] for entry in archive.history() if "psnr" in entry])
    assert torch.equal(fields[0].means, fields[1].means)
    assert torch.equal(fields[0].sh, fields[1].sh)
    assert measured[0]
    assert measured[0] == measured[1]


def test_metrics_count_the_inside() -> None:
    mask, target = _mask(), _noise(0, torch.float32)
    image = torch.where(mask, target * 0.5, _noise(1, torch.float32))
    mse = ((image - target)[mask.expand_as(image)].double() ** 2).mean()
    assert psnr(image, target, mask) == pytest.approx(-10 * float(torch.log10(mse)), abs=1e-6)  # 1.8e-15 seen
    other = torch.where(mask, image, _noise(2, torch.float32))
    assert ssim(image, target, mask) == ssim(other, target, mask) < 1
    assert ssim(torch.where(mask, target, image), target, mask) == pytest.approx(1, abs=1e-6)  # 0 seen
    everywhere = torch.ones_like(mask)
    assert ssim(image, target, everywhere) == pytest.approx(ssim(image, target), abs=1e-5)  # 6.0e-8 seen


def test_a_run_whose_masks_are_gone_is_one_line(plain: Path, tmp_path: Path) -> None:
    reference = SceneReference(str(plain), "full", False, (0.0, 0.0, 0.0), "colmap", masks="gone")
    manifest = Manifest(scene=reference, rasterizer="cpu", **TrainSettings(iterations=10).for_manifest())
    with (
        RunArchive.create(tmp_path / "run", manifest) as archive,
        pytest.raises(RunFolderError, match=r"trained with the masks in .*gone, which are not there any more"),
    ):
        run_scene(archive)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "sample"
    make_sample_scene(path, width=SIDE, height=SIDE, views=4, points=50, progress=False)
    return path


@pytest.fixture
def scene(plain: Path, tmp_path: Path) -> Path:
    shutil.copytree(plain, tmp_path / "scene")
    return tmp_path / "scene"


def _write_masks(scene: Path, spelling: str, scale: float = 1.0, folder: str = "masks") -> None:
    for image in (scene / "images").iterdir():
        name = spelling.format(name=image.name, stem=image.stem)
        write_image(scene / folder / name, _mask().float().expand(3, -1, -1) * scale)


@pytest.mark.parametrize(
    ("spelling", "scale"),
    [("{name}.png", 1), ("{stem}.png", 1 / 255), ("{stem}_mask.png", 1), ("{stem}.JPG", 1)],  # some write 0 and 1
)
def test_masks_are_found_by_the_names_that_people_use(spelling: str, scale: float, scene: Path) -> None:
    assert all(view.mask is None for view in load_scene(scene, progress=False).train)
    _write_masks(scene, spelling, scale)
    assert all(torch.equal(view.mask, _mask()) for view in load_scene(scene, progress=False).train)
    assert all(view.mask is None for view in load_scene(scene, masks="none", progress=False).train)
    halved = load_scene(scene, resolution="1/2", progress=False).train[0]
    assert halved.mask is not None
    assert halved.mask.shape[1:] == halved.image.shape[1:]


def test_masks_may_lie_elsewhere(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write_masks(scene, "{stem}.png", folder="elsewhere/masks")
    (scene / "elsewhere").rename(tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path)
    assert load_scene(scene, masks="elsewhere/masks", progress=False).train[0].mask is not None


def test_alpha_channels_are_masks_if_asked_for(scene: Path) -> None:
    for image in (scene / "images").iterdir():
        pixels = cv2.imread(str(image))
        alpha = _mask()[0].numpy().astype(np.uint8) * 255
        cv2.imwrite(str(image), np.dstack([pixels, alpha]))
    assert torch.equal(load_scene(scene, masks="alpha", progress=False).train[0].mask, _mask())
    assert load_scene(scene, progress=False).train[0].mask is None


def test_a_choice_of_masks_that_masks_nothing_is_one_line(scene: Path) -> None:
    with pytest.raises(UserInputError, match=r"--masks alpha: no image of .* has transparent pixels"):
        load_scene(scene, masks="alpha", progress=False)
    with pytest.raises(SceneError, match=r"--masks .*images: \S+ is the photo itself, expected its mask"):
        load_scene(scene, masks="images", progress=False)


@pytest.mark.parametrize(
    ("aim", "message"),
    [("itself", "Too many levels of symbolic links"), ("nowhere", "No such file"), ("/dev/zero", "socket or device")],
)
def test_masks_that_are_no_files_are_one_line(aim: str, message: str, scene: Path) -> None:
    _write_masks(scene, "{stem}.png")
    mask = min((scene / "masks").iterdir())
    mask.unlink()
    mask.symlink_to(mask.name if aim == "itself" else aim)
    refuses(SceneError, f"{mask} cannot be read: .*{message}.*; expected a mask", load_scene, scene, progress=False)
    shutil.rmtree(scene / "masks")
    (scene / "masks").symlink_to(aim)
    refuses(UserInputError, "masks is a link to no folder", load_scene, scene, progress=False)


def test_masks_that_do_not_fit_are_one_line(scene: Path, tmp_path: Path) -> None:
    def refused(message: str, kind: type[Exception] = SceneError, masks: str = "masks") -> None:
        with pytest.raises(kind, match=message):
            load_scene(scene, masks=masks, progress=False)

    refused("--masks nowhere: no such folder", UserInputError, "nowhere")
    _write_masks(scene, "{stem}.png")
    masks = sorted((scene / "masks").iterdir())
    write_image(masks[0], torch.ones(3, 20, 30))
    refused(r"the mask is 30x20 pixels, its photo 37x37; expected the same size")
    write_image(masks[0], torch.zeros(3, SIDE, SIDE))
    refused("black everywhere")
    shutil.copy(masks[1], masks[0].with_suffix(".tif"))
    refused("has the masks .* and .*, expected one")
    masks[0].with_suffix(".tif").unlink()
    masks[0].unlink()
    refused(r"1 of 4 photos have no mask, the first is .*; expected .*\.png, .* or .*_mask\.png")
    run = tmp_path / "run"
    refusal = CliRunner().invoke(app, ["train", str(scene), "-o", str(run), "--masks", "masks"])
    assert isinstance(refusal.exception, SceneError)
    assert not run.exists()
