"""Say by which rules the kernels render; each set of them is compiled apart, and takes no time from the others."""

from __future__ import annotations

import math
from typing import NamedTuple

from lapgs_plugin.reference_raster.layout import NEAR_DEPTH, PIXEL_VARIANCE


class Rules(NamedTuple):
    """Tell what kernels are given, and what a Gaussian's footprint is.

    Attributes:
        family: the rules of the 3DGS family's CUDA rasterizers instead of gsplat's. Alpha is 0.99 at most, and the
            gradient passes this limit; the Jacobian is limited from the image's centre, and where it is, its depth
            still has the gradient of a free one; a footprint is in tiles, see `records.Projected`; colours lie in
            memory as (3, h, w). Gaussians are given by standard deviations, quaternions that are used as they are, and
            opacities in [0, 1].
        covariances: Gaussians are given by covariances (n, 6) in the place of standard deviations.
        apart: the first SH coefficient is apart from the others.
        dimmed: Gaussians that are smaller than a pixel are dimmed, as the family's antialiasing does.
        exact: they are dimmed as Mip-Splatting does, see `layout.VANISHING`.
        snug: a footprint is the tiles that an ellipse meets instead of those that a square of three sigma does.
        depth: 1 / depth is blended, too, over 0.
        activated: by gsplat's rules, Gaussians are given by standard deviations and opacities in [0, 1].
        alpha: `depth` blends 1 in the place of 1 / depth, which makes the opacity of the image.
    """

    family: bool = False
    covariances: bool = False
    apart: bool = False
    dimmed: bool = False
    exact: bool = False
    snug: bool = False
    depth: bool = False
    activated: bool = False
    alpha: bool = False


GSPLAT = Rules()


class Numbers(NamedTuple):
    """Hold numbers of the rules.

    Attributes:
        modifier: factor on standard deviations.
        blur: added to the diagonal of the 2D covariance, in px^2.
        mult: factor on half the squared distance at which alpha is 1/255, for the ellipse of `Rules.snug`.
        near, far: depths between which Gaussians are seen.
    """

    modifier: float = 1.0
    blur: float = PIXEL_VARIANCE
    mult: float = 1.0
    near: float = NEAR_DEPTH
    far: float = math.inf


NUMBERS = Numbers()
