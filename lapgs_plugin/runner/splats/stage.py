"""Run one level of a script that trains splats: its batches, its renders, its measurements and its archive."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import FieldError, LapgsError, TrainingDivergedError
from lapgs_plugin.evaluation.metrics import means, psnr, qualities
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField, field_from_splats, require_finite
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.hierarchy.cameras import level_intrinsics
from lapgs_plugin.hierarchy.plan import Stage, level_size
from lapgs_plugin.ops.adam.multi_tensor import fuse_steps
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.runner.splats.joint import follow, trainable
from lapgs_plugin.runner.splats.run import SplatRun, write_cameras
from lapgs_plugin.runner.splats.signed import COLORS, CoarserLevels, FinishedField, compose
from lapgs_plugin.runner.splats.views import SplatView, camera_inputs, level_item, level_pixels
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.stages.images import StageImages
from lapgs_plugin.stages.opacity_weight import OpacityWeight
from lapgs_plugin.stages.record import StageRecord

logger = logging.getLogger(__name__)


class SplatStage:
    """Answer the replaced symbols of a script while it trains one level.

    Args:
        run, stage: the level and its run.
        finished: coarser levels, coarsest first; empty for a base and for nested levels.

    Attributes:
        iteration: running iteration, from 1; 0 before the first.
    """

    def __init__(self, run: SplatRun, stage: Stage, finished: Sequence[FinishedField] = ()) -> None:
        self._run, self.stage, self._trainer = run, stage, run.trainer
        self._coarser = CoarserLevels(run.rasterizer, run.pyramid, finished) if finished else None
        self._joint, self._joint_from = False, run.settings.joint_from(stage)
        self._record = StageRecord(
            archive=run.archive,
            stage=stage,
            iterations=run.plan.iterations,
            device=run.device,
            profiled=stage.iterations if run.request.measuring.gpu_busy else 0,
        )
        masked = any(view.mask is not None for view in run.train)
        self._sizes = {view.name: view.size for view in run.train}
        self._images = StageImages(run, stage, self._sizes, eight_bit=True, masked=masked)
        self._batch: list[str] = []  # views of the running iteration
        self._items: dict[int, dict[str, Any]] = {}  # of views, without pixels
        config = self._trainer.cfg
        last = getattr(config.strategy, "refine_stop_iter", config.max_steps)
        self._opacity_weight = OpacityWeight((config,) if stage.signed else (), last)
        self.iteration = 0

    def begin(self) -> None:
        """Make the level's images and start its measurements."""
        run, (width, height) = self._run, self.stage.image_size
        with self._record.overhead.timed("pyramid"):
            for view in run.train:
                self._images.photos.put(view.name, view.image(run.device), view.mask)
        if self._coarser is not None and self._joint_from != 1 and not self._moves_cameras:
            with self._record.overhead.timed("cache"):
                self._images.predictions = self._predict_all(self._coarser)
        logger.info("level %d: %d iterations at %dx%d", self.stage.level, self.stage.iterations, width, height)
        if run.settings.fused_adam and run.device.type == "cuda":
            for optimizer in self._trainer.optimizers.values():
                fuse_steps(optimizer)
        self._record.start()
        self._record.rewind_history()
        run.request.watcher.stage_started(self.stage)

    def item(self, index: int) -> dict[str, Any]:
        """Return a training view for the script's next batch."""
        view = self._run.train[index]
        self._batch.append(view.name)
        if index not in self._items:
            self._items[index] = level_item(view, self.stage.level, self._run.device)
        return {**self._items[index], **level_pixels(view, self._images.photos)}

    def prefetch(self, index: int) -> None:
        """Start copying a training view's images to the device."""
        name = self._run.train[index].name
        self._images.photos.prefetch(name)
        if self._images.predictions is not None:
            self._images.predictions.prefetch(name)

    def iteration_begins(self) -> None:
        """Act before an iteration of the script's loop."""
        self.iteration += 1
        self._batch, count = [], len(self._trainer.splats["means"])
        self._record.start_clock()
        self._look()
        every = self._run.request.measuring.test_every
        if every is not None and self.iteration > 1 and (self.iteration - 1) % every == 0 and self._run.test:
            elapsed = self._record.elapsed_in_run()
            with self._record.outside("evaluation"):
                quality = means(self._held_out_qualities())
            self._record.write_history(self.iteration - 1, {"elapsed": elapsed, **quality})
        if self.iteration == self._joint_from:
            self._train_jointly()
        self._opacity_weight.set(self.iteration)
        if self._joint and self._coarser is not None:
            count += sum(len(field.splats["means"]) for field in self._coarser.fields)
        self._record.count(self.iteration, count)
        if self.iteration % self._record.history_every == 0:
            figures = {"elapsed": self._record.elapsed_in_run(), "num_gaussians": count}
            self._record.write_history(self.iteration, figures)

    def outside(self, purpose: str) -> Any:
        """Return a context whose seconds are no optimization."""
        return self._record.outside(purpose)

    def rasterize(self, **inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Answer a call of the script's `rasterization`: with the coarser levels in the image of a residual."""
        if self._coarser is None:
            return self._run.rasterizer.render(**inputs)
        if not torch.is_grad_enabled() and self.stage.level > 0:
            return self._rasterize_full(inputs)
        return compose(self._run.rasterizer, inputs, self._predict)

    def _predict(self, inputs: Mapping[str, Any]) -> Tensor:
        """Return what the coarser levels predict for a call, (c, h, w, channels): kept, or rendered."""
        assert self._coarser is not None, "of a residual"
        if torch.is_grad_enabled() and not self._joint and self._images.predictions is not None:
            images = self._images.predictions.get(*self._batch)
            return (images[None] if images.ndim == 3 else images).permute(0, 2, 3, 1)
        if self._joint:
            return self._coarser.predict(inputs)
        with torch.set_grad_enabled(torch.is_grad_enabled() and inputs["viewmats"].requires_grad):
            return self._coarser.predict(inputs)

    def _rasterize_full(self, inputs: Mapping[str, Any]) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Answer a call for a full-size image in the middle of a hierarchy: rendered at the level's size, upsampled."""
        assert self._coarser is not None, "of a residual"
        size, level = (inputs["width"], inputs["height"]), self.stage.level
        width, height = level_size(size, level)
        own = {**inputs, "Ks": level_intrinsics(inputs["Ks"], size, level), "width": width, "height": height}
        images, alphas, info = compose(self._run.rasterizer, own, self._coarser.predict)
        full = (to_full_size(batch.permute(0, 3, 1, 2), size, level, self._run.pyramid) for batch in (images, alphas))
        image, alpha = (batch.permute(0, 2, 3, 1) for batch in full)
        return image, alpha, info

    @torch.no_grad()
    def _render(self, view: SplatView) -> Tensor:
        """Return the composed image (3, h, w) of a view at the level's size, before exposure."""
        own = FinishedField(self.stage.level, self.stage.signed, self._splats()).inputs()
        inputs = {**self._camera_inputs(view), **own}
        if self._coarser is None:
            image = self._run.rasterizer.render(**inputs)[0]
        else:
            image = compose(self._run.rasterizer, inputs, self._coarser.predict)[0]
        return image[0].permute(2, 0, 1)

    def _camera_inputs(self, view: SplatView) -> dict[str, Any]:
        return camera_inputs(view, self.stage.level, self._run.config, self._run.device)

    @property
    def _moves_cameras(self) -> bool:
        return any(getattr(self._run.config, name, None) for name in ("pose_opt", "pose_noise"))

    @torch.no_grad()
    def _predict_all(self, coarser: CoarserLevels) -> UpsampledImages:
        """Return what the coarser levels predict for the training views."""
        views, level = {view.name: view for view in self._run.train}, self.stage.level + 1

        def predict(name: str) -> Tensor:
            image = coarser.composed(self._camera_inputs(views[name]))[0, ..., :COLORS]
            return image.permute(2, 0, 1).contiguous()

        return self._images.cache(level, f"predictions_{level}", self._sizes, predict)

    def _train_jointly(self) -> None:
        """Optimize the finished fields, too, and render them instead of reading their predictions."""
        assert self._coarser is not None, "a residual has coarser levels"
        fields = [trainable(field, self._run.device) for field in self._coarser.fields]
        self._coarser, self._joint = CoarserLevels(self._run.rasterizer, self._run.pyramid, fields), True
        follow(self._coarser, self._trainer.optimizers, self._run.settings.color_factor, self._run.device)
        self._images.drop_predictions()

    def finish(self) -> None:
        """Archive the field after the stage's last iteration.

        Raises:
            LapgsError: the script ran other iterations than it was asked for, or the field has NaN or inf.
        """
        if self.iteration != self.stage.iterations:
            raise LapgsError(
                f"{type(self._trainer).__name__}.train() ended after {self.iteration} of {self.stage.iterations} "
                f"iterations of level {self.stage.level}, expected one batch of its training images an iteration; "
                "train with `lapgs run --off`"
            )
        archive = self._run.archive
        self._record.stop(self._images.bytes_on_device)
        field = self._field()
        joint = self._joint_fields()
        try:
            require_finite({self.stage.level: field, **(joint or {})}, self.stage.level)
        except FieldError as error:
            raise TrainingDivergedError(
                f"training diverged at level {self.stage.level}: {error}; start again with lower learning rates, or "
                "see whether `lapgs run --off` diverges too"
            ) from error
        archive.finish_level(self._record.of_level(len(field)), field, None, joint)
        if getattr(self._run.config, "pose_opt", False):
            write_cameras(self._run, self._refined_camera)
        if self._run.test and self.stage.level <= 1:
            with self._record.after_archive("evaluation"):
                views, without = self._held_out_qualities(), self._held_out_without()
            quality = means(views)
            self._record.write_history(self.stage.iterations, quality)
            self._record.write_view_psnrs([view["psnr"] for view in views], without)
            logger.info("held-out PSNR: %.2f dB over %d views", quality["psnr"], len(self._run.test))
        for line in self._record.weak_lines():
            logger.warning("%s", line)
        self._run.request.watcher.stage_finished(self.stage, self._fields)

    def close(self) -> None:
        """Drop the stage's images."""
        self._images.close()

    @torch.no_grad()
    def _held_out_qualities(self) -> list[dict[str, float]]:
        """Return PSNR in dB and SSIM of each held-out view, upsampled."""
        return qualities(self._beside_photo(view, self._render(view)) for view in self._run.test)

    @torch.no_grad()
    def _held_out_without(self) -> list[float]:
        """Return the PSNR in dB of each held-out view without the level; empty unless it is a residual."""
        coarser = self._coarser
        if coarser is None:
            return []
        images = ((view, coarser.predict(self._camera_inputs(view))[0].permute(2, 0, 1)) for view in self._run.test)
        return [psnr(*self._beside_photo(view, image)) for view, image in images]

    def _beside_photo(self, view: SplatView, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return an image (3, h, w) of the level at full size, and the view's photo."""
        whole = to_full_size(image.contiguous(), view.size, self.stage.level, self._run.pyramid)
        return whole, view.image(self._run.device)

    def _refined_camera(self, index: int) -> Camera:
        """Return the camera of a training view at the pose that the script has learned."""
        view, device = self._run.train[index], self._run.device
        pose = view.item["camtoworld"].to(device)[None]  # (1, 4, 4)
        moved = self._trainer.pose_adjust(pose, torch.tensor([index], device=device))[0]
        return replace(view.camera, world_to_camera=torch.linalg.inv(moved.double()).float().cpu())

    def _look(self) -> None:
        """Show the fields to the run's watcher if it wants to look."""
        watcher = self._run.request.watcher
        if watcher.wants_look():
            with self._record.outside("view"):
                watcher.look(self.stage, self.iteration - 1, self._fields, lambda: False)

    def _fields(self) -> dict[int, GaussianField]:
        """Return the fields that are being optimized, by level."""
        return {**(self._joint_fields() or {}), self.stage.level: self._field()}

    def _joint_fields(self) -> dict[int, GaussianField] | None:
        if not self._joint or self._coarser is None:
            return None
        return {
            coarse.level: field_from_splats(coarse.splats, coarse.signed).detach().to("cpu")
            for coarse in self._coarser.fields
        }

    @torch.no_grad()
    def _field(self) -> GaussianField:
        """Return the script's splats as a field on the CPU."""
        return field_from_splats(self._splats(), self.stage.signed).detach().to("cpu")

    @torch.no_grad()
    def _splats(self) -> Mapping[str, Tensor]:
        """Return the script's splats; colours that a network makes of features become those seen from nowhere."""
        splats = self._trainer.splats
        if "sh0" in splats:
            return dict(splats.items())
        # As the script does when it saves a PLY: the embedding of no image, and directions of no length.
        away = torch.zeros_like(splats["means"])[None]
        degree = self._run.config.sh_degree
        logits = self._trainer.app_module(features=splats["features"], embed_ids=None, dirs=away, sh_degree=degree)
        colors = torch.sigmoid(logits + splats["colors"]).squeeze(0)  # (n, 3)
        sh = colors.new_zeros(len(colors), (degree + 1) ** 2, 3)
        sh[:, 0] = (colors - 0.5) / SH_C0
        return {**{name: splats[name] for name in splats}, "sh0": sh[:, :1], "shN": sh[:, 1:]}
