"""Make, hold and drop the images of a stage: targets of training views, and predictions of the coarser levels."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.run import refined_views
from lapgs_plugin.runs.image_store import chosen_precision, eight_bit_levels
from lapgs_plugin.runs.layout import CACHE
from lapgs_plugin.runs.level_images import ImageStores, LevelImages
from lapgs_plugin.runs.profiling import Overhead
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.scenes.scene import View
from lapgs_plugin.training.prepared_run import PreparedRun

TRAIN, TEST = "train", "test"
"""Folders of cached predictions for training views and for views that are measured."""


class StageImages:
    """Hold the images of a stage until `close`.

    Args:
        run: the prepared run.
        stage: to train.
        overhead: gets the seconds that images and predictions take.

    Attributes:
        targets: of the training views.
        train_predictions: of the coarser levels for training views; None for a field that is not a residual, and while
            the coarser fields are trained jointly.
        test_predictions: the same for held-out views and those that were set aside.
    """

    def __init__(self, run: PreparedRun, stage: Stage, overhead: Overhead) -> None:
        self._run = run
        self.train_predictions: UpsampledImages | None = None
        self.test_predictions: UpsampledImages | None = None
        shutil.rmtree(self._folder, ignore_errors=True)  # of a run that was killed
        with overhead.timed("pyramid"):
            self.targets = self._level_images(stage)
        if not stage.signed:
            return
        try:
            with overhead.timed("cache"):
                self.train_predictions = self._predictions(stage, run.scene.train, TRAIN)
            with overhead.timed("evaluation"):
                self.test_predictions = self._predictions(stage, [*run.scene.test, *run.aside], TEST)
        except BaseException:
            self.close()
            raise

    def drop_predictions(self) -> None:
        """Drop the predictions: the stage is finished, or from now on they are rendered."""
        for cache in (self.train_predictions, self.test_predictions):
            if cache is not None:
                cache.close()
        self.train_predictions = self.test_predictions = None

    def close(self) -> None:
        """Drop all images and their files."""
        self.drop_predictions()
        self.targets.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def bytes_on_device(self) -> int:
        """Bytes of the images on the GPU."""
        caches = (cache for cache in (self.train_predictions, self.test_predictions) if cache is not None)
        return self.targets.bytes_on_device + sum(cache.store.bytes_on_device for cache in caches)

    @property
    def _folder(self) -> Path:
        return self._run.archive.path(CACHE)

    def _predictions(self, stage: Stage, views: Sequence[View], name: str) -> UpsampledImages:
        """Return Up(I_hat^(l+1)) of each view at its refined pose, for the stage of level l."""
        run, coarser = self._run, stage.level + 1
        where = run.settings.images_on
        if where == AUTO and name == TEST:
            where = "memory"  # held-out views are rarely used, outside the clock: a GPU needs its memory for others
        precision = chosen_precision(run.settings.prediction_precision, run.device)
        cache = self._stores(views, where).make_upsampled(coarser, precision, name, run.pyramid)
        if views:
            renderer = HierarchyRenderer.from_archive(run.archive, run.rasterizer, run.device)
            for view in refined_views(run.archive, views):
                camera = level_camera(view.camera, stage.level)
                cache.put(view.name, renderer.images([view.camera], coarser)[0], (camera.height, camera.width))
        return cache

    def _stores(self, views: Sequence[View], where: str = AUTO, eight_bit: bool = False) -> ImageStores:
        sizes = [view.camera.size for view in views]
        return ImageStores(sizes, self._run.device, eight_bit, where, self._folder)

    def _level_images(self, stage: Stage) -> LevelImages:
        """Return the targets of a stage's training views, on a CPU as float32."""
        run, views = self._run, self._run.scene.train
        on_gpu = run.device.type == "cuda"
        eight_bit = on_gpu and stage.level == 0 and all(eight_bit_levels(view.image) is not None for view in views)
        with_coarse = run.supervision.needs_coarse and stage.level < run.plan.levels - 1
        stores = self._stores(views, run.settings.images_on, eight_bit)
        masked = any(view.masked for view in views)
        images = LevelImages(stores, stage.level, run.pyramid, with_coarse=with_coarse, masked=masked, exact=not on_gpu)
        for view in views:
            images.put(view.name, view.image, view.mask)
        return images
