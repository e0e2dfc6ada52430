"""Weigh the mean opacity in the loss of a residual less, where options of a trainer have that weight."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from lapgs_plugin.hierarchy.settings import RESIDUAL_OPACITY

OPTION = "opacity_reg"
"""Name of the weight in the options of 3dgs-mcmc and of gsplat's `simple_trainer.py`."""

COLORLESS = 0.02
"""Share of the iterations up to a residual's last refinement in which the loss has no mean opacity. Gaussians that
start without colour have no other gradient of their opacities, and Adam's steps are as long for a small one as for a
large one."""


class OpacityWeight:
    """Set the weight of the mean opacity in options of a trainer, iteration by iteration.

    Args:
        options: objects that may have `OPTION`; those without it, and weights of zero, are left alone.
        densified_until: iteration of the residual at which its densification ends.
    """

    def __init__(self, options: Iterable[Any], densified_until: float) -> None:
        weights = [(each, getattr(each, OPTION, None)) for each in options]
        self._own = [(each, weight) for each, weight in weights if isinstance(weight, float | int) and weight > 0]
        self._colorless = COLORLESS * densified_until

    def set(self, iteration: int) -> None:
        """Set the weight of an iteration, from 1."""
        factor = 0.0 if iteration <= self._colorless else RESIDUAL_OPACITY
        for options, weight in self._own:
            setattr(options, OPTION, factor * weight)

    @contextmanager
    def restored(self) -> Iterator[None]:
        """Give the user's weights back at the end of the block."""
        try:
            yield
        finally:
            for options, weight in self._own:
                setattr(options, OPTION, weight)
