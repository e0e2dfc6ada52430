"""The page of `lapgs export --html`: its bytes, and what a browser without a network shows of them."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import FieldError, UserInputError
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.reports.splat_page import LAYOUT, splat_bytes
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.run_folder import BACKGROUND, write_run, write_scene
from tests.cli.test_export import lapgs_export
from tests.folders import files_in
from tests.headless import CHROMIUM, NO_CHROMIUM, SOFTWARE_3D, headless_chromium
from tests.refusals import refuses
from tests.training_scene import HEIGHT, WIDTH, blob_field

ENLARGED = 8
PHONE = (390, 844)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    run = write_run(folder / "run", write_scene(folder / "scene"), nested=True)
    assert "scene.html: 200 Gaussians" in lapgs_export(run, "--html")
    return run


def test_splats_take_32_bytes_each_the_most_important_first() -> None:
    field = blob_field(50)
    logits = field.opacity_logits.clone()
    logits[7] = -9.0  # invisible
    field = replace(field, opacity_logits=logits)
    packed = splat_bytes(field)
    assert len(packed) == 49 * 32
    splats = np.frombuffer(packed, LAYOUT)
    importance = splats["rgba"][:, 3] / 255 * splats["scale"].prod(axis=1)
    assert (importance[:-1] >= importance[1:] * 0.98).all()  # opacities are rounded
    index = int((field.means - torch.from_numpy(splats["mean"][0].copy())).norm(dim=1).argmin())
    assert np.allclose(splats["scale"][0], field.log_scales[index].exp().numpy(), rtol=1e-6)
    color = (0.5 + field.sh[index, 0] / (2 * np.sqrt(np.pi))).clamp(0, 1)
    assert np.abs(splats["rgba"][0] / 255 - [*color, torch.sigmoid(field.opacity_logits[index])]).max() <= 0.51 / 255
    quaternion = torch.nn.functional.normalize(field.quaternions[index], dim=0).numpy()
    assert np.abs((splats["quaternion"][0] - 128.0) / 128 - quaternion).max() <= 1 / 128
    refuses(FieldError, "residual has signed colours", splat_bytes, replace(field, signed=True))


def test_the_page_is_one_file_with_the_splats(run: Path) -> None:
    page = (run / "export" / "scene.html").read_text()
    assert not re.search(r"(src|href)=|https?://", page)
    (data,) = re.findall(r'id="splats">([A-Za-z0-9+/=]+)<', page)
    assert base64.b64decode(data) == splat_bytes(RunArchive.open(run).field(0))


def test_the_page_of_a_level_leaves_that_of_the_scene(run: Path, tmp_path: Path) -> None:
    lapgs_export(run, "--html", "--out", tmp_path)
    before = (tmp_path / "scene.html").read_bytes()
    assert "level_1_base.html: 250 Gaussians" in lapgs_export(run, "--html", "--level", 1, "--out", tmp_path)
    assert "level_0_field.html: 200 Gaussians" in lapgs_export(run, "--html", "--level", 0, "--out", tmp_path)
    assert files_in(tmp_path) == {"scene.html", "level_0_field.html", "level_1_base.html"}
    assert (tmp_path / "scene.html").read_bytes() == before == (tmp_path / "level_0_field.html").read_bytes()


def test_pages_that_cannot_be_made_are_one_line(tmp_path: Path) -> None:
    residuals = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
    with pytest.raises(UserInputError, match="level 0 is a residual, which no viewer shows by itself; add --merge"):
        lapgs_export(residuals, "--html")
    refuses(UserInputError, "--format does not go with --html", lapgs_export, residuals, "--html", "--format", "spz")
    refuses(UserInputError, "--scene needs --merge, --html", lapgs_export, residuals, "--scene", tmp_path)
    assert not (residuals / "export").exists()


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_a_browser_shows_the_splats_as_a_rasterizer_renders_them(run: Path) -> None:
    pytest.importorskip("playwright.sync_api", reason="needs playwright")
    troubles: list[str] = []
    camera = next(iter(run_cameras(RunArchive.open(run))[0].values())).resized(ENLARGED * WIDTH, ENLARGED * HEIGHT)
    with headless_chromium(*SOFTWARE_3D) as browser:
        page = browser.new_page(viewport={"width": camera.width, "height": camera.height}, device_scale_factor=1)
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda request: request.url[:5] in ("file:", "data:") or troubles.append(request.url))
        page.goto((run / "export" / "scene.html").as_uri())
        page.wait_for_selector("canvas[data-shown]", state="attached")
        page.keyboard.press("h")  # hides the words
        first = _picture(page)
        assert psnr(_tensor(first), _rendered(run, camera)) > 38  # seen 44.9: colours have 8 bits
        page.mouse.move(200, 150)
        page.mouse.down()
        page.mouse.move(260, 150)
        page.mouse.up()
        page.wait_for_timeout(100)
        turned = _picture(page)
        assert psnr(_tensor(turned), _tensor(first)) < 30  # seen 19.2
        page.keyboard.press("r")
        page.wait_for_timeout(100)
        assert np.array_equal(_picture(page), first)
    assert troubles == []


@pytest.fixture(scope="module")
def phone() -> Iterator[Any]:
    """A phone's browser, upright, with a screen to touch."""
    pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with headless_chromium(*SOFTWARE_3D) as browser:
        size = {"width": PHONE[0], "height": PHONE[1]}
        yield browser.new_context(viewport=size, has_touch=True, is_mobile=True, device_scale_factor=1)


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_a_phone_shows_what_was_photographed_and_how_to_touch_it(run: Path, phone: Any) -> None:
    page = phone.new_page()
    page.goto((run / "export" / "scene.html").as_uri())
    page.wait_for_selector("canvas[data-shown]", state="attached")
    words = page.locator("#words")
    assert words.inner_text().strip() == "Drag to turn, pinch to zoom, two fingers to move"
    button = page.get_by_role("button", name="Start again")
    box = button.bounding_box()
    assert min(box["width"], box["height"]) >= 44  # pixels that a finger hits
    page.keyboard.press("h")
    first = _picture(page)
    # The middle of the first photo fills the window: nothing is seen that lay outside of the photo.
    whole = next(iter(run_cameras(RunArchive.open(run))[0].values()))
    enlarged = whole.resized(round(WIDTH * PHONE[1] / HEIGHT), PHONE[1])
    left = (enlarged.width - PHONE[0]) // 2
    photo = _rendered(run, enlarged)[..., left : left + PHONE[0]]
    assert psnr(_tensor(first), photo) > 38
    page.keyboard.press("h")
    page.touchscreen.tap(100, 400)
    assert not words.is_visible()
    page.mouse.move(200, 400)
    page.mouse.down()
    page.mouse.move(260, 420)
    page.mouse.up()
    button.tap()
    page.evaluate("again.hidden = true")
    page.wait_for_timeout(100)
    assert np.array_equal(_picture(page), first)


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_a_page_that_has_not_arrived_says_how_much_has(run: Path, phone: Any, tmp_path: Path) -> None:
    whole = (run / "export" / "scene.html").read_text()
    begin, length = re.search(r'id="splats">', whole).end(), len(re.findall(r'id="splats">([^<]+)<', whole)[0])
    part = tmp_path / "part.html"
    part.write_text(whole[: begin + length // 2])
    page = phone.new_page()
    page.goto(part.as_uri())
    assert page.locator("#state").inner_text().startswith("Loading the scene")
    page.get_by_text("Loading the scene: 50 %").or_(page.get_by_text("Loading the scene: 49 %")).wait_for()
    assert not page.get_by_role("button").is_visible()


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_a_browser_that_cannot_show_the_scene_says_so(run: Path, phone: Any) -> None:
    page = phone.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto((run / "export" / "scene.html").as_uri())
    page.get_by_text("The scene cannot be shown: this browser has no WebGL 2").wait_for()


def _picture(page: object) -> NDArray[np.uint8]:
    png = np.frombuffer(page.screenshot(), np.uint8)  # type: ignore[attr-defined]  # playwright's page
    return cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1]


def _tensor(picture: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(picture.copy()).permute(2, 0, 1) / 255


def _rendered(run: Path, camera: Camera) -> torch.Tensor:
    field = RunArchive.open(run).field(0)
    with torch.no_grad():
        return CpuRasterizer()(field, camera, background=torch.tensor(BACKGROUND)).image
