"""Test focus and up direction for cameras of known arrangement."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.rendering.rig import Rig, forward
from tests.training_scene import ring_camera


def ring(count: int, angle: float = 2 * math.pi) -> list[Camera]:
    """Return cameras of `ring_camera`: 4 from the y axis at y = -1, looking at the origin; y points down."""
    return [ring_camera(angle * i / count) for i in range(count)]


def test_a_ring_looks_at_its_centre() -> None:
    rig = Rig.of(ring(12))
    np.testing.assert_allclose(rig.focus, 0.0, atol=5e-3)  # worst seen 3e-3: the ridge draws it to the guess
    np.testing.assert_allclose(rig.up, [0.0, -1.0, 0.0], atol=1e-6)
    assert rig.distance == pytest.approx(math.sqrt(17.0), rel=2e-3)
    assert rig.surrounds


def test_cameras_on_one_side_do_not_surround() -> None:
    rig = Rig.of(ring(8, angle=1.0))
    assert not rig.surrounds
    np.testing.assert_allclose(rig.focus, 0.0, atol=0.05)


def test_one_camera_looks_somewhere_ahead() -> None:
    camera = ring_camera(0.3)
    rig = Rig.of([camera])
    ahead = rig.focus - camera.position.double().numpy()
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), forward(camera), atol=1e-6)
    assert rig.distance > 0.5
    assert not rig.surrounds
