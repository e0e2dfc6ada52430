"""Predict exposure and pose corrections of held-out views from those of the training views beside them.

In a video, or a walk around an object, both change slowly from view to view. To test that, each training view is
predicted by its two neighbours in the order of names; they are used if they predict better than the neutral value.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable

import torch
from torch import Tensor

from lapgs_plugin.runs.archive import Exposures, Poses

LARGEST_ERROR = 0.5
"""Largest squared error of neighbours' predictions, as a share of the neutral value's, at which they are used."""


def predicted_exposures(learned: Exposures, views: Iterable[str]) -> dict[str, Tensor]:
    """Predict colour transforms (3, 4) of views from those of the training photos, which keep their own.

    Empty where neighbours predict no better than the identity.
    """
    names = sorted(learned)
    return _predicted(names, torch.tensor([learned[name] for name in names]), torch.eye(3, 4), views)


def predicted_poses(learned: Poses, views: Iterable[str]) -> Poses:
    """Predict pose corrections of views from those of the training photos, which keep their own.

    Empty where neighbours predict no better than no correction.
    """
    if not learned:
        return {}
    names = sorted(learned)
    rows = torch.tensor([learned[name] for name in names], dtype=torch.float64)  # (v, 6)
    sizes = rows.view(-1, 2, 3).square().mean((0, 2)).sqrt().clamp_min(1e-12).repeat_interleave(3)  # radians, lengths
    predicted = _predicted(names, rows / sizes, torch.zeros(6), views)
    return {name: (row * sizes).tolist() for name, row in predicted.items()}


def _predicted(names: list[str], values: Tensor, neutral: Tensor, views: Iterable[str]) -> dict[str, Tensor]:
    """Return values by view: its own, or the mean of its neighbours'.

    Args:
        names: of the training views, sorted; `values` (v, ...) are theirs.
        neutral: value of a view that needs none.

    Returns:
        Empty if other views are wanted and neighbours do not predict them.
    """
    wanted, known = list(views), dict(zip(names, values, strict=True))
    if unknown := [name for name in wanted if name not in known]:
        if len(names) < 3:
            return {}
        middle = values[1:-1]
        by_neighbours = (middle - (values[:-2] + values[2:]) / 2).square().sum()
        if by_neighbours > LARGEST_ERROR * (middle - neutral).square().sum():
            return {}
    predicted = {name: known[name] for name in wanted if name in known}
    for name in unknown:
        index = bisect(names, name)
        predicted[name] = values[max(index - 1, 0) : index + 1].mean(dim=0)
    return predicted
