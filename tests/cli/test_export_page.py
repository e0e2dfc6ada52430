"""The page of `lapgs export --html`: its bytes, and what a browser without a network shows of them."""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
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
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.reports import splat_page
from lapgs_plugin.reports.splat_page import shown_first, write_splat_page
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.run_folder import BACKGROUND, write_run, write_scene
from tests.cli.test_export import lapgs_export
from tests.folders import files_in
from tests.headless import CHROMIUM, NO_CHROMIUM, SOFTWARE_3D, headless_chromium
from tests.refusals import refuses
from tests.training_scene import HEIGHT, WIDTH, blob_field, ring_camera
from tests.unit.test_sog import read_rotation

ENLARGED = 8
PHONE = (390, 844)
PHONE_CAMERA = ring_camera(0.0, *PHONE)
BLACK = (0.0, 0.0, 0.0)
PART = r'class="part">([A-Za-z0-9+/=]+)<'


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    run = write_run(folder / "run", write_scene(folder / "scene"), nested=True)
    assert "scene.html: 200 Gaussians" in lapgs_export(run, "--html")
    return run


def colorful(count: int, seed: int = 0) -> GaussianField:
    """A field of SH degree 3, whose colours change with the direction in one of eight ways."""
    sets = 0.25 * torch.randn((8, 15, 3), generator=torch.Generator().manual_seed(seed + 1))
    field = blob_field(count, seed)
    return replace(field, sh=torch.cat([field.sh, sets[torch.arange(count) % 8]], dim=1))


def read_page(page: Path) -> list[list[GaussianField]]:
    """Return the Gaussians of a page by level and part."""
    text = page.read_text()
    headers = json.loads(re.findall(r'id="start">(.*?)</script>', text)[0])["levels"]
    parts = [np.frombuffer(zlib.decompress(base64.b64decode(part)), np.uint8) for part in re.findall(PART, text)]
    return [read_level(header, parts) for header in headers]


def read_level(header: dict[str, Any], parts: list[NDArray[np.uint8]]) -> list[GaussianField]:
    """Take the first parts, which are of a level, out of a list."""
    planes = [parts.pop(0).reshape(17, -1).T.astype(int) for _ in range(header["parts"])]
    count, coefficients = header["count"], (header["degree"] + 1) ** 2
    sh = np.zeros((count, coefficients, 3))
    sh[:, 0] = np.array(header["colors"])[np.concatenate([plane[:, 9:12] for plane in planes])]
    if coefficients > 1:
        shading = parts.pop(0).astype(int)
        labels = shading[:count] + 256 * shading[count : 2 * count]
        sets = shading[2 * count :].reshape(header["sets"], coefficients - 1, 3)
        sh[:, 1:] = np.array(header["rest"])[sets[labels]]
    rows = np.split(sh, np.cumsum([len(plane) for plane in planes])[:-1])
    return [_gaussians(header, plane, sh) for plane, sh in zip(planes, rows, strict=True)]


def _gaussians(header: dict[str, Any], planes: NDArray[Any], sh: NDArray[Any]) -> GaussianField:
    low, high = np.array(header["low"]), np.array(header["high"])
    folded = low + (high - low) * (planes[:, 0:3] + 256 * planes[:, 3:6]) / 65535
    return GaussianField(
        means=torch.from_numpy(np.sign(folded) * np.expm1(np.abs(folded))).float(),
        quaternions=torch.tensor([read_rotation(*map(int, row)) for row in planes[:, 13:]]),
        log_scales=torch.from_numpy(np.array(header["scales"])[planes[:, 6:9]]).float(),
        opacity_logits=torch.logit(torch.from_numpy(planes[:, 12] / 255)).float(),
        sh=torch.from_numpy(sh).float(),
    )


def test_a_page_has_the_visible_gaussians_rounded_the_most_important_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(splat_page, "FIRST_PART", 9)
    monkeypatch.setattr(splat_page, "PART", 25)
    field = colorful(50)
    logits = field.opacity_logits.clone()
    logits[7] = -9.0  # invisible
    write_splat_page([replace(field, opacity_logits=logits)], tmp_path / "page.html", "page", [ring_camera(0.0)], BLACK)
    (parts,) = read_page(tmp_path / "page.html")
    assert [len(part) for part in parts] == [9, 25, 15]
    importance = [torch.sigmoid(part.opacity_logits) * part.log_scales.sum(dim=1).exp() for part in parts]
    for first, second in pairwise(importance):
        assert first.min() >= 0.98 * second.max()  # both are rounded
    for part in parts:
        rows = (part.means[:, None] - field.means).norm(dim=2).argmin(dim=1)
        same = field.kept(rows)
        assert 7 not in rows
        torch.testing.assert_close(part.means, same.means, atol=2e-4, rtol=0)  # seen 4e-5
        torch.testing.assert_close(part.log_scales, same.log_scales, atol=1e-6, rtol=0)  # not rounded: few
        torch.testing.assert_close(part.sh, same.sh, atol=1e-2, rtol=0)  # seen 3.4e-3
        opacities, rounded = torch.sigmoid(same.opacity_logits), torch.sigmoid(part.opacity_logits)
        torch.testing.assert_close(rounded, opacities, atol=0.51 / 255, rtol=0)
        quaternions = torch.nn.functional.normalize(same.quaternions, dim=1)
        assert ((part.quaternions * quaternions).sum(dim=1).abs() > 0.9999).all()
    refuses(
        *(FieldError, "residual has signed colours", write_splat_page),
        *([replace(field, signed=True)], tmp_path / "residual.html", "page", [ring_camera(0.0)], BLACK),
    )


def test_the_page_is_one_file_with_the_splats(run: Path) -> None:
    page = run / "export" / "scene.html"
    assert not re.search(r"(src|href)=|https?://", page.read_text())
    ((part,),) = read_page(page)  # level 1 has more Gaussians than level 0
    means = RunArchive.open(run).field(0).means
    distances = (part.means[:, None] - means).norm(dim=2)
    assert float(distances.min(dim=1).values.max()) < 2e-4  # seen 7e-5


@pytest.mark.parametrize("nested", [True, False])
def test_coarser_levels_are_in_the_page_as_the_finest_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nested: bool
) -> None:
    monkeypatch.setattr(splat_page, "COARSER", 2.0)  # here they are not much smaller
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), nested=nested)
    merge = () if nested else ("--merge", "--iterations", 2)
    assert ", after level 1, opens" in lapgs_export(run, "--html", "--crop", "0,0,0,1", *merge)
    coarse, fine = (parts[0] for parts in read_page(run / "export" / "scene.html"))
    own = RunArchive.open(run).field(1).means
    assert len(coarse) == int((own.norm(dim=1) <= 1.0).sum())
    for field in (coarse, fine):
        assert float(field.means.norm(dim=1).max()) <= 1.0 + 1e-3


def test_a_page_has_coarser_levels_that_are_much_smaller() -> None:
    assert shown_first([100]) == [0]
    assert shown_first([100, 50]) == [1, 0]
    assert shown_first([100, 51]) == [0]
    assert shown_first([225, 80, 79]) == [1, 0]
    assert shown_first([225, 180, 79, 20]) == [3, 2, 0]


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
        page.wait_for_selector("canvas[data-complete][data-shown]", state="attached")
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
    page.wait_for_selector("canvas[data-complete][data-shown]", state="attached")
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
def test_a_page_of_an_antialiased_run_dims_small_gaussians(phone: Any, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), nested=True)
    camera = next(iter(run_cameras(RunArchive.open(run))[0].values()))
    enlarged = camera.resized(round(WIDTH * PHONE[1] / HEIGHT), PHONE[1])
    small = blob_field(200)
    half_a_pixel = 0.5 * float(camera.position.norm()) / enlarged.fy
    small = small.with_parameters(
        {
            "means": 0.1 * small.means,  # so many in a few pixels
            "log_scales": torch.full_like(small.log_scales, math.log(half_a_pixel)),
            "opacity_logits": torch.full_like(small.opacity_logits, 3.0),
        }
    )
    small.save_ply(RunArchive.open(run).field_path(0))
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["settings"] |= {"antialiased": True, "raster": {"antialiasing": True}}
    (run / "manifest.json").write_text(json.dumps(manifest | {"rasterizer": "gsplat"}))
    lapgs_export(run, "--html")
    left = (enlarged.width - PHONE[0]) // 2
    page = phone.new_page()
    page.goto((run / "export" / "scene.html").as_uri())
    page.wait_for_selector("canvas[data-complete][data-shown]", state="attached")
    page.keyboard.press("h")
    shown, background = _tensor(_picture(page)), torch.tensor(BACKGROUND)
    dimmed, plain = (
        OracleRasterizer(antialiasing=antialiasing).render_image(small, enlarged, background=background)
        for antialiasing in (True, False)
    )
    there = dimmed[..., left : left + PHONE[0]], plain[..., left : left + PHONE[0]]
    assert psnr(shown, there[0]) > 52  # 55.9 seen: colours have 8 bits
    assert psnr(shown, there[1]) < 46  # 43.6 seen


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[GaussianField]]:
    """A page of two levels, and the levels."""
    fields = [colorful(60, seed=3), colorful(200)]
    page = tmp_path_factory.mktemp("levels") / "page.html"
    write_splat_page(fields, page, "page", [PHONE_CAMERA, ring_camera(2.0), ring_camera(4.0)], BLACK)
    return page, fields


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_colours_change_with_the_direction(
    levels: tuple[Path, list[GaussianField]], phone: Any, tmp_path: Path
) -> None:
    _, (_, field) = levels
    for angle in (0.0, 2.0):
        camera = ring_camera(angle, *PHONE)
        write_splat_page([field], tmp_path / "page.html", "page", [camera, PHONE_CAMERA, ring_camera(4.0)], BLACK)
        picture = _tensor(_picture(_complete(phone, tmp_path / "page.html")))
        assert psnr(picture, _seen(field, camera)) > 42  # seen 48.9: colours are rounded
        assert psnr(picture, _seen(replace(field, sh=field.sh[:, :1]), camera)) < 28  # seen 23.2


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_the_coarse_level_is_shown_until_the_next_one_is_complete(
    levels: tuple[Path, list[GaussianField]], phone: Any, tmp_path: Path
) -> None:
    page, (coarse, fine) = levels
    text = page.read_text()
    ends = [match.end() for match in re.finditer(PART, text)]
    assert len(ends) == 3  # the coarse level, the fine one, its coefficients above degree 0
    for stop, level, field in ((ends[1] - 500, "0", coarse), (ends[2] - 500, "1", fine)):
        (tmp_path / "part.html").write_text(text[:stop])
        shown = phone.new_page()
        shown.goto((tmp_path / "part.html").as_uri())
        shown.wait_for_selector(f'canvas[data-level="{level}"]', state="attached")
        bar = shown.get_by_role("progressbar")
        assert bar.is_visible()
        assert 0.2 < float(bar.evaluate("bar => bar.value")) < 1.0
        _hide_words(shown)
        flat = _seen(replace(field, sh=field.sh[:, :1]), PHONE_CAMERA)
        assert psnr(_tensor(_picture(shown)), flat) > 48  # seen 57.6
    complete = _complete(phone, page)
    assert not complete.get_by_role("progressbar").is_visible()


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
@pytest.mark.parametrize(("spread", "shift"), [((60, 150), (0, 0)), ((60, 60), (40, -30))], ids=["pinch", "move"])
def test_two_fingers_zoom_and_move(
    levels: tuple[Path, list[GaussianField]], phone: Any, spread: tuple[int, int], shift: tuple[int, int]
) -> None:
    path, (_, field) = levels
    page = _complete(phone, path)
    _touch(page, spread, shift)
    target = json.loads(re.findall(r'id="start">(.*?)</script>', path.read_text())[0])["target"]
    depth = float(torch.tensor(target).sub(PHONE_CAMERA.position).norm())
    pose = PHONE_CAMERA.world_to_camera.clone()
    pose[2, 3] -= depth * (1 - spread[0] / spread[1])  # the camera comes nearer to what it turns around
    pose[:2, 3] += torch.tensor(shift) * depth / PHONE_CAMERA.fx
    moved = replace(PHONE_CAMERA, world_to_camera=pose)
    picture = _tensor(_picture(page))
    assert psnr(picture, _seen(field, moved)) > 38  # seen 43.2
    assert psnr(picture, _seen(field, PHONE_CAMERA)) < 25  # seen 14.7


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_what_is_between_two_fingers_stays_there(levels: tuple[Path, list[GaussianField]], phone: Any) -> None:
    page = _complete(phone, levels[0])
    depth = "START.target.reduce((sum, x, i) => sum + (x - viewer.camera.place[i]) * viewer.camera.axes[2][i], 0)"
    before = page.evaluate(f"[viewer.camera.place, {depth}]")
    _touch(page, (60, 120), (0, 0), middle=(295, 222))
    after = page.evaluate(f"[viewer.camera.place, {depth}]")
    # 100 pixels right of and 200 above the middle, at the target's depth.
    offset = torch.tensor([100.0, -200.0, PHONE_CAMERA.fx]) / PHONE_CAMERA.fx
    axes = PHONE_CAMERA.world_to_camera[:3, :3]
    points = [torch.tensor(place) + axes.T @ (offset * z) for place, z in (before, after)]
    torch.testing.assert_close(points[0], points[1], atol=1e-3, rtol=0)
    assert after[1] == pytest.approx(before[1] / 2, rel=1e-3)


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_one_finger_turns(levels: tuple[Path, list[GaussianField]], phone: Any) -> None:
    page = _complete(phone, levels[0])
    distance = "Math.hypot(...START.target.map((x, i) => x - viewer.camera.place[i]))"
    before = page.evaluate(f"[viewer.camera.place, {distance}]")
    session = page.context.new_cdp_session(page)
    for kind, points in (
        ("touchStart", [(200, 400)]),
        ("touchMove", [(260, 400)]),
        ("touchMove", [(300, 400)]),
        ("touchEnd", []),
    ):
        _send(session, kind, points)
    after = page.evaluate(f"[viewer.camera.place, {distance}]")
    assert after[1] == pytest.approx(before[1], rel=1e-6)
    assert np.linalg.norm(np.subtract(after[0], before[0])) > 0.3 * before[1]


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_a_page_that_has_not_arrived_says_how_much_has(run: Path, phone: Any, tmp_path: Path) -> None:
    whole = (run / "export" / "scene.html").read_text()
    (match,) = re.finditer(PART, whole)
    part = tmp_path / "part.html"
    part.write_text(whole[: sum(match.span(1)) // 2])
    page = phone.new_page()
    page.goto(part.as_uri())
    assert page.locator("#state").inner_text().startswith("Loading the scene")
    page.get_by_text("Loading the scene: 50 %").or_(page.get_by_text("Loading the scene: 49 %")).wait_for()
    assert page.get_by_role("progressbar").evaluate("bar => bar.value") == pytest.approx(0.5, abs=0.01)
    assert not page.get_by_role("button").is_visible()


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_a_browser_that_cannot_show_the_scene_says_so(run: Path, phone: Any) -> None:
    page = phone.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto((run / "export" / "scene.html").as_uri())
    page.get_by_text("The scene cannot be shown: this browser has no WebGL 2").wait_for()


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_a_damaged_page_says_so(run: Path, phone: Any, tmp_path: Path) -> None:
    whole = (run / "export" / "scene.html").read_text()
    (match,) = re.finditer(PART, whole)
    (tmp_path / "damaged.html").write_text(whole[: match.start(1)] + "AAAA" + whole[match.start(1) + 4 :])
    page = phone.new_page()
    page.goto((tmp_path / "damaged.html").as_uri())
    page.get_by_text("The scene cannot be shown:").wait_for()
    assert not page.get_by_role("progressbar").is_visible()


def _complete(phone: Any, path: Path) -> Any:
    """Return a page that has shown all of its scene, without the words over it."""
    page = phone.new_page()
    page.goto(path.as_uri())
    page.wait_for_selector("canvas[data-complete][data-shown]", state="attached")
    _hide_words(page)
    return page


def _hide_words(page: Any) -> None:
    page.evaluate("words.hidden = again.hidden = true; bar.style.opacity = 0")
    page.wait_for_timeout(100)


def _touch(page: Any, spread: tuple[int, int], shift: tuple[int, int], middle: tuple[int, int] | None = None) -> None:
    """Touch with two fingers so far from their middle, and move them in steps to another distance and middle."""
    x, y = middle or (PHONE[0] // 2, PHONE[1] // 2)
    session = page.context.new_cdp_session(page)
    for step in range(7):
        share = min(step, 5) / 5
        apart = spread[0] + share * (spread[1] - spread[0])
        at = (x + share * shift[0], y + share * shift[1])
        fingers = [(at[0] - apart, at[1]), (at[0] + apart, at[1])]
        _send(
            session, "touchStart" if step == 0 else "touchMove" if step < 6 else "touchEnd", fingers[: 2 * (step < 6)]
        )
    page.wait_for_timeout(100)


def _send(session: Any, kind: str, points: Sequence[tuple[float, float]]) -> None:
    touches = [{"x": x, "y": y, "id": index} for index, (x, y) in enumerate(points)]
    session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})


def _picture(page: object) -> NDArray[np.uint8]:
    png = np.frombuffer(page.screenshot(), np.uint8)  # type: ignore[attr-defined]  # playwright's page
    return cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1]


def _tensor(picture: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(picture.copy()).permute(2, 0, 1) / 255


def _rendered(run: Path, camera: Camera) -> torch.Tensor:
    field = RunArchive.open(run).field(0)
    with torch.no_grad():
        return CpuRasterizer()(field, camera, background=torch.tensor(BACKGROUND)).image


def _seen(field: GaussianField, camera: Camera) -> torch.Tensor:
    with torch.no_grad():
        return CpuRasterizer()(field, camera, background=torch.tensor(BLACK)).image.clamp(0, 1)
