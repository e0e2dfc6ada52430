"""Views of several sizes in one launch have the losses, gradients and statistics that each has alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.mixed_sizes import similar_sizes, stack_padded
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.ops.upsample import upsample, upsample_add
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.runs.image_store import ImageStore
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.training.densification import Densifier, scale_to_last
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.strategies import Gradients
from tests.gsplat_on_cpu import GsplatOnCpu
from tests.training_runs import Said, train
from tests.training_scene import blob_field, ring_camera, ring_scene
from tests.unit.test_views_per_step import Batching, leaves

SIZES = [(40, 29), (39, 31), (41, 30)]
BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


def padded(values: Sequence[Tensor], beyond: float) -> Tensor:
    """Images at the top left of one tensor, with a number beyond them."""
    whole = torch.full((len(values), 3, 31, 41), beyond, dtype=values[0].dtype)
    for row, value in zip(whole, values, strict=True):
        row[:, : value.shape[1], : value.shape[2]] = value
    return whole


def images(seed: int, halved: bool = False) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    sides = [((height + halved) >> halved, (width + halved) >> halved) for width, height in SIZES]
    return [torch.rand(3, *size, generator=generator, dtype=torch.float64) for size in sides]


# -------------------------------------------------------------------------------------------------------- groups


def test_sizes_that_differ_by_a_few_pixels_are_one_group() -> None:
    phone = [(750, 1000), (749, 1000), (748, 998), (750, 999)]
    assert set(similar_sizes(phone, 0.05).values()) == {0}
    groups = similar_sizes([*phone, (1000, 750), (1001, 749), (500, 600)], 0.05)
    assert len({groups[size] for size in phone}) == 1
    assert groups[1000, 750] == groups[1001, 749]
    assert len({groups[750, 1000], groups[1000, 750], groups[500, 600]}) == 3


@pytest.mark.parametrize(("most", "together"), [(0.0, False), (0.04, False), (0.06, True)])
def test_padding_counts_by_the_smallest_image_of_a_group(most: float, together: bool) -> None:
    """Of 98x100 and 100x97 the larger one, 100x100, has 2 and 3 % more pixels; of 95x100 it has 5.3 %."""
    assert len(set(similar_sizes([(100, 97), (98, 100), (95, 100)], most).values())) == (
        1 if together else 2 + (not most)
    )
    assert similar_sizes([(7, 5), (7, 5)], 0.0) == {(7, 5): 0}


# ---------------------------------------------------------------------------------------------------- operations


def test_the_loss_is_the_mean_of_the_views_losses() -> None:
    """Whatever is beyond them; SSIM at their borders is that of the views alone."""
    prediction, target = padded(images(0), 0.7).requires_grad_(), padded(images(1), 0.2)
    loss = photometric_loss(prediction, target, 0.2, SIZES)
    loss.backward()
    alone = [image.requires_grad_() for image in images(0)]
    expected = torch.stack([photometric_loss_torch(*pair, 0.2) for pair in zip(alone, images(1), strict=True)]).mean()
    expected.backward()
    torch.testing.assert_close(loss, expected)
    gradients = [image.grad for image in alone]
    torch.testing.assert_close(prediction.grad, padded(gradients, 0.0))  # type: ignore[arg-type]


@pytest.mark.parametrize("grid", ["camera", "even"])
def test_each_view_is_upsampled_alone(grid: str) -> None:
    pyramid, coarse, fine = Pyramid(grid), stack_padded(images(2, halved=True)), padded(images(3), 0.0)
    coarse.requires_grad_()
    expected = [
        pyramid.up(half, whole.shape[-2:]) + whole  # type: ignore[arg-type]
        for half, whole in zip(images(2, halved=True), images(3), strict=True)
    ]
    found = upsample_add(pyramid, coarse, fine, sizes=SIZES)
    torch.testing.assert_close(found, padded(expected, 0.0))
    torch.testing.assert_close(upsample(pyramid, coarse.detach(), (31, 41), SIZES) + fine, found.detach())
    weights = torch.randn(found.shape, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((found * weights).sum(), coarse)
    for row, (half, size) in enumerate(zip(images(2, halved=True), SIZES, strict=True)):
        half.requires_grad_()
        (pyramid.up(half, size[::-1]) * weights[row, :, : size[1], : size[0]]).sum().backward()
        assert half.grad is not None
        own = gradient[row, :, : half.shape[1], : half.shape[2]]
        torch.testing.assert_close(own, half.grad)
        assert int(gradient[row].count_nonzero()) <= own.numel()


@pytest.mark.parametrize("precision", ["float32", "float16", "uint8"])
def test_stores_return_images_of_several_sizes_in_one_tensor(precision: str) -> None:
    photos = [(image.float() * 255).round() / 255 for image in images(4, halved=True)]
    photos[2] = 3 * photos[2] - 1  # encoded otherwise in eight bits
    with ImageStore("memory", precision) as store:
        upsampled = UpsampledImages(store, Pyramid())
        for name, image, size in zip("abc", photos, SIZES, strict=True):
            upsampled.put(name, image, size[::-1])
        for names in ("ab", "abc"):
            assert torch.equal(store.get(*names), stack_padded([store.get(name) for name in names]))
            assert torch.equal(upsampled.get(*names), stack_padded([upsampled.get(name) for name in names]))
            rendered = stack_padded([torch.zeros(3, *size[::-1]) for _, size in zip(names, SIZES, strict=False)])
            torch.testing.assert_close(upsampled.adder(names)(rendered), upsampled.get(*names))


# ------------------------------------------------------------------------------------------------------- renders


@pytest.mark.usefixtures("gsplat_kernels")
def test_a_batch_of_several_sizes_is_its_views() -> None:
    """Images, radii, gradients, and statistics of densification in halves of each view's own image."""
    rasterizer = GsplatOnCpu(True, own_radii=True)
    assert rasterizer.mixes_sizes
    assert not GsplatOnCpu(False).mixes_sizes
    assert not CpuRasterizer().mixes_sizes
    cameras = [ring_camera(angle, *size) for angle, size in zip((0.2, 1.3, 2.9), SIZES, strict=True)]
    together, alone = leaves(blob_field(80)), leaves(blob_field(80))
    weights = [torch.randn(3, camera.height, camera.width) for camera in cameras]
    batch = rasterizer.render_batch(together, cameras, background=BACKGROUND, sh_degree=0)
    assert batch.image.shape == (3, 3, 31, 41)
    (batch.image * padded(weights, 0.0)).sum().backward()
    options = Gradients(grow_grad2d=2e-4)
    schedule = StageSchedule.create(TrainSettings(iterations=100), StagePlan.create((64, 48), 100, 1)[0])
    ours, theirs = (Densifier(schedule, options, 2.0) for _ in range(2))
    for row, camera in enumerate(cameras):
        result = rasterizer(alone, camera, background=BACKGROUND, sh_degree=0)
        (result.image * weights[row]).sum().backward()
        torch.testing.assert_close(batch.image[row, :, : camera.height, : camera.width], result.image)
        assert torch.equal(batch.radii[row], result.radii)
        theirs.accumulate(result, camera)
    for name, value in together.parameters.items():
        expected = alone.parameters[name].grad
        assert value.grad is not None
        assert expected is not None
        assert float((value.grad - expected).abs().max() / expected.abs().max()) < 1e-5, name  # worst seen 0
    scale_to_last(batch, SIZES)
    ours.accumulate(batch, cameras[-1])
    for name in ("grad2d", "count"):
        torch.testing.assert_close(ours.state[name], theirs.state[name], rtol=1e-4, atol=1e-6)


# ---------------------------------------------------------------------------------------------------------- runs


class Mixing(Batching):
    """Batch cameras of several sizes."""

    mixes_sizes = True


def cropped(scene: Scene, masked: bool = False) -> Scene:
    """A scene whose photos have lost columns at the right and rows below: at most 5 % of pixels, the last one more."""

    def view(index: int) -> View:
        whole = scene.train[index]
        less = ((0, 0), (2, 0), (1, 1))[index % 3] if index < len(scene.train) - 1 else (14, 0)
        width, height = whole.camera.width - less[0], whole.camera.height - less[1]
        mask = torch.ones(1, height, width, dtype=torch.bool)
        mask[:, height // 2 :, : width // 3] = False
        camera, image = replace(whole.camera, width=width, height=height), whole.image[:, :height, :width].contiguous()
        return replace(whole, camera=camera, image=image, **({"mask": mask} if masked else {}))

    return replace(scene, train=tuple(map(view, range(len(scene.train)))))


@pytest.mark.parametrize(
    ("masked", "until", "tolerance"),
    [
        (False, 0, 2e-3),  # 1e-7 seen, and 4e-4 with photos of one size
        (True, 0, 2e-3),  # with a loss for each view; 5e-8 seen
        (False, 60, 3e-2),  # rounding decides about single Gaussians; 3e-3 seen, and 6e-3 with photos of one size
    ],
)
def test_rendered_together_or_one_by_one_a_run_is_the_same(
    masked: bool, until: int, tolerance: float, tmp_path: Path
) -> None:
    """With base and residual, joint training, and exposure where views have masks."""
    scene = cropped(ring_scene(train=7, test=2), masked)
    settings = TrainSettings(
        iterations=84,
        hierarchy="laplacian",
        sh_degree=0,
        views_per_step="7",
        joint=0.4,
        appearance="affine" if masked else "none",
        densification=Densification(start=3, until=until, every=14),
    )
    mixing, lines = Mixing(), Said()
    runs = [
        train(tmp_path / name, scene, settings, rasterizer, test_every=1, monitor=lines)
        for name, rasterizer in (("alone", CpuRasterizer()), ("together", mixing))
    ]
    launches = {(count, size) for count, size, _ in mixing.asked}
    assert {(6, (56, 40)), (6, (28, 20))} <= launches
    assert max(count for count, _ in launches) == 6
    assert sum("2 groups of similar sizes" in line for line in lines.lines) == 2
    history = [[(entry["level"], entry["num_gaussians"], entry["psnr"]) for entry in run.history()] for run in runs]
    assert len(history[0]) == len(history[1]) > 6
    for one, other in zip(*history, strict=True):
        assert one[:2] == other[:2]
        assert one[2] == pytest.approx(other[2], abs=tolerance)
