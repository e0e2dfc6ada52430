"""Predict the exposure of held-out photos from that of their neighbours, so that renders can be measured as photos."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from lapgs_plugin.runs.archive import Exposures

LARGEST_ERROR = 0.5
"""Largest squared error of prediction among training photos, as a share of that of the identity, for neighbours to be
used."""


def predicted_exposures(learned: Exposures, views: Iterable[str]) -> Mapping[str, Tensor]:
    """Predict the colour transforms of views from those of the training photos beside them in the order of names.

    In a video, or a walk around an object, exposure changes slowly from photo to photo. Whether it does is found out
    among the training photos: each is predicted by its two neighbours, and by the identity.

    Args:
        learned: colour transforms of the training photos by name.
        views: names of views; a training photo has its own transform.

    Returns:
        (3, 4) transforms by view; empty where neighbours predict no better than the identity.
    """
    names = sorted(learned)
    transforms = torch.tensor([learned[name] for name in names])  # (v, 3, 4)
    wanted = list(views)
    if unknown := [name for name in wanted if name not in learned]:
        if len(names) < 3:
            return {}
        middle = transforms[1:-1]
        by_neighbours = (middle - (transforms[:-2] + transforms[2:]) / 2).square().sum()
        if by_neighbours > LARGEST_ERROR * (middle - torch.eye(3, 4)).square().sum():
            return {}
    found = {name: transforms[names.index(name)] for name in wanted if name in learned}
    for name in unknown:
        place = bisect(names, name)
        beside = transforms[max(place - 1, 0) : place + 1]
        found[name] = beside.mean(dim=0)
    return found
