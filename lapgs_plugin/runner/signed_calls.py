"""Make a checkout's rasterizer evaluate the signed colour of residuals, over a zero background."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.rasterizers.signed_color import ColorPath, signed_degree
from lapgs_plugin.runner.object_values import fields_of, with_values

BACKGROUNDS = ("bg", "bg_color", "background")
"""Names that rasterizers give to the setting of the background."""
DEGREES = ("sh_degree", "active_sh_degree")
"""Names that rasterizers give to the setting of the SH degree."""


def signed_settings(settings: Any, path: ColorPath, zeros: Callable[[Tensor], Tensor]) -> Any:
    """Return settings with a zero background, and with the flag of signed colour where it is native.

    Args:
        settings: of the rasterizer.
        path: how signed colour is evaluated.
        zeros: returns (3,) zeros on the device of a background.
    """
    fields = fields_of(settings)
    changes: dict[str, Any] = {
        name: zeros(fields[name]) for name in BACKGROUNDS if isinstance(fields.get(name), Tensor)
    }
    if path is ColorPath.NATIVE:
        changes |= {name: signed_degree(fields[name]) for name in DEGREES if name in fields}
    return with_values(settings, changes)


def with_signed_colors(inputs: dict[str, Any], settings: Any) -> dict[str, Any]:
    """Return a rasterizer's inputs with colours instead of SH, evaluated as patched kernels do.

    Raises:
        UserInputError: the rasterizer takes no colours.
    """
    if inputs.get("colors_precomp") is not None:
        return inputs
    seen = seen_from(settings, inputs["means3D"]) if {"shs", "means3D"} <= inputs.keys() else None
    if seen is None:
        raise UserInputError(
            f"the checkout's rasterizer takes {', '.join(inputs)}, expected means3D and shs, or colors_precomp, by "
            "which a residual has colours of both signs; train with --hierarchy nested"
        )
    dc, rest, (directions, degree) = inputs.get("dc"), inputs["shs"], seen
    sh = rest if dc is None else torch.cat([dc, rest], dim=1)  # (n, k, 3)
    colors = sh_to_color(sh, directions, degree, signed=True)  # (n, 3)
    others = {name: value for name, value in inputs.items() if name not in ("dc", "shs")}
    return {**others, "colors_precomp": colors}


def seen_from(settings: Any, means: Tensor) -> tuple[Tensor, int] | None:
    """Return what a rasterizer that evaluates SH needs of its settings; None if they have no camera or SH degree.

    Args:
        settings: of the rasterizer.
        means: (n, 3) of the Gaussians.

    Returns:
        Unit directions (n, 3) from the camera to the Gaussians, and the degree as the settings have it.
    """
    fields = fields_of(settings)
    degree = next((fields[name] for name in DEGREES if name in fields), None)
    if degree is None or "campos" not in fields:
        return None
    return torch.nn.functional.normalize(means - fields["campos"], dim=-1), degree
