"""Test which attempt at placing the cameras is kept, on models of our own making."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from lapgs_plugin.scenes.prepare import placement
from lapgs_plugin.scenes.prepare.colmap import MOST_GUIDED, match_more
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import Photos
from lapgs_plugin.scenes.prepare.settings import GLOBAL, INCREMENTAL, PrepareSettings

PHOTOS, SIMPLE = 8, "SIMPLE_RADIAL"


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
    ("placed_by", "attempts", "kept"),
    [
        ((6, 8, 8, 8), 1, 6),  # enough are placed: three quarters
        ((5, 6, 8, 8), 2, 6),  # a simpler lens suffices
        ((5, 4, 6, 8), 3, 6),  # more matches suffice
        ((5, 4, 5, 8), 4, 8),
        ((5, 4, 4, 4), 4, 5),  # never fewer than the first attempt
    ],
)
def test_the_attempt_that_places_most_photos_is_kept(
    placed_by: tuple[int, ...], attempts: int, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str | None, str | None, Path | None]] = []

    def mapped(
        _: Job, __: str, ___: Path, lens: str | None, mapper: str | None, database: Path | None
    ) -> list[pycolmap.Reconstruction]:
        asked.append((lens, mapper, database))
        photos = placed_by[len(asked) - 1]
        # The global mapper gives every photo a place; only some are linked.
        return [model((20, range(1, photos + 1)), photos=PHOTOS if mapper == GLOBAL else photos)]

    monkeypatch.setattr(placement, "map_photos", mapped)
    monkeypatch.setattr(placement, "match_more", lambda job: job.work / "more.db")
    found = Photos(Path("photos"), {f"{number}.jpg": Path() for number in range(1, PHOTOS + 1)})
    models = placement.place_cameras(Job(Path("work"), found, PrepareSettings(), progress=False))
    more = Path("work", "more.db")
    expected = [(None, None, None), (SIMPLE, None, None), (SIMPLE, INCREMENTAL, more), (SIMPLE, GLOBAL, more)]
    assert asked == expected[:attempts]
    assert models[0].num_reg_images() == kept


@pytest.mark.parametrize("pairs", [0, MOST_GUIDED + 1])
def test_no_more_matches_without_pairs_or_with_too_many(pairs: int, tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "database.db") as database:
        database.execute("CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER)")
        database.executemany(
            "INSERT INTO two_view_geometries VALUES (?, ?)", [(0, 14), *((0, 15) for _ in range(pairs))]
        )
    database.close()
    assert match_more(Job(tmp_path, Photos(tmp_path, {}), PrepareSettings(), progress=False)) is None
    assert [file.name for file in tmp_path.iterdir()] == ["database.db"]
