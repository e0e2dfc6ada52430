"""Test which attempt at placing the cameras is kept, on models of our own making."""

from __future__ import annotations

import logging
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from lapgs_plugin.scenes.prepare import colmap, placement
from lapgs_plugin.scenes.prepare.colmap import MOST_GUIDED, Attempt, match_more
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import Photos
from lapgs_plugin.scenes.prepare.settings import GLOBAL, INCREMENTAL, PrepareSettings
from lapgs_plugin.scenes.prepare.view_graph import remove_unlinked
from tests.unit.test_view_graph import ROOM, captured, glued, ring

PHOTOS, SIMPLE = 8, "SIMPLE_RADIAL"


def model(*tracks: tuple[int, Sequence[int]], photos: int = PHOTOS, error: float = 0.0) -> pycolmap.Reconstruction:
    """Make a model of photos 1, 2, ..., with numbers of points by the photos that see them, and their error.

    A photo may see a point twice.
    """
    result = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 50.0, 64, 48)
    result.add_camera_with_trivial_rig(camera)
    count = sum(points for points, _ in tracks)
    for number in range(1, photos + 1):
        image = pycolmap.Image(f"{number}.jpg", keypoints=np.ones((2 * count, 2)), camera_id=1, image_id=number)
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    index = 0
    for points, seen_by in tracks:
        for _ in range(points):
            features = [index + count * seen_by[:place].count(number) for place, number in enumerate(seen_by)]
            track = pycolmap.Track(list(map(pycolmap.TrackElement, seen_by, features)))
            result.points3D[result.add_point3D(np.ones(3), track, np.zeros(3, np.uint8))].error = error
            index += 1
    return result


def placed(reconstruction: pycolmap.Reconstruction) -> list[int]:
    return sorted(key for key, image in reconstruction.images.items() if image.has_pose)


def test_photos_that_points_do_not_link_are_removed() -> None:
    linked = model((15, (1, 2, 3)), (15, (3, 4)), (200, (5, 6)), (14, (4, 5)), (3, (7, 1)))
    remove_unlinked(linked)
    assert placed(linked) == [1, 2, 3, 4]
    assert linked.num_points3D() == 30
    repeated = model((15, (1, 2, 3)), (4, (3, 3, 4, 4)))  # by features that look alike
    remove_unlinked(repeated)
    assert placed(repeated) == [1, 2, 3]
    for photos in (0, 2):
        linked = model(photos=photos)
        remove_unlinked(linked)
        assert len(placed(linked)) == min(photos, 1)


@pytest.mark.parametrize(
    ("lens", "focal", "placed_by", "attempts", "kept", "message"),
    [
        ("auto", 50, (6, 8, 8, 8), 1, 6, ""),  # enough are placed: three quarters
        ("auto", 50, (5, 6, 8, 8), 2, 6, "only 5 of 8 photos could be placed; placing the cameras again"),
        ("auto", 50, (5, 4, 6, 8), 3, 6, "only 5 photos could be placed; looking for more matches"),
        ("auto", 50, (5, 4, 5, 8), 4, 8, "looking for more matches"),
        ("auto", 50, (5, 4, 4, 4), 4, 5, "looking for more matches"),  # never fewer than the first attempt
        ("auto", 54.5, (8, 8), 2, 8, "differ by 9%, which no usual lens does; placing the cameras again"),
        (
            "auto",
            54.5,
            (8, 7),
            2,
            8,
            "a simpler lens places 7 of 8 photos with an error of 0.10 pixels, not 8 with 0.10",
        ),
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
    models: list[pycolmap.Reconstruction] = []

    def mapped(_: Job, attempt: Attempt) -> list[pycolmap.Reconstruction]:
        asked.append((attempt.lens, attempt.mapper, attempt.database))
        photos = placed_by[len(asked) - 1]
        # The global mapper gives every photo a place; only some are linked.
        photographs = model((20, range(1, photos + 1)), photos=PHOTOS if attempt.mapper == GLOBAL else photos)
        if attempt.lens is None:
            photographs.cameras[1].model = pycolmap.CameraModelId.PINHOLE
            photographs.cameras[1].params = [focal, 50.0, 32.0, 24.0]
        models.append(photographs)
        return [photographs]

    monkeypatch.setattr(placement, "map_photos", mapped)
    monkeypatch.setattr(placement, "match_more", lambda job: job.work / "more.db")
    photographs = Photos(Path("photos"), {f"{number}.jpg": Path() for number in range(1, PHOTOS + 1)})
    with caplog.at_level(logging.INFO):
        (best,) = placement.place_cameras(
            Job(Path("work"), photographs, PrepareSettings(camera_model=lens), progress=False)
        )
    more = Path("work", "more.db")
    expected = [(None, None, None), (SIMPLE, None, None), (SIMPLE, INCREMENTAL, more), (SIMPLE, GLOBAL, more)]
    assert asked == expected[:attempts]
    assert best.num_reg_images() == kept
    assert best is next(one for one in reversed(models) if one.num_reg_images() == kept)
    assert message in caplog.text
    assert bool(message) == bool(caplog.text)


def two_attempts(
    first: pycolmap.Reconstruction, again: pycolmap.Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[pycolmap.Reconstruction]:
    """Return what is kept of an attempt and of one with a simpler lens, of photos that do not exist."""
    monkeypatch.setattr(placement, "map_photos", lambda job, attempt: [again if attempt.lens else first])
    monkeypatch.setattr(placement, "match_more", lambda job: None)
    monkeypatch.setattr(placement, "HAS_GLOBAL", False)
    photos = Photos(tmp_path, {image.name: tmp_path / image.name for image in first.images.values()})
    return placement.place_cameras(Job(tmp_path, photos, PrepareSettings(), progress=False))


@pytest.mark.parametrize(
    ("first", "again", "simple"),
    [
        ((8, 1.2), (8, 1.22), True),  # a lens with fewer parameters fits noise less
        ((8, 1.2), (8, 1.3), False),
        ((8, 1.2), (7, 0.6), True),
        ((8, 1.2), (7, 1.1), False),
        ((5, 0.6), (8, 1.2), True),
        ((5, 0.6), (8, 1.6), False),
    ],
)
def test_the_error_of_an_attempt_counts_as_well_as_its_number_of_photos(
    first: tuple[int, float],
    again: tuple[int, float],
    simple: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    attempts = []
    for photos, error in (first, again):
        placed = model((20, range(1, photos + 1)), error=error)
        remove_unlinked(placed)  # photos without points
        attempts.append(placed)
    (kept,) = two_attempts(*attempts, tmp_path, monkeypatch)
    assert (kept is attempts[1]) == simple
    if first[0] == PHOTOS and not simple:
        assert f"an error of {again[1]:.2f} pixels, not 8 with 1.20; the points miss" in caplog.text


def test_glued_groups_are_placed_again_and_what_is_cut_off_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """40 photos of a room: the first attempt places all, 17 of them turned by 100 degrees; the second places 25."""
    wrong = glued(60, 100, photos=(23, 17))
    right = captured(ring(40, (0, 0), 0.8, True)[:25], ROOM)
    caplog.set_level(logging.INFO)
    kept = two_attempts(wrong, right, tmp_path, monkeypatch)
    assert [part.num_reg_images() for part in kept] == [25]
    assert "17 photos (24.jpg, 25.jpg, " in caplog.text
    assert ") are turned by 100 degrees against 23 others, on 60 points" in caplog.text
    kept = two_attempts(glued(60, 100, photos=(23, 17)), model(photos=0), tmp_path, monkeypatch)
    assert [part.num_reg_images() for part in kept] == [23, 17]
    assert kept[0].num_points3D() > 1000
    assert "; only the larger group is kept" in caplog.text


STEPS = {
    # COLMAP starts anew when it cannot go on.
    "incremental": "open(job['placed'], 'wb').write(b'\\n' + b'.' * 16 + b'\\n' + b'.' * 12 + b'\\n..')",
    "nothing": "open(job['placed'], 'wb').close()",
    "global": "[print('=== Running', step, '===', file=sys.stderr) for step in ('averaging', 'positioning')]",
    "sequential": """
for number in range(1, 41):
    print(f'I pairing.cc:372] Indexing image [{number}/40]', file=sys.stderr)
time.sleep(0.3)
database = sqlite3.connect(job['database'])
database.execute('CREATE TABLE two_view_geometries (pair_id INTEGER)')
for number in range(10):
    database.execute('INSERT INTO two_view_geometries VALUES (?)', (number,))
    database.commit()
    time.sleep(0.02)
""",
}


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        ("incremental", [("Placing cameras", 16, 40)]),
        ("nothing", [("Placing cameras", 0, 40)]),
        ("global", [("Placing cameras", colmap.GLOBAL_STEPS, colmap.GLOBAL_STEPS)]),
        ("sequential", [("Comparing photos", 40, 40), ("Matching pairs", 177 + 80, 177 + 80)]),
    ],
)
def test_bars_show_what_colmap_has_done(
    program: str, expected: list[tuple[str, int, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bars of a program in the place of COLMAP that leaves what COLMAP leaves."""
    seen: list[tuple[str, int, int]] = []

    @contextmanager
    def bar(_: Job, title: str, unit: str) -> Iterator[Callable[[int, int], None]]:
        yield lambda done, total: seen.append((title, done, total))

    start = "import json, sqlite3, sys, time\njob = json.loads(sys.stdin.readline())\n"
    (tmp_path / "worker.py").write_text(start + STEPS[program])
    monkeypatch.setattr(colmap, "WORKER", tmp_path / "worker.py")
    monkeypatch.setattr(colmap, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(Job, "bar", bar)
    photos = Photos(tmp_path, {f"{number}.jpg": tmp_path for number in range(40)})
    mapper = GLOBAL if program == "global" else INCREMENTAL
    job = Job(tmp_path, photos, PrepareSettings(matcher="sequential", mapper=mapper), progress=True)
    if program == "sequential":
        colmap.match_pairs(job)
        assert len({done for title, done, _ in seen if title == "Matching pairs"}) > 5, "the count moves"
    else:
        assert colmap.map_photos(job, Attempt("Placing cameras", "models")) == []
    assert list({title: (title, done, total) for title, done, total in seen}.values()) == expected


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
    guided = match_more(Job(tmp_path, Photos(tmp_path, {}), PrepareSettings(), progress=False))
    assert guided is not None
    with closing(sqlite3.connect(guided)) as database:
        assert list(database.execute("SELECT * FROM two_view_geometries")) == [(1, 14), (2, 30)]
    for reader in readers:
        reader.close()
