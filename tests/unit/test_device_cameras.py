"""Cameras as kernels take them."""

from __future__ import annotations

import pytest
import torch

from lapgs_plugin.gpu_raster.cameras import CameraCache
from tests.training_scene import ring_camera


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8])
def test_cameras_of_one_size_together(count: int) -> None:
    cameras, cache = [ring_camera(angle, 40, 30) for angle in torch.linspace(0.1, 3.0, 8).tolist()], CameraCache()
    for start in (0, 8 - count):
        chosen = cameras[start : start + count]
        together = cache.get(chosen, torch.zeros(1))
        assert (together.width, together.height) == (40, 30)
        torch.testing.assert_close(together.poses, torch.stack([camera.world_to_camera for camera in chosen]))
        torch.testing.assert_close(together.centres, torch.stack([camera.position for camera in chosen]))
        for row, camera in enumerate(chosen):
            expected = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
            torch.testing.assert_close(together.intrinsics[row], expected)
        for tensor in together[:3]:
            assert tensor.is_contiguous()
            assert tensor.data_ptr() % 16 == 0, "Triton would compile its kernels again"
