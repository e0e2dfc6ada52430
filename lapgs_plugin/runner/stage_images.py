"""Hold the images of a stage: targets of its level, and upsampled predictions of coarser ones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.checkouts.level_views import SceneImages
from lapgs_plugin.hierarchy.plan import Stage, level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.image_store import PRECISIONS, ImageStore, chosen_precision, place
from lapgs_plugin.runs.upsampled_images import UpsampledImages


class StageImages:
    """Store the images of a stage by the keys of `SceneImages`; the stores are empty until `load`.

    Args:
        full_size: full-size images of the scene.
        scene: the checkout's scene.
        stage: the stage.
        options: settings of the hierarchy.
        device: device that images are copied to when they are used.
        folder: folder for images on the disk.
        accumulated: Up(I_hat^(l+1)) of every view, closed with the rest; None for the base.

    Attributes:
        train, test: the scene's training and held-out cameras.
        targets: I^l.
        coarse: Up(I^(l+1)) of training views; None unless the supervision needs it.
    """

    def __init__(
        self,
        full_size: SceneImages,
        scene: CheckoutScene,
        stage: Stage,
        options: RunSettings,
        device: torch.device,
        folder: Path,
        accumulated: UpsampledImages | None,
    ) -> None:
        self._full_size, self._stage, self._options = full_size, stage, options
        self._device, self._folder = device, folder
        self._pyramid, self._supervision = Pyramid(options.grid), SUPERVISIONS[options.supervision]
        self.train, self.test = scene.train, scene.test
        self._keys = {id(camera): full_size.key(camera) for camera in self.cameras}
        self.accumulated = accumulated
        self.targets = self._store(self._target_precision(stage.level), stage.level, "targets")
        of_laplacian = stage.signed and self._supervision.needs_coarse
        self.coarse = self._upsampled("float16", stage.level + 1, "coarse") if of_laplacian else None

    @property
    def cameras(self) -> list[Any]:
        """All cameras of the scene, training cameras first."""
        return [*self.train, *self.test]

    @property
    def keys(self) -> frozenset[str]:
        """Keys of all views."""
        return frozenset(self._keys.values())

    @property
    def composed_keys(self) -> frozenset[str]:
        """Keys of the views to compose: all, or the held-out ones where residuals are supervised alone."""
        cameras = self.cameras if self._supervision.composes else self.test
        return frozenset(self.key(camera) for camera in cameras)

    def key(self, camera: Any) -> str:
        """Return the key of a camera's view."""
        return self._keys[id(camera)]

    def size(self, camera: Any, level: int) -> tuple[int, int]:
        """Return (width, height) of a camera's image at a level."""
        return level_size(self._full_size[self.key(camera)].size, level)

    def load(self) -> None:
        """Make I^l of every view, and Up(I^(l+1)) of training views if the supervision needs it."""
        level = self._stage.level
        of_laplacian = set() if self.coarse is None else {self.key(camera) for camera in self.train}
        for camera in self.cameras:
            key = self.key(camera)
            image = self._full_size[key].load(self._device)
            images = self._pyramid.gaussian(image, level + 1 + (key in of_laplacian))
            self.targets.put(key, images[level])
            if self.coarse is not None and key in of_laplacian:
                height, width = images[level].shape[1:]
                self.coarse.put(key, images[level + 1], (height, width))

    def new_predictions(self) -> UpsampledImages:
        """Return an empty store for I_hat^l of every view, which returns Up(I_hat^l)."""
        precision = chosen_precision(self._options.prediction_precision, self._device)
        return self._upsampled(precision, self._stage.level, "predictions")

    def drop_predictions(self) -> None:
        """Drop the predictions of coarser levels: from now on they are rendered."""
        if self.accumulated is not None:
            self.accumulated.close()

    @property
    def bytes_on_device(self) -> int:
        """Bytes of this stage's images on the GPU."""
        return sum(store.bytes_on_device for store in self._stores)

    @property
    def wait_elsewhere(self) -> bool:
        """Whether some images must be copied to the device before use."""
        from_memory = self._device.type == "cuda"
        return any(store.bytes_on_disk or (from_memory and store.bytes_in_memory) for store in self._stores)

    def close(self) -> None:
        """Drop all images."""
        for store in self._stores:
            store.close()

    @property
    def _stores(self) -> tuple[ImageStore, ...]:
        upsampled = (images.store for images in (self.coarse, self.accumulated) if images is not None)
        return (self.targets, *upsampled)

    def _target_precision(self, level: int) -> str:
        """Return the precision of targets: 8-bit photos are exact in uint8 at full size, their averages are not."""
        return "uint8" if level == 0 and self._full_size.exact else "float16"

    def _upsampled(self, precision: str, level: int, name: str) -> UpsampledImages:
        """Return an empty store for images of a level that the next finer one uses upsampled, beside its targets."""
        targets = self._bytes(self._target_precision(level - 1), level - 1)
        return UpsampledImages(self._store(precision, level, name, beside=targets), self._pyramid)

    def _bytes(self, precision: str, level: int) -> int:
        """Return the bytes of the images of all views at a level."""
        return 3 * sum(math.prod(self.size(camera, level)) for camera in self.cameras) * PRECISIONS[precision].itemsize

    def _store(self, precision: str, level: int, name: str, beside: int = 0) -> ImageStore:
        """Return an empty store for the images of all views at a level, where the user wants it or where it fits."""
        where = self._options.images_on
        if where == "auto":
            where = place(self._bytes(precision, level) + beside, self._device)
        elif where == "gpu" and self._device.type == "cpu":
            where = "memory"
        folder = self._folder / f"{name}_{self._stage.level}"
        return ImageStore(where, precision, device=self._device, folder=folder)
