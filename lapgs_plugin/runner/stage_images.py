"""The images of one stage: its level of the photos, what lies below them, and where all of them wait."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.checkouts.level_views import PhotoAlbum
from lapgs_plugin.hierarchy.plan import Stage, level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.supervision import Supervision, parse_supervision
from lapgs_plugin.runner.run_state import HierarchyOptions, LoadedScene
from lapgs_plugin.runs.image_store import PRECISIONS, ImageStore, place
from lapgs_plugin.runs.upsampled_images import UpsampledImages


class StageImages:
    """Images of a stage by the album's keys; empty stores until `load`.

    Args:
        album: full-size images of the scene.
        scene: whose cameras they are.
        stage: which level.
        options: of the hierarchy.
        device: where images are handed out.
        folder: for images on the disk.
        accumulated: Up(I_hat^(l+1)) of every view, closed with the rest; None for the base.
    """

    def __init__(
        self,
        album: PhotoAlbum,
        scene: LoadedScene,
        stage: Stage,
        options: HierarchyOptions,
        device: torch.device,
        folder: Path,
        accumulated: UpsampledImages | None,
    ) -> None:
        self._album, self._stage, self._options = album, stage, options
        self._device, self._folder = device, folder
        self._pyramid, self._supervision = Pyramid(options.grid), parse_supervision(options.supervision)
        self.train, self.test = scene.train, scene.test
        self._keys = {id(camera): album.key(camera) for camera in self.cameras}
        self.accumulated = accumulated
        self.targets = self._store(self._target_precision(stage.level), stage.level, "targets")
        of_laplacian = stage.signed and self._supervision is Supervision.GT_LAPLACIAN
        self.coarse = self._raised("float16", stage.level + 1, "coarse") if of_laplacian else None

    @property
    def cameras(self) -> list[Any]:
        return [*self.train, *self.test]

    @property
    def keys(self) -> frozenset[str]:
        return frozenset(self._keys.values())

    @property
    def composed_keys(self) -> frozenset[str]:
        """Views whose rendered residual is composed: all, but for the ablations that supervise residuals alone."""
        cameras = self.cameras if self._supervision is Supervision.RECONSTRUCTED else self.test
        return frozenset(self.key(camera) for camera in cameras)

    def key(self, camera: Any) -> str:
        return self._keys[id(camera)]

    def size(self, camera: Any, level: int) -> tuple[int, int]:
        """(width, height) of a camera's image at a level."""
        return level_size(self._album.photo(self.key(camera)).size, level)

    def load(self) -> None:
        """Make the level's images of every view: I^l, and Up(I^(l+1)) of training views if the supervision needs it."""
        level = self._stage.level
        of_laplacian = set() if self.coarse is None else {self.key(camera) for camera in self.train}
        for camera in self.cameras:
            key = self.key(camera)
            photo = self._album.photo(key).image(self._device)
            images = self._pyramid.gaussian(photo, level + 1 + (key in of_laplacian))
            self.targets.put(key, images[level])
            if self.coarse is not None and key in of_laplacian:
                height, width = images[level].shape[1:]
                self.coarse.put(key, images[level + 1], (height, width))

    def new_predictions(self) -> UpsampledImages:
        """Room for I_hat^l of every view, from which the next stage will have Up(I_hat^l)."""
        return self._raised(self._options.prediction_precision, self._stage.level, "predictions")

    def drop_predictions(self) -> None:
        """Let go of what the stages before predict: from here on it is rendered."""
        if self.accumulated is not None:
            self.accumulated.close()

    @property
    def bytes_on_device(self) -> int:
        """Bytes of this stage's images on the GPU."""
        return sum(store.bytes_on_device for store in self._stores)

    @property
    def wait_elsewhere(self) -> bool:
        """Whether some have to be brought to the device before they can be read."""
        from_memory = self._device.type == "cuda"
        return any(store.bytes_on_disk or (from_memory and store.bytes_in_memory) for store in self._stores)

    def close(self) -> None:
        """Let go of all of them."""
        for store in self._stores:
            store.close()

    @property
    def _stores(self) -> tuple[ImageStore, ...]:
        raised = (images.store for images in (self.coarse, self.accumulated) if images is not None)
        return (self.targets, *raised)

    def _target_precision(self, level: int) -> str:
        """Photos of 8 bits are themselves only at full size: averages need more."""
        return "uint8" if level == 0 and self._album.exact else "float16"

    def _raised(self, precision: str, level: int, name: str) -> UpsampledImages:
        """Room for images of a level that the next finer one will look at as Up of them, beside its targets."""
        targets = self._bytes(self._target_precision(level - 1), level - 1)
        return UpsampledImages(self._store(precision, level, name, beside=targets), self._pyramid)

    def _bytes(self, precision: str, level: int) -> int:
        """Of an image of every view at a level."""
        return 3 * sum(math.prod(self.size(camera, level)) for camera in self.cameras) * PRECISIONS[precision].itemsize

    def _store(self, precision: str, level: int, name: str, beside: int = 0) -> ImageStore:
        """A store for an image of every view at a level, where the user wants it or where it fits."""
        where = self._options.images_on
        if where == "auto":
            where = place(self._bytes(precision, level) + beside, self._device)
        elif where == "gpu" and self._device.type == "cpu":
            where = "memory"
        folder = self._folder / f"{name}_{self._stage.level}"
        return ImageStore(where, precision, device=self._device, folder=folder)
