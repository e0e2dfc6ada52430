"""Test which attempt at placing the cameras is kept, on models of our own making."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from lapgs_plugin.scenes.prepare import placement
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import Photos
from lapgs_plugin.scenes.prepare.settings import GLOBAL, PrepareSettings

PHOTOS = 8


def model(*tracks: tuple[int, Sequence[int]], photos: int = PHOTOS) -> pycolmap.Reconstruction:
    """Make a model of photos 1, 2, ..., with numbers of points by the photos that see them."""
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 50.0, 64, 48)
    made.add_camera_with_trivial_rig(camera)
    count = sum(points for points, _ in tracks)
    for number in range(1, photos + 1):
        image = pycolmap.Image(f"{number}.jpg", keypoints=np.ones((count, 2)), camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    index = 0
    for points, seen_by in tracks:
        for _ in range(points):
            track = pycolmap.Track([pycolmap.TrackElement(number, index) for number in seen_by])
            made.add_point3D(np.ones(3), track, np.zeros(3, np.uint8))
            index += 1
    return made


def placed(reconstruction: pycolmap.Reconstruction) -> list[int]:
    return sorted(key for key, image in reconstruction.images.items() if image.has_pose)


def test_photos_that_points_do_not_link_are_removed() -> None:
    made = model((15, (1, 2, 3)), (15, (3, 4)), (200, (5, 6)), (14, (4, 5)), (3, (7, 1)))
    placement.remove_unlinked(made)
    assert placed(made) == [1, 2, 3, 4]
    assert made.num_points3D() == 30
    made = model(photos=2)
    placement.remove_unlinked(made)
    assert len(placed(made)) == 1


@pytest.mark.parametrize(
    ("first", "simple", "whole", "attempts", "kept"),
    [
        (6, 8, 8, 1, 6),  # enough are placed: three quarters
        (5, 6, 8, 2, 6),  # the simple lens suffices
        (5, 4, 8, 3, 8),
        (5, 4, 4, 3, 5),  # never fewer than the first attempt
        (5, 5, 5, 3, 5),
    ],
)
def test_the_attempt_that_places_most_photos_is_kept(
    first: int, simple: int, whole: int, attempts: int, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def mapped(_: Job, __: str, ___: Path, lens: str | None, mapper: str | None) -> list[pycolmap.Reconstruction]:
        asked.append((lens, mapper))
        count = whole if mapper == GLOBAL else first if lens is None else simple
        # The global mapper gives every photo a place; only some are linked.
        photos = PHOTOS if mapper == GLOBAL else count
        return [model((20, range(1, count + 1)), photos=photos)]

    monkeypatch.setattr(placement, "map_photos", mapped)
    found = Photos(Path("photos"), {f"{number}.jpg": Path() for number in range(1, PHOTOS + 1)})
    models = placement.place_cameras(Job(Path("work"), found, PrepareSettings(), progress=False))
    assert (len(asked), models[0].num_reg_images()) == (attempts, kept)
