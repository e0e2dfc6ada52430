"""Decide the time and size of a client's next picture: small during motion, larger step by step at rest."""

from __future__ import annotations

import math

TARGET_SECONDS = 0.05
"""Seconds of a picture during motion; twenty a second leave time for the browser."""

SETTLE_SECONDS = 0.15
"""Seconds without a change until a picture is drawn larger."""

SMALLEST = 1.0 / 8.0
"""Smallest scale of a picture."""

STEP = 2.0
"""Factor by which a picture at rest is larger than the last one."""


class Pacing:
    """Decide the scale of a client's next picture from the times of the last ones.

    A scale is a share of the window's width and height, in (0, 1]. All times come from one clock, in seconds.

    Args:
        moving: seconds of a picture during motion.
        still: seconds of a picture at rest.
    """

    def __init__(self, moving: float = TARGET_SECONDS, still: float = math.inf) -> None:
        self._moving_seconds, self._still_seconds = moving, still
        self._moving = 0.25  # scale during motion, here before the first measurement
        self._largest = 1.0  # scale at rest
        self._changed: float | None = None  # time of the last change that is not drawn yet
        self._renewed: float | None = None  # time since which the shown scene is outdated
        self._last_change = -math.inf
        self._drawn = 1.0  # scale of the shown picture

    def change(self, now: float) -> None:
        """Note a change of the camera, a control or the window's size."""
        self._changed = self._last_change = now

    def renew(self, now: float) -> None:
        """Note a change of the scene alone: the next picture need not be smaller than the shown one."""
        if self._renewed is None:
            self._renewed = now

    def due(self) -> float | None:
        """Return the time of the next picture; None while the shown one cannot be improved."""
        if self._changed is not None:
            return self._changed
        settled = self._last_change + SETTLE_SECONDS
        if self._renewed is not None:
            return max(self._renewed, settled)
        return settled if self._drawn < self._largest else None

    def begin(self) -> float:
        """Return the scale of a picture that is drawn now. Later changes need another picture."""
        self._renewed = None
        if self._changed is None:
            return min(self._largest, STEP * self._drawn)
        self._changed = None
        return self._moving

    def end(self, scale: float, seconds: float) -> None:
        """Note the seconds in which a picture at the scale of `begin` was drawn and sent."""
        self._drawn = scale
        # A damped step keeps noise out of the size.
        self._moving = math.sqrt(self._moving * _fitting(scale, seconds, self._moving_seconds))
        if self._moving > 0.9:
            self._moving = 1.0
        # Quantized, otherwise every picture would be followed by a slightly larger one.
        self._largest = 0.5 ** (math.ceil(-2.0 * math.log2(_fitting(scale, seconds, self._still_seconds))) / 2.0)


def _fitting(scale: float, seconds: float, wanted: float) -> float:
    """Return the scale at which a picture would take the wanted time, which is proportional to its pixels."""
    return max(SMALLEST, min(1.0, scale * math.sqrt(wanted / max(seconds, 1e-6))))
