"""Drive the graphdeco 3DGS repository with any of its rasterizers: exposure, depth supervision, masks, sparse Adam.

All of these came together in October 2024; an older checkout has none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_plugin.adapters.base import BackboneAdapter, BackboneInfo, StageWindow, TrainingCall

if TYPE_CHECKING:
    from torch import Tensor

    from lapgs_plugin.fields.rasterizer import Semantics


class Adapter(BackboneAdapter):
    """Drive a checkout of the graphdeco repository, or a fork that no other adapter recognises.

    Its render applies a view's exposure and clamps to [0, 1] after the rasterizer, so both act on the composed image.
    Residuals are trained without depth supervision: their opacity says where detail is missing, not where surfaces are.
    """

    info = BackboneInfo(
        name="graphdeco",
        title="graphdeco 3DGS",
        rasterizer="diff_gaussian_rasterization",
        stand_in="graphdeco-aa",
        density_control=("densify_and_prune", "reset_opacity"),
        color_rates=("feature_lr",),
        densify_thresholds=("densify_grad_threshold",),
        telling_options=("depths",),
    )

    @classmethod
    def rasterizer_semantics(cls) -> Semantics:
        from lapgs_plugin.fields.rasterizer import Semantics

        return Semantics(
            expanded_conic_gradient=True,
            note="some builds leave out tiles where alpha stays under 1/255, which no image shows; gradients of "
            "needles are right to a few hundredths",
        )

    @classmethod
    def stand_in_for(cls, checkout: Path, arguments: Sequence[str]) -> str:
        renderer = checkout / "gaussian_renderer" / "__init__.py"
        if "antialiasing" not in renderer.read_text(encoding="utf-8", errors="replace"):
            return "graphdeco"
        wants_sparse_adam = any(argument.rpartition("=")[2] == "sparse_adam" for argument in arguments)
        return "graphdeco-accel" if wants_sparse_adam else cls.info.stand_in

    @property
    def _of_2023(self) -> bool:
        """Whether the checkout is older than October 2024."""
        return not hasattr(self.train, "SPARSE_ADAM_AVAILABLE")

    def model_options(self, call: TrainingCall) -> tuple[Any, ...]:
        return () if self._of_2023 else super().model_options(call)

    def passes_dc_apart(self, call: TrainingCall) -> bool:
        return not self._of_2023 and bool(self.train.SPARSE_ADAM_AVAILABLE)

    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        # Exposure is left out: predictions of finished levels are taken before it is applied.
        options = {} if self._of_2023 else {"separate_sh": self.passes_dc_apart(call), "use_trained_exp": False}
        self.train.render(view, gaussians, call.pipe, background, **options)

    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        return {} if self._of_2023 else {"antialiasing": call.pipe.antialiasing}

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        changed = super().stage_call(call, window, model_path)
        if window.stage.signed and not self._of_2023:
            changed.opt.depth_l1_weight_init = changed.opt.depth_l1_weight_final = 0.0
        return changed

    def level_view(self, view: Any, original: Any, size: tuple[int, int], signed: bool) -> None:
        if self._of_2023:
            return
        if original.alpha_mask is not None:
            # Most masks are opaque; without one the training loop saves a pass over the image.
            opaque = bool((original.alpha_mask == 1).all())
            view.alpha_mask = None if opaque else _shrunk(original.alpha_mask, size)
        if original.invdepthmap is not None:
            if signed:
                view.invdepthmap, view.depth_mask, view.depth_reliable = None, None, False
            else:
                view.invdepthmap = _shrunk(original.invdepthmap, size)
                view.depth_mask = _shrunk(original.depth_mask, size)

    def carried_over(self, gaussians: Any) -> dict[str, Any]:
        """Return the exposures, which belong to the photos and not to a level."""
        import torch

        return {} if self._of_2023 else {"_exposure": torch.nn.Parameter(gaussians._exposure.detach().clone())}


def _shrunk(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Return an image (..., h, w) averaged down to `size` (width, height), float32."""
    import torch

    width, height = size
    result: Tensor = torch.nn.functional.interpolate(image[None].float(), (height, width), mode="area")[0]
    return result
