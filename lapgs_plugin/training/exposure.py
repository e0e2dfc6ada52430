"""Learn a colour transform for each training view: compensation of exposure and white balance.

The composed image of a view is transformed before the loss, so that fields need not explain why the same surface is
brighter in one photo than in the next. Transforms of all views have the identity as their mean. Renders and the viewer
apply none: they show the scene as a photo of mean exposure would.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lapgs_plugin.ops.color_transform import transform_colors, triton_works
from lapgs_plugin.runs.archive import Exposures
from lapgs_plugin.training.view_transforms import ViewTransforms

DIFFERENT = 0.08
"""Spread of exposure in stops, see `MeasuredExposure`, from which on photos count as different."""
FIRST_RATE = 1e-2
"""Adam's step size at the start of a run; its logarithm decays linearly."""
LAST_RATE = 1e-3
"""Adam's step size at the end of a run."""


def identities(views: int) -> Tensor:
    """Return (v, 3, 4) transforms that change nothing."""
    return torch.eye(3, 4).repeat(views, 1, 1)


def from_gains(gains: Tensor) -> Tensor:
    """Return (v, 3, 4) transforms that multiply channels by 2 to the power of (v, 3) gains; their mean is (I, 0)."""
    factors = gains.exp2()
    transforms = identities(len(gains))
    transforms[:, :, :3] *= (factors / factors.mean(dim=0))[:, :, None]
    return transforms


class ViewExposures(ViewTransforms):
    """Hold and optimize the colour transforms (v, 3, 4) of all training views; their mean is the identity."""

    def __post_init__(self) -> None:
        super().__post_init__()
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

    @property
    def _rates(self) -> tuple[float, float]:
        return FIRST_RATE, LAST_RATE

    def _recentre(self) -> None:
        self.transforms.sub_(self.transforms.mean(dim=0) - torch.eye(3, 4, device=self.transforms.device))


def start_from(archived: Exposures, names: Sequence[str]) -> Tensor:
    """Return the (v, 3, 4) transforms of a finished level for views; the identity for views that it does not have."""
    unchanged = torch.eye(3, 4).tolist()
    return torch.tensor([archived.get(name, unchanged) for name in names])
