"""Define constants of the 3DGS rasterizers, and the layout of the arrays that our kernels exchange.

A change here makes all kernels compile again.
"""

from __future__ import annotations

import math

TILE = 16
"""Side of a tile in pixels. A Gaussian is blended in whole tiles, so the image depends on it."""
BLOCK = 4
"""Side of a block in pixels: 4x4 pixels are the 16 lanes of a vector, row by row."""
BLOCKS = (TILE // BLOCK) ** 2
"""Blocks of a tile, row by row: as many as lanes of a vector."""
TILE_PIXELS = TILE * TILE

NEAR_DEPTH = 0.2
"""Gaussians whose centre is at this depth or nearer are culled."""
PIXEL_VARIANCE = 0.3
"""Added to the diagonal of the 2D covariance unless a rasterizer says otherwise, in px^2: a Gaussian is never thinner
than about a pixel."""
MIN_SHARE = 2.5e-5
"""Lower bound, in antialiasing, of the determinant without the blur over that with it."""
VANISHING = 1e-6
"""Largest determinant without the blur, in px^4, of Gaussians that Mip-Splatting's antialiasing leaves out.

It also adds as much to the determinant with the blur, and to the quotient of both.
"""
JACOBIAN_LIMIT = 1.3
"""The Jacobian is taken at most this many half image sides away from the optical axis."""
RADIUS_SIGMAS = 3.0
"""Radius of a footprint in standard deviations along its longer axis."""
MIN_ROOT = 0.1
"""Lower bound of the squared half difference of the 2D covariance's eigenvalues, in px^4."""
MAX_RADIUS = 2.0**30
"""Radii saturate here, in px, so that they fit int32."""
MAX_ALPHA = 0.99
MIN_ALPHA = 1 / 255
LOG2_MIN_ALPHA = -math.log2(255.0)
MIN_TRANSMITTANCE = 1e-4

# A splat is a projected Gaussian. At an offset (dx, dy) in pixels from its centre its alpha before the cap is
#     2^(LOG2_OPACITY - u^2 - v^2),  u = FACTOR_XX dx + FACTOR_XY dy,  v = FACTOR_YY dy.
# The factors are the triangular root of the inverse covariance times sqrt(log2(e) / 2). The exponent is a sum of
# squares, which rounding cannot make positive; the usual quadratic form can become so.
SPLAT = 16
"""Floats of a splat: one cache line in float32."""
(
    CENTRE_X,  # pixels; the first pixel's centre is at 0
    CENTRE_Y,
    FACTOR_XX,
    FACTOR_XY,
    FACTOR_YY,
    LOG2_OPACITY,
    RED,
    GREEN,
    BLUE,
    REACH,  # alpha is under 1/255 where u^2 + v^2 exceeds this, even with rounding
    RIDGE_X,  # dx where u^2 + v^2 is least for a given dy, over dy
    RIDGE_Y,  # dy where u^2 + v^2 is least for a given dx, over dx
    RED_FREE,  # 1 where the colour map passes gradients, 0 where it clamps
    GREEN_FREE,
    BLUE_FREE,
    OPACITY_RATE,  # derivative of the natural logarithm of the opacity by the parameter it comes from
) = range(SPLAT)

FACTOR_SCALE = math.sqrt(math.log2(math.e) / 2)
"""Factors over the root of the inverse covariance."""

# The backward pass of a tile sums, for each splat, over its pixels: the derivative d of the loss by the natural
# logarithm of alpha before the cap, times polynomials in u and v.
SLOT = 16
"""Floats of the gradient of one splat in one tile."""
(
    SUM_RED,  # derivative by the colour
    SUM_GREEN,
    SUM_BLUE,
    SUM_1,
    SUM_U,
    SUM_V,
    SUM_UU,
    SUM_UV,
    SUM_VV,
    SUM_ABS_X,  # |d u|
    SUM_ABS_Y,  # |d (FACTOR_XY u + FACTOR_YY v)|
) = range(11)

# A camera: rotation and translation from world to camera, row by row; position; intrinsics; limits of x / z and y / z;
# the variance added to 2D covariances.
CAMERA = 22
ROTATION, TRANSLATION, POSITION = 0, 9, 12
FOCAL_X, FOCAL_Y, PRINCIPAL_X, PRINCIPAL_Y, LIMIT_X, LIMIT_Y, BLUR = range(15, CAMERA)

SIGNED_COLOR_BIT = -(2**31)
"""Bit of `sh_degree` that requests signed colour: the sign bit of C's int.

Rasterizers patched with `patches/*.toml` clear it in both passes. An unpatched build takes a negative degree for one
below 1 and reads the first coefficient only. Any other high bit would make a degree above 3, at which it would read
coefficients that a field of lower degree does not have.
"""
