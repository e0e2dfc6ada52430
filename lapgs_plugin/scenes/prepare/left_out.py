"""Explain photos that COLMAP could not place, and doubtful results, with advice."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pycolmap

from lapgs_plugin.errors import counted
from lapgs_plugin.scenes.prepare.colmap import VERIFIED

FEW_FEATURES = 100
"""Photos with fewer features are too plain, dark or blurred to be placed."""

BLURRED = f"fewer than {FEW_FEATURES} features: blurred, dark or of a plain surface; take them sharp and in more light"
APART = "a group of their own that nothing connects to the scene; take photos on the way from one to the other"
ALONE = "nothing in common with a placed photo; take photos in between, each a step aside from the last"
UNSURE = (
    "they match placed photos, but not at one place: repeated patterns, mirrors or things that moved; hide these by "
    "--masks, or take more photos around there"
)

FEW_POINTS = 30
"""Fewest points per placed photo with reliable cameras. Well-covered scenes have hundreds."""


def few_points(points: int, photos: int) -> str:
    """Return advice about a scene with so few points that its cameras may be wrong, "" about another."""
    if points >= FEW_POINTS * photos:
        return ""
    return (
        f"{counted(points, 'point')} for {photos} photos, so few that cameras may be wrong; what may help: "
        "--matcher exhaustive, larger masks, or more photos, sharp, in more light and a step aside from each other"
    )


def left_out_because(
    database: Path, models: Sequence[pycolmap.Reconstruction], left_out: Sequence[str]
) -> dict[str, list[str]]:
    """Return the names of unplaced photos by the reason.

    Args:
        database: COLMAP's, with features and matches.
        models: the models that were found, the scene's first.
        left_out: names of the photos.
    """
    with closing(sqlite3.connect(database)) as connection:
        ids = {name: key for key, name in connection.execute("SELECT image_id, name FROM images")}
        features = dict(connection.execute("SELECT image_id, rows FROM keypoints"))
        pairs = connection.execute("SELECT pair_id FROM two_view_geometries WHERE rows >= ?", (VERIFIED,))
        linked: dict[int, set[int]] = {}
        for (pair,) in pairs:
            one, other = pycolmap.pair_id_to_image_pair(pair)
            linked.setdefault(one, set()).add(other)
            linked.setdefault(other, set()).add(one)
    placed, elsewhere = _placed(models[:1]), _placed(models[1:])
    reasons: dict[str, list[str]] = {}
    for name in left_out:
        key = ids.get(name, -1)
        if features.get(key, 0) < FEW_FEATURES:
            reason = BLURRED
        elif linked.get(key, set()) & placed:
            reason = UNSURE
        else:
            reason = APART if key in elsewhere else ALONE
        reasons.setdefault(reason, []).append(name)
    return reasons


def _placed(models: Sequence[pycolmap.Reconstruction]) -> set[int]:
    return {key for model in models for key, image in model.images.items() if image.has_pose}
