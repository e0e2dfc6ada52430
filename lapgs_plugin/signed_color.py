"""Signed colour: how one call asks a CUDA rasterizer for the raw SH value instead of max(SH + 0.5, 0)."""

from __future__ import annotations

SIGNED_COLOR_BIT = -(2**31)
"""The bit of a call's `sh_degree` that asks for signed colour: the sign bit of C's int.

Rasterizers patched with `patches/*.toml` strip it in both passes. Of all bits this one is harmless where it is not
known: an unpatched build takes the degree for one below 1 and reads the first coefficient only, whereas any other high
bit would be taken for a degree above 3 and read coefficients that a field of lower degree does not have.
"""


def signed_degree(degree: int) -> int:
    """The `sh_degree` to pass for signed colour of this SH degree, 0 to 3."""
    return degree | SIGNED_COLOR_BIT
