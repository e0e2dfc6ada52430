"""Compare visibility with images of one Gaussian at a time, and test which Gaussians are pruned."""

from __future__ import annotations

from dataclasses import replace

import torch
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.hierarchy.pruning import blended_pixels, least_blended
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from tests.training_scene import blob_field, ring_camera


def test_pixels_are_what_an_image_of_one_white_gaussian_adds_up_to() -> None:
    field = blob_field(40)
    cameras = [ring_camera(angle) for angle in (0.0, 0.8, 2.5)]
    oracle, black = OracleRasterizer(), torch.zeros(3, dtype=torch.float64)
    expected = []
    for index in range(len(field)):
        white = torch.zeros(40, 1, 3)
        white[index] = 1 / SH_C0
        alone = replace(field, sh=white, signed=True).to(dtype=torch.float64)
        sums = [oracle(alone, camera.to(dtype=torch.float64), background=black).image[0].sum() for camera in cameras]
        expected.append(max(float(value) for value in sums))
    grey = torch.zeros(40, 1, 3, requires_grad=True)
    plain, rasterizer = replace(field, sh=grey), CpuRasterizer()
    pixels = blended_pixels((rasterizer(plain, seen, background=torch.ones(3)).image for seen in cameras), grey)
    # Sums of 2 to 51 pixels, worst seen 5.6e-7; 5.4e-6 where all that is rendered was moved by a rounding.
    torch.testing.assert_close(pixels.double(), torch.tensor(expected, dtype=torch.float64), rtol=2e-5, atol=0)


@given(
    st.lists(st.floats(0, 1e4, width=32), min_size=1, max_size=40),
    st.floats(0, 0.99),
)
def test_as_many_go_as_make_up_the_share_together_and_they_are_the_least(values: list[float], share: float) -> None:
    pixels = torch.tensor(values)
    gone = least_blended(pixels, share)
    whole = float(pixels.double().sum())
    if whole == 0.0:
        assert not gone.any()
        return
    together = float(pixels[gone].double().sum())
    assert together <= share * whole * (1 + 1e-12)
    kept = pixels[~gone].double()
    assert len(kept)
    assert not gone.any() or float(pixels[gone].max()) <= float(kept.min())
    assert together + float(kept.min()) > share * whole * (1 - 1e-12)
