"""Test that the page of `lapgs report` is whole and self-contained, and shows the content of metrics.json."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

from lapgs_plugin.cli.report import report
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import EXPOSURE, VIGNETTING
from lapgs_plugin.runs.manifest import LevelRecord, Manifest, SceneReference
from lapgs_plugin.scenes import load_scene
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.refusals import refuses
from tests.training_scene import HEIGHT, WIDTH, blob_field

app = typer.Typer()
app.command()(report)

VOID = {"meta", "img", "input", "line", "polyline", "circle", "rect", "path"}


class Page(HTMLParser):
    """The content of the page: attributes by tag, text by row of a table, and whether every tag is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.figures: dict[str, list[float]] = {}
        self.text = ""
        self._row = ""
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attributes}
        self.tags.append((tag, values))
        if tag not in VOID:
            self._open.append(tag)
        self._row = values.get("data-metric", self._row) if tag == "tr" else self._row
        if tag == "td" and values.get("data-value") and self._row:
            self.figures.setdefault(self._row, []).append(float(values["data-value"]))

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        assert tag in VOID, f"<{tag}/> closes nothing in HTML"
        self.handle_starttag(tag, attributes)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag
        self._row = "" if tag == "tr" else self._row

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self._open):
            self.text += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]


lapgs_report = succeeding(app, columns=120)


@pytest.fixture
def run(scene: Path, tmp_path: Path) -> Path:
    return write_run(tmp_path / "hierarchy", scene)  # the name is on the page


@pytest.fixture
def baseline(scene: Path, tmp_path: Path) -> Path:
    return write_run(tmp_path / "plain", scene, levels=1, seed=9)


def test_the_page_needs_nothing_else(run: Path, baseline: Path) -> None:
    lapgs_report(run, "--baseline", baseline)
    text = (run / "report.html").read_text()
    page = Page(text)
    assert not re.search(r"https?:", text)
    assert page.all("script") == [{}]  # its text is in the page
    assert not re.search(r"fetch|XMLHttpRequest|WebSocket|import\b", text.partition("<script>")[2])
    assert not page.all("link")
    assert set(re.findall(r"url\((.)", text)) == {"#"}  # the head of an arrow
    for _, attributes in page.tags:
        assert "href" not in attributes
        assert re.match(r"data:image/(jpeg|png);base64,", attributes.get("src", "data:image/jpeg;base64,"))
    (meta,) = [attributes for attributes in page.all("meta") if attributes.get("name") == "viewport"]
    assert "width=device-width" in meta["content"]
    assert "prefers-color-scheme: dark" in text


def test_a_level_that_lost_its_gaussians_is_said(run: Path) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    for record in manifest["records"]:
        record["start_gaussians"] = 10 * record["num_gaussians"] + (record["level"] == 0)
    (run / "manifest.json").write_text(json.dumps(manifest))
    lapgs_report(run)
    text = Page((run / "report.html").read_text()).text
    assert "Level 0 ended with 200 of the 2,001 Gaussians" in text
    assert "evel 1 ended" not in text
    levels = json.loads((run / "metrics.json").read_text())["levels"]
    assert [levels[level]["start_gaussians"] for level in ("0", "1")] == [2001, 2500]


def test_a_length_that_views_decided_is_said(run: Path) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    base, finest = manifest["records"]
    base["decided"] = {"most": base["iterations"], "after": 6, "views": 4, "gain": 0.216}
    finest["decided"] = {"most": 9000, "after": 6, "views": 4, "gain": -0.04}
    (run / "manifest.json").write_text(json.dumps(manifest))
    lapgs_report(run)
    text = Page((run / "report.html").read_text()).text
    for record, limit, gain in ((base, "the most it may have", "+0.22"), (finest, "of at most 9,000", "-0.04")):
        length = f"Level {record['level']}: {record['iterations']} iterations, {limit}; after 6, 4 views set aside"
        assert f"{length} promised {gain} dB for a third more." in text


def test_a_finest_level_that_changes_little_is_said(run: Path) -> None:
    """By the views of metrics.json, here more of them than the scene has, if they were held out."""
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["records"][-1]["iterations"] = 1000
    (run / "manifest.json").write_text(json.dumps(manifest))
    lapgs_report(run)
    metrics = json.loads((run / "metrics.json").read_text())
    for figures in metrics["levels"].values():
        assert len(figures["view_psnr"]) == 2
        assert np.mean(figures["view_psnr"]) == pytest.approx(figures["upsampled_psnr"])

    def page(gain: float, split: str = "test") -> str:
        metrics["levels"]["0"]["view_psnr"] = [20.0 + gain, 22.0 + gain, 24.0 + gain, 26.0 + gain]
        metrics["levels"]["1"]["view_psnr"] = [20.0, 22.0, 24.0, 26.0]
        (run / "metrics.json").write_text(json.dumps({**metrics, "split": split}))
        lapgs_report(run)
        return Page((run / "report.html").read_text()).text

    assert "Level 0 changes the PSNR of 4 held-out images by +0.05 dB" in page(0.05)
    assert "evel 0 changes" not in page(0.05, "train")
    assert "evel 0 changes" not in page(0.15)


def test_every_picture_is_there_and_can_be_decoded(run: Path, baseline: Path) -> None:
    lapgs_report(run, "--baseline", baseline)
    images = [image for image in Page((run / "report.html").read_text()).all("img") if "src" in image]
    cutouts = [image for image in images if "enlarged" in image["alt"]]
    kinds = Counter(image["alt"].split(" of ")[0] for image in cutouts)
    assert kinds == dict.fromkeys(("Photo", "Base", "Residual", "Composition", "Baseline"), 2 * 2)
    images = [image for image in images if image not in cutouts]
    kinds = Counter(image["alt"].split(" of ")[0] for image in images)
    assert kinds == dict.fromkeys(("Photo", "Base", "Residual", "Composition", "Baseline"), 2)  # two views are held out
    for image in images:
        data = np.frombuffer(base64.b64decode(image["src"].partition(",")[2]), np.uint8)
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert pixels.shape == (int(image["height"]), int(image["width"]), 3)
    photo = next(image for image in images if image["alt"] == "Photo of photos/08.png")
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(photo["src"].partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    original = cv2.imread(str(Path(RunArchive.open(run).manifest.scene.path) / "photos" / "08.png"))
    assert np.abs(decoded.astype(int) - original).mean() < 3.0  # JPEG of stripes; 1.8 seen
    cutout = next(image for image in cutouts if image["alt"] == "Photo of photos/08.png, enlarged 1")
    part = cv2.imdecode(np.frombuffer(base64.b64decode(cutout["src"].partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    assert part.shape == (16, 16, 3)
    # The cut-out occurs there pixel by pixel, and nowhere else.
    distances = cv2.matchTemplate(original, part, cv2.TM_SQDIFF)
    assert distances.min() < 1.0


def test_pictures_are_those_that_the_figures_beside_them_measure(run: Path, baseline: Path) -> None:
    """The run learned that its photos are brighter than its renders; the baseline did not."""
    names = [f"photos/{i:02d}.png" for i in range(10)]
    learned = {name: (1.6 * np.eye(3, 4)).tolist() for name in names if name not in ("photos/00.png", "photos/08.png")}
    (run / "level_0" / EXPOSURE).write_text(json.dumps(learned))
    (run / VIGNETTING).write_text(json.dumps(dict.fromkeys(names, -0.7)))
    lapgs_report(run, "--baseline", baseline)
    images = {
        image["alt"]: image["src"] for image in Page((run / "report.html").read_text()).all("img") if "src" in image
    }
    for folder, caption in ((run, "Composition"), (baseline, "Baseline")):
        measured = {view["name"]: view["psnr"] for view in json.loads((folder / "metrics.json").read_text())["views"]}
        for name in ("photos/00.png", "photos/08.png"):
            data = np.frombuffer(base64.b64decode(images[f"{caption} of {name}"].partition(",")[2]), np.uint8)
            shown = cv2.imdecode(data, cv2.IMREAD_COLOR)
            photo = cv2.imread(str(Path(RunArchive.open(run).manifest.scene.path) / name))
            error = np.square((shown.astype(float) - photo) / 255).mean()
            assert -10 * np.log10(error) == pytest.approx(measured[name], abs=0.03)  # it is a JPEG; 0.007 seen


def test_figures_are_those_of_metrics_json(run: Path, baseline: Path) -> None:
    output = lapgs_report(run, "--baseline", baseline)
    page = Page((run / "report.html").read_text())
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (run, baseline)]
    for key in ("psnr", "ssim", "train_seconds", "peak_gaussians"):
        assert page.figures[key] == [figures[key] for figures in metrics]
    for key in ("num_gaussians", "overhead_seconds"):
        assert page.figures[key] == [sum(figures[key].values()) for figures in metrics]
    for figures in metrics:
        assert f"{figures['psnr']:.2f}" in page.text
        assert f"{figures['psnr']:.2f}" in output
    missing = bool(metrics[0]["lpips_missing"])  # unless this machine has the weights
    assert (output.count("not measured"), page.text.count("lapgs eval says how")) == (missing, missing)
    ratio = f"{metrics[1]['train_seconds'] / metrics[0]['train_seconds']:.2f}x as fast"
    assert ratio in page.text
    assert ratio in output
    for view in metrics[0]["views"]:
        assert view["name"] in page.text


def test_charts_show_both_runs_over_time_and_iterations(run: Path, baseline: Path) -> None:
    lapgs_report(run, "--baseline", baseline)
    page = Page((run / "report.html").read_text())
    labels = [svg["aria-label"] for svg in page.all("svg") if " over " in svg.get("aria-label", "")]
    titles = ("Loss", "Held-out PSNR (dB)", "Gaussians in training")
    assert labels == [
        *(f"{title} over {x}" for x in ("seconds of optimization", "iterations, all stages") for title in titles),
        "Optimization (s) against Gaussians over Gaussians of levels, weighted by iterations",
    ]
    # Loss and Gaussians have a line a stage, PSNR one a run; all twice. PSNR was measured too rarely for an inset.
    assert Counter(line["class"] for line in page.all("polyline")) == {"line-run": 2 * 5, "line-baseline": 2 * 3}
    assert page.text.count("level 1") >= 6


def test_bars_show_the_time_of_training(run: Path, baseline: Path) -> None:
    lapgs_report(run, "--baseline", baseline)
    text = (run / "report.html").read_text()
    page, bars = Page(text), re.findall(r'<title>(\w+): .*</title>\s*<rect class="(part-\d)".* width="(.*?)"', text)
    recorded = {"forward": 3, "loss": 3, "backward": 3, "other": 3}  # three stages of two runs
    beside = {"pyramid": 2, "cache": 1, "archive": 2}
    assert Counter(name for name, _, _ in bars) == {**recorded, **beside}
    for parts in (recorded, beside):
        styles = {(name, style) for name, style, _ in bars if name in parts}
        colours = {re.findall(rf"\.{style} {{ fill: (#\w+)", text)[0] for _, style in styles}
        assert len(styles) == len(colours) == len(parts), "each part has a colour of its own in its chart"
    assert "hierarchy, level 1: 35 ms an iteration" in page.text
    assert "plain: 41.2 ms an iteration" in page.text
    widths = [float(width) for name, _, width in bars if name == "backward"]
    assert widths[0] / widths[1] == pytest.approx(1.75 / 3.25, rel=0.01)  # 3.0e-4 seen


def test_views_are_listed_worst_first_beside_the_baseline(run: Path, baseline: Path) -> None:
    lapgs_report(run, "--baseline", baseline)
    text = (run / "report.html").read_text()
    table = text.partition('<table class="numbers views"')[2].partition("</table>")[0]
    rows = [re.findall(r'<th>(.*?)</th>|data-value="(.*?)"', row) for row in table.split("<tr>")[2:]]
    cells = [(row[0][0], *(float(value) for _, value in row[1:])) for row in rows]
    metrics = [json.loads((folder / "metrics.json").read_text())["views"] for folder in (run, baseline)]
    theirs = {view["name"]: view["psnr"] for view in metrics[1]}
    expected = [
        (v["name"], v["psnr"], v["ssim"], theirs[v["name"]], v["psnr"] - theirs[v["name"]])
        for v in sorted(metrics[0], key=lambda view: view["psnr"])
    ]
    assert cells == expected
    assert re.findall(r"<th>([^<]*)</th>", table)[:5] == ["view", "PSNR (dB)", "SSIM", "baseline PSNR", "gain"]


def test_entries_without_a_time_lie_at_the_end_of_their_stage(run: Path) -> None:
    history = run / "history.jsonl"
    entries = [json.loads(line) for line in history.read_text().splitlines()]
    kept = [{key: value for key, value in entry.items() if key != "psnr"} for entry in entries]
    # Entries of `lapgs run` have no time.
    kept.append({"level": 0, "iteration": 200, "psnr": 21.5})
    history.write_text("".join(json.dumps(entry) + "\n" for entry in kept))
    lapgs_report(run)
    page = Page((run / "report.html").read_text())
    assert [svg.get("aria-label") for svg in page.all("svg")].count(
        "Held-out PSNR (dB) over seconds of optimization"
    ) == 1


def test_a_run_alone_is_measured_first_and_has_no_second_column(run: Path) -> None:
    assert RunArchive.open(run).metrics() is None
    output = lapgs_report(run)
    metrics = RunArchive.open(run).metrics()
    assert metrics is not None
    page = Page((run / "report.html").read_text())
    assert page.figures["psnr"] == [metrics["psnr"]]
    assert "baseline" not in page.text.lower()
    assert "change" not in output
    assert not [line for line in page.all("polyline") if line["class"] == "line-baseline"]


def test_a_single_field_without_held_out_views_or_history(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, levels=1, hold_out=False)
    (run / "history.jsonl").unlink()
    lapgs_report(run)
    page = Page((run / "report.html").read_text())
    assert "No views were held out" in page.text
    assert "a single field" in page.text
    assert not page.all("polyline")
    # Worst, median and best; photo and composition, each with two cut-outs, and the two that the script fills.
    assert len(page.all("img")) == 3 * (2 + 2 * 2 + 2)


@pytest.mark.parametrize("noted", [[], [{"level": 0, "iteration": 4, "loss": 0.2}]], ids=["no history", "a history"])
def test_a_loop_of_ones_own_is_not_given_times_or_options(
    scene: Path, tmp_path: Path, noted: list[dict[str, float]]
) -> None:
    """As docs/python.md writes its run folder: no time is measured, nothing is held out, history is optional."""
    reference = SceneReference.of(load_scene(scene, progress=False), resolution="full")
    stages = StagePlan.create((WIDTH, HEIGHT), 8, levels=2)
    with RunArchive.create(tmp_path / "run", Manifest.of_loop(reference, stages.levels, "cpu")) as archive:
        for stage in stages:
            field = blob_field(50)
            for entry in noted:
                archive.append_history({**entry, "level": stage.level})
            archive.finish_level(LevelRecord.of(stage, field), replace(field, signed=stage.signed))
    output = lapgs_report(tmp_path / "run")
    assert re.search(r"Optimization \(s\) +not measured", output)
    page = Page((tmp_path / "run" / "report.html").read_text())
    assert "train_seconds" not in page.figures
    assert "No views were held out" in page.text
    assert not re.search(r"--\w+", page.text), "an option that the loop does not have"
    assert "over time" not in page.text
    assert ("over iterations" in page.text) == bool(noted)


def test_options_are_advised_where_there_are_some(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, hold_out=False)
    manifest = json.loads((run / "manifest.json").read_text())
    for record in manifest["records"]:
        record["breakdown_seconds"] = {}
    (run / "manifest.json").write_text(json.dumps(manifest))
    lapgs_report(run)
    assert set(re.findall(r"--\w+", Page((run / "report.html").read_text()).text)) == {"--eval", "--breakdown"}


def test_differences_of_setup_are_reported(run: Path, scene: Path, tmp_path: Path) -> None:
    other = write_run(tmp_path / "other", scene, levels=1, hold_out=False)
    output = lapgs_report(run, "--baseline", other)
    assert "held-out views True against False" in output
    assert "held-out views True against False" in Page((run / "report.html").read_text()).text


def test_names_are_text_and_not_markup(tmp_path: Path) -> None:
    names = [f"a&b/<i>{i}.png" for i in range(10)]
    scene = write_scene(tmp_path / "<b>scene", names)
    run = write_run(tmp_path / "[red]run", scene, levels=1)
    output = lapgs_report(run)
    page = Page((run / "report.html").read_text())
    assert "a&b/<i>0.png" in page.text
    assert "<b>scene" in page.text
    assert "[red]run" in output


def test_an_unfinished_run_is_refused(run: Path, scene: Path, tmp_path: Path) -> None:
    unfinished = write_run(tmp_path / "unfinished", scene, finished=1)
    refuses(RunFolderError, "only 1 of 2 levels are trained", lapgs_report, unfinished)
    refuses(RunFolderError, "only 1 of 2 levels are trained", lapgs_report, run, "--baseline", unfinished)
    assert not (run / "report.html").exists()


def test_foreign_metrics_are_refused(run: Path) -> None:
    (run / "metrics.json").write_text('{"psnr": 20.0}')
    with pytest.raises(
        RunFolderError, match=r"lacks breakdown_seconds, .*levels, .*; write it again with `lapgs eval`"
    ):
        lapgs_report(run)
