"""Compare a rasterizer's inputs for a checkout's model with the archived field of that model."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.runner.signed_calls import seen_from
from lapgs_plugin.runner.stage_rendering import Captured

SAME_VALUE = 1e-3
"""Largest relative difference of a value from the archived one: logits and logarithms round to 1e-6."""

NESTED_WORKS = "nested levels work: --hierarchy nested"

ADAPTER_MENDS = "an adapter whose snapshot() returns what is rendered mends it: `lapgs help extending`"

NO_RESIDUALS = f"expected the same, to which a residual is added; {ADAPTER_MENDS}, {NESTED_WORKS}"

OF_FIELDS = ("mean", "scal", "rot", "opacit")
"""Parts of the names of inputs that fields have."""


def explain_other_values(adapter: BackboneAdapter, captured: Captured, field: GaussianField) -> str:
    """Return one line on how the render of a model differs from its archived field; empty if it does not.

    Args:
        adapter: of the checkout.
        captured: its rasterizer and the inputs that it got for the model.
        field: the field that is archived of the model.
    """
    differences = []
    if names := " and ".join(_other_values(captured, field)):
        differences.append(f"other {names} than its model has as parameters, from which fields are archived")
    if names := " and ".join(_values_beside(captured, field)):
        differences.append(f"with {names}, values of each Gaussian that fields do not have")
    model = adapter.profile.source.model[1]
    return f"{model}: the checkout renders {', and '.join(differences)}" if differences else ""


def _other_values(captured: Captured, field: GaussianField) -> Iterator[str]:
    """Yield the kinds of values that are rendered and differ from the field's, activated or as parameters."""
    logits = field.opacity_logits[:, None]
    archived = (
        ("positions", "means3D", (field.means,)),
        ("scales", "scales", (field.log_scales.exp(), field.log_scales)),
        ("opacities", "opacities", (logits.sigmoid(), logits)),
        ("SH", "shs", (field.sh,)),
    )
    inputs = dict(captured.inputs)
    if isinstance(dc := inputs.get("dc"), Tensor) and isinstance(rest := inputs.get("shs"), Tensor):
        inputs["shs"] = torch.cat([dc, rest], dim=1)
    for kind, name, values in archived:
        rendered = [inputs.get(name)]
        if kind == "opacities" and isinstance(rendered[0], Tensor):
            rendered.append(rendered[0].clamp(max=1))  # as those above 1 are archived, of which a warning tells
        if not any(_alike(shown, value) for shown in rendered for value in values):
            yield kind
    if _has_other_colors(captured, field):
        yield "colours"


def _has_other_colors(captured: Captured, field: GaussianField) -> bool:
    """Return whether the renderer evaluates colours that are not those of the field's SH, as by a network."""
    colors = captured.inputs.get("colors_precomp")
    if not isinstance(colors, Tensor) or colors.shape != field.means.shape:
        return False
    field = field.to(colors.device)
    if (seen := seen_from(captured.settings, field.means)) is None:
        return False
    directions, degree = seen[0], min(int(seen[1]), field.sh_degree)
    expected = (sh_to_color(field.sh, directions, degree, signed=signed) for signed in (False, True))
    return not any(torch.allclose(colors.detach(), color, rtol=SAME_VALUE, atol=SAME_VALUE) for color in expected)


def _alike(rendered: object, value: Tensor) -> bool:
    """Return whether an input of a rasterizer has the values of a field; True if it cannot be compared."""
    if not isinstance(rendered, Tensor) or rendered.ndim != value.ndim or len(rendered) != len(value):
        return True
    axes = min(rendered.shape[1], value.shape[1])  # flat Gaussians have two scales, and get a third one in fields
    value = value.to(rendered.device)
    return torch.allclose(rendered[:, :axes].detach(), value[:, :axes], rtol=SAME_VALUE, atol=SAME_VALUE**2)


@torch.no_grad()
def _values_beside(captured: Captured, field: GaussianField) -> Iterator[str]:
    """Yield inputs with a value of each Gaussian that the image depends on, such as masks: it is another with ones."""
    for name, value in captured.inputs.items():
        if not (isinstance(value, Tensor) and value.is_floating_point() and value.shape[:1] == (len(field),)):
            continue
        if value.numel() == len(field) and not any(part in name for part in OF_FIELDS):
            image, plain = (captured.repeated(**{name: values}) for values in (value, torch.ones_like(value)))
            if not torch.allclose(image, plain, rtol=SAME_VALUE, atol=SAME_VALUE):
                yield name
