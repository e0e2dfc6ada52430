"""gsplat's unscented transform on a GPU against the CPU rasterizer along rays, and a run of each hierarchy."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.lens import Lens
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.fields.units import in_unit
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer, gsplat_missing, rays_missing
from lapgs_plugin.reference_raster import CpuRasterizer
from tests.bent_scene import FISHEYE, write_bent_scene
from tests.training_scene import ring_camera

MISSING = "needs a CUDA device" if not torch.cuda.is_available() else gsplat_missing() or rays_missing()
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(bool(MISSING), reason=MISSING)]

LENSES = {
    "none": None,
    "fisheye": FISHEYE,
    "all of fisheye": Lens(True, (0.05, -0.02, 0.004, -0.001)),
    "perspective": Lens(False, (-0.2, 0.05, 0.01, 0.02, -0.01, 0.003), (0.004, -0.003)),
}


def gaussians(degree: int, signed: bool, count: int = 3000) -> GaussianField:
    generator = torch.Generator().manual_seed(degree)
    return GaussianField(
        1.2 * torch.randn(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator),
        torch.randn(count, 3, generator=generator) * 0.4 - 2.8,
        torch.randn(count, generator=generator) - 1.0,
        torch.randn(count, (degree + 1) ** 2, 3, generator=generator) * 0.3,
        signed,
    )


def rendered(rasterizer: Rasterizer, field: GaussianField, camera: Camera, device: str) -> tuple[Tensor, list[Tensor]]:
    """The image, and the gradients of a weighted sum of it by the field's parameters and centres, on the CPU."""
    leaves = {name: value.detach().to(device, copy=True).requires_grad_() for name, value in field.parameters.items()}
    background = torch.zeros(3) if field.signed else torch.tensor([0.1, 0.2, 0.3])
    weights = torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(5)).to(device)
    result = rasterizer(field.with_parameters(leaves), camera, background=background.to(device))
    (result.image * weights).sum().backward()  # type: ignore[no-untyped-call]  # torch's
    gradients = [leaf.grad for leaf in (*leaves.values(), result.means2d)]
    return result.image.detach().cpu(), [gradient.cpu() for gradient in gradients if gradient is not None]


@pytest.mark.parametrize("unit", [1.0, 0.5])
@pytest.mark.parametrize(("degree", "signed"), [(3, False), (0, True)])
@pytest.mark.parametrize("lens", LENSES)
def test_gsplat_renders_as_the_cpu(lens: str, degree: int, signed: bool, unit: float) -> None:
    field = gaussians(degree, signed)
    camera = replace(ring_camera(0.4, 120, 88), fx=80.0, fy=82.0, cx=62.0, cy=43.0, lens=LENSES[lens])
    ours, theirs = (
        rendered(in_unit(rasterizer, unit), field, camera, device)
        for rasterizer, device in ((CpuRasterizer(rays=True), "cpu"), (GsplatRasterizer(rays=True), "cuda"))
    )
    difference = (ours[0] - theirs[0]).abs()
    assert ours[0].amax() - ours[0].amin() > 0.1
    # float32 turns comparisons with 1/255 and 1e-4 in a few pixels. Worst seen: 1.1e-5, 0.0082 and below 0.0063.
    assert difference.mean() < 1e-4
    assert (difference > 0.01).double().mean() < 1e-3
    assert len(ours[1]) == len(theirs[1]) == 6
    for mine, gsplats in zip(ours[1], theirs[1], strict=True):
        assert (mine - gsplats).norm() < 0.01 * mine.norm()


def test_images_of_several_cameras_are_those_of_each() -> None:
    rasterizer, field = GsplatRasterizer(rays=True), gaussians(1, signed=False).to("cuda")
    cameras = [replace(ring_camera(angle), lens=lens) for angle in (0.1, 1.2) for lens in LENSES.values()]
    background = torch.zeros(3, device="cuda")
    together = rasterizer.render_images(field, cameras, background=background)
    for image, camera in zip(together, cameras, strict=True):
        alone = rasterizer(field, camera, background=background).image
        torch.testing.assert_close(image, alone, rtol=0, atol=1e-6)


@pytest.mark.parametrize("hierarchy", ["laplacian", "nested"])
def test_a_gpu_trains_on_a_lens_as_it_is(tmp_path: Path, hierarchy: str) -> None:
    scene, run = tmp_path / "scene", tmp_path / "run"
    write_bent_scene(scene, size=(96, 72), focal=48.0, views=32)
    options = ["--eval", "--distorted", "--hierarchy", hierarchy, "--iterations", "600"]
    for arguments in (["train", str(scene), "-o", str(run), *options], ["eval", str(run)]):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
    measured = json.loads((run / "metrics.json").read_text())
    assert measured["rasterizer"] == "gsplat"
    assert measured["psnr"] > 15.0
