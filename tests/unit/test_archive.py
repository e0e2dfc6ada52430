"""Run folders under crashes, full disks, damage and two writers."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import FieldError, RunFolderError, UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import MANIFEST
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import require_room
from lapgs_plugin.runs.manifest import FORMAT_VERSION, LevelRecord, Manifest, SceneReference
from tests.folders import snapshot
from tests.mishaps import FailingWrites, Killed, disk_full

posix_only = pytest.mark.skipif(sys.platform == "win32", reason="uses POSIX signals, limits and permissions")


def manifest(levels: int = 2) -> Manifest:
    return Manifest(
        scene=SceneReference("/data/garden", "1/4", True, (0.0, 0.5, 1.0), "colmap"),
        levels=levels,
        grid="camera",
        supervision="reconstructed",
        inherit="xyz",
        sh_degree=1,
        rasterizer="cpu",
        seed=7,
        settings={"iterations": 30, "split": ["1/3", "2/3"], "learning_rates": {"means": 1.6e-4}, "sh_every": None},
    )


def level_field(level: int, levels: int = 2) -> GaussianField:
    n, generator = 4 + level, torch.Generator().manual_seed(level)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return GaussianField(draw(n, 3), draw(n, 4), draw(n, 3), draw(n), draw(n, 4, 3), signed=level != levels - 1)


def record(level: int, levels: int = 2) -> LevelRecord:
    return LevelRecord(
        level=level,
        signed=level != levels - 1,
        iterations=10,
        num_gaussians=4 + level,
        peak_gaussians=9,
        train_seconds=1.5,
        overhead_seconds={"pyramid": 0.25},
        image_size=(32, 24),
    )


def finish(archive: RunArchive, level: int) -> None:
    levels = archive.manifest.levels
    archive.finish_level(record(level, levels), level_field(level, levels))


def assert_level_is_whole(archive: RunArchive, level: int) -> None:
    loaded, expected = archive.field(level), level_field(level, archive.manifest.levels)
    assert loaded.signed == expected.signed
    assert all(torch.equal(loaded.parameters[name], tensor) for name, tensor in expected.parameters.items())


def test_the_field_finished_last_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[Path] = []
    load = GaussianField.load_ply
    monkeypatch.setattr(GaussianField, "load_ply", lambda path: [reads.append(path), load(path)][1])
    with RunArchive.create(tmp_path / "run", manifest()) as archive:
        field = level_field(1)
        archive.finish_level(record(1), field)
        field.means.zero_()  # a trainer goes on with its tensors
        assert_level_is_whole(archive, 1)
        assert reads == []
        along = level_field(1)
        archive.finish_level(record(0), level_field(0), trained_along={1: along.with_parameters({"sh": 2 * along.sh})})
        assert torch.equal(archive.field(1).sh, 2 * along.sh), "the field that was trained along counts"
        assert [path.parent.name for path in reads] == ["level_1"]
    assert_level_is_whole(RunArchive.open(tmp_path / "run"), 0)


def test_a_run_is_read_as_it_was_written(tmp_path: Path) -> None:
    with RunArchive.create(tmp_path / "deep" / "run", manifest()) as archive:
        assert (archive.available_levels, archive.manifest.complete, archive.manifest.next_level) == ((), False, 1)
        assert (archive.metrics(), archive.history(), archive.load_checkpoint()) == (None, [], None)
        finish(archive, 1)
        with pytest.raises(RunFolderError, match=r"level 0 is not in this run \(finished: 1 of 2\).*--resume"):
            archive.field(0)
        finish(archive, 0)
        archive.write_metrics({"psnr": 30.5, "overhead_seconds": {"pyramid": 30.5}})
    again = RunArchive.open(tmp_path / "deep" / "run")
    records = []
    for level in (1, 0):
        written = again.manifest.record(level).overhead_seconds["archive"]
        assert 0 < written < 60
        records.append(replace(record(level), overhead_seconds={**record(level).overhead_seconds, "archive": written}))
    assert again.manifest == replace(manifest(), records=tuple(records), created=again.manifest.created)
    assert (again.available_levels, again.manifest.complete, again.manifest.next_level) == ((1, 0), True, None)
    assert_level_is_whole(again, 1)
    assert_level_is_whole(again, 0)
    assert again.metrics() == {"psnr": 30.5, "overhead_seconds": {"pyramid": 30.5}}
    assert again.path("renders", "x.png") == tmp_path / "deep" / "run" / "renders" / "x.png"
    layout = {"manifest.json", "metrics.json", ".lock", "level_0/point_cloud.ply", "level_1/point_cloud.ply"}
    assert set(snapshot(again.path())) == layout
    json.loads((again.path() / "manifest.json").read_text())


def test_a_program_may_move_to_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    with RunArchive.create("run", manifest()) as archive:
        archive.finish_level(record(1), level_field(1))
        reader = RunArchive.open("run")
        assert archive.path("history.jsonl") == Path("run/history.jsonl")  # as users typed it
        monkeypatch.chdir(tmp_path / "other")
        archive.finish_level(record(0), level_field(0))
        assert torch.equal(reader.field(1).means, level_field(1).means)
        assert archive.path() == tmp_path / "run"
        assert reader.name == "run"
    assert list(Path().iterdir()) == []
    assert RunArchive.open("../run").available_levels == (1, 0)


# Starting where something is already


def test_a_run_whose_manifest_is_damaged_can_be_replaced(tmp_path: Path) -> None:
    with RunArchive.create(tmp_path, manifest()) as archive:
        finish(archive, 1)
        archive.append_history({"level": 1, "iteration": 1})
    (tmp_path / MANIFEST).write_text('{"format')
    with pytest.raises(RunFolderError, match="already holds a run"):
        RunArchive.create(tmp_path, manifest())
    with RunArchive.create(tmp_path, manifest(), overwrite=True) as archive:
        assert archive.available_levels == ()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / MANIFEST).write_text("not ours")
    with pytest.raises(RunFolderError, match="is not empty and not a run"):
        RunArchive.create(tmp_path / "other", manifest(), overwrite=True)


@pytest.mark.parametrize("has", ["nothing", "level", "history", "checkpoint", "damaged manifest"])
def test_a_run_that_failed_before_its_first_iteration_does_not_block_its_folder(has: str, tmp_path: Path) -> None:
    with RunArchive.create(tmp_path, manifest()) as archive:
        if has == "level":
            finish(archive, 1)
        elif has == "history":
            archive.append_history({"level": 1, "iteration": 1})
        elif has == "checkpoint":
            archive.save_checkpoint({"level": 1})
        elif has == "nothing":
            for take in (
                lambda: RunArchive.create(tmp_path, manifest()),
                lambda: RunArchive.open(tmp_path, resume=True),
            ):
                with pytest.raises(RunFolderError, match=f"is being written by process {os.getpid()}"):
                    take()  # it may be about to begin
    if has == "nothing":
        RunArchive.create(tmp_path, manifest()).close()
        return
    if has == "damaged manifest":
        (tmp_path / MANIFEST).write_text('{"created_by": "lapgs_plugin", "records": [')
    before = snapshot(tmp_path)
    for refuses in (require_room, lambda path: RunArchive.create(path, manifest())):
        with pytest.raises(
            RunFolderError, match=r"already holds a run.*--resume.*--overwrite|is not empty and not a run"
        ):
            refuses(tmp_path)
    assert snapshot(tmp_path) == before


def test_overwrite_removes_only_files_of_a_run(tmp_path: Path) -> None:
    with RunArchive.create(tmp_path, manifest()) as archive:
        archive.finish_level(record(1), level_field(1), {"x": 1})
        archive.append_history({"level": 0, "iteration": 1})
        archive.save_checkpoint({"x": 1})
        archive.write_metrics({"psnr": 1.0})
    written = ("renders/test/a.png", "report.html", "preview.jpg", "cache/train/000000.bin", "run.toml")
    for name in (*written, "tensorboard/events.out.tfevents.1", "level_1/.point_cloud.ply.9.tmp"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"ours")
    mine = {"notes.txt": b"mine", "level_1/edited.ply": b"mine", "paper/figure.png": b"mine"}
    for name, contents in mine.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(contents)
    RunArchive.create(tmp_path, manifest(levels=3), overwrite=True).close()
    left = snapshot(tmp_path)
    assert RunArchive.open(tmp_path).manifest.levels == 3
    assert {name: left[name] for name in set(left) - {"manifest.json", ".lock"}} == mine


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["photo.jpg", "manifest.json"])
def test_a_folder_that_is_no_run_is_refused(tmp_path: Path, name: str, overwrite: bool) -> None:
    (tmp_path / name).write_text('{"name": "somebody else\'s web app"}')
    before = snapshot(tmp_path)
    for refuses in (require_room, lambda path, overwrite: RunArchive.create(path, manifest(), overwrite)):
        with pytest.raises(RunFolderError, match=f"not empty and not a run .it holds {name}"):
            refuses(tmp_path, overwrite)
    assert snapshot(tmp_path) == before


def test_a_file_of_the_runs_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("x")
    with pytest.raises(RunFolderError, match="is a file, expected a folder"):
        RunArchive.create(tmp_path / "run", manifest(), overwrite=True)


@posix_only
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(RunFolderError, match="Permission denied"):
        RunArchive.create(tmp_path / "run", manifest())


# Opening what is damaged


def complete_run(folder: Path) -> None:
    with RunArchive.create(folder, manifest()) as archive:
        finish(archive, 1)
        finish(archive, 0)


def edit_manifest(folder: Path, **changes: Any) -> None:
    values = json.loads((folder / "manifest.json").read_text())
    values.update(changes)
    (folder / "manifest.json").write_text(json.dumps({k: v for k, v in values.items() if v is not ...}, default=str))


def test_opening_a_folder_without_a_run(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="does not exist"):
        RunArchive.open(tmp_path / "nowhere")
    with pytest.raises(RunFolderError, match=r"has no manifest\.json"):
        RunArchive.open(tmp_path)


def test_opening_damaged_manifests(tmp_path: Path) -> None:
    complete_run(tmp_path)
    whole = (tmp_path / "manifest.json").read_text()
    values = json.loads(whole)
    for contents, message in [
        (whole[: len(whole) // 2], "not readable as JSON"),
        ("", "not readable as JSON"),
        ("[]", r"it is \[\], expected a valid dictionary|it is \[\], expected an object"),
        (b"\xff\xfe\x00".decode("latin-1"), "not readable as JSON"),
        (
            json.dumps({**values, "format_version": 99}),
            f"format_version 99, this version of lapgs reads {FORMAT_VERSION}",
        ),
        (json.dumps({k: v for k, v in values.items() if k != "grid"}), "it lacks grid"),
        (json.dumps({**values, "flavour": 1}), "it has an unknown key flavour"),
        (json.dumps({**values, "scene": None}), "scene is None, expected an object"),
        (json.dumps({**values, "records": [{}]}), r"it lacks records\[0\]\.level"),
        (json.dumps({**values, "records": values["records"][1:]}), r"finished levels \[0\], expected \[1\] of 2"),
        (json.dumps({**values, "levels": "two"}), "levels is 'two', expected a valid integer"),
    ]:
        (tmp_path / "manifest.json").write_text(contents)
        with pytest.raises(RunFolderError, match=message) as caught:
            RunArchive.open(tmp_path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("resume", [False, True])
def test_opening_with_damaged_levels(tmp_path: Path, resume: bool) -> None:
    complete_run(tmp_path)
    ply = tmp_path / "level_0" / "point_cloud.ply"
    whole = ply.read_bytes()
    level_field(1).save_ply(ply)
    with pytest.raises(RunFolderError, match=r"level 0 of .* holds 5 Gaussians, the manifest says 4"):
        RunArchive.open(tmp_path, resume=resume)
    ply.write_bytes(whole[:-5])
    with pytest.raises(RunFolderError, match=r"level 0 of .* is damaged: .*cut short or damaged after 3 of 4"):
        RunArchive.open(tmp_path, resume=resume)
    ply.unlink()
    with pytest.raises(RunFolderError, match=r"level 0 of .* is missing"):
        RunArchive.open(tmp_path, resume=resume)
    ply.write_bytes(whole)
    RunArchive.open(tmp_path, resume=resume).close()  # a failed open kept no hold of the folder


def test_values_damaged_after_opening_are_found_on_reading(tmp_path: Path) -> None:
    complete_run(tmp_path)
    archive = RunArchive.open(tmp_path)
    ply = tmp_path / "level_1" / "point_cloud.ply"
    contents = ply.read_bytes()
    ply.write_bytes(contents[:-4] + np.float32(np.nan).tobytes())
    with pytest.raises(RunFolderError, match=r"level 1 of .* is damaged: .* rot_3 is NaN"):
        archive.field(1)


# Crashes


def test_a_run_killed_at_any_write_opens_with_its_finished_levels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes = FailingWrites(monkeypatch, Killed)
    outcomes: list[int | None] = []
    while outcomes[-1:] != [2]:
        folder, finished = tmp_path / str(len(outcomes)), None
        writes.left = len(outcomes)
        with contextlib.suppress(Killed), RunArchive.create(folder, manifest()) as archive:
            finished = 0
            for level in (1, 0):
                archive.save_checkpoint({"of": level})
                finish(archive, level)
                finished += 1
        outcomes.append(finished)
        writes.left = sys.maxsize
        if not (folder / "manifest.json").exists():
            assert finished is None
            RunArchive.create(folder, manifest()).close()  # what is left there is no obstacle
        with RunArchive.open(folder, resume=True) as again:
            # the manifest may be in place already when the kill comes before finish_level returns
            assert len(again.available_levels) - (finished or 0) in (0, 1)
            for level in again.available_levels:
                assert_level_is_whole(again, level)
            assert again.load_checkpoint() in (None, {"of": again.manifest.next_level})
            assert not list(folder.rglob("*.tmp"))
            while again.manifest.next_level is not None:
                finish(again, again.manifest.next_level)
            assert again.available_levels == (1, 0)
    assert set(outcomes) == {None, 0, 1, 2}


# Fields that were trained along


def thawed_fields(seed: int = 9) -> dict[int, GaussianField]:
    """Return both finished fields of three after joint training with the third."""
    return {level: replace(level_field(level, 3), means=torch.full((4 + level, 3), float(seed))) for level in (2, 1)}


def two_of_three(folder: Path) -> RunArchive:
    archive = RunArchive.create(folder, manifest(3))
    finish(archive, 2)
    finish(archive, 1)
    return archive


def finish_with_others(archive: RunArchive) -> None:
    archive.finish_level(record(0, 3), level_field(0, 3), trained_along=thawed_fields())


def assert_all_or_nothing(archive: RunArchive) -> None:
    """Check that the run has the last level and the jointly trained fields, or none of them."""
    for level, thawed in thawed_fields().items():
        expected = thawed if archive.manifest.complete else level_field(level, 3)
        assert torch.equal(archive.field(level).means, expected.means)


SETTLED = {"manifest.json", ".lock", *(f"level_{level}/point_cloud.ply" for level in range(3))}


def test_jointly_trained_fields_replace_their_predecessors(tmp_path: Path) -> None:
    with two_of_three(tmp_path) as archive:
        finish_with_others(archive)
        assert set(snapshot(tmp_path)) == SETTLED
        assert_all_or_nothing(archive)
        assert [archive.field(level).signed for level in (2, 1, 0)] == [False, True, True]
    assert_all_or_nothing(RunArchive.open(tmp_path))


def test_jointly_trained_fields_are_kept_with_their_level_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kill at any write and between any two; then read, resume, and check the remaining files."""
    writes = FailingWrites(monkeypatch, Killed)
    complete: list[bool] = []
    done = False
    while not done:
        folder = tmp_path / str(len(complete))
        with two_of_three(folder) as archive, contextlib.suppress(Killed):
            writes.left = len(complete)
            finish_with_others(archive)
            done = True
        writes.left = sys.maxsize
        reader = RunArchive.open(folder)
        assert_all_or_nothing(reader)
        complete.append(reader.manifest.complete)
        with RunArchive.open(folder, resume=True) as again:
            assert again.manifest == reader.manifest
            assert_all_or_nothing(again)
            names = set(snapshot(folder))
            assert names - {"level_0/point_cloud.ply"} == SETTLED - {"level_0/point_cloud.ply"}
            if not complete[-1]:
                finish_with_others(again)
        assert_all_or_nothing(RunArchive.open(folder))
        assert set(snapshot(folder)) == SETTLED
    # Of each of three PLYs an fsync, its renaming and its folder's fsync; of the manifest the same, the second counts.
    assert complete == [False] * 11 + [True] * 4


def test_a_disk_that_is_full_at_any_write_keeps_the_fields_and_a_second_attempt_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes = FailingWrites(monkeypatch, disk_full)
    for left in range(10):
        folder = tmp_path / str(left)
        with two_of_three(folder) as archive:
            before = [archive.field_path(level).read_bytes() for level in (2, 1)]
            writes.left = left
            with pytest.raises(RunFolderError, match=r"No space left.*free some space.*what was finished .* unharmed"):
                finish_with_others(archive)
            writes.left = sys.maxsize
            assert [archive.field_path(level).read_bytes() for level in (2, 1)] == before
            assert_all_or_nothing(RunArchive.open(folder))
            finish_with_others(archive)
        assert_all_or_nothing(RunArchive.open(folder))
        assert set(snapshot(folder)) == SETTLED


def test_levels_that_are_refused_change_nothing(tmp_path: Path) -> None:
    with two_of_three(tmp_path) as archive:
        before = snapshot(tmp_path)
        broken, thawed = level_field(0, 3), thawed_fields()
        broken.means[2, 1] = thawed[1].means[2, 1] = torch.nan
        for field, along, kind, message in (
            (broken, {}, FieldError, "level 0: y is NaN"),
            (level_field(0, 3), thawed, FieldError, "level 1: y is NaN"),
            (level_field(0, 3), {0: level_field(0, 3)}, RunFolderError, "level 0 is not in this run"),
        ):
            with pytest.raises(kind, match=message):
                archive.finish_level(record(0, 3), field, trained_along=along)
            assert snapshot(tmp_path) == before


def test_fields_of_an_unfinished_level_never_get_into_another_run(tmp_path: Path) -> None:
    """Whether that run is replaced, or its replacement is interrupted."""
    for remove_at_once in (True, False):
        folder = tmp_path / str(remove_at_once)
        two_of_three(folder).close()
        for later in (1, 0):
            level_field(0, 3).save_ply(folder / "level_2" / f"point_cloud.with_level_{later}.ply")
        if remove_at_once:
            RunArchive.create(folder, manifest(3), overwrite=True).close()
        else:
            (folder / "manifest.json").write_text(json.dumps(asdict(manifest(3))))
        with RunArchive.open(folder, resume=True) as archive:
            finish(archive, 2)
            finish(archive, 1)
            assert_level_is_whole(archive, 2)


@posix_only
def test_a_killed_writer_leaves_no_lock(tmp_path: Path) -> None:
    script = f"""
import sys, time
sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from tests.unit.test_archive import *
archive = RunArchive.create({str(tmp_path)!r}, manifest())
finish(archive, 1)
print("writing", flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "writing\n"
        assert RunArchive.open(tmp_path).available_levels == (1,)  # reading is always possible
        with pytest.raises(RunFolderError, match=f"is being written by process {writer.pid} on "):
            RunArchive.open(tmp_path, resume=True)
        with pytest.raises(RunFolderError, match=f"is being written by process {writer.pid} on "):
            RunArchive.create(tmp_path, manifest(), overwrite=True)
        os.kill(writer.pid, signal.SIGKILL)
        writer.wait()
    assert (tmp_path / ".lock").read_text().startswith(f"process {writer.pid}")
    with RunArchive.open(tmp_path, resume=True) as archive:
        finish(archive, 0)


def test_writing_needs_the_lock(tmp_path: Path) -> None:
    complete_run(tmp_path)
    archive = RunArchive.open(tmp_path)
    with pytest.raises(RunFolderError, match="resume=True"):
        archive.append_history({"level": 0, "iteration": 1})
    archive.write_metrics({"psnr": 1.0})  # `lapgs eval` needs none


# A full disk


def test_a_full_disk_is_one_line_and_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writes = FailingWrites(monkeypatch, disk_full)
    with RunArchive.create(tmp_path, manifest()) as archive:
        finish(archive, 1)
        archive.save_checkpoint({"iteration": 3})
        archive.write_metrics({"psnr": 1.0})
        archive.append_history({"level": 0, "iteration": 1})
        before = snapshot(tmp_path)
        writes.left = 0
        for write in (
            lambda: finish(archive, 0),
            lambda: archive.save_checkpoint({"iteration": 4}),
            lambda: archive.rewind_history(0, 0),
        ):
            with pytest.raises(RunFolderError, match=r"cannot be written: No space left.*free some space.*--resume"):
                write()
        for measure in (lambda: archive.write_metrics({"psnr": 2.0}), lambda: archive.write_stability({"psnr": 2.0})):
            with pytest.raises(RunFolderError, match=r"No space left.*free some space and run the command again$"):
                measure()
        writes.left = sys.maxsize
        assert snapshot(tmp_path) == before
        finish(archive, 0)
    assert RunArchive.open(tmp_path).available_levels == (1, 0)


@posix_only
def test_a_disk_that_fills_in_the_middle_of_a_file(tmp_path: Path) -> None:
    """With a limit on file sizes, the kernel itself refuses after half of the bytes."""
    script = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from lapgs_plugin.runs.image_store import ImageStore
from tests.unit.test_archive import *
archive = RunArchive.create({str(tmp_path)!r}, manifest())
finish(archive, 1)
archive.save_checkpoint({{"x": torch.zeros(10)}})
before = snapshot(archive.path())
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
big = {{name: tensor.repeat(100, *[1] * (tensor.ndim - 1)) for name, tensor in level_field(0).parameters.items()}}
big_record = replace(record(0), num_gaussians=400)
cache = ImageStore("disk", "float32", folder=archive.path("cache", "train"))
for write in (
    lambda: archive.finish_level(big_record, GaussianField(**big, signed=True)),
    lambda: archive.save_checkpoint({{"x": torch.zeros(10_000)}}),
    lambda: cache.put("a", torch.rand(3, 40, 40)),
):
    try:
        write()
    except RunFolderError as error:
        assert "File too large" in str(error) and "\\n" not in str(error), error
    else:
        raise SystemExit("no error")
cache.close()
assert snapshot(archive.path()) == before
assert archive.load_checkpoint()["x"].shape == (10,)
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# History


def test_history_survives_a_torn_line(tmp_path: Path) -> None:
    entries = [{"level": 1, "iteration": i, "loss": 0.1 / i, "name": "Fuß"} for i in range(1, 4)]
    with RunArchive.create(tmp_path, manifest()) as archive:
        for entry in entries:
            archive.append_history(entry)
    whole = (tmp_path / "history.jsonl").read_bytes()
    ends = [i for i, byte in enumerate(whole) if byte == ord("\n")]
    for cut in range(len(whole) + 1):
        (tmp_path / "history.jsonl").write_bytes(whole[:cut])
        kept = entries[: sum(end < cut for end in ends)]
        assert RunArchive.open(tmp_path).history() == kept
        if cut % 40 == 1:
            with RunArchive.open(tmp_path, resume=True) as archive:
                archive.append_history({"level": 1, "iteration": 9})
                assert archive.history() == [*kept, {"level": 1, "iteration": 9}]


def test_a_damaged_line_of_history_is_numbered(tmp_path: Path) -> None:
    with RunArchive.create(tmp_path, manifest()) as archive:
        for i in range(3):
            archive.append_history({"level": 1, "iteration": i})
        lines = (tmp_path / "history.jsonl").read_text().splitlines()
        (tmp_path / "history.jsonl").write_text("\n".join([lines[0], lines[1][:5], lines[2], ""]))
        with pytest.raises(RunFolderError, match="line 2 is not readable as JSON"):
            archive.history()


def test_rewinding_drops_later_entries(tmp_path: Path) -> None:
    order = [(2, 5), (2, 10), (1, 5), (1, 10), (0, 5), (0, 10)]  # (level, iteration) as training visits them
    for index, (level, iteration) in enumerate(order):
        with RunArchive.create(tmp_path / str(index), manifest(3)) as archive:
            for entry in order:
                archive.append_history({"level": entry[0], "iteration": entry[1]})
            archive.rewind_history(level, iteration)
            assert [(e["level"], e["iteration"]) for e in archive.history()] == order[: index + 1]
            archive.rewind_history(level, iteration - 1)
            assert [(e["level"], e["iteration"]) for e in archive.history()] == order[:index]


def test_history_and_metrics_are_strict_json(tmp_path: Path) -> None:
    with RunArchive.create(tmp_path, manifest()) as archive:
        for write in (
            lambda: archive.append_history({"level": 0, "iteration": 1, "loss": float("nan")}),
            lambda: archive.write_metrics({"psnr": float("inf")}),
        ):
            with pytest.raises(ValueError, match=r"JSON compliant|expected finite numbers"):
                write()
        assert archive.history() == []
        assert archive.metrics() is None


# Checkpoints


def test_checkpoints_keep_tensors_and_belong_to_a_level(tmp_path: Path) -> None:
    state = {"params": {"means": torch.randn(5, 3)}, "random": torch.get_rng_state(), "loss": float("nan"), "n": [1, 2]}
    with RunArchive.create(tmp_path, manifest()) as archive:
        archive.save_checkpoint({"old": True})
        archive.save_checkpoint(state)
        loaded = archive.load_checkpoint()
        assert loaded is not None
        assert torch.equal(loaded["params"]["means"], state["params"]["means"])
        assert torch.equal(loaded["random"], state["random"])
        assert loaded["n"] == [1, 2]
        old = (tmp_path / "checkpoint.pt").read_bytes()
        finish(archive, 1)
        assert not (tmp_path / "checkpoint.pt").exists()
        (tmp_path / "checkpoint.pt").write_bytes(old)  # as a kill between manifest and clean-up leaves it
        assert archive.load_checkpoint() is None
        (tmp_path / "checkpoint.pt").write_bytes(old[: len(old) // 2])
        with pytest.raises(RunFolderError, match=r"checkpoint\.pt cannot be read .*; delete it"):
            archive.load_checkpoint()


def test_optimizer_state_waits_for_the_next_level(tmp_path: Path) -> None:
    moments = {"means": {"step": torch.tensor(9.0), "exp_avg": torch.randn(6, 3)}}
    with RunArchive.create(tmp_path, manifest(3)) as archive:
        archive.finish_level(record(2, 3), level_field(2, 3), moments)
    with RunArchive.open(tmp_path, resume=True) as archive:  # a kill in between loses nothing
        assert torch.equal(archive.optimizer_state(2)["means"]["exp_avg"], moments["means"]["exp_avg"])
        finish(archive, 1)
        for level in (2, 1):
            with pytest.raises(RunFolderError, match=r"does not exist, and the next level continues from it"):
                archive.optimizer_state(level)
        assert_level_is_whole(archive, 2)


def test_a_checkpoint_runs_no_code(tmp_path: Path) -> None:
    with RunArchive.create(tmp_path, manifest()) as archive:
        torch.save({"level": 1, "state": Path("x")}, tmp_path / "checkpoint.pt")
        with pytest.raises(RunFolderError, match="cannot be read"):
            archive.load_checkpoint()


# Manifest


@pytest.mark.parametrize("records", [(0,), (1, 1), (0, 1), (1, 0, 0)])
def test_records_out_of_order_are_refused(records: tuple[int, ...]) -> None:
    with pytest.raises(UserInputError, match="coarsest first"):
        replace(manifest(), records=tuple(record(level) for level in records))
