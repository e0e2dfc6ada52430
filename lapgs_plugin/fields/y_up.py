"""Turn a field from this package's axes (x right, y down, z ahead) to those of SPZ and glTF (x right, y up, z back)."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import sh_basis

HALF_TURN = (1.0, -1.0, -1.0)
"""Diagonal of the turn by 180 degrees about x, which is its own inverse."""


def y_up(field: GaussianField) -> GaussianField:
    """Return a field turned by 180 degrees about x, with its colours."""
    turn = field.means.new_tensor(HALF_TURN)
    w, x, y, z = field.quaternions.unbind(dim=1)
    return field.with_parameters(
        {
            "means": field.means * turn,
            "quaternions": torch.stack([w, x, -y, -z], dim=1),
            "sh": field.sh * _signs_of_basis(field.sh_degree).to(field.sh)[:, None],
        }
    )


def _signs_of_basis(degree: int) -> Tensor:
    """Return the sign (k,) that each basis function changes by when y and z are negated."""
    anywhere = torch.nn.functional.normalize(torch.tensor([[0.3, 0.5, 0.7]], dtype=torch.float64), dim=1)
    ratio = sh_basis(anywhere * anywhere.new_tensor(HALF_TURN), degree) / sh_basis(anywhere, degree)
    return torch.sign(ratio[0])
