"""Test the viewer with the real command and a headless browser, mouse and keyboard.

Needs playwright and an installed Chromium (or LAPGS_CHROMIUM); otherwise the tests are skipped.
"""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lapgs_plugin.rendering.trajectory import read_trajectory
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.run_folder import write_run, write_scene
from tests.headless import CHROMIUM, NO_CHROMIUM, SOFTWARE_3D, headless_chromium
from tests.training_scene import ring_camera

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
pytest.importorskip("viser", reason="needs the extra 'viewer'")

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM),
]

WIDTH, HEIGHT = 800, 600
PATIENCE = 90.0
"""Seconds to wait for steps that take two; the browser renders in software on a busy machine."""

# The tests' parent process may ignore Ctrl-C, and its children would inherit that.
COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from lapgs_plugin.cli import main
main()
"""

COVERED = """() => {
  let covered = 0;
  for (let x = 5; x < innerWidth; x += 10)
    for (let y = 5; y < innerHeight; y += 10)
      covered += !["CANVAS", "HTML"].includes(document.elementFromPoint(x, y)?.tagName)
        && !document.elementFromPoint(x, y)?.closest("[class*=Notification]");
  return covered * 100 / (innerWidth * innerHeight);
}"""
"""Share of the window over which something lies that is no picture and no message of the browser's."""


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Start `lapgs view` of two runs of one scene and return its address; ends it by Ctrl-C."""
    folder = tmp_path_factory.mktemp("view")
    scene = write_scene(folder / "scene")
    run, baseline = write_run(folder / "run", scene), write_run(folder / "baseline", scene, levels=1, seed=5)
    sharpen_residual(run)
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, "view", str(run), "--baseline", str(baseline), "--port", "8731"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    printed = []
    for line in process.stdout:
        printed.append(line)
        if url := re.search(r"http://\S+", line):
            break
    else:
        pytest.fail("the viewer did not start: " + "".join(printed))
    yield url[0]
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, rest
    assert "Traceback" not in rest
    assert rest.rstrip().endswith("stopped by Ctrl-C")


def sharpen_residual(run: Path) -> None:
    """Make a run's residual small and strong, as trained residuals are."""
    archive = RunArchive.open(run)
    field = archive.field(0)
    small = replace(field, log_scales=field.log_scales - 1.2, opacity_logits=field.opacity_logits + 3, sh=3 * field.sh)
    small.save_ply(archive.field_path(0))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with headless_chromium(*SOFTWARE_3D) as browser:
        yield browser


def opened(browser: Any, address: str) -> Any:
    """Open the viewer's page and wait for its first picture at the window's size."""
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    page.goto(address)
    page.get_by_text(f"{WIDTH} x {HEIGHT} in").wait_for(timeout=1e3 * PATIENCE)
    return page


@pytest.fixture
def page(browser: Any, address: str) -> Iterator[Any]:
    page = opened(browser, address)
    yield page
    page.close()


def picture(page: Any) -> NDArray[np.float64]:
    """Capture the area left of the panel and below the browser's messages, (h, w, 3) in 0 to 255."""
    pixels = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return pixels[180:, :460].astype(np.float64)


def wait_for(page: Any, condition: Callable[[NDArray[np.float64]], bool]) -> NDArray[np.float64]:
    """Wait until the picture satisfies the condition and no longer changes."""
    deadline = time.monotonic() + PATIENCE
    before = picture(page)
    while time.monotonic() < deadline:
        time.sleep(0.4)
        after = picture(page)
        if condition(after) and np.abs(after - before).mean() < 0.1:
            return after
        before = after
    pytest.fail(
        f"no picture as expected in {PATIENCE:.0f} s; mean {before.mean():.1f}, sharpness {sharpness(before):.3f}"
    )


def sharpness(pixels: NDArray[np.float64]) -> float:
    """Mean second derivative above the noise of JPEG; 0.19, 0.07 and 0.40 at gains 1, 0 and 3."""
    return float(np.abs(cv2.Laplacian(cv2.GaussianBlur(pixels, (0, 0), 3.0), cv2.CV_64F)).mean())


def difference(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.abs(a - b).mean())


def put_slider(page: Any, label: str, key: str) -> None:
    """Move a slider to its end by keyboard: "Home" for the minimum, "End" for the maximum."""
    name = page.get_by_text(label, exact=True).get_attribute("for")
    slider = page.locator(f'[id="{name}"] [role=slider]')
    bound = slider.get_attribute("aria-valuemin" if key == "Home" else "aria-valuemax")
    deadline = time.monotonic() + PATIENCE
    slider.press(key)
    while slider.get_attribute("aria-valuenow") != bound:  # a page may lose a key while another one closes
        assert time.monotonic() < deadline, f"{label} stays at {slider.get_attribute('aria-valuenow')}"
        time.sleep(0.2)
        slider.press(key)


def test_gain_level_orbit_and_divider(page: Any) -> None:
    page.get_by_label("split", exact=True).uncheck()
    first = wait_for(page, lambda image: image.std() > 5)

    put_slider(page, "gain 0", "Home")
    blurred = wait_for(page, lambda image: sharpness(image) < 0.6 * sharpness(first))
    put_slider(page, "gain 0", "End")
    wait_for(page, lambda image: sharpness(image) > 1.3 * sharpness(first))
    page.get_by_label("level 0, residual", exact=True).uncheck()  # the same as a gain of zero
    wait_for(page, lambda image: difference(image, blurred) < 1.0)
    page.get_by_label("level 1, base", exact=True).uncheck()
    wait_for(page, lambda image: image.max() < 30)  # nothing is left
    page.get_by_label("level 1, base", exact=True).check()
    wait_for(page, lambda image: difference(image, blurred) < 1.0)

    page.get_by_role("button", name="here", exact=True).click()  # the page begins level, this camera is not
    seen = wait_for(page, lambda image: difference(image, blurred) > 1.0)
    page.mouse.move(200, 400)
    page.mouse.down()
    page.mouse.move(320, 420, steps=8)
    page.mouse.up()
    wait_for(page, lambda image: difference(image, seen) > 5)
    page.get_by_role("button", name="here", exact=True).click()  # back to the camera that was orbited away from
    wait_for(page, lambda image: difference(image, seen) < 1.0)


def test_the_divider_is_dragged_in_the_picture(page: Any) -> None:
    whole = wait_for(page, lambda image: image.std() > 5)
    ball = (WIDTH // 2, round(HEIGHT * 0.75))
    page.mouse.move(*ball)
    page.mouse.down()
    page.mouse.move(ball[0] - 250, ball[1], steps=10)
    page.mouse.up()
    moved = wait_for(page, lambda image: difference(image, whole) > 3)
    # The white line is now where the mouse was let go, and the camera has not turned: the far left is as it was.
    column = ball[0] - 250
    assert (moved[:, column - 4 : column + 5].min(axis=2).max(axis=1) > 180).mean() > 0.9
    assert difference(moved[:, : column - 40], whole[:, : column - 40]) < 1.0


def test_a_client_that_leaves_harms_nobody(page: Any, browser: Any, address: str) -> None:
    other = opened(browser, address)
    mine = wait_for(page, lambda image: image.std() > 5)
    other.get_by_label("split", exact=True).uncheck()
    wait_for(other, lambda image: difference(image, mine) > 0.5)
    assert difference(picture(page), mine) < 0.5  # each has its own controls
    other.close()
    put_slider(page, "gain 0", "End")
    wait_for(page, lambda image: difference(image, mine) > 1)


def test_kept_views_are_saved_as_a_path(page: Any, tmp_path: Path) -> None:
    page.get_by_role("button", name="keep", exact=True).click()
    page.get_by_role("button", name="next", exact=True).click()
    playwright.expect(page.get_by_label("view", exact=True)).to_have_value("photos/08.png", timeout=1e3 * PATIENCE)
    wait_for(page, lambda image: image.std() > 5)
    page.get_by_role("button", name="keep", exact=True).click()
    page.get_by_text("2 views kept").wait_for(timeout=1e3 * PATIENCE)
    with page.expect_download(timeout=1e3 * PATIENCE) as download:
        page.get_by_role("button", name="save", exact=True).click()
    download.value.save_as(tmp_path / "path.json")
    kept = read_trajectory(tmp_path / "path.json")
    assert [camera.size for camera in kept] == [(WIDTH, HEIGHT)] * 2
    for camera, index in zip(kept, (0, 8), strict=True):  # the held-out views come first, and the first is the start
        known = ring_camera(2 * math.pi * index / 10).position
        np.testing.assert_allclose(camera.position.numpy(), known.numpy(), atol=1e-3)


def test_frustums_and_figures(page: Any) -> None:
    before = wait_for(page, lambda image: image.std() > 5)
    for text in ("level 1, base", "250", "level 0, residual", "200"):
        assert page.get_by_role("cell", name=text, exact=True).count() == 1
    page.get_by_label("frustums", exact=True).check()
    wait_for(page, lambda image: difference(image, before) > 0.2)


@pytest.mark.parametrize("size", [(390, 844), (844, 390)], ids=["upright", "on its side"])
def test_on_a_phone_the_controls_are_opened_by_a_tap(browser: Any, address: str, size: tuple[int, int]) -> None:
    width, height = size
    with browser.new_context(
        viewport={"width": width, "height": height}, has_touch=True, is_mobile=True, device_scale_factor=2
    ) as context:
        page = context.new_page()
        page.goto(address)
        controls = page.get_by_text("Controls", exact=True).first
        controls.wait_for(timeout=1e3 * PATIENCE)
        playwright.expect(page.get_by_text("Bands", exact=True)).not_to_be_in_viewport(timeout=1e3 * PATIENCE)
        # The panel slides shut, and hides "Bands" before it has arrived.
        page.wait_for_function(f"({COVERED})() < 0.25", timeout=1e3 * PATIENCE)
        covered = page.evaluate(COVERED)
        assert covered < 0.25, "most of the window shows the picture"  # seen 0.10 upright and 0.08 on its side
        controls.tap()
        playwright.expect(page.get_by_text("Bands", exact=True)).to_be_in_viewport(timeout=1e3 * PATIENCE)
