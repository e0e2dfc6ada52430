"""Views of a level: attributes follow its size, and the wrapped renderers recognise a view however it gets there."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from multiprocessing.pool import ThreadPool
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lapgs_plugin.checkouts.level_views import SceneImages, make_level_view, view_key, view_name, without_depth
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.stage_rendering import GREY, StageRendering
from lapgs_plugin.runner.visible_rows import VisibleRows

WIDTH, HEIGHT = 8, 6


class Camera(nn.Module):
    """Has what cameras of forks have."""

    def __init__(self, name: str, data_device: str = "cuda") -> None:
        super().__init__()
        self.image_name = name
        self.original_image = torch.full((3, HEIGHT, WIDTH), 0.5, device=data_device)
        self.image_width, self.image_height, self.resolution = WIDTH, HEIGHT, (WIDTH, HEIGHT)
        self.focal_x, self.focal_y, self.Cx, self.FoVx = 10.0, np.float32(12.0), 4.0, 0.7
        self.fl_x, self.fl_y, self.cx, self.cy = 10.0, -1.0, 0.5, -1
        self.K = np.array([[10.0, 0, 4], [0, 12, 3], [0, 0, 1]])
        self.mask = torch.arange(HEIGHT * WIDTH).reshape(1, HEIGHT, WIDTH) % WIDTH < WIDTH // 2
        self.objects = torch.arange(HEIGHT * WIDTH, dtype=torch.uint8).reshape(HEIGHT, WIDTH)
        self.invdepthmap, self.depth_mask, self.depth_reliable = np.ones((HEIGHT, WIDTH), np.float32), None, True
        self.alpha_mask = torch.ones(1, HEIGHT, WIDTH)
        self.world_view_transform = torch.randn(4, 4, generator=torch.Generator().manual_seed(len(name)))


def made(name: str = "photo", **options: Any) -> tuple[Camera, SceneImages]:
    images, original = SceneImages(), Camera.__init__
    try:
        Camera.__init__ = images.adopting(original)  # type: ignore[method-assign,assignment]
        return Camera(name, **options), images
    finally:
        Camera.__init__ = original  # type: ignore[method-assign]


def test_cameras_may_be_made_in_several_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in forks that load photos in a pool: two cameras are being made at the same time here."""
    images, together, original = SceneImages(), threading.Barrier(2, timeout=20), Camera.__init__

    def make(camera: Camera, name: str, data_device: str = "cuda") -> None:
        together.wait()
        original(camera, name, data_device)
        together.wait()

    monkeypatch.setattr(Camera, "__init__", images.adopting(make))
    with ThreadPool(2) as pool:
        cameras = pool.map(Camera, ["a", "b"], chunksize=1)
    assert [view_name(images.key(camera)) for camera in cameras] == ["a", "b"]
    assert [images[images.key(camera)].size for camera in cameras] == [(WIDTH, HEIGHT)] * 2


def test_attributes_follow_the_size_of_the_level() -> None:
    camera, images = made()
    assert not hasattr(camera, "original_image"), "its image is in the store, and was never on a GPU"
    assert images[images.key(camera)].size == (WIDTH, HEIGHT)
    view = make_level_view(camera, (4, 3), lambda: torch.zeros(3, 3, 4))
    assert (view.image_width, view.image_height, view.resolution) == (4, 3, (4, 3))
    assert (view.focal_x, view.focal_y, view.Cx, view.FoVx) == (5.0, 6.0, 2.0, 0.7), "also a number of NumPy"
    assert (view.fl_x, view.fl_y, view.cx, view.cy) == (5.0, -1.0, 0.5, -1), "shares of an image, and unknown numbers"
    assert view.K.tolist() == [[5, 0, 2], [0, 6, 1.5], [0, 0, 1]]
    assert view.mask.tolist() == [[[True, True, False, False]] * 3]
    assert view.invdepthmap.shape == (3, 4)
    assert view.objects.dtype == torch.uint8
    assert set(view.objects.flatten().tolist()) < set(camera.objects.flatten().tolist()), "labels have no averages"
    assert (view.objects // WIDTH // 2 == torch.arange(3)[:, None]).all(), "each of its place"
    assert view.alpha_mask is None, "opaque"
    assert view.original_image.shape == (3, 3, 4)
    assert (camera.focal_x, camera.K[0, 0], camera.invdepthmap.shape) == (10.0, 10.0, (HEIGHT, WIDTH)), "unchanged"
    without_depth(view)
    assert (view.invdepthmap, view.depth_reliable) == (None, False)
    view.original_image = torch.ones(3, 3, 4)  # some checkouts move it to the GPU
    assert view.original_image.sum() == 36


def test_a_view_has_its_key_in_every_copy() -> None:
    camera, images = made()
    view = make_level_view(camera, (4, 3), lambda: torch.zeros(3, 3, 4))
    for one in (camera, view, copy.copy(view), copy.deepcopy(view)):
        assert view_key(one) == images.key(camera)
    assert [view_key(other) for other in (None, torch.zeros(3), SimpleNamespace(lapgs_key=3))] == [None] * 3


class Settings(NamedTuple):
    """Settings of a fork's rasterizer, under names of its own."""

    image_height: int
    image_width: int
    bg_color: Tensor
    w2c: Tensor


def rasterize(means: Tensor, rasterizer_settings: Settings) -> tuple[Tensor, Tensor]:
    """Render the background plus the mean of the Gaussians, as (h, w, 3)."""
    size = rasterizer_settings.image_height, rasterizer_settings.image_width, 3
    return torch.zeros(1, *size[:2]), rasterizer_settings.bg_color.expand(size) + means.mean()


def residual(camera: Camera, key: str, below: Tensor) -> tuple[Stages, RasterizerWrapper, Any, Any]:
    """Return a slot with a residual's stage, and a wrapper with its replacements of `Settings` and `rasterize`."""
    store = SimpleNamespace(get=lambda _: below, prefetch=lambda _: None)
    views = {key: camera}
    rendering = StageRendering(True, ColorPath.NATIVE, views, accumulated=store, composed=frozenset(views))
    stages = Stages()
    stages.rendering = rendering
    wrapper = RasterizerWrapper(stages)
    return stages, wrapper, wrapper.settings(Settings), wrapper.wrap_function(rasterize)


def colored(means: Tensor, colors: Tensor, rasterizer_settings: Settings) -> tuple[Tensor, Tensor]:
    """Return no radii and an image (h, w, 3) of the mean colour."""
    size = rasterizer_settings.image_height, rasterizer_settings.image_width, 3
    return torch.zeros(1), means.mean() + colors.mean(0).expand(size)


@pytest.mark.parametrize("signed", [True, False])
def test_an_image_of_other_colours_than_the_models_is_left_as_it_is(signed: bool) -> None:
    """As an image of features, masks or scores, that a loop compares with something else than the photo."""
    camera, images = made()
    stages, wrapper, settings, _ = residual(camera, images.key(camera), torch.full((3, 3, 4), 0.25))
    rendering: Any = stages.rendering
    rendering.signed = signed
    rendering.on_image = lambda key, image, below: image + 1
    function = wrapper.wrap_function(colored)
    view = make_level_view(camera, (4, 3), lambda: torch.zeros(3, 3, 4))
    means, own = torch.zeros(2, 3, requires_grad=True), torch.full((2, 3), 0.125)

    @wrapper.renderer
    def render(viewpoint: Any, override_color: Tensor | None = None) -> Tensor:
        raster_settings = settings(3, 4, torch.zeros(3), torch.eye(4))
        image: Tensor = function(means, own if override_color is None else override_color, raster_settings)[1]
        return image

    scores = torch.full((2, 3), 0.5)
    for image in (render(view, scores), render(view, override_color=scores)):
        assert image.unique().tolist() == [0.5], "neither composed nor given to hooks"
        if signed:
            with pytest.raises(
                UserInputError,
                match=r"test_checkout_views.py:\d+: the loop trains on .* other colours than the model's, .* nested",
            ) as caught:
                image.sum().backward()
            assert "\n" not in str(caught.value)
        else:
            image.sum().backward()
    assert render(view).unique().tolist() == [1.375], "the model's own colours are composed"
    assert wrapper.running.values == ()


@pytest.mark.parametrize("signed", [True, False])
def test_maps_beside_a_residuals_image_are_not_trained_on(signed: bool) -> None:
    """As gaussian-grouping's features, RaDe-GS's normals: outputs of the call that renders the image."""
    camera, images = made()
    stages, wrapper, settings, _ = residual(camera, images.key(camera), torch.full((3, 3, 4), 0.25))
    rendering: Any = stages.rendering
    rendering.signed = signed
    means = torch.zeros(2, 3, requires_grad=True)

    def forward(means: Tensor, shs: Tensor, rasterizer_settings: Settings) -> dict[str, Tensor]:
        size = rasterizer_settings.image_height, rasterizer_settings.image_width
        outputs = {"radii": (3,), "image": (3, *size), "depth": size, "normals": (*size, 3), "features": (16, *size)}
        return {name: means.mean().expand(shape) * 1 for name, shape in outputs.items()}

    function = wrapper.wrap_function(forward)

    @wrapper.renderer
    def render(viewpoint: Any) -> dict[str, Tensor]:
        outputs: dict[str, Tensor] = function(means, torch.ones(2, 1, 3), settings(3, 4, torch.zeros(3), torch.eye(4)))
        return outputs

    outputs = render(make_level_view(camera, (4, 3), lambda: torch.zeros(3, 3, 4)))
    (outputs["image"].sum() + outputs["radii"].sum() + 0 * outputs["depth"].sum()).backward(retain_graph=True)
    for name in ("depth", "normals", "features"):
        refused = pytest.raises(
            UserInputError, match=r"test_checkout_views.py:\d+: the loop trains on an image of other"
        )
        with refused if signed else nullcontext():
            outputs[name].sum().backward(retain_graph=True)


@pytest.mark.parametrize(("model", "first"), [("sh", "image"), ("sh", "depths"), ("colors", "image")])
def test_other_values_that_a_renderer_rasterizes_beside_the_image_are_left_as_they_are(
    model: str, first: str, caplog: pytest.LogCaptureFixture
) -> None:
    """As GaussianPro's opacities: the colours are made inside of the renderer."""
    camera, images = made()
    stages, wrapper, settings, _ = residual(camera, images.key(camera), torch.full((3, 3, 4), 0.25))
    rendering: Any = stages.rendering
    rendering.capture = True
    view = make_level_view(camera, (4, 3), lambda: torch.zeros(3, 3, 4))

    def forward(means: Tensor, shs: Tensor | None, colors_precomp: Tensor | None, rasterizer_settings: Settings) -> Any:
        size = rasterizer_settings.image_height, rasterizer_settings.image_width, 3
        values = shs.mean((0, 1)) if colors_precomp is None else colors_precomp.mean(0)  # type: ignore[union-attr]
        return torch.zeros(1), means.mean() + values.expand(size)

    function = wrapper.wrap_function(forward)

    @wrapper.renderer
    def render(viewpoint: Any) -> dict[str, Tensor]:
        made, means = settings(3, 4, torch.zeros(3), torch.eye(4)), torch.zeros(2, 3, requires_grad=True)
        model_colors = {"sh": (torch.full((2, 1, 3), 0.125), None), "colors": (None, torch.full((2, 3), 0.125))}[model]
        calls = {"image": model_colors, "depths": (None, torch.full((2, 3), 0.5))}
        order = ("image", "depths") if first == "image" else ("depths", "image")
        return {name: function(means, *calls[name], made)[1] for name in order}

    if first == "depths":
        # It is known from the probe of signed colour on, in every later stage, that this renderer passes on SH.
        with stages.rendering_as(StageRendering(True, ColorPath.NATIVE, {}, capture=True)):
            render(view)
    outputs = render(view)
    assert rendering.captured is not None
    assert outputs["image"].unique().tolist() == rendering.captured.image.unique().tolist() == [0.375]
    assert outputs["depths"].unique().tolist() == [0.5]
    outputs["image"].sum().backward()
    with pytest.raises(UserInputError, match="other colours than the model's"):
        outputs["depths"].sum().backward()
    assert not caplog.records
    rendering.capture, rendering.images = False, SimpleNamespace(targets=None, weights=None, coarse=None)
    render(view), render(view)
    (warning,) = (each.getMessage() for each in caplog.records)
    assert "in a residual they are those of its own Gaussians, not the scene's" in warning


@pytest.mark.parametrize("how", ["the camera", "a copy of its matrix", "a transposed matrix"])
def test_a_view_is_composed_however_it_gets_to_the_rasterizer(how: str) -> None:
    camera, images = made()
    _, wrapper, settings, function = residual(camera, images.key(camera), torch.full((3, 3, 4), 0.25))
    view = make_level_view(camera, (4, 3), lambda: torch.zeros(3, 3, 4))

    def render(viewpoint: Any, matrix: Tensor) -> Tensor:
        image: Tensor = function(torch.full((2, 3), 0.5), settings(3, 4, torch.ones(3), matrix))[1]
        return image

    match how:
        case "the camera":
            image = wrapper.renderer(render)(view, torch.eye(4))
        case "a copy of its matrix":
            image = render(None, camera.world_view_transform.clone())
        case _:
            image = render(None, camera.world_view_transform.T.contiguous())
    assert image.shape == (3, 4, 3)
    assert image.unique().tolist() == [0.75], "over zero, not over the checkout's white background"
    assert wrapper.running.key is None


def test_a_prediction_is_read_once_and_not_for_a_viewer_at_the_place_of_a_photo() -> None:
    """Joint training renders it at each reading."""
    camera, images = made()
    stages, _, settings, function = residual(camera, images.key(camera), torch.full((3, 3, 4), 0.25))
    rendering: Any = stages.rendering
    below, read = rendering.accumulated, []
    rendering.accumulated = SimpleNamespace(get=lambda key: read.append(key) or below.get(key))
    matrix = camera.world_view_transform
    assert function(torch.full((2, 3), 0.5), settings(3, 4, torch.ones(3), matrix))[1].unique().tolist() == [0.75]
    assert read == [images.key(camera)]
    assert function(torch.zeros(2, 3), settings(6, 8, torch.ones(3), matrix))[1].unique().tolist() == [GREY]


LOOP = """
import torch

def render(radii, also=None):
    if also is not None:
        also()
    return {"visibility_filter": (radii > 0).nonzero()}

def training(radii, total, also):
    package = render(radii, also)
    shown = package["visibility_filter"]
    total[shown] += 1
    return total
"""


@pytest.mark.parametrize("capture", [True, False])
def test_renders_within_a_render_list_no_gaussians_where_only_their_image_is_used(
    capture: bool, load_module: Callable[[str], ModuleType]
) -> None:
    """As those of joint training; a renderer that calls another one may use its indices."""
    module, rows, stages, shown = load_module(LOOP), VisibleRows(), Stages(), []
    rows.note_caller(module.training, {"render"}, {})
    wrapper = RasterizerWrapper(stages, rows=rows)
    module.render = render = wrapper.renderer(module.render)  # type: ignore[attr-defined]
    radii = torch.tensor([0, 2, 0, 1])

    def again() -> None:
        with stages.rendering_as(StageRendering(False, ColorPath.NATIVE, {}, capture=capture)):
            shown.append(render(radii)["visibility_filter"])

    assert module.training(radii, torch.zeros(4), again).tolist() == [0, 1, 0, 1]
    assert shown[0].tolist() == ([False, True, False, True] if capture else [[1], [3]])
    again()
    assert shown[1].tolist() == [[1], [3]], "outside of the loop"


class WithProjection(NamedTuple):
    image_height: int
    image_width: int
    bg_color: Tensor
    w2c: Tensor
    projection: Tensor


def test_photos_of_one_pose_are_told_apart_by_their_lenses() -> None:
    cameras = {key: SimpleNamespace(world_view_transform=torch.eye(4)) for key in ("0-wide", "1-tele")}
    for factor, camera in enumerate(cameras.values(), 2):
        camera.full_proj_transform = torch.eye(4) * factor
    stage = StageRendering(True, ColorPath.NATIVE, cameras, on_image=lambda key, image, below: image)
    for key, camera in cameras.items():
        settings = WithProjection(3, 4, torch.ones(3), torch.eye(4), camera.full_proj_transform.clone())
        assert stage.key(None, settings) == key


def test_photos_of_one_camera_are_composed_alike_and_not_mistaken_for_each_other() -> None:
    cameras = {key: SimpleNamespace(world_view_transform=torch.eye(4)) for key in ("0-day", "1-night")}
    settings, matters = Settings(3, 4, torch.ones(3), torch.eye(4)), r"day and night have the same camera, .*--masks"
    stage = StageRendering(True, ColorPath.NATIVE, cameras, composed=frozenset(cameras))
    assert stage.key(None, settings) in cameras, "their predictions are the same"
    for options in (
        {"masked": frozenset({"0-day"})},
        {"on_image": lambda key, image, below: image},
        {"composed": frozenset({"1-night"})},
    ):
        stage = replace(stage, **{"masked": frozenset(), "on_image": None, **options})
        with pytest.raises(UserInputError, match=matters):
            stage.key(None, settings)
        assert stage.key("0-day", settings) == "0-day", "a renderer was called with it"


def test_training_on_a_view_that_is_not_recognised_stops() -> None:
    camera, images = made()
    _, _, settings, function = residual(camera, images.key(camera), torch.zeros(3, 3, 4))
    means = torch.zeros(2, 3, requires_grad=True)
    image = function(means, settings(3, 4, torch.ones(3), torch.eye(4)))[1]
    assert image.unique().tolist() == [GREY], "a viewer may look"
    with pytest.raises(UserInputError, match="trains on a camera that is no view of its scene") as caught:
        image.sum().backward()
    assert "\n" not in str(caught.value)


def test_a_render_of_another_size_is_said() -> None:
    """DashGaussian's frequency schedule renders a view smaller than its level."""
    camera, images = made()
    _, wrapper, settings, function = residual(camera, images.key(camera), torch.zeros(3, 3, 4))
    render = wrapper.renderer(lambda view: function(torch.zeros(2, 3), settings(2, 2, torch.ones(3), torch.eye(4))))
    with pytest.raises(UserInputError, match=r"renders view photo at 2x2, expected 4x3.*--hierarchy nested") as caught:
        render(camera)
    assert "\n" not in str(caught.value)


def test_outputs_without_an_image_are_named() -> None:
    camera, images = made()
    _, wrapper, settings, _ = residual(camera, images.key(camera), torch.zeros(3, 3, 4))
    broken = wrapper.wrap_function(lambda rasterizer_settings: (torch.zeros(2, 3, 4), torch.zeros(2)))
    with pytest.raises(UserInputError, match=r"returns \(2, 3, 4\), \(2,\), expected an image \(3, h, w\) of 4x3"):
        broken(rasterizer_settings=settings(3, 4, torch.ones(3), torch.eye(4)))


@pytest.mark.parametrize("leading", [(), (1,)])
def test_an_image_is_the_first_three_of_more_channels(leading: tuple[int, ...]) -> None:
    """As of a rasterizer that returns normals, depth and opacity in one tensor with the colours."""
    camera, images = made()
    _, wrapper, settings, _ = residual(camera, images.key(camera), torch.full((3, 3, 4), 0.25))

    def forward(means: Tensor, rasterizer_settings: Settings) -> tuple[Tensor, Tensor]:
        rows = torch.arange(5.0).reshape(*leading, 5, 1, 1) + means.mean()
        return rows.expand(*leading, 5, 3, 4), torch.zeros(2)

    means, function = torch.zeros(2, 3, requires_grad=True), wrapper.wrap_function(forward)
    render = wrapper.renderer(lambda view: function(means, settings(3, 4, torch.ones(3), torch.eye(4)))[0])
    image = render(camera)
    assert image.shape == (*leading, 5, 3, 4)
    assert image.amax((-1, -2)).flatten().tolist() == [0.25, 1.25, 2.25, 3, 4], "Up(coarse) is added to colours alone"
    image[..., :3, :, :].sum().backward(retain_graph=True)
    (image[..., 3, :, :] * 0).sum().backward(retain_graph=True)  # a loss that has no weight yet
    with pytest.raises(UserInputError, match="other colours than the model's"):
        image[..., 3, :, :].sum().backward()
