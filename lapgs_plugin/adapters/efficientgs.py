"""Drive EfficientGS: SH come late, each Gaussian with a degree of its own, and pruning at fixed iterations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall

if TYPE_CHECKING:
    from lapgs_plugin.fields.gaussian_field import GaussianField


class Adapter(BackboneAdapter):
    """Drive an EfficientGS checkout.

    In a stage of its own, SH are unlocked at the same share of the iterations. A residual has them from its start,
    all with the same degree.
    """

    info = BackboneInfo(
        name="efficientgs",
        title="EfficientGS",
        rasterizer="diff_gaussian_rasterization",
        own_files=("scene/renderer.py",),
        family_files=("train.py",),
        fork_of=("graphdeco",),
        unscaled=("oneupSHdegree_from_iter",),
    )

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        if not super().recognises(folder):
            return False
        renderer = folder / "scene" / "renderer.py"
        return "sparse_shs_degree" in renderer.read_text(encoding="utf-8", errors="replace")

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        changed = super().stage_call(call, window, model_path)
        opt = changed.opt
        opt.oneupSHdegree_from_iter = 0 if window.stage.signed else window.scaled(opt.oneupSHdegree_from_iter)
        if window.stage.signed:
            opt.use_sparse_shs = False
        return changed

    def replacements(self, in_residual: Callable[[], bool]) -> list[Replacement]:
        return [
            Replacement(self.train, "prepare_output_and_logger", _in_any_folder, "training() at its start", ("args",))
        ]

    def snapshot(self, gaussians: Any, signed: bool) -> GaussianField:
        field = super().snapshot(gaussians, signed)
        degrees = getattr(gaussians, "sparse_shs_degree", None)
        if degrees is None:
            return field
        import torch

        # Its rasterizer leaves out what is above a Gaussian's own degree, which no PLY says.
        of_coefficient = torch.arange(field.sh.shape[1], device=field.sh.device).sqrt().floor()
        kept = of_coefficient <= degrees[:, None]  # (n, k)
        return field.with_parameters({"sh": field.sh * kept[:, :, None]})


def _in_any_folder(original: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Let the checkout write into the run's folder, which exists, and whose contents were asked about before."""

    def prepare_output_and_logger(args: Any) -> Any:
        args.ignore_check_output = True
        return original(args)

    return prepare_output_and_logger
