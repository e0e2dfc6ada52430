"""Test which attempt at placing the cameras is kept, on models of our own making."""

from __future__ import annotations

import logging
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from lapgs_plugin.scenes.prepare import colmap, placement
from lapgs_plugin.scenes.prepare.colmap import MOST_GUIDED, Attempt, match_more
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
    for photos in (0, 2):
        made = model(photos=photos)
        placement.remove_unlinked(made)
        assert len(placed(made)) == min(photos, 1)


@pytest.mark.parametrize(
    ("lens", "focal", "placed_by", "attempts", "kept", "message"),
    [
        ("auto", 50, (6, 8, 8, 8), 1, 6, ""),  # enough are placed: three quarters
        ("auto", 50, (5, 6, 8, 8), 2, 6, "only 5 of 8 photos could be placed; placing the cameras again"),
        ("auto", 50, (5, 4, 6, 8), 3, 6, "only 5 photos could be placed; looking for more matches"),
        ("auto", 50, (5, 4, 5, 8), 4, 8, "looking for more matches"),
        ("auto", 50, (5, 4, 4, 4), 4, 5, "looking for more matches"),  # never fewer than the first attempt
        ("auto", 54.5, (8, 8), 2, 8, "differ by 9%, which no usual lens does; placing the cameras again"),
        ("auto", 54.5, (8, 5), 2, 8, "with a simpler lens only 5 of 8 photos could be placed"),
        ("OPENCV", 54.5, (8, 8), 1, 8, "leave out --camera-model OPENCV, or choose SIMPLE_RADIAL"),
    ],
)
def test_the_attempt_that_places_most_photos_is_kept(
    lens: str,
    focal: float,
    placed_by: tuple[int, ...],
    attempts: int,
    kept: int,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    asked: list[tuple[str | None, str | None, Path | None]] = []
    made: list[pycolmap.Reconstruction] = []

    def mapped(_: Job, attempt: Attempt) -> list[pycolmap.Reconstruction]:
        asked.append((attempt.lens, attempt.mapper, attempt.database))
        photos = placed_by[len(asked) - 1]
        # The global mapper gives every photo a place; only some are linked.
        found = model((20, range(1, photos + 1)), photos=PHOTOS if attempt.mapper == GLOBAL else photos)
        if attempt.lens is None:
            found.cameras[1].model = pycolmap.CameraModelId.PINHOLE
            found.cameras[1].params = [focal, 50.0, 32.0, 24.0]
        made.append(found)
        return [found]

    monkeypatch.setattr(placement, "map_photos", mapped)
    monkeypatch.setattr(placement, "match_more", lambda job: job.work / "more.db")
    found = Photos(Path("photos"), {f"{number}.jpg": Path() for number in range(1, PHOTOS + 1)})
    with caplog.at_level(logging.INFO):
        (best,) = placement.place_cameras(Job(Path("work"), found, PrepareSettings(camera_model=lens), progress=False))
    more = Path("work", "more.db")
    expected = [(None, None, None), (SIMPLE, None, None), (SIMPLE, INCREMENTAL, more), (SIMPLE, GLOBAL, more)]
    assert asked == expected[:attempts]
    assert best.num_reg_images() == kept
    assert best is next(each for each in reversed(made) if each.num_reg_images() == kept)
    assert message in caplog.text
    assert bool(message) == bool(caplog.text)


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


def test_more_matches_start_from_the_whole_database_after_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite would add the log of an interrupted call to a new copy; and COLMAP's own log may outlive COLMAP."""
    readers = []

    def write(file: Path, pairs: Sequence[tuple[int, int]]) -> None:
        """Add rows as COLMAP does, while another connection is open, which keeps them in the log."""
        with closing(sqlite3.connect(file)) as writer:
            writer.execute("PRAGMA journal_mode=WAL")
            writer.execute("CREATE TABLE IF NOT EXISTS two_view_geometries (pair_id INTEGER, rows INTEGER)")
            writer.executemany("INSERT INTO two_view_geometries VALUES (?, ?)", pairs)
            writer.commit()
            readers.append(sqlite3.connect(file))
            readers[-1].execute("SELECT * FROM two_view_geometries").fetchone()

    write(tmp_path / "killed.db", [(pair, 99) for pair in range(2000)])
    for suffix in ("", "-wal"):
        shutil.copy(tmp_path / f"killed.db{suffix}", tmp_path / f"guided.partial{suffix}")
    write(tmp_path / "database.db", [(1, 14), (2, 15)])
    monkeypatch.setattr(colmap, "_run_step", lambda *_: write(tmp_path / "guided.partial", [(2, 30)]))
    found = match_more(Job(tmp_path, Photos(tmp_path, {}), PrepareSettings(), progress=False))
    assert found is not None
    with closing(sqlite3.connect(found)) as database:
        assert list(database.execute("SELECT * FROM two_view_geometries")) == [(1, 14), (2, 30)]
    for reader in readers:
        reader.close()
