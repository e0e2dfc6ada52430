"""Measure a checkout's own run for `lapgs run --off --record`, without changing it.

Wraps the symbols that the driver of a hierarchy replaces to measure time, so that both are timed between the same
moments: from the first iteration to the return of `training`, without saving. The script gets one more call an
iteration. After its end its held-out views are rendered with its own `render`. The measurements go into one file of the
script's output folder.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.attachment import Attachment, Replacement, of_class
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.metrics import mean_quality
from lapgs_plugin.files import BARE_RECORD, write_text
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runner.step_clock import counting_steps
from lapgs_plugin.runs.gpu_busy import GpuBusy

logger = logging.getLogger(__name__)

TIMELINE_ENTRIES = 200
"""About how many entries the timeline of a run has."""


class BareRunRecorder:
    """Run a script's main block and measure it.

    Args:
        adapter: adapter of the script's backbone.
        device: "cuda", or "cpu" inside `cpu_device.cuda_on_cpu`.
        gpu_busy: profile some iterations; needs a CUDA device.

    Attributes:
        iteration: running iteration, from 1; 0 before the first.
    """

    def __init__(self, adapter: BackboneAdapter, device: str, gpu_busy: bool = False) -> None:
        self._adapter, self._device = adapter, device
        self._profiles, self._busy = gpu_busy, GpuBusy()
        self._call: TrainingCall | None = None
        self._scene: Any = None
        self._began: float | None = None
        self._seconds = self._saving = self._profiling = 0.0
        self.iteration = self._peak = self._summed = 0
        self._memory: dict[str, int] = {}
        self._timeline: list[dict[str, float]] = []

    def run(self) -> None:
        """Run the main block and write `BARE_RECORD`.

        Raises:
            UserInputError: the script never trained.
        """
        with Attachment(self._replacements()), counting_steps(self._adapter.profile.model, lambda: self):
            self._adapter.script.run_main()
        if self._call is None or self._began is None:
            raise UserInputError(f"{self._adapter.script.path} ended without training; there is nothing to record")
        path = Path(self._call.dataset.model_path) / BARE_RECORD
        write_text(path, json.dumps(self._record(), indent=2) + "\n")
        logger.info("recorded: %s", path)

    def _replacements(self) -> list[Replacement]:
        profile = self._adapter.profile
        if not (scenes := profile.script_names(profile.scene)):
            raise UserInputError(
                f"--record: {self._adapter.script.path} makes no {profile.scene.__name__} of its own, whose Gaussians "
                "would be counted; leave it out"
            )
        return [
            Replacement(profile.script.module, profile.training.__name__, self._make_training, "the main block"),
            *(Replacement(profile.script.module, name, self._make_scene, "training()") for name in scenes),
            *of_class(profile.model, "update_learning_rate", self._make_update_learning_rate, "every iteration"),
            *of_class(profile.scene, "save", self._make_save, "training() at --save_iterations"),
        ]

    def _make_training(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def training(*args: Any, **kwargs: Any) -> Any:
            self._call = TrainingCall.bind(original, args, kwargs)
            result = original(*args, **kwargs)
            self._profile()
            self._synchronize()
            if self._began is not None:
                self._seconds = self._elapsed(self._began)
            if self._device == "cuda":
                self._memory = {"peak": torch.cuda.max_memory_allocated(), "images": self._image_bytes()}
            return result

        return training

    def _make_scene(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def make_scene(*args: Any, **kwargs: Any) -> Any:
            self._scene = original(*args, **kwargs)
            return self._scene

        return make_scene

    def _make_update_learning_rate(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def update_learning_rate(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            self.iteration_begins(gaussians)
            return original(gaussians, *args, **kwargs)

        return update_learning_rate

    def _make_save(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def save(scene: Any, *args: Any, **kwargs: Any) -> Any:
            self._synchronize()
            start = time.perf_counter()
            result = original(scene, *args, **kwargs)
            self._saving += time.perf_counter() - start
            return result

        return save

    @property
    def gaussians(self) -> Any:
        """The checkout's model; None before its scene is made."""
        return None if self._scene is None else self._scene.gaussians

    @property
    def has_more(self) -> bool:
        """Whether training has iterations after this one."""
        return self._call is not None and self.iteration < self._call.opt.iterations

    def iteration_begins(self, gaussians: Any) -> None:
        """Count an iteration that is about to begin."""
        if self._began is None:
            self._synchronize()
            if self._device == "cuda":
                torch.cuda.reset_peak_memory_stats()
            self._began = time.perf_counter()
            if self._profiles and self._call is not None:
                self._busy = GpuBusy(self._call.opt.iterations)
        self._profile()
        count = len(gaussians._xyz)
        self.iteration += 1
        self._summed += count
        self._peak = max(self._peak, count)
        assert self._call is not None, "training() makes iterations"
        if self.iteration % max(1, self._call.opt.iterations // TIMELINE_ENTRIES) == 0:
            elapsed = self._elapsed(self._began)
            self._timeline.append({"iteration": self.iteration, "elapsed": elapsed, "num_gaussians": count})

    def _profile(self) -> None:
        """Start or end a profile if it is due; its time does not count."""
        if self._busy.due(self.iteration):
            self._synchronize()
            start = time.perf_counter()
            self._busy.step(self.iteration)
            self._profiling += time.perf_counter() - start

    def _elapsed(self, began: float) -> float:
        return time.perf_counter() - began - self._saving - self._profiling

    def _record(self) -> dict[str, Any]:
        """Return the contents of the file, which `imported` and `experiments.rows` read."""
        gaussians = self.gaussians
        return {
            "iterations": self.iteration,
            "train_seconds": self._seconds,
            "saving_seconds": self._saving,
            "num_gaussians": len(gaussians._xyz),
            "peak_gaussians": max(self._peak, len(gaussians._xyz)),
            "mean_gaussians": self._summed / self.iteration,
            "memory_bytes": self._memory,
            **({} if (busy := self._busy.seconds()) is None else {"gpu_busy_seconds": busy}),
            **self._held_out(gaussians),
            "timeline": self._timeline,
        }

    @torch.no_grad()
    def _held_out(self, gaussians: Any) -> dict[str, float]:
        """Return means of PSNR in dB and SSIM over the held-out views, empty without any."""
        assert self._call is not None, "called after training"
        cameras = list(self._scene.getTestCameras())
        background = torch.full((3,), float(self._call.white_background), device=self._device)
        wrapper = RasterizerWrapper()
        wrapper.stage = StageRendering(signed=False, path=ColorPath.NATIVE, views={}, capture=True)
        found = wrapper.entries(self._adapter.profile)
        with Attachment([Replacement(owner, name, make, "render()") for owner, name, make in found]):
            return mean_quality(self._rendered(camera, gaussians, background, wrapper.stage) for camera in cameras)

    def _rendered(
        self, camera: Any, gaussians: Any, background: Tensor, rendering: StageRendering
    ) -> tuple[Tensor, Tensor]:
        """Return a view's image, captured at the checkout's rasterizer, and its photo; (3, h, w) each."""
        assert self._call is not None, "called after training"
        self._adapter.render(self._call, camera, gaussians, background)
        assert rendering.captured is not None, "render() rasterizes"
        return rendering.captured, camera.original_image.to(rendering.captured.device)

    def _image_bytes(self) -> int:
        """Return the bytes of photos on the GPU."""
        cameras = [*self._scene.getTrainCameras(), *self._scene.getTestCameras()]
        images = [camera.original_image for camera in cameras]
        return sum(image.numel() * image.element_size() for image in images if image.device.type == "cuda")

    def _synchronize(self) -> None:
        if self._device == "cuda":
            torch.cuda.synchronize()
