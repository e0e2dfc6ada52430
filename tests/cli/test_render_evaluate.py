"""Compare the files of `lapgs render` and `lapgs eval` with each other and with NumPy."""

from __future__ import annotations

import json
import math
import re
import shutil
from io import StringIO
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import typer
from rich.console import Console
from typer.testing import CliRunner

from lapgs_plugin.cli.evaluate import evaluate, print_levels
from lapgs_plugin.cli.render import render
from lapgs_plugin.errors import RunFolderError, SceneError, UserInputError
from lapgs_plugin.evaluation.figures import evaluate_run
from lapgs_plugin.evaluation.lpips import NETWORKS
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rendering.images import caption_height, file_stems
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.reports.comparison import comparison_rows
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import EXPOSURE, POSES
from lapgs_plugin.scenes.images import read_image
from lapgs_plugin.scenes.scene import View, load_cameras
from tests.cli.commands import succeeding
from tests.cli.run_folder import SECONDS, write_run, write_scene
from tests.folders import files_in
from tests.refusals import refuses
from tests.training_scene import HEIGHT, WIDTH, ring_camera

app = typer.Typer()
app.command("render")(render)
app.command("eval")(evaluate)
lapgs = succeeding(app, columns=100)


def test_render_writes_every_image_of_the_held_out_views(run: Path) -> None:
    output = lapgs("render", run)
    suffixes = ("base", "residual_0", "composed")
    assert files_in(run / "renders") == {f"test/photos/{i}_{s}.png" for i in ("00", "08") for s in suffixes}
    assert str(run / "renders") in output


def test_the_log_says_which_rasterizer_renders(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    lapgs("render", run, "--level", "1")
    assert "rendering with the CPU rasterizer: " in caplog.text


def test_exr_files_add_up_and_png_files_show_them(run: Path) -> None:
    lapgs("render", run, "--format", "exr")
    lapgs("render", run)
    folder = run / "renders" / "test" / "photos"
    exr = {s: read_image(folder / f"00_{s}.exr") for s in ("base", "residual_0", "composed")}
    assert exr["base"].shape == (3, 20, 28)
    assert exr["residual_0"].min() < -0.05
    up = Pyramid("camera").up(exr["base"], (40, 56))
    np.testing.assert_allclose(exr["composed"], up + exr["residual_0"], atol=1e-6)
    shown = {
        "base": exr["base"].clamp(0, 1),
        "residual_0": (0.5 + exr["residual_0"] / 2).clamp(0, 1),
        "composed": exr["composed"].clamp(0, 1),
    }
    for suffix, image in shown.items():
        png = cv2.imread(str(folder / f"00_{suffix}.png"))[:, :, ::-1] / 255.0
        np.testing.assert_allclose(png, image.permute(1, 2, 0).numpy(), atol=0.5 / 255 + 1e-6)


def test_compare_puts_photo_and_composition_side_by_side(run: Path, scene: Path) -> None:
    lapgs("render", run, "--compare")
    folder = run / "renders" / "test" / "photos"
    photo, composed = cv2.imread(str(scene / "photos" / "08.png")), cv2.imread(str(folder / "08_composed.png"))
    whole = cv2.imread(str(folder / "08_compare.png")).astype(int)
    captions, compare = np.split(whole, [caption_height(len(photo))])
    words = [(captions[:, start : start + 56] < 128).any() for start in (0, 56, 112)]
    assert all(words), "each panel has its name"
    np.testing.assert_array_equal(compare[:, :56], photo)
    np.testing.assert_array_equal(compare[:, 56:112], composed)
    expected = 127.5 + (composed.astype(int) - photo.astype(int)) / 2
    np.testing.assert_allclose(
        compare[:, 112:], expected, atol=1.0
    )  # three roundings of half a step, one of them halved


def test_render_options(run: Path, tmp_path: Path) -> None:
    lapgs("render", run, "--level", "1", "--out", tmp_path / "coarse")
    assert files_in(tmp_path / "coarse") == {"test/photos/00_base.png", "test/photos/08_base.png"}
    lapgs("render", run, "--views", "all", "--out", tmp_path / "all")
    assert len(files_in(tmp_path / "all" / "train")) == 8 * 3
    assert len(files_in(tmp_path / "all" / "test")) == 2 * 3
    assert not (run / "renders").exists()


def test_tables_fit_into_80_columns(scene: Path, tmp_path: Path) -> None:
    metrics = evaluate_run(RunArchive.open(write_run(tmp_path / "run", scene)))
    for figures in metrics["levels"].values():  # of a large run
        figures.update(image_size=[4946, 3286], iterations=30000, train_seconds=1234.5)
        figures.update(num_gaussians=1_000_000, peak_gaussians=1_500_000)
    stream = StringIO()
    print_levels(Console(file=stream, width=80), metrics)
    text = stream.getvalue()
    assert "…" not in text
    assert re.search("level +size +iterations +seconds +Gaussians +peak +PSNR +upsampled", text)


def test_one_level_has_one_image_a_view(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, levels=1, hold_out=False)
    lapgs("render", run)
    assert files_in(run / "renders") == {f"train/photos/{i:02d}_composed.png" for i in range(10)}


def test_an_interrupted_run_renders_what_is_there_and_is_not_measured(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, finished=1)
    lapgs("render", run)
    assert files_in(run / "renders") == {"test/photos/00_base.png", "test/photos/08_base.png"}
    refuses(UserInputError, "level 0 cannot be rendered, expected 1; finer", lapgs, "render", run, "--level", 0)
    refuses(RunFolderError, "only 1 of 2 levels are trained", lapgs, "eval", run)
    empty = write_run(tmp_path / "empty", scene, finished=0)
    refuses(RunFolderError, "level 1 is not in this run", lapgs, "render", empty)
    # What is advised has to work: there is nothing to render yet.
    assert "`lapgs render`" in refuses(RunFolderError, "only 1 of 2 levels", lapgs, "eval", run)
    assert "`lapgs render`" not in refuses(RunFolderError, "none of 2 levels is trained", lapgs, "eval", empty)


def test_view_names_that_would_share_a_file_keep_their_extension(tmp_path: Path) -> None:
    names = ["a/1.png", "a/1.tif", *(f"b/{i}.png" for i in range(8))]
    scene = write_scene(tmp_path / "scene", names)
    run = write_run(tmp_path / "run", scene, levels=1, hold_out=False)
    lapgs("render", run)
    written = files_in(run / "renders" / "train")
    assert {"a/1.png_composed.png", "a/1.tif_composed.png", "b/0_composed.png"} <= written
    assert len(written) == 10


@pytest.mark.parametrize("names", [["1.png", "1.tif", "1.png.tif"], ["../1.png", "1.png"], ["a/../1.png", "a/1.png"]])
def test_no_two_views_share_a_file(names: list[str]) -> None:
    camera, image = ring_camera(0.0), torch.zeros(3, HEIGHT, WIDTH)
    stems = file_stems([View(name, camera, image) for name in names])
    assert len(set(stems.values())) == len(stems) == len(names)
    assert not any(".." in Path(stem).parts or Path(stem).is_absolute() for stem in stems.values())


def test_eval_agrees_with_numpy_on_the_rendered_files(run: Path, scene: Path) -> None:
    output = lapgs("eval", run)
    metrics = json.loads((run / "metrics.json").read_text())
    lapgs("render", run, "--format", "exr")
    values = []
    for view in ("00", "08"):
        rendered = read_image(run / "renders" / "test" / "photos" / f"{view}_composed.exr").numpy()
        photo = cv2.imread(str(scene / "photos" / f"{view}.png"))[:, :, ::-1].transpose(2, 0, 1) / 255.0
        values.append(-10 * math.log10(np.mean((rendered.clip(0, 1) - photo) ** 2)))
    assert [view["name"] for view in metrics["views"]] == ["photos/00.png", "photos/08.png"]
    assert [view["psnr"] for view in metrics["views"]] == pytest.approx(values, abs=1e-4)  # worst seen 2e-6
    assert metrics["psnr"] == pytest.approx(np.mean(values), abs=1e-4)
    assert metrics["levels"]["0"]["psnr"] == pytest.approx(metrics["psnr"], abs=1e-12)
    assert metrics["levels"]["0"]["upsampled_psnr"] == pytest.approx(metrics["psnr"], abs=1e-12)
    assert 0 < metrics["ssim"] < 1
    assert f"{metrics['psnr']:.2f} dB" in output
    assert output.index("photos/00.png" if values[0] < values[1] else "photos/08.png") < output.index(
        "photos/08.png" if values[0] < values[1] else "photos/00.png"
    )


def test_eval_sums_what_training_recorded(run: Path) -> None:
    result = CliRunner(env={"COLUMNS": None, "FORCE_COLOR": None}).invoke(app, ["eval", str(run)])
    headings = "level size iterations seconds Gaussians peak PSNR upsampled"
    assert headings in [" ".join(line.split()) for line in result.stdout.splitlines()], "one line in a log"
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["split"] == "test"
    assert metrics["num_views"] == 2
    assert metrics["train_seconds"] == SECONDS[0] + SECONDS[1]
    assert metrics["num_gaussians"] == {"1": 250, "0": 200}
    assert metrics["peak_gaussians"] == 257
    overhead = dict(metrics["overhead_seconds"])
    assert overhead.pop("archive") > 0  # timed when the run folder was written
    assert overhead == {"pyramid": 0.625, "cache": 0.25}
    assert metrics["weighted_gaussians"] == pytest.approx((100 * 250 + 200 * 200) / 300)
    assert metrics["mean_gaussians"] == pytest.approx((100 * 130.5 + 200 * 110.25) / 300)
    assert metrics["breakdown_seconds"] == {"forward": 2.0, "loss": 0.75, "backward": 5.0, "other": 4.0}
    assert metrics["peak_memory_bytes"] == 5_000_000_000
    assert metrics["peak_memory_without_images_bytes"] == 3_000_000_000
    assert metrics["levels"]["1"]["memory_bytes"] == {"peak": 3_500_000_000, "images": 500_000_000}
    assert metrics["fps"] > 0
    assert metrics["levels"]["1"]["image_size"] == [28, 20]
    assert metrics["rasterizer"] == "cpu"
    assert metrics["versions"].keys() >= {"lapgs_plugin", "torch", "python"}
    assert RunArchive.open(run).metrics() == metrics


def test_lpips_is_measured_where_there_are_weights_and_said_where_not(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "nothing"))
    output = lapgs("eval", run)
    metrics = json.loads((run / "metrics.json").read_text())
    assert set(metrics["lpips_missing"]) == {"vgg", "vgg_3dgs"}
    assert output.count("LPIPS") == output.count("not measured") == 1  # no columns without figures
    (line,) = (line for line in output.splitlines() if line.startswith("LPIPS ("))
    assert line.startswith("LPIPS (vgg, vgg_3dgs) not measured: no weights; get them with: curl ")

    shapes = {f"features.{key}": value.shape for key, value in NETWORKS["alex"].layers().state_dict().items()}
    layers = {key: 0.05 * torch.randn(shape) for key, shape in shapes.items()}
    learned = {f"lin{k}.weight": torch.rand(1, c, 1, 1) for k, c in enumerate(NETWORKS["alex"].channels)}
    torch.save({**layers, **learned}, tmp_path / "alex.pth")
    output = lapgs("eval", run, "--lpips-weights", tmp_path / "alex.pth")
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["lpips_missing"] == {}
    assert metrics["lpips_alex"] == pytest.approx(np.mean([view["lpips_alex"] for view in metrics["views"]]))
    assert metrics["lpips_alex"] > 0
    assert "LPIPS (AlexNet)" in output
    refuses(UserInputError, "--lpips magic: expected none, or some of vgg", lapgs, "eval", run, "--lpips", "magic")


def test_without_held_out_views_eval_says_so(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, hold_out=False)
    assert "TRAINING" in lapgs("eval", run)
    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["split"], metrics["num_views"]) == ("train", 10)
    refuses(UserInputError, "nothing was held out", lapgs, "render", run, "--views", "test")


def test_a_scene_that_moved_is_given_by_option(scene: Path, tmp_path: Path) -> None:
    old = tmp_path / "old"
    shutil.copytree(scene, old)
    run = write_run(tmp_path / "run", old)
    old.rename(tmp_path / "new")
    for command in ("render", "eval"):
        with pytest.raises(RunFolderError, match="old, which is not there any more; say where it is now with --scene"):
            lapgs(command, run)
        lapgs(command, run, "--scene", tmp_path / "new")
        refuses(SceneError, "no such scene folder", lapgs, command, run, "--scene", tmp_path / "nowhere")
        refuses(SceneError, r"^--scene: .*neither a COLMAP", lapgs, command, run, "--scene", tmp_path)


@pytest.mark.parametrize("hold_out", [False, True])
def test_eval_says_that_views_are_of_another_scene(hold_out: bool, scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, hold_out=hold_out)
    others = write_scene(tmp_path / "others", [f"others/{i:02d}.png" for i in range(9)])
    output = lapgs("eval", run, "--scene", others)
    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["split"], metrics["num_views"]) == ("other", 9)
    assert "9 views of a scene that it was not trained on" in " ".join(output.split())
    assert "TRAINING" not in output
    assert comparison_rows([metrics])[0].label == "PSNR, another scene's views (dB)"
    shutil.copytree(scene, tmp_path / "copy")  # the same photos elsewhere
    lapgs("eval", run, "--scene", tmp_path / "copy")
    assert json.loads((run / "metrics.json").read_text())["split"] == ("test" if hold_out else "train")


def test_another_scene_is_told_where_photos_of_the_run_have_another_size_now(scene: Path, tmp_path: Path) -> None:
    own = tmp_path / "own"
    shutil.copytree(scene, own)
    run = write_run(tmp_path / "run", own)
    write_scene(own, size=(20, 16))
    lapgs("eval", run, "--scene", write_scene(tmp_path / "others", [f"others/{i:02d}.png" for i in range(9)]))
    assert json.loads((run / "metrics.json").read_text())["split"] == "other"


def test_what_a_run_learned_of_its_photos_is_not_used_for_photos_of_the_same_name(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene)
    others = write_scene(tmp_path / "others", [f"photos/{i:02d}.png" for i in range(1, 10)])  # at other poses
    lapgs("eval", run, "--scene", others)
    before = json.loads((run / "metrics.json").read_text())
    names = [f"photos/{i:02d}.png" for i in range(10) if i not in (0, 8)]
    (run / "level_0" / EXPOSURE).write_text(json.dumps({name: (1.5 * np.eye(3, 4)).tolist() for name in names}))
    (run / "level_0" / POSES).write_text(json.dumps({name: [0.1, 0.0, 0.0, 0.2, 0.0, 0.0] for name in names}))
    lapgs("eval", run, "--scene", others)
    after = json.loads((run / "metrics.json").read_text())
    assert before["split"] == after["split"] == "other"
    assert [view["psnr"] for view in after["views"]] == [view["psnr"] for view in before["views"]]
    ours, theirs = (run_cameras(RunArchive.open(run), folder)[0] for folder in (None, others))
    plain = load_cameras(others, resolution="full", eval=True)[0]
    for name, camera in theirs.items():
        assert torch.equal(camera.world_to_camera, plain[name].world_to_camera)
    moved = load_cameras(scene, resolution="full", eval=True)[0]["photos/02.png"]
    assert not torch.equal(ours["photos/02.png"].world_to_camera, moved.world_to_camera)


def test_training_views_are_not_said_to_have_the_exposure_of_their_neighbours(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, hold_out=False)
    learned = {f"photos/{i:02d}.png": (1.25 * np.eye(3, 4)).tolist() for i in range(10)}
    (run / "level_0" / EXPOSURE).write_text(json.dumps(learned))
    assert "exposure of its neighbours" not in " ".join(lapgs("eval", run).split())
    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["split"], metrics["exposure_compensated"], metrics["exposure_predicted"]) == ("train", True, False)


def test_pixels_outside_of_masks_change_no_psnr_of_any_level(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    run = write_run(tmp_path / "run", scene)
    inside = np.zeros((HEIGHT, WIDTH), np.uint8)
    inside[5:-9, 7:-15] = 255
    for photo in sorted((scene / "photos").iterdir()):
        (scene / "masks" / "photos").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(scene / "masks" / "photos" / photo.name), inside)
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["scene"]["masks"] = "masks"
    (run / "manifest.json").write_text(json.dumps(manifest))
    measured = []
    for outside in (None, 255):
        for photo in sorted((scene / "photos").iterdir()):
            image = read_image(photo).numpy().transpose(1, 2, 0)[..., ::-1] * 255
            image = image if outside is None else np.where(inside[..., None] > 0, image, outside)
            cv2.imwrite(str(photo), np.rint(image).astype(np.uint8))
        lapgs("eval", run)
        metrics = json.loads((run / "metrics.json").read_text())
        assert metrics["masked"]
        of_levels = [metrics["levels"][level][key] for level in "10" for key in ("psnr", "upsampled_psnr")]
        measured.append([metrics["psnr"], metrics["fitted_psnr"], *of_levels])
    np.testing.assert_allclose(*measured, atol=1e-3)


def test_another_scene_is_refused(run: Path, tmp_path: Path) -> None:
    other = write_scene(tmp_path / "other", size=(64, 48))
    with pytest.raises(RunFolderError, match=r"level 1 would be 32x24 pixels, the run was trained at 28x20"):
        lapgs("eval", run, "--scene", other)


@pytest.mark.parametrize("command", ["render", "eval"])
def test_a_folder_that_is_no_run_is_refused(command: str, tmp_path: Path) -> None:
    refuses(RunFolderError, "not a run", lapgs, command, tmp_path)


@pytest.mark.parametrize(("option", "value"), [("--views", "validation"), ("--format", "tga")])
def test_unknown_choices_name_the_known_ones(option: str, value: str, run: Path) -> None:
    refuses(UserInputError, f"{option} {value}: expected ", lapgs, "render", run, option, value)


def test_an_interruption_leaves_only_whole_images(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lapgs_plugin.scenes import images

    write, started = images.write_image, count()

    def interrupted(path: Path, image: object) -> None:
        if next(started) >= 4:  # counted before writing: several threads write at once
            raise KeyboardInterrupt
        write(path, image)

    monkeypatch.setattr(images, "write_image", interrupted)
    result = CliRunner().invoke(app, ["render", str(run)])
    assert result.exit_code != 0
    written = files_in(run / "renders")
    assert len(written) == 4
    for name in written:
        assert cv2.imread(str(run / "renders" / name)) is not None


@pytest.mark.parametrize("damage", ["cut short", "missing"])
def test_what_is_left_of_a_damaged_run_can_be_rendered(run: Path, damage: str) -> None:
    finest = run / "level_0" / "point_cloud.ply"
    contents = finest.read_bytes()
    finest.unlink()
    if damage == "cut short":
        finest.write_bytes(contents[:-5])
    with pytest.raises(RunFolderError, match=rf"level 0 of .*{damage}.*before it is whole: `lapgs render --level 1`"):
        lapgs("render", run)
    assert not (run / "renders").exists()
    lapgs("render", run, "--level", "1")
    assert files_in(run / "renders") == {"test/photos/00_base.png", "test/photos/08_base.png"}
    (run / "level_1" / "point_cloud.ply").unlink()
    line = refuses(RunFolderError, r"level 1 of .* is missing", lapgs, "render", run, "--level", "1")
    assert "whole" not in line


def test_frame_rates_are_printed_and_nothing_is_written(run: Path) -> None:
    before = files_in(run)
    printed = lapgs("render", run, "--fps")
    assert "medians over 2 cameras" in printed
    for words in (("levels 1 to 0, one after the other", "450"), ("base", "250"), ("residual 0 alone", "200")):
        assert any(all(word in line for word in words) for line in printed.splitlines()), words
    assert "100x60" in lapgs("render", run, "--fps", "--size", "100x60")
    refuses(UserInputError, "--format does not go with --fps", lapgs, "render", run, "--fps", "--format", "exr")
    assert files_in(run) == before
