"""Drive the graphdeco 3DGS repository with any of its rasterizers: exposure, depth supervision, masks, sparse Adam.

All of these came together in October 2024; an older checkout has none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lapgs_plugin.adapters.base import OF_A_CALL, BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.source import readable_source

if TYPE_CHECKING:
    from lapgs_plugin.fields.rasterizer import Semantics


SETTINGS = {*OF_A_CALL, "antialiasing"}
"""Settings of graphdeco's rasterizers."""

OTHER_INPUTS = {"scores", "culling"}


class Adapter(BackboneAdapter):
    """Drive a checkout of the graphdeco repository, or a fork that renders with its rasterizers.

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
    def recognises(cls, folder: Path) -> bool:
        """Return whether a folder has the files of a checkout whose calls fit graphdeco's own rasterizers."""
        if not cls.info.recognises(folder):
            return False
        source = readable_source(folder)
        if source is None or cls.info.own_files:
            return True
        return all(
            use.module == cls.info.rasterizer and not use.settings - SETTINGS and not use.inputs & OTHER_INPUTS
            for use in source.rasterizers
        )

    @classmethod
    def stand_in_for(cls, checkout: Path, arguments: Sequence[str]) -> str:
        from lapgs_plugin.checkouts.stand_in import fitting_stand_in

        wants_sparse_adam = any(argument.rpartition("=")[2] == "sparse_adam" for argument in arguments)
        return fitting_stand_in(checkout, "graphdeco-accel" if wants_sparse_adam else cls.info.stand_in)
