"""The choice of rasterizer and device, and the parts of training on a GPU that do not need one."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gsplat
import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import (
    DeviceMemoryError,
    MissingExtraError,
    RunFolderError,
    TrainingDivergedError,
    UserInputError,
)
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.ops.adam import GpuFieldAdam
from lapgs_plugin.rasterizers.gsplat import rasterizer as gsplat_adapter
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.reference_raster import gsplat as gsplat_on_cpu
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.level_images import ImageStores, LevelImages
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training import backend
from lapgs_plugin.training import model as model_module
from lapgs_plugin.training.backend import choose_rasterizer, training_rasterizer
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.settings import Densification, LearningRates, TrainSettings
from lapgs_plugin.training.stage import StageRun
from lapgs_plugin.training.strategies import Gradients, Mcmc
from tests.training_runs import plys, ring_manifest, train
from tests.training_scene import blob_field, ring_scene

SETTINGS = TrainSettings(
    iterations=60,
    hierarchy="laplacian",
    sh_degree=1,
    sh_every=10,
    densification=Densification(start=3, until=45, every=5, reset_every=12),
    split="1/2,1/2",
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene()


def losses(archive: RunArchive) -> list[tuple[int, int, float]]:
    return [(entry["level"], entry["iteration"], entry["loss"]) for entry in archive.history()]


# ------------------------------------------------------------------------------------------------------- the choice


def test_gsplat_trains_if_there_is_a_gpu_and_nothing_falls_back_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(backend, "driver_version", lambda: "")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert choose_rasterizer("auto") == "cpu"
    monkeypatch.setattr(backend, "driver_version", lambda: "470.10")
    for build, words in (("13.0", "which is built for CUDA 13.0, cannot use it"), (None, "built without CUDA, cannot")):
        monkeypatch.setattr(torch.version, "cuda", build)
        with pytest.raises(MissingExtraError, match=f"driver 470.10, and PyTorch .*{words}.*--rasterizer cpu does"):
            choose_rasterizer("auto")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
    assert choose_rasterizer("auto") == "cpu", "the GPU was hidden on purpose"
    with pytest.raises(MissingExtraError, match="PyTorch finds no CUDA device"):
        training_rasterizer("gsplat", SETTINGS)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gsplat_adapter, "missing", lambda **options: "there is no nvcc")
    with pytest.raises(MissingExtraError, match=r"there is no nvcc.*--rasterizer cpu does without"):
        choose_rasterizer("auto")
    assert choose_rasterizer("cpu") == "cpu"
    monkeypatch.setattr(gsplat_adapter, "missing", lambda **options: "")
    assert choose_rasterizer("auto") == "gsplat"
    monkeypatch.setattr(gsplat_adapter, "gsplat_missing", lambda: "there is no nvcc")
    with pytest.raises(MissingExtraError, match=r"--sparse-adam is gsplat's: there is no nvcc; .*leave it out"):
        training_rasterizer("gsplat", replace(SETTINGS, sparse_adam=True))
    placed = training_rasterizer("gsplat", SETTINGS)
    assert (placed.rasterizer.name, placed.device.type) == ("gsplat", "cuda")


def test_options_of_gsplat_are_refused_elsewhere() -> None:
    settings = replace(SETTINGS, packed=True, antialiased=True)
    with pytest.raises(UserInputError, match="--antialiased, --packed with --rasterizer cpu: only gsplat"):
        training_rasterizer("cpu", settings)
    with pytest.raises(UserInputError, match="gpu: expected memory or disk"):
        training_rasterizer("cpu", replace(SETTINGS, images_on="gpu"))


def test_settings_survive_the_manifest() -> None:
    strategy = Densification(start=3, until=45, every=5, strategy="mcmc", options=Mcmc(cap_max=500))
    settings = replace(SETTINGS, densification=strategy, packed=True, antialiased=True)
    manifest = ring_manifest(settings, "gsplat")
    assert settings_from_manifest(manifest).for_manifest() == settings.for_manifest()
    saved = manifest.settings["densification"]
    for damaged, message in (
        ({"densification": {**saved, "strategy": []}}, r"densification.strategy is \[\], expected a valid string"),
        (
            {"densification": {**saved, "options": {"cap_max": "many"}}},
            "mcmc is damaged: cap_max is 'many', expected a valid",
        ),
        ({"inherit_ratio": 0.5}, r"settings inherit_ratio do not match\); continue it with lapgs_plugin"),
    ):
        with pytest.raises(RunFolderError, match=message):
            settings_from_manifest(replace(manifest, settings={**manifest.settings, **damaged}))


# --------------------------------------------------------------------------------------- gsplat's functions on a CPU


def test_a_run_on_gsplat_learns_what_a_run_on_the_cpu_learns(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gsplat, "spherical_harmonics", gsplat_on_cpu.spherical_harmonics)

    def rasterization(*args: Any, near_plane: float, **kwargs: Any) -> Any:
        image, alpha, info = gsplat_on_cpu.rasterization(*args, **kwargs)
        centres = info["means2d"]
        # gsplat's centres are inside of the graph and have hooks; the stand-in's are a leaf that is written to.
        centres.register_hook = lambda hook: hooks.append(lambda: hook(centres.grad))
        return image, alpha, {**info, "conics": torch.ones(1, len(args[0]), 3)}

    hooks: list[Any] = []
    monkeypatch.setattr(gsplat, "rasterization", rasterization)

    class Deliver(StageHook):
        """Call the hooks of gsplat's centres after the backward pass."""

        def before_render(self, context: StageContext) -> None:
            hooks.clear()  # of renders that were not trained on

        def after_backward(self, context: StageContext) -> None:
            if hooks:  # as long as there is density control
                hooks.pop()()

    settings = replace(SETTINGS, iterations=20, densification=replace(SETTINGS.densification, until=4))
    theirs = train(
        tmp_path / "theirs", scene, settings, GsplatRasterizer("cpu", own_radii=True), user_hooks=[Deliver()]
    )
    ours = train(tmp_path / "ours", scene, settings)
    assert theirs.manifest.records[0].num_gaussians == ours.manifest.records[0].num_gaussians
    for (*place, loss), (*expected_place, expected) in zip(losses(theirs), losses(ours), strict=True):
        assert place == expected_place
        assert loss == pytest.approx(expected, rel=2e-4)  # worst seen 1.3e-5


def test_absolute_gradients_densify_more(scene: Scene, tmp_path: Path) -> None:
    """They do not cancel, so more Gaussians are above the same threshold."""
    counts = []
    for absgrad in (False, True):
        density = replace(
            SETTINGS.densification, reset_every=1000, options=Gradients(grow_grad2d=2e-4, absgrad=absgrad)
        )
        archive = train(tmp_path / f"{absgrad}", scene, replace(SETTINGS, densification=density))
        counts.append(archive.manifest.records[0].num_gaussians)
    assert counts[1] > counts[0]


def test_losses_that_are_read_together_are_the_same(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once = train(tmp_path / "a", scene, SETTINGS)
    monkeypatch.setattr(StageRun, "_reads_late", True)
    monkeypatch.setattr("lapgs_plugin.training.stage.LOSSES_READ_EVERY", 7)
    later = train(tmp_path / "b", scene, SETTINGS)
    assert losses(later) == losses(at_once)
    assert plys(later) == plys(at_once)

    class Poison(StageHook):
        def loss(self, context: StageContext, image: Tensor) -> Tensor | None:
            return image.sum() * math.nan if (context.stage.level, context.iteration) == (0, 23) else None

    with pytest.raises(TrainingDivergedError, match="level 0, iteration 23: the loss is nan"):
        train(tmp_path / "c", scene, SETTINGS, user_hooks=[Poison()])


def test_a_full_gpu_is_one_line(scene: Scene, tmp_path: Path) -> None:
    class Full(CpuRasterizer):
        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            if args[0].signed:
                raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
            return super().__call__(*args, **kwargs)

    with pytest.raises(DeviceMemoryError, match=r"no memory left at level 0; finished levels .* are kept"):
        train(tmp_path / "run", scene, SETTINGS, Full())
    assert RunArchive.open(tmp_path / "run").available_levels == (1,)


# ---------------------------------------------------------------------------------------------------- the optimizers


def stepped(model: TrainableField, steps: int = 5) -> TrainableField:
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        for value in model.field.parameters.values():
            weights = torch.randn(value.shape, generator=generator)
            (value * weights).sum().backward()
        model.step(1e-3, (model.field.sh_degree + 1) ** 2)
    return model


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("signed", [False, True])
def test_steps_on_a_gpu_are_those_on_a_cpu(degree: int, signed: bool) -> None:
    """By PyTorch's fused Adam, which a CPU has, too."""
    field = replace(blob_field(20), sh=torch.randn(20, (degree + 1) ** 2, 3), signed=signed)
    ours = stepped(TrainableField.create(field, LearningRates(), 4.0))
    theirs = stepped(TrainableField._in_two(field, LearningRates(), 4.0, sparse=False))
    for name, value in theirs.field.parameters.items():
        # Rounding of five steps; worst seen 6e-7.
        torch.testing.assert_close(value, ours.field.parameters[name], rtol=0, atol=1e-5)
        assert not torch.equal(value, field.parameters[name])


@pytest.mark.parametrize("signed", [False, True])
def test_a_factor_scales_the_steps_of_higher_harmonics_alone(signed: bool) -> None:
    """Adam's first step is as long as its rate, whatever the gradient."""
    field = replace(blob_field(20), sh=torch.randn(20, 4, 3), signed=signed)
    moved = {}
    for factor in (None, 1.0, 8.0):
        for make in (TrainableField.create, lambda *given: TrainableField._in_two(*given, sparse=False)):
            model = make(field, LearningRates(), 4.0)
            model.field.sh.square().sum().backward()  # type: ignore[no-untyped-call]  # torch's
            for value in model.params.values():
                value.grad = torch.ones_like(value) if value.grad is None else value.grad
            model.step(1e-3, 4, *([] if factor is None else [factor]))
            moved.setdefault(factor, []).append(model.field.sh.detach() - field.sh)
    rate = LearningRates().residual_sh if signed else LearningRates().sh
    for one, plain, eightfold in zip(moved[None], moved[1.0], moved[8.0], strict=True):
        assert torch.equal(one, plain), "a factor of 1 changes no bit"
        torch.testing.assert_close(plain[:, 1:].abs(), torch.full((20, 3, 3), rate / 20), rtol=2e-3, atol=0)
        torch.testing.assert_close(eightfold[:, 1:], 8 * plain[:, 1:], rtol=2e-3, atol=0)  # worst seen 3e-4
        assert torch.equal(eightfold[:, 0], plain[:, 0])


def test_a_base_with_fewer_harmonics_is_composed(scene: Scene, tmp_path: Path) -> None:
    settings = replace(SETTINGS, sh_degree=2, base_sh_degree=1, joint=0.5, sh_rate_factor=4.0)
    archive = train(tmp_path / "run", scene, settings)
    assert [archive.field(level).sh_degree for level in (1, 0)] == [1, 2]
    assert all(bool((archive.field(level).sh[:, 1:] != 0).any()) for level in (1, 0))
    assert archive.history()[-1]["psnr"] > archive.history()[0].get("psnr", 0)
    assert settings_from_manifest(archive.manifest).for_manifest() == settings.for_manifest()


@pytest.mark.parametrize("adam", ["ours", "a GPU's"])
def test_moments_follow_sh_from_one_tensor_to_two_and_back(adam: str, monkeypatch: pytest.MonkeyPatch) -> None:
    field = replace(blob_field(20), sh=torch.randn(20, 4, 3))
    in_one = stepped(TrainableField.create(field, LearningRates(), 4.0))
    in_two = TrainableField._in_two(field, LearningRates(), 4.0, sparse=False)
    if adam == "a GPU's":
        monkeypatch.setattr(model_module, "_cpu_adam", GpuFieldAdam)
    back = TrainableField.create(field, LearningRates(), 4.0)
    in_two.adopt_moments(in_one.optimizer_moments(), torch.arange(20))
    assert set(in_two.optimizer_moments()) == {"means", "quats", "scales", "opacities", "sh0", "shN"}
    back.adopt_moments(in_two.optimizer_moments(), torch.arange(20))
    for name, state in in_one.optimizer_moments().items():
        for key, value in state.items():
            assert torch.equal(back.optimizer_moments()[name][key], value), (name, key)


def test_a_gpus_state_is_continued() -> None:
    field = replace(blob_field(20), sh=torch.randn(20, 4, 3))
    whole = stepped(TrainableField._in_two(field, LearningRates(), 4.0, sparse=False))
    copy = TrainableField._in_two(whole.field, LearningRates(), 4.0, sparse=False)
    copy.adopt_moments(whole.optimizer_moments(), torch.arange(len(whole)))
    for model in (whole, copy):
        stepped(model, 3)
    for name, value in whole.field.parameters.items():
        assert torch.equal(value, copy.field.parameters[name])


# ------------------------------------------------------------------------------------------------------- the images


@pytest.mark.parametrize("level", [0, 1])
def test_stored_images_are_the_targets(scene: Scene, level: int) -> None:
    eight_bit = tuple(replace(view, image=(view.image * 255).round() / 255) for view in scene.train)
    stores = ImageStores([view.camera.size for view in eight_bit], torch.device("cpu"), True)
    held = LevelImages(stores, level, Pyramid(), with_coarse=level == 0, exact=True)
    stored = LevelImages(stores, level, Pyramid(), with_coarse=level == 0)
    for view in eight_bit:
        held.put(view.name, view.image)
        stored.put(view.name, view.image)
    for view in eight_bit:
        stored.prefetch(view.name)
        (target, coarse), (expected, expected_coarse) = stored.get(view.name), held.get(view.name)
        assert (expected_coarse is None) == (coarse is None) == (level == 1)
        if level == 0:
            assert torch.equal(target, expected)
            torch.testing.assert_close(coarse, expected_coarse, rtol=0, atol=2.5e-4)  # float16 below 1
        else:
            torch.testing.assert_close(target, expected, rtol=0, atol=2.5e-4)
    stored.close()
