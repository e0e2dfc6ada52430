"""Compare stacked fields, rendered in one set of launches, with the oracle: field by field and composed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import gsplat
import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.composition import Composition
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.rasterizers.gsplat.stack import GsplatStack
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.rendering.field_renderer import FieldOffload
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.speed import measure_speed
from tests.gsplat_on_cpu import direct_on_cpu, gsplat_160_on_cpu, gsplat_on_cpu
from tests.training_scene import blob_field, ring_camera

CPU = torch.device("cpu")
CAMERA = ring_camera(0.4, 53, 37)  # odd, and at the next level, too
BACKGROUND = (0.2, 0.5, 0.9)
TOLERANCE = 1e-5
"""Of sums of up to four levels, with gains up to 3. Worst seen 1.7e-6."""


@pytest.fixture(autouse=True)
def kernels() -> Iterator[None]:
    with gsplat_on_cpu():
        yield


@pytest.fixture(params=[False, True], ids=["by gsplat's functions", "by stand-ins of our kernels"])
def direct(request: pytest.FixtureRequest) -> Iterator[bool]:
    with direct_on_cpu():
        yield request.param


class OnCpu(GsplatRasterizer):
    """gsplat behind our interface on the CPU, where it can only render stacks."""

    def __init__(self, direct: bool = False) -> None:
        super().__init__(CPU)
        self._may_be_direct = self._must_be_direct = direct
        self.stacked: list[int] = []
        self.rendered: list[int] = []

    can_stack = True

    def stack(self, fields: Sequence[GaussianField]) -> FieldStack:
        self.stacked.append(len(fields))
        stacked, asked = super().stack(fields), self.rendered

        class Watched:
            def render(self, cameras: Sequence[Camera], background: Tensor | None) -> list[Tensor]:
                asked.append(len(cameras))
                return stacked.render(cameras, background)

        return Watched()


def field(count: int, signed: bool, degree: int = 1, seed: int = 0) -> GaussianField:
    """Make Gaussians, some outside the view and near, where projection and culling depend on the image size."""
    generator = torch.Generator().manual_seed(seed)
    blobs = blob_field(count, seed)
    means = blobs.means * torch.tensor([3.0, 2.0, 3.0])
    sh = torch.randn((count, (degree + 1) ** 2, 3), generator=generator) * (0.4 if signed else 1.0)
    logits = blobs.opacity_logits.clamp_max(3)  # below the 0.99 where the oracle caps alpha, and gsplat does not yet
    return replace(blobs.with_parameters({"means": means, "sh": sh, "opacity_logits": logits}), signed=signed)


def hierarchy(counts: Sequence[int], degrees: Sequence[int] = (1, 1, 1, 1)) -> dict[int, GaussianField]:
    """Make fields with `counts` Gaussians, finest first."""
    top = len(counts) - 1
    return {level: field(counts[level], level < top, degrees[level], seed=level) for level in range(top, -1, -1)}


def at_once(fields: Mapping[int, GaussianField], rasterizer: OnCpu | None = None) -> HierarchyRenderer:
    return HierarchyRenderer(
        fields, len(fields), Pyramid(), rasterizer or OnCpu(), BACKGROUND, offload=FieldOffload(CPU)
    )


def by_the_oracle(renderer: HierarchyRenderer) -> HierarchyRenderer:
    """Return the renderer with the oracle, one field after the other."""
    return replace(renderer, rasterizer=OracleRasterizer(three_sigma_cut=False), offload=None)


def assert_same(found: Composition, expected: Composition) -> None:
    assert list(found.composed) == list(expected.composed)
    assert list(found.residuals) == list(expected.residuals)
    torch.testing.assert_close(found.base, expected.base, rtol=0, atol=TOLERANCE)
    for kind in ("residuals", "composed"):
        for level, image in getattr(expected, kind).items():
            torch.testing.assert_close(getattr(found, kind)[level], image, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(
    "counts", [(200,), (300, 100), (10, 1500), (1500, 10), (150, 0, 120), (0, 0), (100, 60, 80, 30)], ids=str
)
def test_it_is_the_oracles_composition(counts: Sequence[int], direct: bool) -> None:
    rasterizer = OnCpu(direct)
    renderer = at_once(hierarchy(counts), rasterizer)
    composition = renderer.render(CAMERA)
    assert rasterizer.rendered == [len(counts)], "all in one go"
    assert_same(composition, by_the_oracle(renderer).render(CAMERA))


def test_degrees_of_colour_may_differ(direct: bool) -> None:
    renderer = at_once(hierarchy((80, 90, 70), degrees=(2, 0, 3)), OnCpu(direct))
    assert_same(renderer.render(CAMERA), by_the_oracle(renderer).render(CAMERA))


def test_a_coarse_field_is_culled_and_linearized_for_its_own_size() -> None:
    """Projected at the finest size, it would have more Gaussians, and others at its border."""
    fields = hierarchy((50, 400))
    asked: list[tuple[int, int]] = []
    projection = gsplat.fully_fused_projection

    def watched(*args: object, **options: object) -> object:
        asked.append(args[6:8])  # type: ignore[arg-type]  # width and height
        return projection(*args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gsplat, "fully_fused_projection", watched)
        GsplatStack(list(fields.values()), CPU).render([level_camera(CAMERA, 1), CAMERA], None)
    assert asked == [(27, 19), (53, 37)]


def test_gains_and_levels_of_detail(direct: bool) -> None:
    rasterizer = OnCpu(direct)
    renderer = at_once(hierarchy((90, 70, 50)), rasterizer)
    expected = by_the_oracle(renderer)
    gains = {2: 0.5, 1: 3.0, 0: 1.7}
    for level in (2, 1, 0, 1, 2):
        wanted = {each: gain for each, gain in gains.items() if each >= level}
        assert_same(renderer.render(CAMERA, level, wanted), expected.render(CAMERA, level, wanted))
    assert rasterizer.rendered == [1, 2, 3, 2, 1]
    assert rasterizer.stacked == [1, 2, 3], "a coarser level takes the first fields of what is there"


def test_clamped_levels() -> None:
    fields = {level: replace(each, sh=4 * each.sh) for level, each in hierarchy((90, 70)).items()}
    renderer = replace(at_once(fields), clamped=True)
    composition = renderer.render(CAMERA)
    assert composition.base.max() == 1
    assert_same(composition, by_the_oracle(renderer).render(CAMERA))


def test_what_stays_field_by_field() -> None:
    fields = hierarchy((30, 20))
    rasterizer = OnCpu()
    renderer = at_once(fields, rasterizer)
    asked = []
    plain = OracleRasterizer(three_sigma_cut=False)

    def render_images(field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        asked.append(len(cameras))
        return torch.stack([plain(field, camera, background=background).image for camera in cameras])

    rasterizer.render_images = render_images  # type: ignore[method-assign]  # to see who comes here
    expected = by_the_oracle(renderer)
    for other in (
        replace(renderer, concurrent=False),
        replace(renderer, stack_pixels=0),
        replace(renderer, stack_pixels=53 * 37 - 1),
        replace(renderer, offload=None),
        replace(renderer, offload=FieldOffload(CPU, keep=False)),
    ):
        asked.clear()
        assert_same(other.render(CAMERA), expected.render(CAMERA))
        assert asked == [1, 1]
    asked.clear()
    renderer.render_batch([CAMERA, CAMERA])
    renderer.render(CAMERA, gains={0: 0.0})
    assert asked == [2, 2, 1]
    assert rasterizer.stacked == []
    assert_same(replace(renderer, stack_pixels=53 * 37).render(CAMERA), expected.render(CAMERA))
    assert rasterizer.stacked == [2]


def test_which_rasterizers_can() -> None:
    on_cpu = GsplatRasterizer("cpu")
    assert not on_cpu.can_stack
    assert not OracleRasterizer().can_stack
    able = {"packed": False, "antialiasing": True}
    for options, expected in ((able, True), ({**able, "packed": True}, False)):
        there = GsplatRasterizer("cpu", **options)
        there._device = torch.device("cuda")  # as if there were a GPU
        assert there.can_stack is expected


@pytest.mark.parametrize("antialiasing", [False, True])
def test_it_renders_by_the_functions_of_1_6_0_as_well(antialiasing: bool) -> None:
    fields = list(hierarchy((300, 100)).values())
    cameras = [level_camera(CAMERA, 1), CAMERA]
    background = torch.tensor(BACKGROUND)
    expected = GsplatStack(fields, CPU, antialiased=antialiasing).render(cameras, background)
    with gsplat_160_on_cpu():
        rasterizer = GsplatRasterizer("cpu", antialiasing=antialiasing)
        images = rasterizer.stack(fields).render(cameras, background)
        rasterizer._device = torch.device("cuda")  # as if there were a GPU
        assert rasterizer.can_stack
    for image, other in zip(images, expected, strict=True):
        assert other.abs().max() > 0.1
        torch.testing.assert_close(image, other, rtol=0, atol=1e-5)  # worst seen: 0


def test_antialiasing_dims_by_the_area_that_was_added() -> None:
    """A Gaussian in a pixel centre is dimmed by the root of the quotient of the determinants."""
    camera = Camera(17, 17, 20.0, 20.0, 8.5, 8.5, torch.eye(4))
    deviation, opacity = 0.04, 0.9
    small = GaussianField(
        means=torch.tensor([[0.0, 0.0, 4.0]]),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), math.log(deviation)),
        opacity_logits=torch.logit(torch.tensor([opacity])),
        sh=torch.ones(1, 1, 3),
        signed=True,
    )
    variance = (20.0 * deviation / 4.0) ** 2
    for antialiased, factor in ((False, 1.0), (True, variance / (variance + 0.3))):
        (image,) = GsplatStack([small], CPU, antialiased=antialiased).render([camera], None)
        expected = opacity * factor * float(0.5 / math.sqrt(math.pi))  # of Y_00
        assert float(image[0, 8, 8]) == pytest.approx(expected, rel=1e-5)  # 6.4e-8 seen


def test_later_changes_of_a_field_are_not_seen(direct: bool) -> None:
    one = field(40, False)
    stack = OnCpu(direct).stack([one])
    (before,) = stack.render([CAMERA], None)
    with torch.no_grad():
        one.sh.zero_()
        one.log_scales.add_(1.0)
    assert torch.equal(stack.render([CAMERA], None)[0], before)


def test_a_full_gpu_is_one_line() -> None:
    class Full(OnCpu):
        def stack(self, fields: Sequence[GaussianField]) -> FieldStack:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    with pytest.raises(
        DeviceMemoryError, match="left to render levels 1 to 0, 50 Gaussians at 53x37; render a coarser"
    ):
        at_once(hierarchy((30, 20)), Full()).render(CAMERA)


def test_it_is_measured() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            OnCpu, "render_images", lambda self, field, cameras, *, background: torch.zeros(1, 3, *_size(cameras))
        )
        speeds = measure_speed(replace(at_once(hierarchy((30, 20))), stack_pixels=0), [CAMERA], 0, rounds=1)
        one = measure_speed(at_once(hierarchy((30,))), [CAMERA], 0, rounds=1)
    assert [(each.what, each.gaussians) for each in speeds[:2]] == [
        ("levels 1 to 0, one after the other", 50),
        ("levels 1 to 0, all at once", 50),
    ]
    assert [each.what for each in one] == ["field", "field, at once"]


def _size(cameras: Sequence[Camera]) -> tuple[int, int]:
    return cameras[0].height, cameras[0].width
