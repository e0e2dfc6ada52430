"""Drive FastGS: multi-view scores for densification and pruning, compact boxes, an optimizer that skips steps.

Its optimizer steps by numbers in the model's class. They are left as they are and count from 1 in each residual stage,
as in the paper authors' release.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo

if TYPE_CHECKING:
    from lapgs_plugin.fields.rasterizer import Semantics


class Adapter(BackboneAdapter):
    """Drive a FastGS checkout.

    Its score functions get composed images and the level's ground truth, because both are replaced below them.
    """

    info = BackboneInfo(
        name="fastgs",
        title="FastGS",
        rasterizer="diff_gaussian_rasterization_fastgs",
        stand_in="fastgs",
        density_scores=("compute_gaussian_score_fastgs",),
        own_files=("utils/fast_utils.py",),
        fork_of=("taming",),
        raster_defaults={"mult": 0.5},
    )

    @classmethod
    def rasterizer_semantics(cls) -> Semantics:
        from lapgs_plugin.fields.rasterizer import Semantics

        return Semantics(
            three_sigma_cut=False,
            expanded_conic_gradient=True,
            note="tiles by the ellipse alpha = 1/255 (mult = 1), not by three sigma; gradients of needles are right to "
            "a few hundredths",
        )
