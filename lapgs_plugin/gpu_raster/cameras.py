"""Copy cameras to the device that renders, or make them there of matrices, once each."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.gpu_raster.records import aligned, state_of
from lapgs_plugin.ops.mixed_sizes import if_mixed, largest_size, sizes_on_device

NUMBERS_OF_16_BYTES = 4


class DeviceCameras(NamedTuple):
    """Hold c cameras on the device that renders. Their images are as large as the largest.

    Attributes:
        sizes: (c, 2) int32 width and height of each if they differ, else None.
    """

    poses: Tensor  # (c, 4, 4) world to camera
    intrinsics: Tensor  # (c, 3, 3)
    centres: Tensor  # (c, 3) in world coordinates
    width: int
    height: int
    sizes: Tensor | None = None


class _Copied(NamedTuple):
    """Hold a camera on the device, also as flat tensors, which are quicker to concatenate."""

    camera: weakref.ref[Camera]
    alone: DeviceCameras
    pose: Tensor  # (16,)
    intrinsics: Tensor  # (9,)
    centre: Tensor  # (3,)


class CameraCache:
    """Copy each camera to the device once, because training views come back many times."""

    def __init__(self) -> None:
        self._copied: dict[int, _Copied] = {}

    def get(self, cameras: Sequence[Camera], like: Tensor) -> DeviceCameras:
        """Return cameras on the device of `like`; several are concatenated in one launch."""
        if len(cameras) == 1:
            return self._one(cameras[0], like).alone
        copied = [self._one(camera, like) for camera in cameras]
        _, _, poses, intrinsics, centres = zip(*copied, strict=True)
        count = len(cameras)
        # Filled up, because Triton compiles anew for tensors that do not begin at a multiple of 16 bytes.
        filling = -count % NUMBERS_OF_16_BYTES
        numbers = torch.cat((*poses, *intrinsics, copied[0].pose[:filling], *centres))
        pose, matrix, _, centre = numbers.split_with_sizes((16 * count, 9 * count, filling, 3 * count))
        sizes = [camera.size for camera in cameras]
        own = sizes_on_device(sizes, like.device) if if_mixed(sizes) else None
        return DeviceCameras(
            pose.view(-1, 4, 4), matrix.view(-1, 3, 3), centre.view(-1, 3), *largest_size(sizes), own
        )  # fmt: skip

    def _one(self, camera: Camera, like: Tensor) -> _Copied:
        copied = self._copied.get(id(camera))
        if copied is None or copied.camera() is not camera or copied.pose.device != like.device:
            with torch.inference_mode(False):  # cached for later calls, which may need gradients
                poses, intrinsics, centres = cameras_on_device([camera], like)
                flat = poses.view(-1), intrinsics.view(-1), centres.view(-1)
            key, cache = id(camera), self._copied
            known = weakref.ref(camera, lambda _: cache.pop(key, None))
            alone = DeviceCameras(poses, intrinsics, centres, camera.width, camera.height)
            copied = cache[key] = _Copied(known, alone, *flat)
        return copied


class _OfMatrices(NamedTuple):
    """Hold a camera, the matrices that it was made of, and their states with all else that it depends on."""

    view: weakref.ref[Tensor]
    full: weakref.ref[Tensor]
    centre: weakref.ref[Tensor]
    state: tuple[Any, ...]
    camera: DeviceCameras


class MatrixCameras:
    """Make the camera of a view's matrices once, because training views come back many times.

    Matrices are the same ones if they are the same objects, and `state_of` them is the same.
    """

    def __init__(self) -> None:
        self._made: dict[tuple[int, tuple[int, int]], _OfMatrices] = {}

    def get(
        self, view: Tensor, full: Tensor, centre: Tensor, tangents: tuple[float, float], size: tuple[int, int],
        like: Tensor, stream: int,
    ) -> DeviceCameras:  # fmt: skip
        """Return the camera of matrices as `kernels.camera_of` takes them, on any device.

        Args:
            like: a tensor on the device that renders.
            stream: number of its current one.
        """
        key, here = (id(view), size), (*tangents, like.device, stream)
        made = self._made.get(key)
        if (
            made is not None
            and made.view() is view
            and made.full() is full
            and made.centre() is centre
            and made.state == (*state_of(view), *state_of(full), *state_of(centre), *here)
        ):
            return made.camera
        camera = _camera_of(view, full, centre, tangents, size, like)
        tracked = not (view.is_inference() or full.is_inference() or centre.is_inference())
        if tracked and not _is_recording(like):
            known = weakref.ref(view, lambda _: self._made.pop(key, None))
            state = *state_of(view), *state_of(full), *state_of(centre), *here
            self._made[key] = _OfMatrices(known, weakref.ref(full), weakref.ref(centre), state, camera)
        return camera


def _camera_of(
    view: Tensor, full: Tensor, centre: Tensor, tangents: tuple[float, float], size: tuple[int, int], like: Tensor
) -> DeviceCameras:
    from lapgs_plugin.gpu_raster.kernels import camera_of

    view, full, centre = (matrix.detach().to(like) for matrix in (view, full, centre))
    # Scripts cut the centre out of an inverse: where it lies, only Triton's own launch would start the kernel.
    return camera_of(view, full, aligned(centre), tangents, size)


def _is_recording(like: Tensor) -> bool:
    """Return whether launches are recorded into a graph, so that they have no results yet."""
    return like.is_cuda and torch.cuda.is_current_stream_capturing()


def cameras_on_device(cameras: Sequence[Camera], like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return poses (b, 4, 4), intrinsics (b, 3, 3) and centres (b, 3) beside `like`, without waiting for its GPU.

    They are contiguous.
    """
    poses = [camera.world_to_camera for camera in cameras]
    elsewhere = any(pose.device.type != "cpu" for pose in poses)
    # All numbers in one tensor: each small copy costs time in every frame. Each part of a single camera's begins at a
    # multiple of 16 bytes.
    rows = [[c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0] for c in cameras]
    if not elsewhere:
        nothing = [0.0] * (12 - 9)
        rows = [[*row, *nothing, *_pose_numbers(pose)] for row, pose in zip(rows, poses, strict=True)]
    # Page-locked, because a copy from other memory would wait for the GPU.
    numbers = torch.tensor(rows, dtype=like.dtype, pin_memory=like.device.type == "cuda")
    numbers = numbers.to(like.device, non_blocking=True)  # (b, 31) or (b, 9)
    intrinsics = numbers[:, :9].contiguous().view(-1, 3, 3)
    if elsewhere:
        return torch.stack(poses).to(like), intrinsics, torch.stack([camera.position for camera in cameras]).to(like)
    return numbers[:, 12:28].contiguous().view(-1, 4, 4), intrinsics, numbers[:, 28:].contiguous()


def _pose_numbers(pose: Tensor) -> list[float]:
    """Return the 16 numbers of a pose on the CPU, row by row, and the 3 of the camera's centre, -R^T t."""
    rows: list[list[float]] = pose.tolist()
    centre = [-sum(rows[j][i] * rows[j][3] for j in range(3)) for i in range(3)]
    return [*rows[0], *rows[1], *rows[2], *rows[3], *centre]
