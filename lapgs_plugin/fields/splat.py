"""Encode a field in 32 bytes a Gaussian, the compact form of web viewers (".splat")."""

from __future__ import annotations

import numpy as np
import torch

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import SH_C0

INVISIBLE = 1.0 / 255.0
"""Opacities below this are drawn by no rasterizer."""

LAYOUT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)])


def splat_bytes(field: GaussianField) -> bytes:
    """Return the visible Gaussians of a field, the most important first, without colours of SH degree 1 and higher.

    Each has its mean and standard deviations as float32, colour and opacity as 8 bits, and a normalised quaternion,
    wxyz, whose components q are stored as 128 q + 128.

    Raises:
        FieldError: the field is a residual, or holds NaN or inf.
    """
    if field.signed:
        raise FieldError("a residual has signed colours, which no viewer shows by themselves; merge the run first")
    field = field.detach().to("cpu", torch.float32)
    field.require_finite()
    opacities = torch.sigmoid(field.opacity_logits)
    importance = opacities.log() + field.log_scales.sum(dim=1)
    order = importance.argsort(descending=True)
    order = order[opacities[order] >= INVISIBLE]
    colors = (0.5 + SH_C0 * field.sh[order, 0]).clamp(0.0, 1.0)
    quaternions = torch.nn.functional.normalize(field.quaternions[order], dim=1)
    packed = np.zeros(len(order), LAYOUT)
    packed["mean"], packed["scale"] = field.means[order].numpy(), field.log_scales[order].exp().numpy()
    packed["rgba"] = (torch.cat([colors, opacities[order, None]], dim=1) * 255.0).round().numpy()
    packed["quaternion"] = (quaternions * 128.0 + 128.0).round().clamp(0.0, 255.0).numpy()
    return packed.tobytes()
