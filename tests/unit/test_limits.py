"""Sizes above a limit are refused before memory is allocated, with a line that says how to raise the limit."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from lapgs_bench.experiments.worker import RunFailedError
from lapgs_plugin.errors import LapgsError, SceneError, UserInputError, printable
from lapgs_plugin.limits import FRAMES, PHOTO_PIXELS, PHOTO_SIDE, VIEW_PIXELS, Limit
from lapgs_plugin.rendering.clip import render_size
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.images import check_image, image_size, read_as_3dgs, read_image
from lapgs_plugin.scenes.prepare.pipeline import prepare_scene
from lapgs_plugin.scenes.sample import make_sample_scene
from tests.cli.run_folder import write_scene
from tests.refusals import refuses


def test_a_limit_says_how_to_raise_it(monkeypatch: pytest.MonkeyPatch) -> None:
    limit = Limit("LAPGS_MAX_THINGS", 10, "things")
    limit.check(10, "ten of them")
    with pytest.raises(UserInputError) as caught:
        limit.check(11, "--things 11", "take fewer")
    assert str(caught.value) == (
        "--things 11, expected at most 10 things; take fewer or raise the limit with the environment variable "
        "LAPGS_MAX_THINGS"
    )
    monkeypatch.setenv("LAPGS_MAX_THINGS", "11")
    limit.check(11, "--things 11")
    for text in ("many", "-3", "0", "1e9", "9" * 30, ""):
        monkeypatch.setenv("LAPGS_MAX_THINGS", text)
        refuses(UserInputError, r"LAPGS_MAX_THINGS is .* a whole number of things such as 10", limit.check, 1, "one")


def test_todays_photos_and_clips_are_within_the_limits() -> None:
    assert PHOTO_PIXELS.value > 16320 * 12240  # a phone of 200 megapixels
    assert VIEW_PIXELS.value > 11656 * 8742  # medium format, at full resolution
    assert PHOTO_SIDE.value > 16320
    assert FRAMES.value > 3600 * 24


def tiny_exr(path: Path, full: tuple[int, int]) -> None:
    """Write an EXR of 4x3 stored pixels with a display window of any size."""
    spec = oiio.ImageSpec(4, 3, 3, oiio.FLOAT)
    spec.full_width, spec.full_height = full
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), spec)
    assert target.write_image(np.ones((3, 4, 3), np.float32))
    assert target.close()


def test_the_display_window_of_an_exr_is_refused_from_its_header(tmp_path: Path) -> None:
    tiny_exr(tmp_path / "a.exr", (60_000, 50_000))
    for read in (image_size, check_image, read_image):
        with pytest.raises(SceneError, match=r"a\.exr: the image is 60000x50000 pixels, expected at most 250,000,000"):
            read(tmp_path / "a.exr")
    tiny_exr(tmp_path / "b.exr", (70_000, 4))
    with pytest.raises(SceneError, match=r"expected at most 65,536 pixels a side; .*LAPGS_MAX_PHOTO_SIDE"):
        image_size(tmp_path / "b.exr")


def test_the_limit_of_photos_can_be_lowered_and_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(path)
    monkeypatch.setenv(PHOTO_PIXELS.variable, "1199")
    for read in (image_size, check_image, read_image, lambda path: read_as_3dgs(path, (4, 3), None)):
        refuses(SceneError, r"40x30 pixels, expected at most 1,199 pixels; .*LAPGS_MAX_PHOTO_PIXELS", read, path)
    monkeypatch.setenv(PHOTO_PIXELS.variable, "1200")
    assert image_size(path) == (40, 30)


def test_views_are_limited_at_the_size_they_are_trained_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_scene(tmp_path, size=(56, 40))
    monkeypatch.setenv(VIEW_PIXELS.variable, "1000")
    with pytest.raises(SceneError, match=r"at --resolution full the image has 56x40 pixels, expected at most 1,000"):
        load_scene(path, progress=False)
    assert load_scene(path, resolution="1/2", progress=False).smallest_size == (28, 20)
    monkeypatch.delenv(VIEW_PIXELS.variable)
    with pytest.raises(SceneError, match="at --resolution 3dgs:90000000 the image has 90000000x"):  # it may enlarge
        load_scene(path, resolution="3dgs:90000000", progress=False)


def test_sizes_that_are_asked_for(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"268,435,456 pixels, expected at most .* LAPGS_MAX_VIEW_PIXELS"):
        render_size("16384x16384")
    for text in ("9" * 5000 + "x720", "\u0661\u0662x720"):
        refuses(UserInputError, "expected WIDTHxHEIGHT", render_size, text)
    with pytest.raises(UserInputError, match="expected at most 8192x8192"):
        make_sample_scene(tmp_path / "new", width=99999, height=99999)
    refuses(UserInputError, "--points", make_sample_scene, tmp_path / "new", points=10**9)
    assert not (tmp_path / "new").exists()


def test_photos_are_prepared_at_a_size_that_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png"):
        Image.new("RGB", (200, 100)).save(tmp_path / "photos" / name)
    monkeypatch.setenv(VIEW_PIXELS.variable, "10000")
    with pytest.raises(SceneError, match=r"a\.png: the photo has 200x100 pixels, .*; choose a smaller --max-size or"):
        prepare_scene(tmp_path / "photos", tmp_path / "out", progress=False)
    assert not (tmp_path / "out").exists()


def added_memory(work: Callable[[], object]) -> float:
    """Return the process's peak of additional memory during some work in MB."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak becomes what there is now

    def status(name: str) -> float:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))

    before = status("VmRSS")
    work()
    return status("VmHWM") - before


@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="the peak can be reset on Linux only")
def test_a_large_photo_takes_the_memory_of_its_small_copy(tmp_path: Path) -> None:
    """20 megapixels take 240 MB as float32, and 80 MB of any mode in Pillow."""
    path = tmp_path / "a.png"
    Image.new("RGB", (5000, 4000)).save(path, compress_level=1)
    # Seen 170, and 466 when the image was decoded to float32 at once.
    assert added_memory(lambda: read_image(path, size=(64, 48))) < 300
    assert added_memory(lambda: check_image(path)) < 300
    Image.new("LA", (5000, 4000)).save(path, compress_level=1)
    # Seen 107, and 381 when the photo was converted and blended at once.
    assert added_memory(lambda: read_as_3dgs(path, (64, 48), (1.0, 1.0, 1.0))) < 200


def test_names_are_printed_without_what_they_do_to_a_terminal() -> None:
    assert printable("a\x1b[2J\n\r\x07\x9b1m\u202egnp\ud800") == r"a\x1b[2J\n\r\x07\x9b1m\u202egnp\ud800"
    ordinary = "Größe 写真\u3000é [bold] C:\\x ~ 🙂"
    assert printable(ordinary) == ordinary
    assert str(RunFailedError("it ends with", "\x1b[1mone", "two")) == "it ends with\n\\x1b[1mone\ntwo"
    for kind in (LapgsError, SceneError, UserInputError):
        assert str(kind("photo \x1b]0;x\x07.png\nlapgs: all is well")) == r"photo \x1b]0;x\x07.png\nlapgs: all is well"


def test_a_message_that_quotes_a_long_value_keeps_its_ends() -> None:
    message = str(UserInputError(f"scene.json: fl_x is {'9' * 5000}, expected a number; export it again"))
    assert message.startswith("scene.json: fl_x is 999")
    assert message.endswith("999, expected a number; export it again")
    assert len(message) < 1_250
