"""Compare what a rasterizer gets for a model with the field that is archived of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.runner.archived_values import explain_other_values
from lapgs_plugin.runner.stage_rendering import Captured

ADAPTER: Any = SimpleNamespace(profile=SimpleNamespace(source=SimpleNamespace(model=("Model", "model.py:3"))))
FIELD = GaussianField(
    means=torch.ones(2, 3),
    quaternions=torch.ones(2, 4),
    log_scales=torch.full((2, 3), -1.0),
    opacity_logits=torch.tensor([0.5, -0.5]),
    sh=torch.arange(24.0).reshape(2, 4, 3),
)
SETTINGS = SimpleNamespace(image_height=2, image_width=2, campos=torch.zeros(3), sh_degree=0)
GREY = FIELD.sh[:, 0] * SH_C0 + 0.5
"""Colours of the first coefficients."""


def captured(**others: Any) -> Captured:
    """Return a call of a rasterizer whose image depends on masks and on nothing else."""

    def rasterizer(masks: Tensor | None = None, **_: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full((3, 2, 2), 0.5 if masks is None else float(masks.mean())), torch.zeros(2)

    inputs = {
        "means3D": FIELD.means,
        "scales": FIELD.log_scales.exp(),
        "opacities": FIELD.opacity_logits.sigmoid()[:, None],
        "shs": FIELD.sh,
    }
    return Captured(torch.zeros(3, 2, 2), rasterizer, {**inputs, **others}, SETTINGS)


@pytest.mark.parametrize(
    "others",
    [
        {},
        {"scales": FIELD.log_scales, "opacities": FIELD.opacity_logits[:, None]},  # a rasterizer of raw parameters
        {"scales": FIELD.log_scales[:, :2].exp()},  # flat Gaussians
        {"dc": FIELD.sh[:, :1], "shs": FIELD.sh[:, 1:]},
        {"masks": torch.ones(2, 1)},
        {"scores": torch.zeros(2, 1)},  # as Speedy-Splat's, which only receive gradients
        {"means3D": torch.zeros(5, 3)},  # of other Gaussians
        {"shs": None, "colors_precomp": GREY},
        {"shs": None, "colors_precomp": GREY - 0.5},  # a residual's
    ],
)
def test_the_same_values(others: dict[str, Any]) -> None:
    assert explain_other_values(ADAPTER, captured(**others), FIELD) == ""


@pytest.mark.parametrize(
    ("others", "line"),
    [
        ({"scales": FIELD.log_scales.exp() * 1.01, "shs": FIELD.sh.round(decimals=-1)}, "other scales and SH than its"),
        ({"dc": FIELD.sh[:, :1] + 1, "shs": FIELD.sh[:, 1:]}, "other SH than its model has as parameters, from which"),
        ({"shs": None, "colors_precomp": GREY + 0.1}, "other colours than its model has as parameters, from which"),
        ({"masks": torch.tensor([[1.0], [0.0]])}, "with masks, values of each Gaussian that fields do not have"),
        ({"masks": torch.tensor([1.0, 0.9])}, "with masks, values of each Gaussian that fields do not have"),
    ],
)
def test_other_values(others: dict[str, Any], line: str) -> None:
    assert explain_other_values(ADAPTER, captured(**others), FIELD).startswith(
        f"model.py:3: the checkout renders {line}"
    )
