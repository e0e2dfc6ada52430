"""Steps of several views have the gradients and statistics of single views, by stand-ins of gsplat on the CPU."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError, TrainingStoppedError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.ops.adam import ADAM_EPS, GpuFieldAdam, StepScale
from lapgs_plugin.ops.adam.in_torch import step_torch
from lapgs_plugin.ops.mixed_sizes import largest_size, stack_padded
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.image_store import ImageStore
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training import model as model_module
from lapgs_plugin.training.densification import Densifier
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import Densification, LearningRates, TrainSettings
from lapgs_plugin.training.strategies import GRADIENTS, Gradients
from tests.gsplat_on_cpu import GsplatOnCpu
from tests.training_runs import Said, StopAt, plys, resume, train
from tests.training_scene import blob_field, ring_camera, ring_scene

CAMERAS = [ring_camera(angle, 40, 29) for angle in (0.2, 1.3, 2.9)]
BACKGROUND = torch.tensor([0.1, 0.2, 0.3])
SETTINGS = TrainSettings(
    iterations=60,
    hierarchy="laplacian",
    sh_degree=1,
    sh_every=10,
    views_per_step="4",
    densification=Densification(start=3, until=45, every=10, reset_every=25),
)


def hand_over(place: Tensor) -> Callable[[Tensor], None]:
    def hook(leaf: Tensor) -> None:
        assert leaf.grad is not None
        place.copy_(leaf.grad)

    return hook


class Batching(CpuRasterizer):
    """Render several cameras on the CPU one by one, with one result, as gsplat does on a GPU.

    Args:
        holds: number of cameras that fit into its memory.
    """

    can_batch = True

    def __init__(self, holds: int = 8) -> None:
        super().__init__()
        self.holds = holds
        self.asked: list[tuple[int, tuple[int, int], int | None]] = []

    def render_batch(
        self,
        field: GaussianField,
        cameras: Sequence[Camera],
        *,
        background: Tensor,
        sh_degree: int | None = None,
        with_geometry: bool = True,
    ) -> RenderResult:
        assert len(cameras) > 1
        sizes = [camera.size for camera in cameras]
        assert self.mixes_sizes or len(set(sizes)) == 1
        warms_up = cameras[0].width == 16
        if not warms_up:
            self.asked.append((len(cameras), largest_size(sizes), sh_degree))
        if len(cameras) > self.holds and not warms_up:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        results = [self(field, camera, background=background, sh_degree=sh_degree) for camera in cameras]
        images = stack_padded([result.image for result in results])
        if not with_geometry:
            return RenderResult(images, None, results[0].radii[:0], results[0].means2d.detach()[:0])
        joined: Any = torch.stack([result.means2d.detach() for result in results])
        result = RenderResult(images, None, torch.stack([result.radii for result in results]), joined, None)
        if images.requires_grad:
            joined.grad = torch.zeros_like(joined)
            for row, one in enumerate(results):
                one.means2d.register_post_accumulate_grad_hook(hand_over(joined.grad[row]))
        return result


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene()


# ------------------------------------------------------------------------------------------------------------ gsplat


def leaves(field: GaussianField) -> GaussianField:
    return field.with_parameters({name: value.clone().requires_grad_() for name, value in field.parameters.items()})


@pytest.mark.usefixtures("gsplat_kernels")
@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize(("signed", "own_radii"), [(False, True), (True, False)])
def test_a_batch_by_gsplat_is_its_views(direct: bool, signed: bool, own_radii: bool) -> None:
    """Images, statistics of densification, and gradients, which are the sum of the views' own and the oracle's."""
    rasterizer = GsplatOnCpu(direct, own_radii=own_radii, absgrad=not direct)
    generator = torch.Generator().manual_seed(1)
    blobs = blob_field(80)
    logits = blobs.opacity_logits.clamp_max(3)  # below the 0.99 where the oracle caps alpha
    sh = torch.randn(80, 4, 3, generator=generator)
    field = replace(blobs.with_parameters({"opacity_logits": logits, "sh": sh}), signed=signed)
    weights = torch.randn(3, 3, 29, 40, generator=generator)
    together, alone, by_the_oracle = leaves(field), leaves(field), leaves(field)
    batch = rasterizer.render_batch(together, CAMERAS, background=BACKGROUND, sh_degree=1)
    (batch.image * weights).sum().backward()
    assert batch.means2d.grad is not None
    for row, camera in enumerate(CAMERAS):
        result = rasterizer(alone, camera, background=BACKGROUND, sh_degree=1)
        (result.image * weights[row]).sum().backward()
        oracle = OracleRasterizer(three_sigma_cut=False)(by_the_oracle, camera, background=BACKGROUND, sh_degree=1)
        (oracle.image * weights[row]).sum().backward()
        torch.testing.assert_close(batch.image[row], oracle.image, rtol=0, atol=1e-5)
        assert torch.equal(batch.radii[row], result.radii)
        pairs = [(batch.image, result.image), (batch.means2d, result.means2d)]
        pairs += [(batch.means2d.grad, result.means2d.grad)]  # type: ignore[list-item]
        if not direct:
            pairs += [(batch.absgrad2d, result.absgrad2d)]  # type: ignore[list-item]
        for found, expected in pairs:
            torch.testing.assert_close(found[row], expected, rtol=1e-4, atol=1e-4)
    for name, value in together.parameters.items():
        # Sums in another order: worst seen 3e-7 of the largest. Beyond the Jacobian's limit, where a Gaussian or two
        # are, gsplat's gradient by depth is not the oracle's: worst seen 9e-4, of the others 2e-6.
        for other, tolerance in ((alone, 1e-5), (by_the_oracle, 1e-2)):
            expected = other.parameters[name].grad
            assert expected is not None
            assert value.grad is not None
            assert float((value.grad - expected).abs().max() / expected.abs().max()) < tolerance, name
    plain = rasterizer.render_batch(together, CAMERAS, background=BACKGROUND, sh_degree=1, with_geometry=False)
    assert torch.equal(plain.image, batch.image)
    plain.image.sum().backward()
    nothing = field.with_parameters({name: value[:0] for name, value in field.parameters.items()})
    empty = rasterizer.render_batch(leaves(nothing), CAMERAS, background=BACKGROUND)
    assert torch.equal(empty.image, BACKGROUND[None, :, None, None].expand(3, 3, 29, 40))
    empty.image.sum().backward()


@pytest.mark.usefixtures("gsplat_kernels")
def test_a_camera_that_inference_mode_saw_first_can_be_trained_on() -> None:
    rasterizer, field = GsplatOnCpu(True), leaves(blob_field(20))
    with torch.inference_mode():
        rasterizer.render_image(field, CAMERAS[0], background=BACKGROUND)
    rasterizer.render_image(field, CAMERAS[0], background=BACKGROUND).sum().backward()
    assert field.means.grad is not None


def test_packed_renders_have_no_batches() -> None:
    assert not GsplatRasterizer("cpu", packed=True).can_batch
    assert not GsplatRasterizer("cpu").can_batch
    there = GsplatRasterizer("cpu")
    there._device = torch.device("cuda")  # as if there were a GPU
    assert there.can_batch


# ------------------------------------------------------------------------------------------------- loss, statistics


def test_the_loss_of_several_views_is_their_mean() -> None:
    generator = torch.Generator().manual_seed(0)
    prediction, target = (torch.rand(3, 3, 21, 34, generator=generator) for _ in range(2))
    for loss in (photometric_loss, photometric_loss_torch):
        one_by_one = [loss(*pair, 0.2) for pair in zip(prediction, target, strict=True)]
        torch.testing.assert_close(loss(prediction, target, 0.2), torch.stack(one_by_one).mean())


@pytest.mark.parametrize("absgrad", [False, True])
def test_statistics_of_a_batch_are_those_of_its_views(absgrad: bool) -> None:
    """Two launches of three and one views and a refinement, against the views one after the other."""
    density = Densification(start=2, until=60, every=4, reset_every=1000)
    options = Gradients(grow_grad2d=2e-4, absgrad=absgrad)
    settings = TrainSettings(iterations=100, densification=density)
    (stage,) = StagePlan.create((64, 48), 100, 1)
    schedule = StageSchedule.create(settings, stage)
    camera = replace(CAMERAS[0], width=64, height=48)
    generator = torch.Generator().manual_seed(3)
    n, b = 200, 4

    def result(rows: slice) -> RenderResult:
        means2d = torch.zeros_like(gradients[rows], requires_grad=True)
        means2d.grad = gradients[rows]
        outputs = [radii[rows], means2d, 2 * gradients[rows].abs()]
        if gradients[rows].shape[0] == 1:
            outputs = [radii[rows][0], torch.zeros(n, 2, requires_grad=True), outputs[2][0]]
            outputs[1].grad = gradients[rows][0]
        return RenderResult(torch.zeros(()), None, *outputs)

    gradients = 1e-3 * torch.randn(b, n, 2, generator=generator)
    radii = torch.randint(0, 4, (b, n), generator=generator, dtype=torch.int32)
    gradients[radii == 0] = 0
    fields = [TrainableField.create(blob_field(n), settings.learning_rates, 2.0) for _ in range(2)]
    ours, theirs = (Densifier(schedule, options, 2.0) for _ in range(2))
    torch.manual_seed(7)
    ours.accumulate(result(slice(0, 3)), camera)
    assert ours.after_step(fields[0], 4, result(slice(3, 4)), camera)
    torch.manual_seed(7)
    edited = [theirs.after_step(fields[1], i + 1, result(slice(i, i + 1)), camera) for i in range(b)]
    assert edited == [False, False, False, True]
    assert len(fields[0]) == len(fields[1]) != n
    for name, value in fields[0].params.items():
        assert torch.equal(value, fields[1].params[name]), name
    again = Densifier(schedule, options, 2.0), Densifier(schedule, options, 2.0)
    again[0].accumulate(result(slice(0, 4)), camera)
    for row in range(b):
        again[1].accumulate(result(slice(row, row + 1)), camera)
    for name in ("grad2d", "count"):
        torch.testing.assert_close(again[0].state[name], again[1].state[name], rtol=1e-6, atol=0)


# -------------------------------------------------------------------------------------------------------- the steps


@pytest.mark.parametrize("adam", ["ours", "torch's", "a GPU's"])
def test_steps_for_several_views_are_adams_with_scaled_rates(adam: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Grendel's: rate times sqrt(v), betas to the power of v, epsilon over sqrt(v), by the mean of the gradients; with
    moments in units of the mean, here in those of one view. In float64, for v that changes from step to step."""
    field = replace(blob_field(30), sh=torch.randn(30, 4, 3, generator=torch.Generator().manual_seed(4)))
    if adam == "a GPU's":
        monkeypatch.setattr(model_module, "_cpu_adam", GpuFieldAdam)
        monkeypatch.setitem(sys.modules, "lapgs_plugin.ops.adam.in_triton", SimpleNamespace(step_triton=step_torch))
    if adam == "torch's":
        model = TrainableField._in_two(field, LearningRates(), 4.0, False)
    else:
        model = TrainableField.create(field, LearningRates(), 4.0)
    generator = torch.Generator().manual_seed(5)
    expected = {name: param.detach().double() for name, param in model.params.items()}
    first, second = ({name: torch.zeros_like(value) for name, value in expected.items()} for _ in range(2))
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in model.optimizers.items()} | {"means": 1e-3}
    seen = 0
    for views in (4, 4, 1, 3, 8):
        sums = {name: torch.zeros_like(param) for name, param in model.params.items()}
        for _ in range(views):
            for name, param in model.params.items():
                weights = torch.randn(param.shape, generator=generator)
                (param * weights).sum().backward()
                sums[name] += weights
        model.step(1e-3, 4, scale=StepScale.of(views))
        seen += views
        for name, value in expected.items():
            mean = sums[name].double() / views
            root = math.sqrt(views)
            first[name] = 0.9**views * first[name] + (1 - 0.9**views) * mean * root
            second[name] = 0.999**views * second[name] + (1 - 0.999**views) * (mean * root) ** 2
            unbiased = first[name] / (1 - 0.9**seen), second[name] / (1 - 0.999**seen)
            scale = torch.ones(())
            if name == "sh":
                scale = torch.tensor([1.0, 0.05, 0.05, 0.05]).double()[:, None]
            # Of the mean's own moments: unbiased[0] / root, unbiased[1] / views and ADAM_EPS / root.
            step = (unbiased[0] / root) / ((unbiased[1] / views).sqrt() + ADAM_EPS / root)
            expected[name] = value - rates[name] * root * scale * step
        for name, value in expected.items():
            torch.testing.assert_close(model.params[name].detach().double(), value, rtol=1e-5, atol=2e-6)  # 4.2e-7 seen
    assert all(model.optimizers[name].param_groups[0]["lr"] == rate for name, rate in rates.items() if name != "means")
    assert model.optimizers["means"].param_groups[0]["lr"] == pytest.approx(1e-3 * math.sqrt(8))


# ------------------------------------------------------------------------------------------------------------- runs


def test_rendered_together_or_one_by_one_a_run_is_the_same(scene: Scene, tmp_path: Path) -> None:
    """With base and residual, joint training, gathered views, and an SH degree that rises within steps."""
    settings = replace(SETTINGS, iterations=340, joint=0.1, accumulate_views=2, sh_every=50)
    batching = Batching()
    runs = [
        train(tmp_path / name, scene, settings, each, test_every=1)
        for name, each in (("a", CpuRasterizer()), ("b", batching))
    ]
    histories = [[(e["level"], e["iteration"], e["num_gaussians"], e["psnr"]) for e in run.history()] for run in runs]
    assert len(histories[0]) == len(histories[1]) > 60
    for one, other in zip(*histories, strict=True):
        assert one[:2] == other[:2]
        if one[0] == 1 and one[1] < 40:  # sums in another order, until one makes a refinement differ
            assert one[2] == other[2]
            assert one[3] == pytest.approx(other[3], abs=1e-3)  # 1.2e-5 seen
    assert {count for count, _, _ in batching.asked} == {2, 3, 4}
    assert runs[0].manifest.complete
    assert runs[1].manifest.complete


@pytest.mark.parametrize("holds", [4, 2])  # in one launch, and in two
def test_regularization_counts_for_each_view_of_a_step(
    holds: int, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, own = [], TrainableField.step

    def step(model: TrainableField, *given: Any, **options: Any) -> None:
        if StepScale.of(4) in given:
            seen.append({name: (param.detach().clone(), param.grad.clone()) for name, param in model.params.items()})
        own(model, *given, **options)

    monkeypatch.setattr(TrainableField, "step", step)
    for weight in (0.0, 0.25):
        options = Gradients(opacity_regularization=weight, scale_regularization=2 * weight)
        settings = replace(
            SETTINGS,
            iterations=40,
            levels=1,
            accumulate_views=1,
            densification=Densification(GRADIENTS, options=options),
        )
        train(tmp_path / str(weight), scene, settings, Batching(holds))
        parameters = seen[0]
        seen.clear()
        logits, log_scales = (parameters[name][0].double().requires_grad_() for name in ("opacities", "scales"))
        sizes = log_scales.exp().mean() * 5 / scene.extent  # in fifths of the extent
        term = weight * logits.sigmoid().mean() + 2 * weight * sizes
        expected = torch.autograd.grad(4 * term, (logits, log_scales))
        if weight == 0.0:
            plain = parameters
            continue
        for name, wanted in zip(("opacities", "scales"), expected, strict=True):
            assert torch.equal(parameters[name][0], plain[name][0])
            added = parameters[name][1].double() - plain[name][1].double()
            torch.testing.assert_close(added, wanted, rtol=1e-5, atol=1e-9)  # 4e-7 seen
        assert torch.equal(parameters["means"][1], plain["means"][1])


def test_a_stopped_run_for_several_views_ends_where_an_uninterrupted_one_does(scene: Scene, tmp_path: Path) -> None:
    settings = replace(SETTINGS, joint=0.25, split="1/2,1/2")
    whole = train(tmp_path / "whole", scene, settings, test_every=1)
    ends = [entry["iteration"] for entry in whole.history() if entry["level"] == 1]
    assert ends[:4] == [4, 8, 10, 14]
    for level, iteration in ((1, 8), (0, 4), (0, 27)):
        folder = tmp_path / f"{level}-{iteration}"
        with pytest.raises(TrainingStoppedError, match=f"level {level}, iteration {iteration}"):
            train(folder, scene, settings, monitor=StopAt(level, iteration), test_every=1)
        assert settings_from_manifest(RunArchive.open(folder).manifest).for_manifest() == settings.for_manifest()
        archive = resume(folder, scene, settings, test_every=1)
        assert plys(archive) == plys(whole)
        assert [entry["loss"] for entry in archive.history()] == [entry["loss"] for entry in whole.history()]


def test_two_views_a_step_learn_what_one_learns(tmp_path: Path) -> None:
    scene = ring_scene(train=8)
    calm = Densification(start=20, until=200, every=20, reset_every=10_000)
    losses = {}
    for views in (1, 2):
        settings = replace(
            SETTINGS, levels=1, iterations=400, accumulate_views=1, views_per_step=str(views), densification=calm
        )
        archive = train(tmp_path / str(views), scene, settings)
        losses[views] = archive.history()[-1]["loss"]
        first = archive.history()[0]["loss"]
    assert losses[2] < 0.4 * first
    assert losses[2] < 1.25 * losses[1]  # 1.0 seen


class Counter(StageHook):
    """Record the calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int, str]] = []
        self.shapes: set[tuple[int, ...]] = set()
        self.cameras: dict[str, Camera] = {}

    def before_render(self, context: StageContext) -> None:
        assert context.field is None
        self.calls.append(("before_render", context.iteration, context.view))

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        self.calls.append(("compose", context.iteration, context.view))
        self.shapes |= {tuple(image.shape), tuple(context.target.shape)}
        return image

    def loss(self, context: StageContext, image: Tensor) -> Tensor | None:
        self.calls.append(("loss", context.iteration, context.view))
        assert context.field is not None
        assert context.field.gaussians.means.requires_grad
        self.cameras[context.view] = context.field.camera
        return None

    def after_backward(self, context: StageContext) -> None:
        self.calls.append(("after_backward", context.iteration, context.view))

    def on_densify(self, context: StageContext) -> None:
        assert context.field is None  # it is another one now
        self.calls.append(("on_densify", context.iteration, context.view))


@pytest.mark.parametrize("rasterizer", [CpuRasterizer(), Batching()], ids=["one by one", "together"])
def test_hooks_are_called_for_every_view_and_once_a_step(scene: Scene, tmp_path: Path, rasterizer: Rasterizer) -> None:
    settings = replace(SETTINGS, levels=1, iterations=20, densification=replace(SETTINGS.densification, until=15))
    counter = Counter()
    with_hook = train(tmp_path / "run", scene, settings, rasterizer, user_hooks=[counter])
    for name in ("before_render", "compose", "loss"):
        assert [i for what, i, _ in counter.calls if what == name] == list(range(1, 21)), name
    views = {name: [view for what, _, view in counter.calls if what == name] for name in ("before_render", "loss")}
    assert views["before_render"] == views["loss"]
    ends = [i for what, i, _ in counter.calls if what == "after_backward"]
    # Ten is a refinement, fourteen the last view with statistics, fifteen the end of densification; sixteen and
    # eighteen are where "multiview" would prune.
    assert ends == [4, 8, 10, 14, 15, 16, 18, 20]
    assert [i for what, i, _ in counter.calls if what == "on_densify"] == [10]
    assert counter.shapes == {(3, 40, 56)}
    assert {view.name for view in scene.train} == counter.cameras.keys()
    for view in scene.train:
        assert torch.equal(counter.cameras[view.name].world_to_camera, view.camera.world_to_camera)
    without = train(tmp_path / "without", scene, settings, rasterizer)
    for name, value in without.field(0).parameters.items():
        torch.testing.assert_close(with_hook.field(0).parameters[name], value, rtol=1e-3, atol=1e-4)  # 0 seen


def test_memory_that_runs_out_halves_the_views_of_a_launch(scene: Scene, tmp_path: Path) -> None:
    """One line is shown, and the run has the same result: steps take as many views."""
    settings = replace(SETTINGS, levels=1, views_per_step="4", iterations=30)
    lines, tight = Said(), Batching(holds=1)
    tight_run = train(tmp_path / "tight", scene, settings, tight, monitor=lines)
    assert [count for count, _, _ in tight.asked] == [4, 2]
    strategy, *halved = lines.lines
    assert strategy == "density control: --strategy 3dgs"
    assert len(halved) == 2
    assert halved[0].startswith("level 0: no memory for 4 views at once; from here on 2 are rendered together")
    assert plys(tight_run) == plys(train(tmp_path / "one", scene, settings))

    class Full(CpuRasterizer):
        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    with pytest.raises(DeviceMemoryError):
        train(tmp_path / "full", scene, settings, Full())


def test_views_of_several_sizes_are_rendered_by_size(tmp_path: Path) -> None:
    upright = ring_scene(train=6, test=0, size=(40, 56))
    lying = ring_scene(train=6, test=0)
    mixed = replace(
        lying,
        train=(*lying.train[:4], *(replace(view, name="up_" + view.name) for view in upright.train[:2])),
    )
    settings = replace(
        SETTINGS,
        **{"levels": 1, "views_per_step": "6", "iterations": 24, "sh_every": 99, "prune": 0.01},
        densification=Densification(until=0),
    )
    lines, batching = Said(), Batching()
    train(tmp_path / "run", mixed, settings, batching, monitor=lines)
    # Two whole epochs come before anything ends a step early.
    assert {(count, size) for count, size, _ in batching.asked[:4]} == {(4, (56, 40)), (2, (40, 56))}
    assert any("views have 2 groups of similar sizes, and those of one group are" in line for line in lines.lines)
    assert "--prune 0.01: level 0 is not pruned: no densification ends in its iterations" in lines.lines


def test_launches_stay_small_where_images_are_large(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lapgs_plugin.training.launches.PIXELS_OF_A_LAUNCH", 3 * 56 * 40)
    settings = replace(
        SETTINGS, levels=1, views_per_step="4", iterations=8, accumulate_views=1, densification=Densification(until=0)
    )
    batching = Batching()
    train(tmp_path / "run", scene, settings, batching)
    assert {count for count, _, _ in batching.asked} == {2}


# ----------------------------------------------------------------------------------------------------------- images


@pytest.mark.parametrize("where", ["memory", "disk"])
@pytest.mark.parametrize("precision", ["float32", "float16", "uint8"])
def test_a_batch_of_images_is_the_single_images(where: str, precision: str, tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    photos = [(torch.rand(3, 6, 9, generator=generator) * 255).round() / 255 for _ in range(2)]
    images = [*photos, 3 * torch.randn(3, 6, 9, generator=generator)]
    with ImageStore(where, precision, folder=tmp_path / "store") as store:
        raised = UpsampledImages(store, Pyramid())
        for index, image in enumerate(images):
            raised.put(str(index), image, (12, 18))
        for names in (["0", "1"], ["1", "2"]):
            for name in names:
                store.prefetch(name)
            assert torch.equal(store.get(*names), torch.stack([store.get(name) for name in names]))
            assert torch.equal(raised.get(*names), torch.stack([raised.get(name) for name in names]))
