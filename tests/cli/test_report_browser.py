"""Test report.html in a headless browser without a network, with mouse and keyboard."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.cli.run_folder import write_run, write_scene
from tests.cli.test_report import lapgs_report
from tests.cli.test_report_experiment import write_experiment
from tests.headless import CHROMIUM, NO_CHROMIUM, headless_chromium

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
pytestmark = [pytest.mark.browser, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]

PHONE, DESKTOP = (390, 844), (1280, 900)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the page of a hierarchy beside a single field, whose pictures differ a lot."""
    folder = tmp_path_factory.mktemp("report")
    scene = write_scene(folder / "scene")
    run, baseline = write_run(folder / "run", scene), write_run(folder / "baseline", scene, levels=1, seed=5)
    lapgs_report(run, "--baseline", baseline)
    return (run / "report.html").as_uri()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with headless_chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the page of an experiment."""
    folder = write_experiment(tmp_path_factory.mktemp("experiment") / "trial")
    lapgs_report(folder)
    return (folder / "report.html").as_uri()


@pytest.fixture(params=[PHONE, DESKTOP], ids=["phone", "desktop"])
def size(request: pytest.FixtureRequest) -> Any:
    return request.param


@contextmanager
def opened(browser: Any, address: str, size: tuple[int, int]) -> Iterator[Any]:
    """Open a page, and check that it requests nothing and reports no error."""
    width, height = size
    troubles: list[str] = []
    page = browser.new_page(viewport={"width": width, "height": height}, device_scale_factor=1)
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda message: troubles.append(message.text))
    page.on("request", lambda request: request.url[:5] in ("file:", "data:") or troubles.append(request.url))
    page.goto(address)
    yield page
    assert troubles == []
    page.close()


@pytest.fixture
def page(browser: Any, address: str, size: tuple[int, int]) -> Iterator[Any]:
    with opened(browser, address, size) as page:
        yield page


def test_the_page_of_an_experiment_fits_and_is_complete(browser: Any, experiment: str, size: tuple[int, int]) -> None:
    with opened(browser, experiment, size) as page:
        widths = page.evaluate("[document.documentElement.scrollWidth, window.innerWidth]")
        assert widths[0] <= widths[1]
        assert page.locator("#tables table").is_visible()
        assert page.locator(".charts svg[role=img]").first.locator("line[marker-end]").count() == 4  # an arrow each
        scenes = page.locator("details.part")
        assert scenes.count() == 4
        assert [scene.locator(".pair").first.is_visible() for scene in scenes.all()] == [True, False, False, False]
        scenes.nth(2).locator("summary").first.click()
        divider = scenes.nth(2).get_by_role("slider")
        divider.press("End")
        assert divider.get_attribute("aria-valuenow") == "100"


def pixels(element: Any) -> NDArray[np.float64]:
    """Capture an element, (h, w, 3)."""
    return cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(np.float64)


def difference(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.abs(one - other).mean())


def choose(strip: Any, side: str, caption: str) -> None:
    strip.locator(f'select[data-side="{side}"]').select_option(label=caption)


def test_the_page_fits_and_is_complete(page: Any) -> None:
    widths = page.evaluate("[document.documentElement.scrollWidth, window.innerWidth]")
    assert widths[0] <= widths[1]  # nothing has to be scrolled sideways but tables inside their own boxes
    for heading in ("Figures", "Training", "Time", "Views", "Settings"):
        assert page.get_by_role("heading", name=heading, exact=True).is_visible()
    charts = page.locator(".charts svg[role=img]")
    shown = [chart for chart in charts.all() if chart.is_visible()]
    assert len(shown) == 3 + 3  # over time; and time against Gaussians, breakdown, overhead
    for chart in shown:
        box = chart.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= widths[1]
        assert box["width"] > 250
        for text in chart.locator("text").all():
            assert float(text.evaluate("node => node.getBoundingClientRect().height")) >= 9  # pixels: can be read
    page.get_by_text("over iterations").click()
    assert [chart.is_visible() for chart in charts.all()] == [False] * 3 + [True] * 6
    images = page.locator("img").all()
    assert all(image.evaluate("node => node.complete && node.naturalWidth > 0") for image in images)


def test_the_divider_is_dragged(page: Any) -> None:
    strip = page.locator(".strip").first
    pair, divider = strip.locator(".pair"), strip.get_by_role("slider")
    pair.evaluate("node => node.querySelectorAll('.box').forEach(box => box.remove())")
    divider.press("Home")  # out of the way
    whole = {}
    for caption in ("Photo", "Composition"):
        choose(strip, "left", caption)
        choose(strip, "right", caption)
        whole[caption] = pixels(pair)
    assert difference(whole["Photo"], whole["Composition"]) > 20
    choose(strip, "left", "Photo")
    box = pair.bounding_box()
    y = box["y"] + box["height"] * 0.75
    page.mouse.move(box["x"] + box["width"] * 0.5, y)
    page.mouse.down()
    for share in (0.2, 0.8, 0.3):
        page.mouse.move(box["x"] + box["width"] * share, y, steps=4)
        assert float(divider.get_attribute("aria-valuenow")) == pytest.approx(100 * share, abs=1.0)
        seen = pixels(pair)
        at, margin = round(share * seen.shape[1]), 24  # pixels around the line and its handle
        assert difference(seen[:, margin : at - margin], whole["Photo"][:, margin : at - margin]) < 0.5
        assert difference(seen[:, at + margin :], whole["Composition"][:, at + margin :]) < 0.5
    page.mouse.up()
    page.mouse.move(box["x"] + box["width"] * 0.9, y)
    assert divider.get_attribute("aria-valuenow") == "30"  # let go


def test_the_divider_obeys_the_keyboard(page: Any) -> None:
    strip = page.locator(".strip").nth(1)
    divider = strip.get_by_role("slider")
    for key, value in (("ArrowLeft", "48"), ("ArrowRight", "50"), ("End", "100"), ("ArrowRight", "100"), ("Home", "0")):
        divider.press(key)
        assert divider.get_attribute("aria-valuenow") == value
    assert page.locator(".strip").first.get_by_role("slider").get_attribute("aria-valuenow") == "50"  # its own


def test_any_two_pictures_can_be_compared(page: Any) -> None:
    strip = page.locator(".strip").first
    options = strip.locator('select[data-side="left"] option').all_inner_texts()
    assert [option.partition(",")[0] for option in options] == ["Photo", "Base", "Residual", "Composition", "Baseline"]
    assert strip.locator("select").evaluate_all("nodes => nodes.map(node => node.selectedOptions[0].text)") == [
        "Baseline",
        "Composition",
    ]
    for caption in options:
        choose(strip, "right", caption)
        shown, small = (
            strip.locator(path).get_attribute("src")
            for path in (".pair .right", f'.zoom img[alt^="{caption.partition(",")[0]} of"]')
        )
        assert shown == small


def test_a_small_picture_is_enlarged_and_put_back(page: Any) -> None:
    image = page.locator(".zoom img").first
    before = image.bounding_box()
    image.click()
    assert image.bounding_box()["width"] == page.viewport_size["width"]
    image.click()
    assert image.bounding_box()["width"] == before["width"]


@pytest.mark.parametrize("baseline", [False, True], ids=["4 pictures", "5 pictures"])
def test_no_cut_out_is_alone_in_its_row_on_a_phone(browser: Any, address: str, tmp_path: Path, baseline: bool) -> None:
    if not baseline:
        run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
        lapgs_report(run)
        address = (run / "report.html").as_uri()
    with opened(browser, address, PHONE) as page:
        tops = page.locator(".cutout").first.locator("img").evaluate_all("nodes => nodes.map(node => node.y)")
        assert len(tops) == 4 + baseline
        assert min(Counter(tops).values()) > 1


def test_a_table_with_columns_beside_the_window_says_so(browser: Any, address: str) -> None:
    with opened(browser, address, PHONE) as page:
        box = page.locator(".scroll", has=page.locator("#levels"))
        for position, sign in (
            (0, "more columns \u2192"),
            (100, "\u2190 more columns \u2192"),
            (9999, "\u2190 more columns"),
        ):
            box.evaluate("(node, position) => node.scrollTo(position, 0)", position)
            playwright.expect(box).to_have_attribute("data-sign", sign)
            assert box.evaluate("node => getComputedStyle(node, '::before').content") == f'"{sign}"'
    with opened(browser, address, DESKTOP) as page:
        assert page.locator("[data-sign]").count() == 0
