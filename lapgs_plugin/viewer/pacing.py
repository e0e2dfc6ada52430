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

    Args:
        moving: what a picture may take while something moves.
        still: what one may take when nothing does.
    """

    def __init__(self, moving: float = TARGET_SECONDS, still: float = math.inf) -> None:
        self._moving_seconds, self._still_seconds = moving, still
        self._moving = 0.25  # scale; before anything was measured
        self._largest = 1.0  # scale of a picture when nothing moves
        self._changed: float | None = None  # time of the last change that was not drawn
        self._renewed: float | None = None  # since when the scene is another than the one that is shown
        self._last_change = -math.inf
        self._drawn = 1.0  # scale of the picture that is shown

    def change(self, now: float) -> None:
        """What is shown is out of date: the camera moved, a control was used, the window has another size."""
        self._changed = self._last_change = now

    def renew(self, now: float) -> None:
        """The scene is another, seen as before: what is drawn next need not be smaller than what is shown."""
        if self._renewed is None:
            self._renewed = now

    def due(self) -> float | None:
        """When the next picture is to be drawn; None while the one that is shown is as good as it gets."""
        if self._changed is not None:
            return self._changed
        settled = self._last_change + SETTLE_SECONDS
        if self._renewed is not None:
            return max(self._renewed, settled)
        return settled if self._drawn < self._largest else None

    def begin(self) -> float:
        """The scale to draw at now; changes from here on ask for another picture."""
        self._renewed = None
        if self._changed is None:
            return min(self._largest, STEP * self._drawn)
        self._changed = None
        return self._moving

    def end(self, scale: float, seconds: float) -> None:
        """A picture was drawn and sent.

        Args:
            scale: what `begin` said.
            seconds: what it took.
        """
        self._drawn = scale
        # Half the step keeps noise out of the size.
        self._moving = math.sqrt(self._moving * _fitting(scale, seconds, self._moving_seconds))
        if self._moving > 0.9:
            self._moving = 1.0
        # In steps, or every picture would be followed by one a little larger.
        self._largest = 0.5 ** (math.ceil(-2.0 * math.log2(_fitting(scale, seconds, self._still_seconds))) / 2.0)


def _fitting(scale: float, seconds: float, wanted: float) -> float:
    """The scale at which a picture would take the time that is wanted. Time goes with the number of pixels."""
    return max(SMALLEST, min(1.0, scale * math.sqrt(wanted / max(seconds, 1e-6))))
