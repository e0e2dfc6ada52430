"""Compare compositions with the formula written out, and with constant images of known sum."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.composition import compose, to_full_size
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.rendering.field_renderer import FieldOffload, FieldRenderer
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer

BACKGROUND = (0.2, 0.5, 0.9)
CAMERA = Camera(45, 30, fx=40.0, fy=41.0, cx=21.0, cy=16.0, world_to_camera=torch.eye(4))


def blobs(seed: int, signed: bool) -> GaussianField:
    generator = torch.Generator().manual_seed(seed)
    n = 40
    means = torch.randn((n, 3), generator=generator) * torch.tensor([1.0, 0.7, 0.5]) + torch.tensor([0.0, 0.0, 4.0])
    return GaussianField(
        means=means,
        quaternions=torch.randn((n, 4), generator=generator),
        log_scales=-1.7 + 0.3 * torch.randn((n, 3), generator=generator),
        opacity_logits=torch.randn(n, generator=generator),
        sh=torch.randn((n, 4, 3), generator=generator) * (0.4 if signed else 1.0),
        signed=signed,
    )


class Constant(Rasterizer):
    """Render the first SH value of a field's first Gaussian everywhere, and record the calls."""

    name = "constant"

    def __init__(self) -> None:
        self.calls: list[tuple[bool, tuple[int, int], list[float]]] = []

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        self.calls.append((field.signed, camera.size, background.tolist()))
        image = field.sh[0, 0].view(3, 1, 1).expand(3, camera.height, camera.width)
        nothing = torch.zeros(len(field))
        return RenderResult(image, image[0], nothing.int(), torch.zeros(len(field), 2))


def constant_field(value: float, signed: bool) -> GaussianField:
    return replace(blobs(0, signed), sh=torch.full((40, 1, 3), value))


def test_three_levels_by_the_formula() -> None:
    fields = {2: blobs(2, False), 1: blobs(1, True), 0: blobs(0, True)}
    oracle, pyramid = OracleRasterizer(), Pyramid("camera")
    composition = HierarchyRenderer(fields, 3, pyramid, oracle, BACKGROUND).render(CAMERA)

    background, zero = torch.tensor(BACKGROUND), torch.zeros(3)
    base = oracle(fields[2], CAMERA.resized(12, 8), background=background).image
    residual_1 = oracle(fields[1], CAMERA.resized(23, 15), background=zero).image
    residual_0 = oracle(fields[0], CAMERA, background=zero).image
    composed_1 = pyramid.up(base, (15, 23)) + residual_1
    composed_0 = pyramid.up(composed_1, (30, 45)) + residual_0

    torch.testing.assert_close(composition.base, base, rtol=0, atol=0)
    torch.testing.assert_close(composition.residuals, {1: residual_1, 0: residual_0}, rtol=0, atol=0)
    # The kernel sums in another order; worst seen 1.8e-7.
    torch.testing.assert_close(composition.composed, {2: base, 1: composed_1, 0: composed_0}, rtol=0, atol=1e-6)
    assert residual_0.abs().max() > 0.05  # the scene shows something
    assert residual_0.min() < 0


def test_gradients_reach_every_composed_level() -> None:
    generator = torch.Generator().manual_seed(3)
    sides = {2: (8, 12), 1: (15, 23), 0: (30, 45)}
    renders = {
        level: torch.randn((3, *side), generator=generator, dtype=torch.float64, requires_grad=True)
        for level, side in sides.items()
    }
    weights = torch.randn((3, *sides[0]), generator=generator, dtype=torch.float64)
    pyramid = Pyramid("camera")
    (compose(pyramid, renders.items(), gains={1: 0.5}).image * weights).sum().backward()
    # The image is linear in each render, so the gradient times the render is that render's part of the weighted sum.
    parts = {
        0: renders[0],
        1: 0.5 * pyramid.up(renders[1], sides[0]),
        2: pyramid.up(pyramid.up(renders[2], sides[1]), sides[0]),
    }
    for level, render in renders.items():
        assert render.grad is not None
        expected = float((parts[level] * weights).sum().detach())
        assert float((render.grad * render.detach()).sum()) == pytest.approx(expected, rel=1e-9)  # 6.4e-16 seen


@pytest.mark.parametrize("grid", ["camera", "even"])
def test_nothing_is_clamped_between_levels_and_residuals_lie_over_zero(grid: str) -> None:
    rasterizer = Constant()
    fields = {2: constant_field(1.5, False), 1: constant_field(-1.9, True), 0: constant_field(0.7, True)}
    composition = HierarchyRenderer(fields, 3, Pyramid(grid), rasterizer, BACKGROUND).render(CAMERA)
    for level, value in {2: 1.5, 1: -0.4, 0: 0.3}.items():
        composed = composition.composed[level]
        # Up keeps constants but for rounding; worst seen 2.4e-7
        torch.testing.assert_close(composed, torch.full_like(composed, value), rtol=0, atol=1e-6)
    assert rasterizer.calls == [
        (True, (45, 30), [0.0, 0.0, 0.0]),
        (True, (23, 15), [0.0, 0.0, 0.0]),
        (False, (12, 8), pytest.approx(list(BACKGROUND))),
    ]


@pytest.mark.parametrize("signed", [True, False])
def test_frames_are_clamped_images(signed: bool) -> None:
    fields = {2: constant_field(1.5, False), 1: constant_field(-1.9, signed), 0: constant_field(2.7, signed)}
    renderer = HierarchyRenderer(fields, 3, Pyramid(), Constant(), BACKGROUND)
    for level in range(3):
        images = renderer.images([CAMERA], level)
        assert float(images.abs().max()) > 1 or level == 1
        torch.testing.assert_close(renderer.frames([CAMERA], level), images.clamp(0, 1), rtol=0, atol=1e-6)  # 0 seen


def test_a_coarser_level_is_its_plain_render_and_stops_early() -> None:
    fields = {1: blobs(3, False), 0: constant_field(0.1, True)}
    oracle = OracleRasterizer()
    composition = HierarchyRenderer(fields, 2, Pyramid(), oracle, BACKGROUND).render(CAMERA, level=1)
    plain = oracle(fields[1], CAMERA.resized(23, 15), background=torch.tensor(BACKGROUND)).image
    assert composition.residuals == {}
    torch.testing.assert_close(composition.composed, {1: plain}, rtol=0, atol=0)
    assert to_full_size(composition.composed[1], CAMERA.size, 1, Pyramid()).shape == (3, 30, 45)


def test_level_cameras_keep_the_field_of_view() -> None:
    camera = level_camera(CAMERA, 2)
    assert camera.size == (12, 8)
    assert camera.tan_half_fov == pytest.approx(CAMERA.tan_half_fov)
    # A point seen at a quarter of the width stays at a quarter of the width.
    assert camera.cx / camera.width == pytest.approx(CAMERA.cx / CAMERA.width)


def test_an_unfinished_hierarchy_renders_what_it_has() -> None:
    renderer = HierarchyRenderer({2: blobs(2, False), 1: blobs(1, True)}, 3, Pyramid(), OracleRasterizer())
    assert renderer.finest == 1
    assert set(renderer.render(CAMERA, level=1).composed) == {2, 1}
    for options in ({}, {"level": 1, "gains": {0: 2.0}}):
        with pytest.raises(UserInputError, match="level 0 cannot be rendered, expected 1 to 2; finer"):
            renderer.render(CAMERA, **options)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, r"fields of levels \[\]"),
        ({1: blobs(0, False)}, r"expected 2, \.\.\., 0"),
        ({2: blobs(0, False), 0: blobs(1, True)}, "without gaps"),
        ({2: blobs(0, True)}, "levels 2 signed; expected the coarsest, 2, unsigned"),
        ({2: blobs(0, True), 1: blobs(1, False)}, "levels 2 signed, 1 unsigned; expected"),
        ({2: blobs(0, False), 1: blobs(1, False), 0: blobs(2, True)}, "levels 2 unsigned, 1 unsigned, 0 signed"),
    ],
)
def test_fields_that_make_no_hierarchy_are_refused(fields: dict[int, GaussianField], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        HierarchyRenderer(fields, 3, Pyramid(), OracleRasterizer())


RESIDUAL = {2: blobs(2, False), 1: blobs(1, True), 0: blobs(0, True)}
NESTED = {2: blobs(2, False), 1: blobs(1, False), 0: blobs(0, False)}


@pytest.mark.parametrize("fields", [RESIDUAL, NESTED])
@pytest.mark.parametrize("gain", [3.0, 0.0])
def test_gains_weigh_bands_by_the_formula(fields: dict[int, GaussianField], gain: float) -> None:
    renderer = HierarchyRenderer(fields, 3, Pyramid("camera"), OracleRasterizer(), BACKGROUND)
    plain = renderer.render(CAMERA)
    gains = {2: 0.5, 1: gain, 0: 1.7}
    weighed = renderer.render(CAMERA, gains=gains)
    middle = renderer.pyramid.up(0.5 * plain.base, (15, 23)) + gain * plain.residuals[1]
    finest = renderer.pyramid.up(middle, (30, 45)) + 1.7 * plain.residuals[0]
    torch.testing.assert_close(weighed.base, 0.5 * plain.base)
    torch.testing.assert_close(weighed.residuals[0], 1.7 * plain.residuals[0])
    # The kernel of Up and the sum adds in another order; worst seen 1.2e-7.
    torch.testing.assert_close(weighed.composed[0], finest, rtol=0, atol=1e-6)
    torch.testing.assert_close(renderer.images([CAMERA], 0, gains)[0], finest, rtol=0, atol=1e-6)


def test_a_band_of_gain_zero_is_not_rendered() -> None:
    constant = Constant()
    fields = {1: constant_field(0.25, False), 0: constant_field(0.5, True)}
    renderer = HierarchyRenderer(fields, 2, Pyramid("camera"), constant)
    without = renderer.render(CAMERA, gains={0: 0.0})
    assert [signed for signed, *_ in constant.calls] == [False]
    torch.testing.assert_close(without.composed[0], torch.full((3, 30, 45), 0.25))
    assert not without.residuals[0].any()
    torch.testing.assert_close(renderer.render(CAMERA, gains={1: 0.0}).composed[0], torch.full((3, 30, 45), 0.5))


@pytest.mark.parametrize("gain", [-0.1, float("nan"), float("inf"), 1e4])
def test_a_gain_out_of_range_is_refused(gain: float) -> None:
    renderer = HierarchyRenderer(RESIDUAL, 3, Pyramid("camera"), OracleRasterizer())
    message = rf"gain {gain:g} of level 0: expected a number from 0 .* to 1000".replace("+", r"\+")
    with pytest.raises(UserInputError, match=message):
        renderer.render(CAMERA, gains={0: gain})
    with pytest.raises(UserInputError, match=message):
        renderer.band(CAMERA, 0, gain)


def test_a_band_is_what_its_field_renders() -> None:
    renderer = HierarchyRenderer(RESIDUAL, 3, Pyramid("camera"), OracleRasterizer(), BACKGROUND)
    composition = renderer.render(CAMERA)
    for level, expected in {2: composition.base, **composition.residuals}.items():
        assert renderer.fields_for_band(level) == [level]
        torch.testing.assert_close(renderer.band(CAMERA, level, 1.5), 1.5 * expected, rtol=0, atol=0)
    assert renderer.fields_for_band(1, 0.0) == []
    assert not renderer.band(CAMERA, 1, 0.0).any()


def test_nested_levels_by_the_formula() -> None:
    oracle, pyramid = OracleRasterizer(), Pyramid("camera")
    renderer = HierarchyRenderer(NESTED, 3, pyramid, oracle, BACKGROUND)
    composition = renderer.render(CAMERA)
    own = {
        level: oracle(NESTED[level], CAMERA.resized(*size), background=torch.tensor(BACKGROUND)).image
        for level, size in {2: (12, 8), 1: (23, 15), 0: (45, 30)}.items()
    }
    residuals = {1: own[1] - pyramid.up(own[2], (15, 23)), 0: own[0] - pyramid.up(own[1], (30, 45))}
    torch.testing.assert_close(composition.base, own[2], rtol=0, atol=0)
    torch.testing.assert_close(composition.composed, own, rtol=0, atol=0)
    torch.testing.assert_close(composition.residuals, residuals, rtol=0, atol=0)
    for level, image in own.items():
        torch.testing.assert_close(renderer.images([CAMERA], level)[0], image, rtol=0, atol=0)
    for level in (1, 0):
        assert renderer.fields_for_band(level) == [level + 1, level]
        torch.testing.assert_close(renderer.band(CAMERA, level, 2.0), 2.0 * residuals[level], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("level", "gains", "rendered"), [(0, {}, [0]), (1, {2: 1.0}, [1]), (2, {}, [2]), (0, {0: 0.0}, [2, 1, 0])]
)
def test_an_image_of_nested_levels_takes_one_field(level: int, gains: dict[int, float], rendered: list[int]) -> None:
    rasterizer = Constant()
    fields = {level: constant_field(0.1 * level, False) for level in range(3)}
    renderer = HierarchyRenderer(fields, 3, Pyramid(), rasterizer, BACKGROUND)
    assert renderer.fields_for(level, gains) == rendered
    renderer.images([CAMERA], level, gains)
    sizes = {2: (12, 8), 1: (23, 15), 0: (45, 30)}
    assert [size for _, size, _ in rasterizer.calls] == [sizes[one] for one in reversed(rendered)]
    assert all(background == pytest.approx(list(BACKGROUND)) for *_, background in rasterizer.calls)


def test_a_batch_is_its_views_one_by_one() -> None:
    renderer = HierarchyRenderer(RESIDUAL, 3, Pyramid("camera"), OracleRasterizer(), BACKGROUND)
    turned = replace(CAMERA, world_to_camera=CAMERA.world_to_camera @ torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])))
    batch = renderer.render_batch([CAMERA, turned], 0, {1: 0.5})
    assert batch.composed[0].shape == (2, 3, 30, 45)
    for index, camera in enumerate((CAMERA, turned)):
        alone = renderer.render(camera, 0, {1: 0.5})
        for images, expected in zip(astuple(batch.view(index)), astuple(alone), strict=True):
            torch.testing.assert_close(images, expected, rtol=0, atol=0)
    for cameras, sizes in (([CAMERA, CAMERA.resized(40, 30)], "40x30, 45x30"), ([], "none")):
        with pytest.raises(UserInputError, match=f"cameras of {sizes} pixels, expected one size"):
            renderer.render_batch(cameras)


def test_fields_come_to_the_device_when_they_are_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(Tensor, "pin_memory", lambda tensor: tensor.clone())
    fields = {1: blobs(1, False), 0: blobs(0, True)}
    asked: list[GaussianField] = []

    class Elsewhere(Constant):
        def __call__(self, field: GaussianField, camera: Camera, **options: Any) -> RenderResult:
            asked.append(field)
            return super().__call__(fields[int(not field.signed)], camera, background=torch.zeros(3))

    there = torch.device("meta")
    monkeypatch.setattr(FieldRenderer, "background_of", lambda renderer, level: torch.zeros(3))
    for keep in (True, False):
        asked.clear()
        offload = FieldOffload(there, keep)
        renderer = HierarchyRenderer(fields, 2, Pyramid(), Elsewhere(), offload=offload)
        assert renderer.device == there
        renderer.render(CAMERA, level=1)
        assert [field.signed for field in asked] == [False], "the other one has not been needed"
        for _ in range(2):
            renderer.render(CAMERA)
        assert all(field.means.device == there for field in asked)
        bases = {id(field) for field in asked if not field.signed}
        assert len(bases) == (1 if keep else 3)
    assert FieldOffload(torch.device("cpu")).bring(0, fields[0]) is fields[0]


def test_a_full_gpu_is_one_line() -> None:
    class Full(Constant):
        def __call__(self, *args: Any, **options: Any) -> RenderResult:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    renderer = HierarchyRenderer({0: blobs(0, False)}, 1, Pyramid(), Full())
    with pytest.raises(DeviceMemoryError, match="left to render level 0, 40 Gaussians at 45x30; render a coarser"):
        renderer.render(CAMERA)


@pytest.mark.parametrize(
    ("size", "level"),
    [((1, 1), 2), ((12, 8), 2), ((13, 8), 1), ((23, 15), 1), ((24, 15), 0), ((45, 30), 0), ((90, 60), 0)],
)
def test_the_level_of_detail_is_the_coarsest_that_is_not_smaller(size: tuple[int, int], level: int) -> None:
    for finest in (0, 1):
        fields = {one: field for one, field in RESIDUAL.items() if one >= finest}  # 12x8, 23x15, 45x30
        renderer = HierarchyRenderer(fields, 3, Pyramid(), OracleRasterizer())
        assert renderer.level_for_size(CAMERA, size) == max(level, finest)


class InCurrentStream(Constant):
    in_current_stream = True


class Streams:
    """Replace the streams of `torch.cuda`, and record which stream waits for which."""

    def __init__(self) -> None:
        self.log: list[tuple[str, ...]] = []
        self.stack = [Stream("current", self.log)]

    def make(self, device: object, priority: int) -> Stream:
        number = len([entry for entry in self.log if entry[0] == "new"])
        return Stream(f"stream {number}", self.log, new=f"priority {priority}")

    @contextmanager
    def inside(self, stream: Stream) -> Iterator[None]:
        self.stack.append(stream)
        yield
        self.stack.pop()


class Stream:
    def __init__(self, name: str, log: list[tuple[str, ...]], new: str = "") -> None:
        self.name, self.log = name, log
        if new:
            log.append(("new", name, new))

    def wait_stream(self, other: Stream) -> None:
        self.log.append((self.name, "waits for", other.name))


def test_each_field_has_a_stream_and_nothing_is_used_too_early(monkeypatch: pytest.MonkeyPatch) -> None:
    fields = {2: constant_field(0.4, False), 1: constant_field(-0.25, True), 0: constant_field(0.125, True)}
    rasterizer, streams = InCurrentStream(), Streams()
    renderer = HierarchyRenderer(fields, 3, Pyramid(), rasterizer, BACKGROUND)
    expected = renderer.render(CAMERA)
    monkeypatch.setattr(FieldRenderer, "device", torch.device("cuda"))
    monkeypatch.setattr(FieldRenderer, "_background", torch.tensor(BACKGROUND))
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: streams.log.append(("synchronize",)))
    monkeypatch.setattr(torch.cuda, "Stream", streams.make)
    monkeypatch.setattr(torch.cuda, "stream", streams.inside)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: streams.stack[-1])
    monkeypatch.setattr(Tensor, "record_stream", lambda tensor, stream: None)
    renderer = replace(renderer)
    concurrent = renderer.render(CAMERA)
    assert torch.equal(concurrent.composed[0], expected.composed[0])
    first = streams.log.copy()
    assert first == [
        ("synchronize",),
        # Of levels 2, 1 and 0; the finest one waits for whoever is there.
        *[("new", "stream 0", "priority -1"), ("new", "stream 1", "priority -1"), ("new", "stream 2", "priority 0")],
        *[("current", "waits for", f"stream {i}") for i in range(3)],
    ]
    streams.log.clear()
    renderer.render(CAMERA)
    assert streams.log == first[4:]  # not one wait of the processor
    streams.log.clear()
    replace(renderer, concurrent=False).render(CAMERA)
    replace(renderer, rasterizer=Constant()).render(CAMERA)  # may have a stream of its own that nobody waits for
    assert streams.log == []
