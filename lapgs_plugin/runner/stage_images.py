"""Hold the images of a stage: targets of its level, and upsampled predictions of coarser ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.checkouts.level_views import SceneImages
from lapgs_plugin.hierarchy.plan import Stage, level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.image_store import ImageStore, chosen_precision
from lapgs_plugin.runs.level_images import HeldImages, ImageStores, LevelImages
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
        weights: share of each pixel inside of the mask; None without masks.
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
        self._full_size, self._stage, self._options, self._device = full_size, stage, options, device
        self._pyramid, self._supervision = Pyramid(options.grid), SUPERVISIONS[options.supervision]
        self.train, self.test = scene.train, scene.test
        self._keys = {id(camera): full_size.key(camera) for camera in self.cameras}
        self.accumulated = accumulated
        sizes = [full_size[key].size for key in map(self.key, self.cameras)]
        self._stores = ImageStores(sizes, device, full_size.exact, options.images_on, folder)
        with_coarse = stage.signed and self._supervision.needs_coarse
        masked = bool(full_size.masks)
        self._images = LevelImages(self._stores, stage.level, self._pyramid, with_coarse=with_coarse, masked=masked)
        assert isinstance(self._images.targets, ImageStore), "as `exact` is not given"
        self.targets, self.coarse = self._images.targets, self._images.coarse
        self.weights = self._images.weights

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
        training = {self.key(camera) for camera in self.train}
        for camera in self.cameras:
            key = self.key(camera)
            image, mask = self._full_size[key].load(self._device), self._full_size.masks.get(key)
            self._images.put(key, image, mask, with_coarse=key in training)

    def new_predictions(self) -> UpsampledImages:
        """Return an empty store for I_hat^l of every view, which returns Up(I_hat^l)."""
        precision = chosen_precision(self._options.prediction_precision, self._device)
        level = self._stage.level
        return self._stores.make_upsampled(level, precision, f"predictions_{level}", self._pyramid)

    def drop_predictions(self) -> None:
        """Drop the predictions of coarser levels: from now on they are rendered."""
        if self.accumulated is not None:
            self.accumulated.close()

    @property
    def bytes_on_device(self) -> int:
        """Bytes of this stage's images on the GPU."""
        return sum(store.bytes_on_device for store in self._all_stores)

    def close(self) -> None:
        """Drop all images."""
        for store in self._all_stores:
            store.close()

    @property
    def _all_stores(self) -> tuple[ImageStore | HeldImages, ...]:
        return (*self._images.stores, *([] if self.accumulated is None else [self.accumulated.store]))
