"""Test residuals in a run of each stub: the loss's images, the rendered images, and resuming."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.rendering.run import run_renderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CACHE
from lapgs_plugin.scenes import load_scene
from tests.contract.stub_runs import (
    HALF,
    ITERATIONS,
    KINDS,
    NAMES,
    SHORT,
    STUBS,
    Result,
    StopAt,
    captured,
    composed_psnr,
    drive,
    drive_residuals,
    edited_graphdeco,
    loaded,
    run_residuals,
)

Run = tuple[RunArchive, Result]


@pytest.fixture(scope="module")
def run_of(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Run]:
    """Run a stub with two levels once; the checkout saves and reports at the end of a stage, and finished fields are
    frozen."""
    runs: dict[str, Run] = {}

    def run(name: str) -> Run:
        if name not in runs:
            folder = tmp_path_factory.mktemp(name) / "run"
            more = ("--test_iterations", ITERATIONS, "--save_iterations", 30)
            runs[name] = run_residuals(STUBS[name], scene, folder, *more, joint=0.0)
        return runs[name]

    return run


@pytest.mark.parametrize("name", NAMES)
def test_two_levels_are_trained_and_archived(name: str, run_of: Callable[[str], Run]) -> None:
    archive, _ = run_of(name)
    base, residual = archive.manifest.records
    assert (base.level, base.signed, base.iterations, base.image_size) == (1, False, 30, (32, 24))
    assert (residual.level, residual.signed, residual.iterations, residual.image_size) == (0, True, 60, (64, 48))
    for record in (base, residual):
        field = archive.field(record.level)
        assert len(field) == record.num_gaussians > 300, "density control is the backbone's"
        assert record.peak_gaussians >= record.num_gaussians
        assert record.train_seconds > 0
    assert archive.manifest.settings["backbone"]["name"] == name
    assert not archive.path(CACHE).exists()


@pytest.mark.parametrize("name", NAMES)
def test_each_level_has_what_the_backbone_writes_for_a_model(name: str, run_of: Callable[[str], Run]) -> None:
    archive, _ = run_of(name)
    for level, iteration in ((1, 30), (0, 60)):
        folder = archive.path(f"level_{level}")
        assert {"cfg_args", "cameras.json", "input.ply"} <= {path.name for path in folder.iterdir()}
        assert len(json.loads((folder / "cameras.json").read_text())) == 12
        saved = GaussianField.load_ply(folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply")
        field = archive.field(level)
        for part in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
            assert torch.equal(getattr(saved, part), getattr(field, part)), part


@pytest.mark.parametrize("name", ["taming", "graphdeco"])
def test_the_archive_renders_what_the_checkout_reported(name: str, run_of: Callable[[str], Run]) -> None:
    """The checkout's own report of held-out views equals a rendering of the PLYs without its code."""
    archive, result = run_of(name)
    (reported,) = [float(line.split()[-1]) for line in result.lines if "Evaluating test" in line]
    assert composed_psnr(archive) == pytest.approx(reported, abs=1e-3)  # 5e-5 seen: predictions are float16


class Recorder(StageHook):
    """Keep the contexts of hooks in the last iterations of each stage."""

    def __init__(self) -> None:
        self.contexts: dict[int, list[tuple[StageContext, Tensor]]] = {}

    def loss(self, context: StageContext, image: Tensor) -> None:
        self.contexts.setdefault(context.stage.level, []).append((context, image.detach().clone()))


@pytest.fixture(scope="module")
def recorded(big: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunArchive, Recorder]:
    """Run three levels whose fields hardly move: the tests are about the images of the loss, not about quality."""
    recorder = Recorder()
    folder = tmp_path_factory.mktemp("recorded") / "run"
    more = ("--densify_until_iter", 0, "--iterations", 12)
    archive, _ = run_residuals(STUBS["graphdeco"], big, folder, *more, levels=3, hooks=(recorder,), joint=0.0)
    return archive, recorder


def test_three_levels_with_sizes_rounded_up(recorded: tuple[RunArchive, Recorder]) -> None:
    records = recorded[0].manifest.records
    assert [(r.level, r.signed, r.image_size) for r in records] == [
        (2, False, (24, 17)),
        (1, True, (48, 33)),
        (0, True, (96, 66)),
    ]
    assert sum(r.iterations for r in records) == 12


def test_targets_are_the_levels_of_the_photos(recorded: tuple[RunArchive, Recorder], big: Path) -> None:
    photos = {view.name: view.image for view in load_scene(big, progress=False).train}
    pyramid = Pyramid("camera")
    for level, told in recorded[1].contexts.items():
        for context, image in told:
            target = pyramid.gaussian(photos[context.view], level + 1)[level]
            assert image.shape == context.target.shape == target.shape
            assert (context.target - target).abs().max() < 5e-4  # 2.4e-4 seen: float16


def test_composed_images_build_on_the_finished_levels(recorded: tuple[RunArchive, Recorder], big: Path) -> None:
    """The upsampled prediction is that of the archived levels, rendered without the checkout's code."""
    archive, recorder = recorded
    renderer = run_renderer(archive, device="cpu", rasterizer="cpu")
    cameras = {view.name: view.camera for view in load_scene(big, progress=False).train}
    pyramid = Pyramid("camera")
    for level in (1, 0):
        context, image = recorder.contexts[level][0]
        height, width = context.target.shape[1:]
        below = pyramid.up(renderer.render(cameras[context.view], level + 1).composed[level + 1], (height, width))
        assert context.accumulated is not None
        difference = (context.accumulated - below).abs()
        assert difference.flatten().quantile(0.98) < 2e-3  # 3.8e-4 seen, of all pixels: float16
        assert difference.max() < 0.02  # on another processor a pixel at 1/255 may differ
        # Inherited geometry without colour renders zeros, so the first composed image is the upsampled prediction.
        assert torch.equal(image, context.accumulated)


@pytest.mark.parametrize("name", ["fastgs", "taming"])
def test_score_functions_compare_composed_images(name: str, scene: Path, tmp_path: Path) -> None:
    """The function that makes error maps gets the images to check, in both stages."""
    seen: dict[tuple[int, ...], list[float]] = {}
    module, function = {"fastgs": ("fast_utils", "get_loss"), "taming": ("taming_utils", "get_loss_map")}[name]
    with captured(tmp_path, []), loaded(STUBS[name], scene, tmp_path / "run", *HALF) as adapter:
        utils = sys.modules[f"utils.{module}"]
        original = getattr(utils, function)

        def spy(image: Tensor, photo: Tensor, *others: Any) -> Tensor:
            assert image.shape == photo.shape
            seen.setdefault(tuple(photo.shape), []).append(float((image - photo).abs().mean() / photo.mean()))
            return original(image, photo, *others)

        setattr(utils, function, spy)
        drive_residuals(adapter)
    assert seen.keys() == {(3, 24, 32), (3, 48, 64)}
    # A bare residual would be off by the photo itself: 1. Composed ones were off by 0.30 to 0.40.
    assert max(sum(values) / len(values) for values in seen.values()) < 0.6


def test_one_level_of_fastgs(scene: Path, tmp_path: Path) -> None:
    """Numbers in its training function are scaled, so `test_run_off` compares those of the others."""
    archive, _ = run_residuals(STUBS["fastgs"], scene, tmp_path / "run", *SHORT, levels=1)
    assert archive.available_levels == (0,)


@pytest.mark.parametrize(
    ("name", "supervision"), [*((name, "gt_laplacian") for name in NAMES), ("graphdeco", "online_residual")]
)
def test_ablations_compare_the_residual_alone(name: str, supervision: str, scene: Path, tmp_path: Path) -> None:
    """The checkout's L1 gets the images to check, at the first iteration of the second stage."""
    compared: list[tuple[Tensor, Tensor]] = []
    recorder = Recorder()
    with captured(tmp_path, []), loaded(STUBS[name], scene, tmp_path / "run", *SHORT) as adapter:
        original = adapter.train.l1_loss

        def spy(image: Tensor, target: Tensor) -> Tensor:
            compared.append((image.detach().clone(), target.clone()))
            return original(image, target)

        adapter.train.l1_loss = spy
        drive_residuals(adapter, hooks=(recorder,), supervision=supervision)
    image, target = next(pair for pair in compared if pair[0].shape == (3, 48, 64))
    assert not image.any(), "a residual without colour, not composed"
    context, told = recorder.contexts[0][0]
    (photo,) = [
        view.image for view in load_scene(scene, progress=False).train if view.name.startswith(Path(context.view).stem)
    ]
    assert context.accumulated is not None
    assert torch.equal(told, context.accumulated), "hooks see composed images"
    assert (context.target - photo).abs().max() < 5e-4, "and I^l"  # 0 seen
    below = context.accumulated
    if supervision == "gt_laplacian":
        pyramid = Pyramid("camera")
        below = pyramid.up(pyramid.gaussian(photo, 2)[1], (48, 64))
        assert context.coarse_target is not None
        assert (context.coarse_target - below).abs().max() < 5e-4  # 2.4e-4 seen: float16
    assert (target - (photo - below)).abs().max() < 5e-4  # 1.2e-4 seen: float16


@pytest.mark.parametrize(("name", "inherit"), [*((name, "geometry") for name in NAMES), ("graphdeco", "xyz")])
def test_a_residual_starts_from_the_field_before(name: str, inherit: str, scene: Path, tmp_path: Path) -> None:
    """The checkout's model is as inherited at the first iteration of the second stage; `test_run_fields` has "full"."""
    at_start: list[dict[str, Tensor]] = []
    parts = ("_xyz", "_rotation", "_scaling", "_opacity", "_features_dc")
    with captured(tmp_path, []), loaded(STUBS[name], scene, tmp_path / "run", *SHORT) as adapter:
        model = adapter.train.GaussianModel
        original = model.training_setup

        def spy(self: Any, training_args: Any) -> None:
            at_start.append({part: getattr(self, part).detach().clone() for part in parts})
            original(self, training_args)

        model.training_setup = spy
        drive_residuals(adapter, inherit=inherit, joint=0.0)
    archive = RunArchive.open(tmp_path / "run")
    field = archive.field(1)
    started = at_start[1]
    assert torch.equal(started["_xyz"], field.means)
    same_shape = torch.equal(started["_scaling"], field.log_scales) and torch.equal(
        started["_opacity"][:, 0], field.opacity_logits
    )
    assert same_shape == (inherit == "geometry")
    assert not started["_features_dc"].any(), "no colour: an empty residual"
    if inherit == "xyz":
        assert torch.sigmoid(started["_opacity"]).allclose(torch.tensor(0.1))


@pytest.mark.parametrize("name", NAMES)
def test_a_run_stopped_between_stages_goes_on(
    name: str, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt), caplog.at_level("INFO", "lapgs_plugin"):
        run_residuals(STUBS[name], scene, folder, *SHORT, hooks=(StopAt(0),), joint=0.0)
    assert caplog.messages[-1] == f"stopped; finished levels in {folder}: 1; --resume continues after them"
    stopped = RunArchive.open(folder)
    assert stopped.available_levels == (1,)
    base = stopped.field_path(1).read_bytes()
    archive, result = run_residuals(STUBS[name], scene, folder, *SHORT, resume=True, joint=0.0)
    assert archive.available_levels == (1, 0)
    assert archive.field_path(1).read_bytes() == base
    assert result.output.count("Number of points at initialisation") == 1, "only the second stage was trained"


class StopInside(StageHook):
    """Press Ctrl-C at an iteration of a stage."""

    def __init__(self, level: int, iteration: int) -> None:
        self._place = (level, iteration)

    def before_render(self, context: StageContext) -> None:
        if (context.stage.level, context.iteration) == self._place:
            raise KeyboardInterrupt


@pytest.mark.parametrize("hierarchy", KINDS)
def test_a_script_that_uses_what_training_returns_ends_there_when_its_run_is_finished(
    hierarchy: str, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    script = edited_graphdeco(tmp_path / "own", "train.py", "\n    training(\n", "\n    trained = training(\n")
    text = script.read_text(encoding="utf-8")
    for old, new in (
        ("\n\n\ndef prepare_output", "\n    return gaussians\n\n\ndef prepare_output"),
        ('print("\\nTraining complete.")', 'print(len(trained.get_xyz), "trained")'),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    script.write_text(text, encoding="utf-8")
    results: list[Result] = []
    for resume in (False, True):
        caplog.clear()
        folder = tmp_path / "run"
        with (
            caplog.at_level("INFO", "lapgs_plugin"),
            captured(folder, results),
            loaded(STUBS["graphdeco"], scene, folder, *SHORT, script=script) as adapter,
        ):
            drive(adapter, hierarchy=hierarchy, resume=resume)
        line = "training() was not called, so that train.py ends here: what follows may use its result"
        assert (line in caplog.messages) == resume
        assert (" trained" in results[-1].output) != resume


def noted(archive: RunArchive) -> list[tuple[int, int, set[str]]]:
    """Return the place in the run of each history entry, and its values."""
    return [(entry["level"], entry["iteration"], set(entry)) for entry in archive.history()]


def test_a_run_stopped_inside_stages_has_the_history_of_a_whole_one(
    scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A run is stopped in both stages, and resumed once more when it is complete."""
    folder = tmp_path / "run"

    def train(*hooks: StageHook, folder: Path = folder, resume: bool = True) -> RunArchive:
        short = ("--iterations", 30, "--densify_from_iter", 0, "--densification_interval", 3)
        return run_residuals(STUBS["graphdeco"], scene, folder, *short, hooks=hooks, resume=resume, test_every=4)[0]

    whole = noted(train(folder=tmp_path / "whole", resume=False))
    for level, iteration in ((1, 7), (0, 15)):
        with captured(folder, []), pytest.raises(KeyboardInterrupt):
            train(StopInside(level, iteration), resume=level == 0)
        assert noted(RunArchive.open(folder))[-1][:2] == (level, iteration), "entries that are to be dropped"
    for finished in (False, True):
        with caplog.at_level("INFO", "lapgs_plugin"):
            archive = train()
        assert (f"the run in {folder} is finished: nothing is left to train" in caplog.messages) == finished
        assert noted(archive) == whole
        elapsed = [entry["elapsed"] for entry in archive.history() if "elapsed" in entry]
        assert elapsed == sorted(elapsed)
