"""Test when pictures are drawn and at which size, on a simulated clock."""

from __future__ import annotations

from lapgs_plugin.viewer.pacing import SETTLE_SECONDS, SMALLEST, TARGET_SECONDS, Pacing


def move(pacing: Pacing, seconds_at_full_size: float, pictures: int) -> float:
    """Draw pictures of a moving camera on a machine of that speed and return the last one's scale."""
    scale = 0.0
    for frame in range(pictures):
        pacing.change(float(frame))
        scale = pacing.begin()
        pacing.end(scale, seconds_at_full_size * scale**2)
    return scale


def test_nothing_is_due_before_something_changes() -> None:
    pacing = Pacing()
    assert pacing.due() is None
    pacing.change(3.0)
    assert pacing.due() == 3.0


def test_a_fast_machine_moves_at_full_size_and_draws_once() -> None:
    pacing = Pacing()
    assert move(pacing, 0.01, 20) == 1.0
    assert pacing.due() is None


def test_a_slow_machine_moves_at_the_size_that_fits_and_refines_when_still() -> None:
    pacing = Pacing()
    scale = move(pacing, 0.8, 20)
    assert abs(0.8 * scale**2 - TARGET_SECONDS) < 0.1 * TARGET_SECONDS
    assert pacing.due() == 19.0 + SETTLE_SECONDS
    sizes = []
    while pacing.due() is not None:
        sizes.append(pacing.begin())
        pacing.end(sizes[-1], 0.8 * sizes[-1] ** 2)
    assert sizes == [2 * scale, 1.0]


def test_a_hopeless_machine_keeps_a_smallest_size() -> None:
    assert SMALLEST <= move(Pacing(), 1e4, 40) < 1.05 * SMALLEST


def test_a_change_while_drawing_is_not_lost() -> None:
    pacing = Pacing()
    pacing.change(1.0)
    scale = pacing.begin()
    pacing.change(1.5)
    pacing.end(scale, 0.01)
    assert pacing.due() == 1.5


def test_slow_first_pictures_are_forgotten_soon() -> None:
    """The first pictures compile and load code, so their times predict nothing."""
    pacing = Pacing()
    for frame in range(3):
        pacing.change(float(frame))
        pacing.end(pacing.begin(), 3.0)
    assert move(pacing, 0.01, 8) == 1.0
