"""Measure a checkout's own run for `lapgs run --off --record`, without changing it.

Wraps the symbols that the driver of a hierarchy replaces to measure time, so that both are timed between the same
moments: from the first iteration to the return of `training`, without saving. The script gets one more call an
iteration. After its end its held-out views are rendered with its own `render`. The measurements go into one file of the
script's output folder.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.attachment import Attachment, Replacement
from lapgs_plugin.checkouts.concurrent_runs import beside_other_runs
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.evaluation.metrics import mean_quality
from lapgs_plugin.files import BARE_RECORD, MANIFEST, write_text
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runner.step_clock import TimedLoop, counting_steps, timing_replacements
from lapgs_plugin.runs.layout import exists
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.stages.record import LoopRecord

logger = logging.getLogger(__name__)

TIMELINE_ENTRIES = 200
"""About how many entries the timeline of a run has."""


class BareRunRecorder(TimedLoop):
    """Run a script's main block and measure it.

    Args:
        adapter: adapter of the script's backbone.
        device: "cuda", or "cpu" inside `cpu_device.cuda_on_cpu`.
        measuring: what is measured in training; `gpu_busy` needs a CUDA device, and `breakdown` has no effect.
        compiled: why modules of ours are in the places of its compiled ones, by package.
    """

    def __init__(
        self,
        adapter: BackboneAdapter,
        device: str,
        measuring: MeasuringOptions,
        compiled: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(LoopRecord(torch.device(device)))
        self._adapter, self._device, self._measuring = adapter, torch.device(device), measuring
        self._compiled = dict(compiled or {})
        self._call: TrainingCall | None = None
        self._scene: Any = None
        self._timeline: list[dict[str, float]] = []
        self._timing = ExitStack()  # begins when the scene has a model, whose class is known then

    def run(self) -> None:
        """Run the main block and write `BARE_RECORD`.

        Raises:
            UserInputError: the script never trained.
            RunFolderError: its output folder holds a run in levels.
            SystemExit: the script's own.
        """
        try:
            with Attachment(self._replacements()), self._timing:
                self._adapter.script.run_main()
        except SystemExit as error:
            if error.code in (None, 0) and self._call is not None and self.iteration:  # as of sys.exit(main())
                self._write(self._call)
            raise
        if self._call is None or self.iteration == 0:
            raise UserInputError(f"{self._adapter.script.path} ended without training; there is nothing to record")
        self._write(self._call)

    def _write(self, call: TrainingCall) -> None:
        path = Path(call.dataset.model_path) / BARE_RECORD
        write_text(path, json.dumps(self._contents(call), indent=2) + "\n")
        logger.info("recorded: %s", path)

    def _replacements(self) -> list[Replacement]:
        profile = self._adapter.profile
        if not (scenes := profile.script_names(profile.scene)):
            raise UserInputError(
                f"--record: {self._adapter.script.path} makes no {profile.scene.__name__} of its own, whose Gaussians "
                "would be counted; leave it out"
            )
        return [
            *beside_other_runs(profile),
            Replacement(profile.script.module, profile.training.__name__, self._make_training, "the main block"),
            *(Replacement(profile.script.module, name, self._make_scene, "training()") for name in scenes),
        ]

    def _make_training(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def training(*args: Any, **kwargs: Any) -> Any:
            self._call = TrainingCall.bind(original, args, kwargs)
            folder = self._call.dataset.model_path  # empty: the script makes one
            if folder and exists(Path(folder) / MANIFEST):
                raise RunFolderError(f"-m {folder}: it holds a run in levels; give a bare run another folder")
            self.record = LoopRecord(self._device, self._call.opt.iterations if self._measuring.gpu_busy else 0)
            self._timeline = []
            result = original(*args, **kwargs)
            if self.iteration:
                self.record.stop(self._image_bytes())
            return result

        return training

    def _make_scene(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the scene's class, which keeps the scene and times the steps of its model."""

        def make_scene(*args: Any, **kwargs: Any) -> Any:
            self._scene = original(*args, **kwargs)
            self.gaussians, profile = self._scene.gaussians, self._adapter.profile
            profile.choose_model(type(self.gaussians))
            self._timing.close()
            self._timing.enter_context(Attachment(timing_replacements(profile, lambda: self)))
            self._timing.enter_context(counting_steps(profile, lambda: self))
            return self._scene

        return make_scene

    @property
    def has_more(self) -> bool:
        return self._call is not None and self.iteration < self._call.opt.iterations

    def iteration_begins(self, gaussians: Any) -> None:
        record, count = self.record, len(gaussians._xyz)
        if self.iteration == 0:
            record.start()
        record.start_clock()
        assert self._call is not None, "training() makes iterations"
        every, done = self._measuring.test_every, self.iteration
        if every is not None and done and done % every == 0:
            entry = {"iteration": done, "elapsed": record.elapsed(), "num_gaussians": count}
            with record.outside("evaluation"):
                quality = self._held_out(self._call)
            self._timeline.append({**entry, **quality})
        record.count(done + 1, count)
        if self.iteration % max(1, self._call.opt.iterations // TIMELINE_ENTRIES) == 0:
            entry = {"iteration": self.iteration, "elapsed": record.elapsed(), "num_gaussians": count}
            self._timeline.append(entry)

    def _contents(self, call: TrainingCall) -> dict[str, Any]:
        """Return the contents of the file, which `imported` and `experiments.rows` read."""
        record, counts, count = self.record, self.record.counts, len(self.gaussians._xyz)
        quality = self._held_out(call)
        if self._measuring.test_every is not None:
            at_end = {"iteration": self.iteration, "elapsed": counts.seconds, "num_gaussians": count}
            self._timeline.append({**at_end, **quality})
        return {
            "backbone": self._adapter.info.name,
            **({"compiled": self._compiled} if self._compiled else {}),
            "iterations": self.iteration,
            "train_seconds": counts.seconds,
            "saving_seconds": record.overhead.get("saving", 0.0),
            "num_gaussians": count,
            "peak_gaussians": max(counts.peak_gaussians, count),
            "mean_gaussians": counts.mean_gaussians,
            "memory_bytes": record.memory_bytes,
            **({} if (busy := record.busy.seconds()) is None else {"gpu_busy_seconds": busy}),
            **quality,
            "timeline": self._timeline,
        }

    @torch.no_grad()
    def _held_out(self, call: TrainingCall) -> dict[str, float]:
        """Return means of PSNR in dB and SSIM over the held-out views, empty without any."""
        background = torch.full((3,), float(call.white_background), device=self._device)
        stages, rendering = Stages(), StageRendering(signed=False, path=ColorPath.NATIVE, views={}, capture=True)

        def rendered(camera: Any) -> tuple[Tensor, Tensor]:
            """Return a view's image, captured at the checkout's rasterizer, and its photo; (3, h, w) each."""
            self._adapter.render(call, camera, self.gaussians, background)
            assert rendering.captured is not None, "render() rasterizes"
            image = rendering.captured.image
            return image, camera.original_image.to(image.device)

        wrapped = RasterizerWrapper(stages).replacements(self._adapter.profile, "render()")
        with stages.rendering_as(rendering), Attachment(wrapped):
            return mean_quality(map(rendered, self._scene.getTestCameras()))

    def _image_bytes(self) -> int:
        """Return the bytes of photos on the GPU."""
        cameras = [*self._scene.getTrainCameras(), *self._scene.getTestCameras()]
        images = [camera.original_image for camera in cameras]
        return sum(image.numel() * image.element_size() for image in images if image.device.type == "cuda")
