"""Copy cameras to the device that renders."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera


class DeviceCameras(NamedTuple):
    """Hold c cameras of one image size on the device that renders."""

    poses: Tensor  # (c, 4, 4) world to camera
    intrinsics: Tensor  # (c, 3, 3)
    centres: Tensor  # (c, 3) in world coordinates
    width: int
    height: int


class CameraCache:
    """Copy each camera to the device once, because training views come back many times."""

    def __init__(self) -> None:
        self._copied: dict[int, tuple[weakref.ref[Camera], DeviceCameras]] = {}

    def get(self, cameras: Sequence[Camera], like: Tensor) -> DeviceCameras:
        """Return cameras of one size on the device of `like`; several are concatenated in one launch."""
        if len(cameras) == 1:
            return self._one(cameras[0], like)
        copied, count = [self._one(camera, like) for camera in cameras], len(cameras)
        # Centres first: Triton compiles anew for tensors that do not begin at a multiple of 16 bytes.
        parts = [getattr(each, kind).view(-1) for kind in ("centres", "poses", "intrinsics") for each in copied]
        numbers = torch.cat(parts)
        centres, poses, intrinsics = numbers[: 3 * count], numbers[3 * count : 19 * count], numbers[19 * count :]
        return DeviceCameras(
            poses.view(-1, 4, 4), intrinsics.view(-1, 3, 3), centres.view(-1, 3), copied[0].width, copied[0].height
        )

    def _one(self, camera: Camera, like: Tensor) -> DeviceCameras:
        known, copied = self._copied.get(id(camera), (None, None))
        if known is None or copied is None or known() is not camera or copied.poses.device != like.device:
            with torch.inference_mode(False):  # cached for later calls, which may need gradients
                poses, intrinsics, centres = (value.contiguous() for value in cameras_on_device([camera], like))
            copied = DeviceCameras(poses, intrinsics, centres, camera.width, camera.height)
            key, cache = id(camera), self._copied
            cache[key] = (weakref.ref(camera, lambda _: cache.pop(key, None)), copied)
        return copied


def cameras_on_device(cameras: Sequence[Camera], like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return poses (b, 4, 4), intrinsics (b, 3, 3) and centres (b, 3) beside `like`, without waiting for its GPU."""
    poses = [camera.world_to_camera for camera in cameras]
    elsewhere = any(pose.device.type != "cpu" for pose in poses)
    # All numbers in one tensor: each small copy costs time in every frame.
    rows = [[c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0] for c in cameras]
    if not elsewhere:
        rows = [[*row, *_pose_numbers(pose)] for row, pose in zip(rows, poses, strict=True)]
    # Page-locked, because a copy from other memory would wait for the GPU.
    numbers = torch.tensor(rows, dtype=like.dtype, pin_memory=like.device.type == "cuda")
    numbers = numbers.to(like.device, non_blocking=True)  # (b, 28) or (b, 9)
    intrinsics = numbers[:, :9].reshape(-1, 3, 3)
    if elsewhere:
        return torch.stack(poses).to(like), intrinsics, torch.stack([camera.position for camera in cameras]).to(like)
    return numbers[:, 9:25].reshape(-1, 4, 4), intrinsics, numbers[:, 25:]


def _pose_numbers(pose: Tensor) -> list[float]:
    """Return the 16 numbers of a pose on the CPU, row by row, and the 3 of the camera's centre, -R^T t."""
    rows: list[list[float]] = pose.tolist()
    centre = [-sum(rows[j][i] * rows[j][3] for j in range(3)) for i in range(3)]
    return [*rows[0], *rows[1], *rows[2], *rows[3], *centre]
