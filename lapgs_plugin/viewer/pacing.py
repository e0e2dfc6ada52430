"""When to draw a client's next picture, and how small: small while something moves, larger step by step when still."""

from __future__ import annotations

import math

TARGET_SECONDS = 0.05
"""What a picture may take while something moves; twenty a second leaves room for what a browser does with them."""

SETTLE_SECONDS = 0.15
"""How long nothing must have changed before the picture is drawn larger."""

SMALLEST, STEP = 1.0 / 8.0, 2.0


class Pacing:
    """Decides the scale of a client's next picture, from what the last ones took.

    A scale is a share of the window's width and height, in (0, 1]. All times are of one clock, in seconds.
    """

    def __init__(self) -> None:
        self._moving = 0.25  # before anything was measured
        self._changed: float | None = None  # time of the last change that was not drawn
        self._last_change = -math.inf
        self._drawn = 1.0  # scale of the picture that is shown

    def change(self, now: float) -> None:
        """What is shown is out of date: the camera moved, a control was used, the window has another size."""
        self._changed = self._last_change = now

    def due(self) -> float | None:
        """When the next picture is to be drawn; None while the one that is shown is as good as it gets."""
        if self._changed is not None:
            return self._changed
        return None if self._drawn >= 1.0 else self._last_change + SETTLE_SECONDS

    def begin(self) -> float:
        """The scale to draw at now; changes from here on ask for another picture."""
        if self._changed is None:
            return min(1.0, STEP * self._drawn)
        self._changed = None
        return self._moving

    def end(self, scale: float, seconds: float) -> None:
        """A picture was drawn and sent.

        Args:
            scale: what `begin` said.
            seconds: what it took.
        """
        self._drawn = scale
        # Time goes with the number of pixels, once there are many; half the step keeps noise out of the size.
        fitting = scale * math.sqrt(TARGET_SECONDS / max(seconds, 1e-6))
        fitting = max(SMALLEST, min(1.0, fitting))
        self._moving = math.sqrt(self._moving * fitting)
        if self._moving > 0.9:
            self._moving = 1.0
