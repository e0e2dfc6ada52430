"""The family's engine of our kernels against the oracle and the CPU's engine: interpreted on a CPU, or compiled."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from tests.unit.test_blend_kernels import run_checks

COMMON = """
from dataclasses import replace
from types import SimpleNamespace

import torch
from torch.nn.functional import normalize

from lapgs_plugin.evaluation.cases import ADVERSARIAL, COLORED, make_camera, random_case
from lapgs_plugin.family import cpu, gpu
from lapgs_plugin.family.call import Inputs, Options
from lapgs_plugin.gpu_raster import tiles
from lapgs_plugin.reference_raster.layout import SIGNED_COLOR_BIT
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.reference_raster.thresholds import threshold_mask
from tests.raster.standin_cases import covariances

if DEVICE == "cpu":
    tiles.LEAST_ROOM = 256  # places for pairs are slow to interpret


def settings_of(case, device, modifier=1.0):
    camera = case.camera
    tan_x, tan_y = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1 / tan_x, 1 / tan_y, 1
    projection[0, 2], projection[1, 2] = 2 * camera.cx / camera.width - 1, 2 * camera.cy / camera.height - 1
    projection[2, 2], projection[2, 3] = 100 / (100 - 0.01), -1 / (100 - 0.01)
    pose = camera.world_to_camera.double()
    degree = case.field.sh_degree if case.sh_degree is None else case.sh_degree
    return SimpleNamespace(
        image_height=camera.height, image_width=camera.width, tanfovx=tan_x, tanfovy=tan_y,
        bg=torch.tensor(case.background, device=device), scale_modifier=modifier,
        # Transposed views, as some checkouts pass them.
        viewmatrix=pose.float().to(device).T, projmatrix=(projection @ pose).float().T.contiguous().to(device),
        sh_degree=degree | (SIGNED_COLOR_BIT if case.field.signed else 0),
        campos=(-pose[:3, :3].T @ pose[:3, 3]).float().to(device),
    )


def inputs_of(case, device, columns=3, apart=False, given=False):
    field = case.to(torch.float32).field
    scales, quats, n = field.log_scales.exp(), normalize(field.quaternions), len(field)
    parts = {"means": field.means, "means2d": torch.zeros(n, columns)}
    parts["opacities"] = field.opacity_logits.sigmoid()[:, None]
    if given:
        parts["covariances"] = covariances({"scales": scales, "quats": quats})
        parts["colors"] = torch.randn(n, 3, generator=torch.Generator().manual_seed(4))
    else:
        parts |= {"scales": scales, "quats": quats}
        parts |= {"dc": field.sh[:, :1], "sh": field.sh[:, 1:]} if apart else {"sh": field.sh}
    leaves = {key: value.detach().clone().to(device).requires_grad_() for key, value in parts.items()}
    return Inputs(**{key: leaves.get(key) for key in Inputs._fields})


def small(sh_degree=3, signed=False, width=29, height=15, **more):
    camera = make_camera(width, height, pose_seed=7, principal_offset=(3.0, -2.0))
    more |= {"seed": 5, "sh_degree": sh_degree, "signed": signed, "background": COLORED, "camera": camera}
    return random_case(20, width, height, **more).to(torch.float32)


def relative(found, expected):
    return float((found.cpu().double() - expected.double()).norm() / expected.double().norm().clamp_min(1e-6))


def gradients(inputs):
    return {key: value.grad.cpu() for key, value in inputs._asdict().items() if value is not None}
"""

PLAIN = """
worst = {}

def check(name, case):
    case, n = case.to(torch.float32), len(case.field)
    mask = threshold_mask(case.field, case.camera, sh_degree=case.sh_degree)
    weights = torch.randn(3, case.camera.height, case.camera.width, generator=torch.Generator().manual_seed(1))
    weights = weights * ~mask.pixels
    exact = case.to(torch.float64)
    fields = {key: value.detach().clone().requires_grad_() for key, value in exact.field.parameters.items()}
    exact = replace(exact, field=exact.field.with_parameters(fields))
    expected = exact.render(OracleRasterizer())
    (expected.image * weights).sum().backward()
    inputs = inputs_of(case, DEVICE, columns=4)
    found = gpu.rasterize(settings_of(case, DEVICE), inputs, Options())
    image = found.image.detach().cpu()
    (found.image * weights.to(DEVICE)).sum().backward()
    off = {"image": float(((image - expected.image).abs() * ~mask.pixels).max()) if n else 0.0}
    assert torch.equal(found.radii.cpu()[~mask.radii], expected.radii[~mask.radii].int()), name
    assert float(mask.pixels.float().mean()) < 0.5, name
    if not n:
        return print(name, off)
    by, smooth, half = gradients(inputs), ~mask.kinks, torch.tensor([case.camera.width, case.camera.height]) / 2
    if n:
        # By activated values, from those by raw ones.
        raw = {key: value.grad for key, value in exact.field.parameters.items()}
        opacities, scales = exact.field.opacity_logits.sigmoid(), exact.field.log_scales.exp()
        want = {
            "means": raw["means"], "sh": raw["sh"], "scales": raw["log_scales"] / scales,
            "opacities": (raw["opacity_logits"] / (opacities * (1 - opacities)))[:, None],
            "means2d": torch.cat([expected.means2d.grad * half, expected.absgrad2d * half], 1),
        }
        for key, value in want.items():
            assert torch.isfinite(by[key]).all(), (name, key)
            off[key] = relative(by[key][smooth], value.detach()[smooth])
        # Quaternions have no length in the oracle: without the part along them.
        q = normalize(exact.field.quaternions.detach(), dim=1)
        along = by["quats"].double() - (by["quats"].double() * q).sum(1, keepdim=True) * q
        length = exact.field.quaternions.detach().norm(dim=1, keepdim=True)
        off["quats"] = relative(along[smooth], (raw["quaternions"] * length)[smooth])
    print(name, {key: f"{value:.1e}" for key, value in off.items()})
    for key, value in off.items():
        assert value < LIMITS.get((name, key), LIMIT), (name, key, value)

for name in NAMES or ADVERSARIAL:
    check(name, ADVERSARIAL[name]())
"""

OPTIONS = """
def check(name, case, options=Options(), modifier=1.0, limit=2e-5, **how):
    camera = case.camera
    weights = torch.randn(4, camera.height, camera.width, generator=torch.Generator().manual_seed(1))
    found = []
    options = replace(options, positions=True)
    for engine, device in ((cpu, "cpu"), (gpu, DEVICE)):
        inputs = inputs_of(case, device, **how)
        output = engine.rasterize(settings_of(case, device, modifier), inputs, options)
        images = output.image if output.inverse_depths is None else torch.cat([output.image, output.inverse_depths])
        found.append((images, output, inputs))
    (exact, one, expected), (images, other, inputs) = found
    # A comparison that rounding turns in one of both changes a pixel by 1/255 of a colour.
    off = (exact.detach() - images.detach().cpu()).abs().amax(0)
    agree = (off < 1e-4).float()
    assert agree.mean() > 0.99, name
    print(name, f"image {float((off * agree).max()):.1e}", end=" ")
    assert (off * agree).max() < limit
    for each in (exact, images):
        (each * (weights[: len(each)] * agree).to(each.device)).sum().backward()
    for key in ("radii", "depths", "centres"):
        close = torch.isclose(getattr(one, key).float(), getattr(other, key).cpu().float(), rtol=1e-4, atol=1e-3)
        assert close.float().mean() > 0.98, (name, key)
    by = gradients(inputs)
    for key, value in gradients(expected).items():
        if key == "means2d" and options.inverse_depth:  # the CPU adds absolute values of image and depths apart
            by[key], value = by[key][:, :2], value[:, :2]
        off = relative(by[key], value)
        print(key, f"{off:.1e}", end=" ")
        assert off < limit, (name, key, off)
    print()

# Worst seen 7.3e-6.
check("signed", small(1, signed=True, width=35, height=21))
check("apart", replace(small(3), sh_degree=2), apart=True, columns=4)
check("dc alone", small(0), apart=True)
check("modifier", small(2), modifier=0.6)
check("given", small(2), given=True)
check("dimmed", small(1, pixels=(0.05, 3.0)), Options(antialiasing=True))
check("dimmed given", small(1, pixels=(0.05, 3.0)), Options(antialiasing=True, inverse_depth=True), given=True)
check("depth", small(0), Options(inverse_depth=True))
check("depth and absolute", small(0), Options(inverse_depth=True), columns=4)
check("blur", small(1), Options(blur=0.05))
exactly = Options(antialiasing=True, exact_antialiasing=True, blur=0.1)
check("dimmed exactly", small(1, pixels=(0.05, 3.0)), exactly)
for mult in (0.3, 1.0):
    check("snug", small(1, pixels=(1.0, 9.0)), Options(mult=mult), columns=4, apart=True)
"""

SUMS_OVER_PIXELS = """
def check(name, case, mult=None):
    pixels = case.camera.height * case.camera.width
    generator = torch.Generator().manual_seed(1)
    weights, by_image = torch.rand(pixels, generator=generator), torch.randn(3, pixels, generator=generator)
    sums = "weights", "counts", "blending", "distances"
    options = Options(sums=sums, pixel_weights=weights, blending=True, mult=mult)
    one, other = (
        engine.rasterize(settings_of(case, device), inputs_of(case, device), options)
        for engine, device in ((cpu, "cpu"), (gpu, DEVICE))
    )
    for key in sums:
        found, expected = other.sum(key).cpu(), one.sum(key)
        assert found.dtype == expected.dtype, key
        off = relative(found.double(), expected)
        print(name, key, f"{off:.1e}")
        assert off < 1e-2, (name, key)  # a comparison may turn; worst seen 2e-7
    leaders, expected = (each.blending.leaders(3).cpu() for each in (other, one))
    assert leaders.dtype == expected.dtype
    assert leaders.shape == expected.shape
    assert (leaders == expected).float().mean() > 0.98, name
    assert (expected[0] >= 0).any()
    off = (other.blending.transmittance.cpu() - one.blending.transmittance).abs()
    assert off.median() < 1e-6, name
    assert off.mean() < 1e-4, name
    assert other.blending.n == len(case.field)
    for key, argument in (("weighted_shares", weights), ("squared_gradients", by_image)):
        found = getattr(other.blending, key)(argument.to(DEVICE)).cpu()
        off = relative(found, getattr(one.blending, key)(argument))
        print(name, key, f"{off:.1e}")
        assert off < 1e-2, (name, key)  # worst seen 4e-6
    alone = gpu.rasterize(settings_of(case, DEVICE), inputs_of(case, DEVICE), Options(sums=("counts",), mult=mult))
    assert torch.equal(alone.sum("counts"), other.sum("counts"))
    assert alone.contributions.weights is None
    assert alone.blending is None

check("snug", small(1), 0.5)
opaque = small(0)
check("opaque", replace(opaque, field=opaque.field.with_parameters({"opacity_logits": torch.linspace(4.0, 9.0, 20)})))
"""

CHANGED_IN_PLACE = """
case = small(0, width=17, height=9)
found = []
for changed in (False, True):
    inputs = inputs_of(case, DEVICE)
    output = gpu.rasterize(settings_of(case, DEVICE), inputs, Options(inverse_depth=True))
    image, depths = output.image, output.inverse_depths
    if changed:
        image *= 0.5
        depths *= 0.5
        output.radii[:3] = 0
        image, depths = 2 * image, 2 * depths
    (image.square().sum() + depths.square().sum()).backward()
    found.append(gradients(inputs))
for key, value in found[0].items():
    assert relative(found[1][key], value) < 1e-6, key  # worst seen 1e-7
"""

LITTLE_ROOM = """
tiles.LEAST_ROOM = 8


def rendered():
    inputs = inputs_of(small(), DEVICE, columns=4)
    options = Options(sums=("counts", "blending"), inverse_depth=True, positions=True)
    output = gpu.rasterize(settings_of(small(), DEVICE), inputs, options)
    (output.image.square().sum() + output.inverse_depths.sum()).backward()
    outputs = {key: getattr(output, key) for key in ("image", "inverse_depths", "radii", "centres", "depths")}
    return outputs | {key: output.sum(key) for key in options.sums} | gradients(inputs)


first = rendered()
(room,) = tiles._rooms.values()
assert room > 8, room
for key in tiles._rooms:
    tiles._rooms[key] = 1.0
again = rendered()
assert list(tiles._rooms.values()) == [room]
for key, value in first.items():
    assert relative(again[key], value) < 1e-6, key  # worst seen 0
"""

CHANGED_MATRICES = """
case, other = small(0, width=17, height=9), small(0, width=17, height=9)
other = replace(other, camera=make_camera(17, 9, pose_seed=8, principal_offset=(1.0, 2.0)))


def check(name, settings, expected):
    output = gpu.rasterize(settings, inputs_of(case, DEVICE), Options())
    assert torch.equal(output.image, expected.image), name
    assert torch.equal(output.radii, expected.radii), name


first, second = settings_of(case, DEVICE), settings_of(other, DEVICE)
expected = [gpu.rasterize(settings_of(each, DEVICE), inputs_of(case, DEVICE), Options()) for each in (case, other)]
assert not torch.equal(expected[0].image, expected[1].image)
check("first", first, expected[0])
check("second", second, expected[1])
check("first again", first, expected[0])
for name in ("viewmatrix", "projmatrix", "campos"):
    getattr(first, name).copy_(getattr(second, name))
check("changed in place", first, expected[1])
for name in ("viewmatrix", "projmatrix", "campos"):
    getattr(first, name).data = getattr(settings_of(case, DEVICE), name)
check("other memory", first, expected[0])
for name in ("viewmatrix", "projmatrix", "campos"):
    setattr(second, name, getattr(settings_of(case, DEVICE), name))
check("other tensors", second, expected[0])
second.tanfovx = 1.1 * second.tanfovx
output = gpu.rasterize(second, inputs_of(case, DEVICE), Options())
assert not torch.equal(output.image, expected[0].image), "another field of view"
second.tanfovx = settings_of(case, DEVICE).tanfovx
with torch.inference_mode():
    for k, each in enumerate((case, other)):  # such tensors have no versions
        check("inference", settings_of(each, DEVICE), expected[k])
check("after inference", second, expected[0])
second.bg.mul_(2.0)
assert not torch.equal(gpu.rasterize(second, inputs_of(case, DEVICE), Options()).image, expected[0].image)
# Cameras go when their matrices do.
kept = len(gpu._cameras._made)
assert kept > 0
del first, second
assert len(gpu._cameras._made) == 0, kept
"""

REPLAYED = """
import gc
import weakref

from lapgs_plugin.gpu_raster import replay

whole = random_case(20_000, 160, 90, seed=5, sh_degree=1, background=COLORED, pixels=(0.5, 6.0)).to(torch.float32)


def of(n):
    return replace(whole, field=whole.field.with_parameters({k: v[:n] for k, v in whole.field.parameters.items()}))


EVERYTHING = Options(sums=("counts",), inverse_depth=True, positions=True)


def render(case, replayed, options=EVERYTHING, settings=None):
    replay.ENABLED = replayed
    inputs = inputs_of(case, DEVICE, columns=4)
    return inputs, gpu.rasterize(settings or settings_of(case, DEVICE), inputs, options)


def differentiate(view, **how):
    inputs, output = view
    for value in inputs:
        if value is not None:
            value.grad = None
    loss = output.image.square().sum()
    (loss if output.inverse_depths is None else loss + output.inverse_depths.sum()).backward(**how)
    return view


def check(name, view, expected):
    for key in ("image", "inverse_depths", "radii", "centres", "depths"):
        one, other = getattr(view[1], key), getattr(expected[1], key)
        assert one is other is None or torch.equal(one, other), (name, key)
    if other := expected[1].contributions:
        for key, value in vars(other).items():
            assert value is None or relative(view[1].sum(key), value.cpu()) < 1e-5, (name, key)
    by = gradients(view[0])
    for key, value in gradients(expected[0]).items():
        assert relative(by[key], value) < 1e-5, (name, key)  # sums over pixels have no order


sizes = 20_000, 19_000, 17_000, 20_000
expected = {n: differentiate(render(of(n), False)) for n in sizes}
for i in range(3):
    check(f"view {i}", differentiate(render(whole, True)), expected[20_000])
for n in sizes:  # a frame has room for all of them
    check(n, differentiate(render(of(n), True)), expected[n])
# Two views at once, one of which is differentiated twice.
first, second = render(of(19_000), True), render(whole, True)
check("second", differentiate(second, retain_graph=True), expected[20_000])
check("first", differentiate(first, retain_graph=True), expected[19_000])
third = render(of(17_000), True)
check("first again", differentiate(first), expected[19_000])
check("third", differentiate(third), expected[17_000])
# Room for pairs that does not suffice.
for key in tiles._rooms:
    tiles._rooms[key] = 1.0
check("little room", differentiate(render(whole, True)), expected[20_000])
assert len(replay._frames._by_kind) == 1
assert not replay._broken, replay._broken
# Views of other sizes and with other outputs in between, whose results are held.
replay.MOST_FRAMES = 4
half = random_case(20_000, 80, 45, seed=6, sh_degree=1, background=COLORED, pixels=(0.5, 6.0)).to(torch.float32)
shares = Options(sums=("blending",))
weighted = Options(sums=("weights", "counts"), pixel_weights=torch.rand(160 * 90, device=DEVICE))
kinds = {"whole": (whole, EVERYTHING), "half": (half, EVERYTHING), "bare": (whole, Options())}
kinds |= {"shares": (whole, shares), "weighted": (whole, weighted)}
plain = {name: differentiate(render(case, False, options)) for name, (case, options) in kinds.items()}
for name, (case, options) in kinds.items():
    for i in range(replay.REPEATED):
        check(f"{name} alone {i}", differentiate(render(case, True, options)), plain[name])
for i in range(3):
    views = {name: render(case, True, options) for name, (case, options) in kinds.items()}
    for name, view in views.items():
        check(f"{name} {i}", differentiate(view), plain[name])
assert len(replay._frames._by_kind) == 4  # weights are added up elsewhere, in the frame of bare images
# A background that changes, in place or not, and views without gradients.
settings = settings_of(whole, DEVICE)
for name in ("first", "again", "in place", "row", "another", "inference", "after inference"):
    if name == "in place":
        settings.bg.mul_(0.5)
    if name == "row":
        settings.bg = settings.bg[None].mul(0.5)
    if name == "another":
        settings.bg = settings.bg[0].flip(0)
    if name == "inference":
        with torch.inference_mode():
            settings.bg = settings.bg + 0.25
            _, seen = render(whole, True, EVERYTHING, settings)
            assert torch.equal(seen.image, render(whole, False, EVERYTHING, settings)[1].image)
    expected_view = differentiate(render(whole, False, EVERYTHING, settings))
    with torch.no_grad():
        unused = render(whole, True, EVERYTHING, settings)
    check(name, differentiate(render(whole, True, EVERYTHING, settings)), expected_view)
    assert torch.equal(unused[1].image, expected_view[1].image), name
assert not replay._broken, replay._broken
# A frame that another one replaces gives its memory back at once, not when Python looks for cycles.
gc.disable()
replay.MOST_ROOM = 1.1
kind, = (kind for kind, frame in replay._frames._by_kind.items() if kind[2] == (160, 90) and kind[3].depth)
replaced = weakref.ref(replay._frames._by_kind[kind])
for i in range(replay.REPEATED + 1):
    check("other frame", differentiate(render(of(17_000), True)), expected[17_000])
assert kind in replay._frames._by_kind
assert replaced() is None
"""

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only"
)
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
# Long needles lose digits: worst seen 2.5e-3 by scales, 3.5e-4 by quaternions, 7.7e-5 by means; of others 8.5e-6.
LIMITS = """
LIMIT, LIMITS = 5e-5, {("needles", "scales"): 1e-2, ("needles", "quats"): 2e-3, ("needles", "means"): 1e-3}
"""


@needs_triton
def test_plain_rules_interpreted_against_the_oracle() -> None:
    names = ["one_pixel", "saturated", "needles", "off_centre", "large_quaternions", "no_gaussians"]
    run_checks("cpu", f"NAMES = {names}\n{COMMON}{LIMITS}{PLAIN}", TRITON_INTERPRET="1")


@needs_triton
def test_options_interpreted_against_the_engine_of_the_cpu() -> None:
    run_checks("cpu", COMMON + OPTIONS, TRITON_INTERPRET="1")


@needs_triton
def test_sums_over_pixels_interpreted_against_the_engine_of_the_cpu() -> None:
    run_checks("cpu", COMMON + SUMS_OVER_PIXELS, TRITON_INTERPRET="1")


@pytest.mark.gpu
@needs_cuda
def test_compiled() -> None:
    run_checks(
        "cuda", f"NAMES = []\n{COMMON}{LIMITS}{PLAIN}{OPTIONS}{SUMS_OVER_PIXELS}{CHANGED_IN_PLACE}{CHANGED_MATRICES}"
    )


@pytest.mark.gpu
@needs_cuda
def test_views_by_graphs_equal_those_without() -> None:
    run_checks("cuda", COMMON + REPLAYED)


@needs_triton
def test_views_for_which_there_was_too_little_room_are_rendered_again() -> None:
    run_checks("cpu", COMMON + LITTLE_ROOM, TRITON_INTERPRET="1")


@needs_triton
def test_matrices_may_be_changed_in_place() -> None:
    run_checks("cpu", COMMON + CHANGED_MATRICES, TRITON_INTERPRET="1")


@needs_triton
def test_outputs_may_be_changed_in_place() -> None:
    run_checks("cpu", COMMON + CHANGED_IN_PLACE, TRITON_INTERPRET="1")
