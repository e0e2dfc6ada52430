"""Drive the graphdeco 3DGS repository with any of its rasterizers: exposure, depth supervision, masks, sparse Adam.

All of these came together in October 2024; an older checkout has none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lapgs_plugin.adapters import generic
from lapgs_plugin.adapters.base import BackboneInfo

if TYPE_CHECKING:
    from lapgs_plugin.fields.rasterizer import Semantics


class Adapter(generic.Adapter):
    """Drive a checkout of the graphdeco repository, or a fork that no other adapter recognises.

    Its render applies a view's exposure and clamps to [0, 1] after the rasterizer, so both act on the composed image.
    Residuals are trained without depth supervision: their opacity says where detail is missing, not where surfaces are.
    """

    info = BackboneInfo(
        name="graphdeco",
        title="graphdeco 3DGS",
        rasterizer="diff_gaussian_rasterization",
        stand_in="graphdeco-aa",
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
