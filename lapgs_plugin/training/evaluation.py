"""Measure views during a stage: held-out ones for the log, and those that were set aside to keep the best state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.evaluation.metrics import color_fitted_psnr, psnr
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.ops.vignetting import vignette
from lapgs_plugin.runs.neighbours import predicted_exposures
from lapgs_plugin.scenes.scene import View, with_pixels
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.poses import at_pose
from lapgs_plugin.training.quality import LEAST_GAIN, SAMPLED_VIEWS, QualityWatch, copied, spread_views
from lapgs_plugin.training.stage import StageRun
from lapgs_plugin.training.views import LevelView, level_views


@dataclass(frozen=True)
class ViewPsnr:
    """Hold the PSNR in dB of a view, upsampled to full size.

    Attributes:
        plain: of the composed image.
        fitted: the same after a colour fit.
        coarser: of the coarser levels' image without the running residual; None if no residual runs.
    """

    plain: float
    fitted: float
    coarser: float | None


@dataclass
class StageEvaluation:
    """Measure views of a stage, composed so far and upsampled to full resolution.

    Attributes:
        run: the stage.
        watch: compares the measurements of all stages.
        monitor: shows warnings to the user.
        best: the stage's best state so far, see `checkpoint.BestState`; None before the first measurement.
    """

    run: StageRun
    watch: QualityWatch
    monitor: Monitor
    best: dict[str, Any] | None = None
    _last: tuple[int, list[ViewPsnr]] | None = None  # iteration and figures of all held-out views

    def held_out(self, every: bool, sample: bool) -> dict[str, float]:
        """Return the PSNR fields of a `Tick`: of every held-out view, of some, or of both; empty without such views."""
        run, test = self.run, self.run.prepared.scene.test
        some = spread_views(test, SAMPLED_VIEWS) if test and sample else []
        views = test if every else some
        if not views:  # after most steps: reading exposures would wait for the GPU
            return {}
        with run.record.overhead.timed("evaluation"):
            learned = None if run.appearance is None else run.appearance.archived()
            exposures = {} if learned is None else predicted_exposures(learned, [view.name for view in views])
            psnrs = self._psnrs(views, exposures)
        measured = {"psnr": fmean(each.plain for each in psnrs.values())} if every else {}
        if every:
            self._last = run.counts.iteration, list(psnrs.values())
        if some:
            sampled = [psnrs[view.name] for view in some]
            measured["sampled_psnr"] = fmean(each.plain for each in sampled)
            measured["sampled_fitted_psnr"] = fmean(each.fitted for each in sampled)
        return measured

    def withheld(self) -> list[float]:
        """Return the PSNR in dB of the views that decide the stage's length, at its size and after a colour fit."""
        with self.run.record.overhead.timed("evaluation"):
            return [self._fitted_psnr(view) for view in self._withheld]

    @cached_property
    def _withheld(self) -> tuple[LevelView, ...]:
        return level_views(self.run.prepared.withheld, self.run.stage.level)

    @torch.no_grad()
    def _fitted_psnr(self, view: LevelView) -> float:
        """Return the PSNR of a training view at the stage's size, with its falloff and after a colour fit."""
        run, images = self.run, self.run.images
        camera = at_pose(view, run.poses).camera
        image = run.prepared.rasterizer.render_image(run.model.field, camera, background=run.background)
        composed = add_prediction(image, None if images.predictions is None else images.predictions.get(view.name))
        composed = vignette(composed, [run.falloffs.get(view.name, 0.0)])
        photo, _ = images.photos.get(view.name)
        return color_fitted_psnr(composed, photo, images.photos.get_weights(view.name))

    def note_views(self) -> None:
        """Write the PSNR of each held-out view, in the state that is archived, to the history if it can be of use."""
        run = self.run
        if not run.prepared.scene.test or run.stage.level > 1:
            return
        if self._last is None or self._last[0] != run.stage.iterations:
            self.held_out(every=True, sample=False)
        assert self._last is not None, "`held_out` sets it"
        views = self._last[1]
        coarser = [each.coarser for each in views if each.coarser is not None]
        run.record.write_view_psnrs([each.plain for each in views], coarser)

    def _psnrs(self, views: Sequence[View], exposures: Mapping[str, Tensor] | None = None) -> dict[str, ViewPsnr]:
        """Measure views, each on the rank that has its image, and return the figures by name in their order."""
        prepared, exposures = self.run.prepared, exposures or {}
        held = prepared.owned(views)
        photos, idle = with_pixels(held), prepared.sharding.idle_rounds(len(held))
        own = {view.name: self._psnr(view, exposures.get(view.name)) for view in photos}
        for _ in range(idle):  # other ranks have more views
            self._renders(views[0])
        measured = {name: psnr for one in prepared.ranks.gathered(own) for name, psnr in one.items()}
        return {view.name: measured[view.name] for view in views}

    @torch.no_grad()
    def _psnr(self, view: View, exposure: Tensor | None = None) -> ViewPsnr:
        """Measure a view.

        Args:
            exposure: (3, 4) colour transform from renders to the view's photo; None leaves renders unchanged.
        """
        image, coarser = self._renders(view)
        whole, photo, mask = self._beside_photo(view, add_prediction(image, coarser), exposure)
        without = None if coarser is None else psnr(*self._beside_photo(view, coarser, exposure))
        return ViewPsnr(psnr(whole, photo, mask), color_fitted_psnr(whole, photo, mask), without)

    @torch.no_grad()
    def _renders(self, view: View) -> tuple[Tensor, Tensor | None]:
        """Return a view's image (3, h, w) of the stage's field, and its prediction by coarser levels, if any."""
        run, below = self.run, self.run.images.held_out
        camera = level_camera(view.camera, run.stage.level)
        camera = camera if run.poses is None else run.poses.camera(view.name, camera)
        image = run.prepared.rasterizer(run.model.field, camera, background=run.background).image
        if below is None or (run.joint is None and view.name not in run.prepared.own):  # another rank has it
            return image, None
        return image, below.get(view.name)

    def _beside_photo(self, view: View, image: Tensor, exposure: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return an image (3, h, w) of the level at full size as a view is photographed, the photo and its mask."""
        whole, photo, mask = self.run.prepared.beside_photo(self.run.stage.level, image, view.image, view.mask)
        whole = vignette(whole, [self.run.falloffs.get(view.name, 0.0)])
        return whole if exposure is None else transform_colors(whole, exposure.to(whole.device)), photo, mask

    def warn_of_a_fall(self, measured: Mapping[str, float]) -> None:
        """Tell the user if held-out views got worse while the training loss fell."""
        run = self.run
        key = "sampled_psnr" if run.appearance is None else "sampled_fitted_psnr"
        now, level = measured.get(key), run.stage.level
        if now is None or not self.watch.falls(level, now, run.loss):
            return
        helps = ["fewer --iterations", "--masks for what moves or is no part of the scene"]
        if run.appearance is None and run.prepared.supervision.composes:
            helps.insert(0, "--appearance affine if brightness or colours of the photos change")
        self.monitor.say(
            f"level {level}, iteration {run.counts.iteration}: held-out PSNR fell to {now:.1f} dB from "
            f"{self.watch.best:.1f} while the training loss fell; what may help: {', '.join(helps)}"
        )

    def note_best(self) -> None:
        """Keep a copy of the state in memory if it is the best of the stage on the views that were set aside."""
        run, aside, iteration = self.run, self.run.prepared.aside, self.run.counts.iteration
        last = iteration == run.stage.iterations
        with run.record.overhead.timed("evaluation"):
            fitted = run.appearance is not None
            psnrs = list(self._psnrs(aside).values())
            now = fmean(each.fitted if fitted else each.plain for each in psnrs)
            if self.best is None or now > self.best["psnr"] - (LEAST_GAIN if last else 0.0):
                state = run.state()
                parts = {name: copied(state[name]) for name in ("model", "joint", *run.transforms)}
                self.best = {"psnr": now, "iteration": iteration, **parts}
            if last and self.best["iteration"] < iteration:
                self.monitor.say(
                    f"level {run.stage.level}: archives the state after iteration {self.best['iteration']} of "
                    f"{iteration}, {self.best['psnr'] - now:.2f} dB better than the last one on "
                    f"{len(aside)} training views that were set aside"
                )

    def return_to_best(self) -> None:
        """Give a finished stage its best state."""
        run, best = self.run, self.best
        if best is None or best["iteration"] == run.stage.iterations:
            return
        run.model = run.prepared.restored_model(best["model"])
        if best["joint"] is not None:
            run.train_jointly(best["joint"])
        elif run.joint is not None:
            run.leave_finished_fields()
        run.restore_transforms(best)
        self._last = None
