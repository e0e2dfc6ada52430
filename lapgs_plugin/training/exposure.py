"""Learn a colour transform for each training view: compensation of exposure and white balance.

The composed image of a view is transformed before the loss, so that fields need not explain why the same surface is
brighter in one photo than in the next. Transforms of all views have the identity as their mean. Renders and the viewer
apply none: they show the scene as a photo of mean exposure would.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.ops.color_transform import transform_colors, triton_works
from lapgs_plugin.runs.archive import Exposures

DIFFERENT = 0.08
"""Spread of exposure in stops, see `MeasuredExposure`, from which on photos count as different."""
FIRST_RATE, LAST_RATE = 1e-2, 1e-3
"""Adam's step size at the start and the end of a run; its logarithm decays linearly."""
BETAS = (0.8, 0.99)
"""Of Adam, which makes one step in each pass over the views, not one for each view."""


def identities(views: int) -> Tensor:
    """Return (v, 3, 4) transforms that change nothing."""
    return torch.eye(3, 4).repeat(views, 1, 1)


def from_gains(gains: Tensor) -> Tensor:
    """Return (v, 3, 4) transforms that multiply channels by 2 to the power of (v, 3) gains; their mean is (I, 0)."""
    factors = gains.exp2()
    transforms = identities(len(gains))
    transforms[:, :, :3] *= (factors / factors.mean(dim=0))[:, :, None]
    return transforms


@dataclass
class ViewExposures:
    """Hold and optimize the transforms of all training views during a stage.

    Gradients are added up over one pass through all views; then Adam steps, and the mean of the transforms is set back
    to the identity.

    Attributes:
        names: of the views.
        transforms: (v, 3, 4) parameter, on the training device.
        done, total: iterations of the run before this stage, and of all stages, for the step size.
    """

    names: Sequence[str]
    transforms: torch.nn.Parameter  # (v, 3, 4)
    done: int
    total: int
    _index: dict[str, int] = field(init=False, repr=False)
    _adam: torch.optim.Adam = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._index = {name: index for index, name in enumerate(self.names)}
        self._adam = torch.optim.Adam([self.transforms], lr=FIRST_RATE, betas=BETAS)
        triton_works(self.transforms)  # compiles its kernels now, not in the first iteration

    @classmethod
    def create(cls, names: Sequence[str], start: Tensor, device: torch.device, done: int, total: int) -> ViewExposures:
        """Start a stage from transforms (v, 3, 4), which are copied, with empty moments."""
        return cls(names, torch.nn.Parameter(start.detach().clone().to(device)), done, total)

    def apply(self, names: Sequence[str], image: Tensor) -> Tensor:
        """Transform the image (3, h, w) of a view, or those of several, (b, 3, h, w), differentiably."""
        chosen = [self._index[name] for name in names]
        if image.ndim == 3:
            return transform_colors(image, self.transforms[chosen[0]])
        places = torch.tensor(chosen).to(self.transforms.device, non_blocking=True)
        return transform_colors(image, self.transforms.index_select(0, places))

    def after_step(self, iteration: int, views: int) -> None:
        """Step after the views of an iteration if they end a pass through all views.

        Args:
            iteration: the last one, from 1 within the stage.
            views: that the training step took.
        """
        if iteration % len(self.names) >= views:
            return
        progress = min(1.0, (self.done + iteration) / self.total)
        self._adam.param_groups[0]["lr"] = FIRST_RATE * (LAST_RATE / FIRST_RATE) ** progress
        self._adam.step()
        self._adam.zero_grad()
        with torch.no_grad():
            self.transforms.sub_(self.transforms.mean(dim=0) - torch.eye(3, 4, device=self.transforms.device))

    def forget_gradients(self) -> None:
        """Drop gradients of the pass so far."""
        self._adam.zero_grad()

    def archived(self) -> Exposures:
        """Return the transforms by view, as they are archived."""
        return dict(zip(self.names, self.transforms.detach().cpu().tolist(), strict=True))

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue to the same bits."""
        return {
            "transforms": self.transforms.detach(),
            "gradient": self.transforms.grad,
            "moments": dict(self._adam.state[self.transforms]),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a result of `state` of the same views."""
        device = self.transforms.device
        with torch.no_grad():
            self.transforms.copy_(state["transforms"])
        self.transforms.grad = None if state["gradient"] is None else state["gradient"].to(device, copy=True)
        moments = {key: value if key == "step" else value.to(device) for key, value in state["moments"].items()}
        if moments:
            self._adam.state[self.transforms] = {key: value.clone() for key, value in moments.items()}


def start_from(archived: Exposures, names: Sequence[str]) -> Tensor:
    """Return the (v, 3, 4) transforms of a finished level for views; the identity for views that it does not have."""
    transforms = identities(len(names))
    for index, name in enumerate(names):
        if name in archived:
            transforms[index] = torch.tensor(archived[name])
    return transforms
