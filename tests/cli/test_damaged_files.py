"""Run folders with damaged files: every command ends in one line that names the file, and writes nothing.

So it is with links and special files: nothing is written through a link, waited for or read without end.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from lapgs_plugin.cli.evaluate import evaluate
from lapgs_plugin.cli.export import export
from lapgs_plugin.cli.import_run import import_run
from lapgs_plugin.cli.render import render
from lapgs_plugin.cli.report import report
from lapgs_plugin.cli.train import train
from lapgs_plugin.errors import LapgsError
from lapgs_plugin.files import MANIFEST
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import HISTORY, METRICS
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run
from tests.folders import files_in, snapshot
from tests.mishaps import FailingWrites, disk_full
from tests.refusals import refuses

app = typer.Typer()
for name, command in {
    "eval": evaluate,
    "export": export,
    "import-run": import_run,
    "render": render,
    "report": report,
    "train": train,
}.items():
    app.command(name)(command)
lapgs = succeeding(app, columns=200)

MEMORY = 100 * 2**20
"""Bytes that opening a damaged manifest may take; 2 MiB seen."""


def refused(message: str, *arguments: object) -> None:
    """A command ends in one line."""
    with pytest.raises(LapgsError, match=message) as caught:
        lapgs(*arguments)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1_000
    assert caught.value.exit_code == 2


def change(path: Path, where: str, value: Any) -> None:
    """Set a value in a JSON file; `where` is as messages write it."""
    values: Any = json.loads(path.read_text())
    *parts, last = where.replace("[", ".").replace("]", "").split(".")
    at = values
    for part in parts:
        at = at[int(part)] if isinstance(at, list) else at[part]
    at[int(last) if isinstance(at, list) else last] = value
    path.write_text(json.dumps(values))


MANIFEST_DAMAGE: list[tuple[str, Any, str]] = [
    ("settings", [], "expected an object"),
    ("settings.iterations", "300", "expected a valid integer"),
    ("settings.iterations", 0, "expected greater than 0"),
    ("settings.hierarchy", "flat", "expected 'nested' or 'laplacian'"),
    ("settings.raster", {"mult": "big"}, "expected"),
    ("scene.path", 5, "expected a valid string"),
    ("scene.path", "a\0b", "is no path"),
    ("scene.eval", 1, "expected a valid boolean"),
    ("scene.background", [0, 0], "it lacks scene.background.2."),
    ("scene.background[1]", -1, "expected greater than or equal to 0"),
    ("levels", 1_000_000_000, "expected 1 to 24"),
    ("levels", 10**25, "expected 64 bits at most"),
    ("levels", 0, "expected 1 to 24"),
    ("grid", "x", "'x' is no pixel grid, expected camera or even"),
    ("sh_degree", 9, "expected less than or equal to 3"),
    ("seed", -1, "expected greater than or equal to 0"),
    ("records", {}, "expected a valid array"),
    ("records[0].level", 7, "finished levels .7, 0., expected .1, 0."),
    ("records[0].iterations", 0, "expected greater than 0"),
    ("records[0].num_gaussians", 10**18, "holds 250 Gaussians, the manifest says 1000000000000000000"),
    ("records[0].mean_gaussians", 1e308, r"holds the number 1e\+308, expected finite numbers below 3\.4e\+38"),
    ("records[0].train_seconds", "long", "expected a valid number"),
    ("records[0].overhead_seconds", {"pyramid": "x"}, "expected a valid number"),
    ("records[0].image_size", [56], r"it lacks records\[0\]\.image_size\[1\]"),
    ("records[0].memory_bytes", {"peak": 1}, "expected peak and images"),
]


@pytest.mark.parametrize(("where", "value", "message"), MANIFEST_DAMAGE)
def test_values_of_a_manifest(run: Path, where: str, value: Any, message: str) -> None:
    change(run / MANIFEST, where, value)
    before = files_in(run)
    refused(message, "export", run)
    if where == "levels":
        tracemalloc.start()
        try:
            refused(message, "train", run, "-o", run, "--resume")
            assert tracemalloc.get_traced_memory()[1] < MEMORY
        finally:
            tracemalloc.stop()
    assert files_in(run) | {".lock"} == before | {".lock"}


WHOLE_FILES = [b"", b"[]", b"[" * 200_000, b"\xff"]
"""`test_untrusted` has more."""


@pytest.mark.parametrize("contents", WHOLE_FILES, ids=range(len(WHOLE_FILES)))
@pytest.mark.parametrize("name", [MANIFEST, METRICS])
def test_whole_files_of_a_run(run: Path, name: str, contents: bytes) -> None:
    (run / name).write_bytes(contents)
    refused(rf"{name} (is|holds)", "report", run)
    assert not (run / "report.html").exists()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"null", "it is None, expected an object"),
        (b"[]", "it is .., expected an object"),
        (b"5", "it is 5, expected an object"),
        (b"{}", "it lacks level"),
        (b'{"level": "0", "iteration": 1}', "level is '0', expected a valid integer"),
        (b'{"level": 0, "iteration": -1}', "iteration is -1"),
        (b'{"level": 0, "iteration": 1, "loss": "x"}', "loss is 'x', expected a valid number"),
        (b'{"level": 0, "iteration": 1, "elapsed": null}', "elapsed is None"),
        (b'{"level": 0, "iteration": 1, "psnr": NaN}', "is not readable as JSON"),
        (b'{"level": 0, "iteration": 1, "name": "\xff"}', "is not readable as JSON"),
        (b"[" * 200_000, "recursion limit"),
        (b"1" * 5_000, "is not readable as JSON"),
        (b"", "is not readable as JSON"),
    ],
)
def test_lines_of_a_history(run: Path, scene: Path, line: bytes, message: str) -> None:
    history = run / HISTORY
    history.write_bytes(history.read_bytes() + line + b"\n")
    number = history.read_bytes().count(b"\n")
    line_of = rf"history\.jsonl line {number} .*{message}"
    change(run / MANIFEST, "records", json.loads((run / MANIFEST).read_text())["records"][:1])
    refused(f"{line_of}.*; delete that line", "train", scene, "-o", run, "--resume", "--threads", "1")
    refuses(LapgsError, line_of, RunArchive.open(run).history)


def write_metrics(run: Path) -> None:
    lapgs("eval", run, "--device", "cpu", "--lpips", "none")


METRICS_DAMAGE: list[tuple[str, Any, str]] = [
    ("psnr", "high", "psnr is 'high', expected a valid number"),
    ("views", {}, "views is .*expected a valid array"),
    ("views", [], "has no views"),
    ("views[0]", 5, r"views\[0\] is 5, expected an object"),
    ("views[0].name", 5, r"views\[0\].name is 5"),
    ("views[0].name", "\x1b[31m", r"measures the view '.x1b\[31m', which .* does not have"),
    ("views[0].psnr", None, r"views\[0\]\.psnr is None"),
    ("levels", 3, "levels is 3"),
    ("levels.0.image_size", [1], "image_size"),
    ("overhead_seconds", [], "overhead_seconds is"),
    ("num_gaussians", 5, "num_gaussians is 5"),
    ("train_seconds", "x", "train_seconds is 'x'"),
    ("lpips_missing", [], "lpips_missing is"),
    ("lpips_vgg", "x", "lpips_vgg is 'x'"),
    ("split", "some", "split is 'some'"),
    ("versions", 1, "versions is 1"),
]


def test_values_of_metrics(run: Path) -> None:
    write_metrics(run)
    whole = (run / METRICS).read_text()
    for where, value, message in METRICS_DAMAGE:
        (run / METRICS).write_text(whole)
        change(run / METRICS, where, value)
        refused(f"metrics.json .*{message}.*write it again with `lapgs eval`", "report", run, "--device", "cpu")
        assert not (run / "report.html").exists()


def damaged_finer_level(run: Path) -> None:
    ply = run / "level_0" / "point_cloud.ply"
    contents = bytearray(ply.read_bytes())
    contents[-4:] = b"\x00\x00\xc0\x7f"  # the last number becomes NaN, which only reading the values shows
    ply.write_bytes(contents)


@pytest.mark.parametrize("command", ["export", "render"])
def test_nothing_is_written_of_a_run_whose_finer_level_is_damaged(run: Path, command: str) -> None:
    damaged_finer_level(run)
    before = files_in(run)
    refused("level 0 of .* is damaged: .*rot_3 is NaN", command, run)
    assert files_in(run) == before


@pytest.mark.parametrize("command", ["export", "report"])
def test_a_full_disk_is_no_reason_to_resume(run: Path, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if command == "report":
        write_metrics(run)
    FailingWrites(monkeypatch, disk_full).left = 0
    line = refuses(LapgsError, r"free (some )?space and (run the command again|permissions)", lapgs, command, run)
    assert "--resume" not in line


@pytest.mark.parametrize("file", ["level_0", "level_0/point_cloud.ply", MANIFEST])
def test_what_may_not_be_looked_at_is_one_line(run: Path, file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As chmod 0 has it; root may look everywhere."""

    def denied(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *arguments: Any, **options: Any) -> Any:
            if str(path).startswith(str(run / file)):
                raise PermissionError(13, "Permission denied", str(path))
            return real(path, *arguments, **options)

        return call

    for owner, name in ((Path, "stat"), (Path, "open"), (os, "open")):
        monkeypatch.setattr(owner, name, denied(getattr(owner, name)))
    for command in ("export", "render", "eval"):
        refused(rf"{run / file}.*Permission denied|Permission denied", command, run)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("scene.resolution", "x", "--resolution 'x': expected 1k"),
        ("scene.images", "/", "/.*: no such image"),
        ("scene.masks", "x", "--masks x: no such folder"),
        ("settings.split", "5", "--split has 1 shares, expected 2"),
        ("supervision", "clamped", "--supervision clamped: expected reconstructed, .*; install the package"),
    ],
)
def test_the_file_is_named_that_says_how_the_scene_was_read(
    run: Path, scene: Path, where: str, value: str, message: str
) -> None:
    """The user gave none of the options that messages about such a value name."""
    change(run / MANIFEST, where, value)
    if where in ("scene.resolution", "scene.images"):
        refused(f"{run / MANIFEST}: {message}", "eval", run, "--device", "cpu")
    change(run / MANIFEST, "records", json.loads((run / MANIFEST).read_text())["records"][:1])
    refused(f"{run / MANIFEST}( is damaged)?: {message}", "train", scene, "-o", run, "--resume", "--threads", "1")


def test_a_file_in_the_place_of_a_levels_folder(run: Path) -> None:
    for path in (run / "level_0").iterdir():
        path.unlink()
    (run / "level_0").rmdir()
    (run / "level_0").write_text("")
    refused("level 0 of .* is missing|Not a directory", "export", run)


def foreign_folder(folder: Path, scene: Path, **options: Any) -> Path:
    """What a codebase's training would leave, without a field."""
    values = {"source_path": str(scene), "resolution": 1, "sh_degree": 0, "eval": True, **options}
    (folder / "point_cloud" / "iteration_30").mkdir(parents=True)
    (folder / "cfg_args").write_text(f"Namespace({', '.join(f'{key}={value!r}' for key, value in values.items())})")
    return folder


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sh_degree": None}, "sh_degree is None, expected 0, 1, 2 or 3"),
        ({"sh_degree": "3"}, "sh_degree is '3', expected 0, 1, 2 or 3"),
        ({"source_path": 5}, "source_path is 5, expected a valid string"),
        ({"source_path": b"x"}, "holds the bytes b'x', expected text"),
        ({"source_path": "a\0"}, "is no path"),
        ({"resolution": None}, "resolution is None, expected a valid integer"),
        ({"resolution": 10**30}, "expected 64 bits"),
        ({"eval": "yes"}, "eval is 'yes', expected a valid boolean"),
        ({"images": 3}, "images is 3"),
        ({"white_background": "no"}, "white_background is 'no'"),
    ],
)
def test_options_of_a_foreign_run(tmp_path: Path, scene: Path, options: dict[str, Any], message: str) -> None:
    folder = foreign_folder(tmp_path / "foreign", scene, **options)
    refused(f"cfg_args .*{message}", "import-run", folder, "--backbone", "fastgs")
    assert not (folder / "lapgs").exists()


RECORD = {
    **{"iterations": 30, "train_seconds": 1.5, "saving_seconds": 0.5, "num_gaussians": 3, "peak_gaussians": 3},
    **{"mean_gaussians": 2.5, "memory_bytes": {}, "timeline": []},
}


@pytest.mark.parametrize(
    ("name", "contents", "message"),
    [
        ("cfg_args", b"Namespace(a='\xff')", "byte 13 is b'.xff', expected UTF-8"),
        ("cfg_args", b"Namespace(a=" + b"-" * 200_000 + b"1)", "is not readable"),
        ("cfg_args", b"Namespace(a=" + b"1" * 5_000 + b")", "is not readable"),
        ("cfg_args", b"#" * 2_000_000, "is larger than 1 MiB"),
        ("runtime_breakdown.json", b"[]", "expected an object"),
        ("runtime_breakdown.json", b'{"config": 3}', "config is 3"),
        ("runtime_breakdown.json", b"[" * 200_000, "recursion limit"),
        ("lapgs_record.json", b"{}", "it lacks iterations"),
        ("lapgs_record.json", b"null", "it is None, expected an object"),
        ("lapgs_record.json", json.dumps({**RECORD, "train_seconds": "1"}).encode(), "train_seconds is '1'"),
        ("lapgs_record.json", json.dumps({**RECORD, "timeline": [{}]}).encode(), r"it lacks timeline\[0\]\.iteration"),
        ("lapgs_record.json", json.dumps({**RECORD, "memory_bytes": {"a": 1}}).encode(), "expected peak and images"),
    ],
)
def test_files_of_a_foreign_run(tmp_path: Path, scene: Path, name: str, contents: bytes, message: str) -> None:
    folder = foreign_folder(tmp_path / "foreign", scene)
    (folder / "point_cloud" / "iteration_30" / "point_cloud.ply").write_bytes(b"")
    (folder / name).write_bytes(contents)
    refused(f"{name} .*{message}", "import-run", folder, "--backbone", "fastgs")
    assert not (folder / "lapgs").exists()


def test_a_folder_whose_name_cannot_be_kept_is_refused_before_training(tmp_path: Path, scene: Path) -> None:
    odd = tmp_path / os.fsdecode(b"\xff")
    refuses(LapgsError, r"holds the text .*expected UTF-8", write_run, tmp_path / "run", odd)
    assert not (tmp_path / "run").exists()


def replaced_by_a_link(path: Path, target: Path | str) -> None:
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(target)


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """What links point to; it stays as it is."""
    folder = tmp_path / "precious"
    for name in ("file", "point_cloud.ply", "test/00.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("precious")
    return folder


WRITTEN = [".lock", MANIFEST, HISTORY, METRICS, "checkpoint.pt", "run.toml", "preview.jpg", "level_0", "level_1"]
WRITTEN += ["level_1/point_cloud.ply", "cache", "tensorboard", "renders", "renders/test", "export", "report.html"]


@pytest.mark.parametrize("name", WRITTEN)
def test_nothing_is_trained_through_a_link(scene: Path, precious: Path, tmp_path: Path, name: str) -> None:
    before, run = snapshot(precious), write_run(tmp_path / "run", scene, finished=1)
    if name == MANIFEST:
        (run / name).rename(precious / name)
        before = snapshot(precious)
    for target in (precious / name,) if name == MANIFEST else (precious / "file", precious, precious / "nothing"):
        replaced_by_a_link(run / name, target)
        inside = files_in(run)
        for how in ("--resume", "--overwrite"):
            refused(f"{run / name} is a link", "train", scene, "-o", run, how, "--threads", "1")
        assert snapshot(precious) == before
        assert files_in(run) == inside


@pytest.mark.parametrize(("command", "name"), [("render", "renders"), ("render", "renders/test"), ("export", "export")])
def test_no_result_is_written_through_a_link(run: Path, precious: Path, command: str, name: str) -> None:
    before = snapshot(precious)
    replaced_by_a_link(run / name, precious)
    refused(f"{run / name} is a link", command, run)
    assert snapshot(precious) == before


@pytest.mark.parametrize(
    ("command", "name"), [("eval", METRICS), ("eval", f".{METRICS}.PROCESS.tmp"), ("report", "report.html")]
)
def test_a_result_takes_the_place_of_a_link(run: Path, precious: Path, command: str, name: str) -> None:
    write_metrics(run)
    before = snapshot(precious)
    name = name.replace("PROCESS", str(os.getpid()))
    replaced_by_a_link(run / name, precious / "file")
    lapgs(command, run, "--device", "cpu", *(("--lpips", "none") if command == "eval" else ()))
    assert snapshot(precious) == before
    assert not (run / name).is_symlink()


def test_a_run_folder_may_be_a_link(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "big disk").mkdir()
    (tmp_path / "runs").symlink_to("big disk")
    run = write_run(tmp_path / "runs", scene)
    lapgs("export", run)
    RunArchive.open(run, resume=True).close()
    assert any((tmp_path / "big disk" / "export").iterdir())


def test_fields_may_be_links_to_files_when_they_are_read(run: Path, tmp_path: Path) -> None:
    """As caches of downloads keep them."""
    kept = (run / "level_0" / "point_cloud.ply").rename(tmp_path / "blob")
    replaced_by_a_link(run / "level_0" / "point_cloud.ply", kept)
    lapgs("export", run)
    assert len(list((run / "export").iterdir())) == 2


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def loop(path: Path) -> None:
    path.symlink_to(path.name)


def without_end(path: Path) -> None:
    """A file of more bytes than memory has, none of them on the disk."""
    path.touch()
    os.truncate(path, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") + 1)


@pytest.fixture
def no_waiting() -> Iterator[None]:
    """Let a test fail that waits for a pipe."""

    def late(*_: object) -> None:
        raise AssertionError("it waits")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("no_waiting")
@pytest.mark.parametrize("put", [pipe, device, loop, without_end])
@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("export", MANIFEST),
        ("export", "level_0/point_cloud.ply"),
        ("report", HISTORY),
        ("report", METRICS),
        ("train", "checkpoint.pt"),
        ("train", HISTORY),
        ("import-run", "cfg_args"),
        ("import-run", "runtime_breakdown.json"),
        ("import-run", "lapgs_record.json"),
    ],
)
def test_only_files_are_read(tmp_path: Path, scene: Path, command: str, name: str, put: Callable[[Path], None]) -> None:
    if command == "import-run":
        folder = foreign_folder(tmp_path / "foreign", scene)
        (folder / "point_cloud" / "iteration_30" / "point_cloud.ply").write_bytes(b"")
        arguments: tuple[object, ...] = (folder, "--backbone", "fastgs")
    else:
        folder = write_run(tmp_path / "run", scene, finished=1 if command == "train" else 2)
        arguments = (scene, "-o", folder, "--resume", "--threads", "1") if command == "train" else (folder,)
    (folder / name).unlink(missing_ok=True)
    put(folder / name)
    refused(f"{folder / name} (cannot be read|is a link|is a pipe)|has no {MANIFEST}", command, *arguments)
