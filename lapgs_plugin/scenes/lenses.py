"""Say which lenses of COLMAP can be trained on as they are, and how they bend rays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from shlex import quote

from lapgs_plugin.errors import SceneError
from lapgs_plugin.fields.lens import Lens
from lapgs_plugin.scenes.source import ALL_AROUND, undistort_hint

PERSPECTIVE = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Perspective lenses: OpenCV's names of their parameters, in COLMAP's order."""
FISHEYE = {
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "THIN_PRISM_FISHEYE": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
}
"""Fisheye lenses: the names of their parameters. Those of the last that OpenCV's fisheye lacks have to be 0."""


def lens_of(model: str, distortion: Sequence[float], subject: str, scene: Path) -> Lens | None:
    """Return how a camera of COLMAP bends rays; None for a pinhole.

    Args:
        model: name of the camera model.
        distortion: its parameters without focal lengths and principal point.
        subject: of messages: the file and its camera.
        scene: folder, for advice.

    Raises:
        SceneError: it cannot be expressed by OpenCV's models, or a parameter is not finite.
    """
    if not all(map(math.isfinite, distortion)):
        raise SceneError(f"{subject} has NaN or inf among its distortion; calibrate or export it again")
    names = PERSPECTIVE.get(model) or FISHEYE.get(model) or ()
    terms = dict(zip(names, distortion, strict=False))
    beyond = [name for name in ("p1", "p2", "sx1", "sy1") if model in FISHEYE and terms.get(name)]
    if model not in PERSPECTIVE | FISHEYE or beyond:
        raise SceneError(_refusal(model, beyond, subject, scene))
    if model in FISHEYE:
        return Lens(True, tuple(terms.get(f"k{i}", 0.0) for i in range(1, 5)))
    if not any(distortion):
        return None
    radial = tuple(terms.get(f"k{i}", 0.0) for i in range(1, 7))
    return Lens(False, radial, (terms.get("p1", 0.0), terms.get("p2", 0.0)))


def _refusal(model: str, beyond: Sequence[str], subject: str, scene: Path) -> str:
    """Return the message about a lens that cannot be trained on as it is."""
    if model == ALL_AROUND:
        return f"{subject} is {ALL_AROUND}: {undistort_hint(scene, model)}"
    terms = f" with {' and '.join(beyond)}" if beyond else ""
    known = [name for name in (*PERSPECTIVE, *FISHEYE) if name != model]
    return (
        f"{subject} has the lens model {model}{terms}, which --distorted does not know; expected one of "
        f"{', '.join(known)}: calibrate the photos with OPENCV or OPENCV_FISHEYE, or undistort them with "
        f"`lapgs prepare {quote(str(scene))} OUT` and leave --distorted out"
    )
