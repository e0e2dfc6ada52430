"""Fields as plain dictionaries of tensors, under the names that gsplat's trainers and strategies give them."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.gaussian_field import GaussianField

SPLAT_NAMES = {"means": "means", "quats": "quaternions", "scales": "log_scales", "opacities": "opacity_logits"}
"""gsplat's name of each parameter but the colours; right of each, a field's."""


def field_from_splats(splats: Mapping[str, Tensor], signed: bool = False) -> GaussianField:
    """A field that shares the tensors of a gsplat trainer, and their gradients.

    Args:
        splats: "means" (n, 3), "quats" (n, 4), "scales" (n, 3) logarithms, "opacities" (n,) or (n, 1) logits, and SH
            as "sh" (n, k, 3), or as "sh0" (n, 1, 3) and "shN" (n, k - 1, 3). Further entries are left out.
        signed: whether it is a residual.

    Raises:
        FieldError: an entry is missing, or of another shape.
    """
    colors = ("sh",) if "sh" in splats else ("sh0", "shN")
    if missing := [name for name in (*SPLAT_NAMES, *colors) if name not in splats]:
        raise FieldError(
            f"splats without {', '.join(missing)} (they have {', '.join(splats)}); expected gsplat's names"
        )
    values = {ours: splats[theirs] for theirs, ours in SPLAT_NAMES.items()}
    if values["opacity_logits"].ndim == 2:
        values["opacity_logits"] = values["opacity_logits"][:, 0]
    sh = splats["sh"] if colors == ("sh",) else torch.cat([splats["sh0"], splats["shN"]], 1)
    return GaussianField(**values, sh=sh, signed=signed)


def splats_from_field(field: GaussianField) -> dict[str, Tensor]:
    """A field's tensors as a gsplat trainer names them: "means", "quats", "scales", "opacities", "sh0", "shN".

    Nothing is copied but the coefficients; whether it was signed is for the caller to remember.
    """
    values = {theirs: field.parameters[ours] for theirs, ours in SPLAT_NAMES.items()}
    return {**values, "sh0": field.sh[:, :1].contiguous(), "shN": field.sh[:, 1:].contiguous()}
