"""Leave Gaussians out at random while a field is trained on few photos (DropGaussian, Park et al. 2025).

A Gaussian that only serves one photo, such as a floater in front of its camera, is of no use where it is left out;
those that several photos need make up for each other.
"""

from __future__ import annotations

import torch

from lapgs_plugin.fields.gaussian_field import GaussianField

NOTHING = -20.0
"""Logit of an opacity that no rasterizer blends."""
MOST_OPACITY = 0.9999


def thinned(field: GaussianField, share: float, generator: torch.Generator | None = None) -> GaussianField:
    """Return a field in which Gaussians that are drawn at random are transparent, and others more opaque.

    The expected opacity of each stays what it was, where that is possible. Gradients flow to what is left.

    Args:
        field: to thin; its other tensors are shared.
        share: of the Gaussians, from 0 to below 1.
        generator: of random numbers, on the field's device; None for PyTorch's own.
    """
    if share == 0.0:
        return field
    logits = field.opacity_logits
    kept = torch.rand(logits.shape, generator=generator, dtype=logits.dtype, device=logits.device) >= share
    opacities = (torch.sigmoid(field.opacity_logits.clamp_min(NOTHING)) / (1.0 - share)).clamp_max(MOST_OPACITY)
    return field.with_parameters({"opacity_logits": torch.where(kept, torch.logit(opacities), NOTHING)})
