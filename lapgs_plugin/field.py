"""A set of Gaussians with the parameterisation every 3DGS backbone optimizes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from lapgs_plugin.errors import FieldError


@dataclass(frozen=True)
class GaussianField:
    """n Gaussians, as raw (unconstrained) parameters.

    Attributes:
        means: (n, 3) centres in world coordinates.
        quaternions: (n, 4) rotations, wxyz, not necessarily normalised.
        log_scales: (n, 3) natural logarithm of the standard deviations along the rotated axes, in world units.
        opacity_logits: (n,) logit of the opacity.
        sh: (n, k, 3) spherical-harmonic coefficients, k = (degree + 1)^2 with degree 0 to 3, RGB last.
        signed: True for a residual field, whose colour is the raw SH value; False for max(SH + 0.5, 0).
    """

    means: Tensor  # (n, 3)
    quaternions: Tensor  # (n, 4)
    log_scales: Tensor  # (n, 3)
    opacity_logits: Tensor  # (n,)
    sh: Tensor  # (n, k, 3)
    signed: bool = False

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {"means": (n, 3), "quaternions": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise FieldError(f"{name} has shape {tuple(getattr(self, name).shape)}, expected {shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[1] not in (1, 4, 9, 16) or self.sh.shape[2] != 3:
            raise FieldError(f"sh has shape {tuple(self.sh.shape)}, expected ({n}, 1|4|9|16, 3)")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The tensors by attribute name, in declaration order."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "signed"}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> GaussianField:
        """The field with some or all tensors replaced."""
        return GaussianField(**{**self.parameters, **parameters}, signed=self.signed)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> GaussianField:
        return self.with_parameters({k: v.to(device=device, dtype=dtype) for k, v in self.parameters.items()})

    def detach(self) -> GaussianField:
        return self.with_parameters({k: v.detach() for k, v in self.parameters.items()})
