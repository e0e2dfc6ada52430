"""Make, hold and drop the images of a stage: its photos at the level's size, and predictions by the coarser levels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from torch import Tensor

from lapgs_plugin.hierarchy.plan import Stage, level_size
from lapgs_plugin.runs.image_store import chosen_precision
from lapgs_plugin.runs.level_images import ImageStores, LevelImages
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.stages.joint import Predictions
from lapgs_plugin.stages.run import StagedRun

Sizes = Mapping[str, tuple[int, int]]
"""(width, height) of views at full size, by name."""


class StageImages:
    """Hold the images of a stage until `close`.

    Args:
        run, stage: the stage and its run.
        sizes: of the views that have targets.
        eight_bit: whether their photos have 8 bits a channel.
        masked: whether they have masks.
        exact: see `LevelImages`.

    Attributes:
        photos: I^l of the views, and with it all that their losses compare with.
        predictions: Up(I_hat^(l+1)) of the training views; None for a field that is not a residual.
        held_out: the same of views that are measured.
    """

    def __init__(
        self, run: StagedRun, stage: Stage, sizes: Sizes, *, eight_bit: bool, masked: bool, exact: bool = False
    ) -> None:
        self._run = run
        self._stores = ImageStores(
            list(sizes.values()), run.device, eight_bit, run.settings.images_on, run.cache_folder
        )
        with_coarse = stage.signed and run.supervision.needs_coarse
        self.photos = LevelImages(
            self._stores, stage.level, run.pyramid, with_coarse=with_coarse, masked=masked, exact=exact
        )
        self.predictions: Predictions | None = None
        self.held_out: Predictions | None = None

    def cache(
        self, level: int, name: str, sizes: Sizes, predict: Callable[[str], Tensor], where: str | None = None
    ) -> UpsampledImages:
        """Return predictions I_hat^level of views, stored for the residual stage of the next finer level.

        Args:
            level: of the images.
            name: of their folder, if they are kept on the disk.
            sizes: of the views.
            predict: returns a view's composed image (3, h, w) at the level's size.
            where: see `ImageStores`; None for the place of the photos.
        """
        stores = replace(self._stores, sizes=list(sizes.values()), where=where or self._stores.where)
        precision = chosen_precision(self._run.settings.prediction_precision, self._run.device)
        images = stores.make_upsampled(level, precision, name, self._run.pyramid)
        for view, size in sizes.items():
            width, height = level_size(size, level - 1)
            images.put(view, predict(view), (height, width))
        return images

    def drop_predictions(self) -> None:
        """Drop cached predictions: the stage is finished, or from now on they are rendered."""
        for cache in self._caches:
            cache.close()
        self.predictions = self.held_out = None

    def close(self) -> None:
        """Drop all images and their files."""
        self.drop_predictions()
        self.photos.close()

    @property
    def bytes_on_device(self) -> int:
        """Bytes of the images on the GPU."""
        return self.photos.bytes_on_device + sum(cache.store.bytes_on_device for cache in self._caches)

    @property
    def _caches(self) -> set[UpsampledImages]:
        return {cache for cache in (self.predictions, self.held_out) if isinstance(cache, UpsampledImages)}
