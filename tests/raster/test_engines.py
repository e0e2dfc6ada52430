"""Both engines give what every variant returns: the GPU's is interpreted on a CPU, or compiled on a GPU."""

from __future__ import annotations

import importlib.util

import pytest

from tests.unit.test_blend_kernels import run_checks

CHECKS = """
import math
import torch
from torch import Tensor

from lapgs_plugin.family import VARIANTS, engine, stand_ins
from lapgs_plugin.gpu_raster import tiles
from tests.raster.scenes import COLORED, make_camera, random_case
from tests.raster.test_standins import SPLIT, activated, settings_of

ENGINES = {"cpu": "lapgs_plugin.family.cpu", DEVICE: "lapgs_plugin.family.gpu"}
if DEVICE == "cpu":
    tiles.LEAST_ROOM = 256  # places for pairs are slow to interpret

N, HEIGHT, WIDTH = 12, 18, 20
camera = make_camera(WIDTH, HEIGHT, pose_seed=7, principal_offset=(1.0, -1.0))
case = random_case(N, WIDTH, HEIGHT, seed=5, sh_degree=2, background=COLORED, camera=camera, pixels=(0.5, 6.0))
case = case.to(torch.float32)
generator = torch.Generator().manual_seed(0)
MAP = torch.rand(HEIGHT, WIDTH, generator=generator)
BY = torch.randn(7, HEIGHT, WIDTH, generator=generator)
SETTINGS = {
    "antialiasing": True, "mult": 0.5, "get_flag": True, "metric_map": (MAP.view(-1) < 0.4).int(), "pixel_weights": MAP,
    "kernel_size": 0.1, "subpixel_offset": torch.zeros(HEIGHT, WIDTH, 2), "depth_threshold": 4.0,
    "use_train_speedup": False, "ignored_rate": 0.0, "lambda_dssim": 0.2, "use_hwc": False,
    "confidence": torch.rand(N, 1, generator=torch.Generator().manual_seed(1)),
}
INPUTS = {
    "speedy-splat": {"scores": torch.zeros(N, 1)},
    "mini-splatting2": {"culling": torch.arange(N) % 7 == 0, "flag_max_count": True},
    "efficientgs": {
        "gt_image": None, "top_k": 2, "pix_loss": BY[:3].abs(),
        "sparse_shs_degree": torch.arange(N, dtype=torch.int32) % 3,
    },
}


def on(device, value):
    return value.detach().clone().to(device) if isinstance(value, Tensor) else value


def prepared(variant, device, **changes):
    # The module, its settings, and the leaves that are passed to it.
    module = stand_ins(variant)[VARIANTS[variant].module]
    settings = settings_of(module, case.camera, case.background, 2, **(SETTINGS | changes))
    settings = type(settings)(*(on(device, value) for value in settings))
    values = activated(case) | {"means2D": torch.zeros(N, 4 if variant in ("fastgs", "absgs") else 3)}
    if variant in SPLIT or variant == "mini-splatting2":
        sh = values.pop("shs")
        values |= {"dc": sh[:, :1], "shs": sh[:, 1:]}
    if variant == "2dgs":
        values["scales"] = values["scales"][:, :2].contiguous()
    leaves = {name: on(device, value).requires_grad_() for name, value in values.items()}
    others = {name: on(device, value) for name, value in INPUTS.get(variant, {}).items()}
    if "scores" in others:
        others["scores"].requires_grad_()
        leaves["scores"] = others.pop("scores")
    return module.GaussianRasterizer(settings), leaves, others


def by_both(call):
    # What `call(device)` returns by each engine, on the CPU.
    found = []
    for device, name in (("cpu", "lapgs_plugin.family.cpu"), (DEVICE, "lapgs_plugin.family.gpu")):
        engine.ENGINES[device] = name
        results = call(device)
        assert all(value.device.type == device for value in results.values()), results
        found.append({key: value.detach().cpu() for key, value in results.items()})
    engine.ENGINES["cpu"] = "lapgs_plugin.family.cpu"
    return found


def close(name, call, limit=1e-4):
    expected, found = by_both(call)
    assert expected.keys() == found.keys(), name
    for key, value in expected.items():
        other = found[key]
        assert (value.shape, value.dtype) == (other.shape, other.dtype), (name, key)
        if value.is_floating_point():
            off = float((other.double() - value.double()).norm() / value.double().norm().clamp_min(1e-30))
            print(name, key, f"{off:.1e}")
            assert off <= limit, (name, key, off)
        elif value.numel():
            assert (other == value).float().mean() > 0.9, (name, key)  # rounding turns a comparison


def forward_and_backward(variant):
    def call(device):
        rasterizer, leaves, others = prepared(variant, device)
        outputs = rasterizer(**leaves, **others)
        loss = (outputs[0] * on(device, BY[:3])).sum()
        for one in outputs[1:]:
            if one.requires_grad:
                loss = loss + (one * on(device, BY[: len(one)])).sum()
        loss.backward()
        results = {f"output {i}": value for i, value in enumerate(outputs)}
        return results | {name: leaf.grad for name, leaf in leaves.items()}

    return call


for variant in NAMES:
    close(variant, forward_and_backward(variant))


def simply(device):
    rasterizer, leaves, others = prepared("mini-splatting2", device)
    others.pop("flag_max_count")
    return {f"output {i}": value for i, value in enumerate(rasterizer.render_simp(**leaves, **others))}


def depths(device):
    rasterizer, leaves, _ = prepared("mini-splatting", device)
    return rasterizer.render_depth(**leaves)


def raw(device):
    module, field, camera = stand_ins("faster-gs")["FasterGSCudaBackend.torch_bindings"], case.field, case.camera
    info = torch.zeros(2, N, device=device)
    settings = module.RasterizerSettings(
        w2c=on(device, camera.world_to_camera[:3]), cam_position=on(device, camera.position),
        bg_color=torch.tensor(case.background, device=device), active_sh_bases=9, width=WIDTH, height=HEIGHT,
        focal_x=camera.fx, focal_y=camera.fy, center_x=camera.cx, center_y=camera.cy, near_plane=0.2, far_plane=1e4,
        proper_antialiasing=True,
    )
    parts = field.means, field.log_scales, field.quaternions, field.opacity_logits[:, None], *field.sh.split([1, 8], 1)
    leaves = [on(device, part).requires_grad_() for part in parts]
    image = module.diff_rasterize(*leaves, info, settings)
    (image * on(device, BY[:3])).sum().backward()
    return {"image": image, "info": info} | {f"leaf {i}": leaf.grad for i, leaf in enumerate(leaves)}


if EXTRAS:
    close("mini-splatting2, render_simp", simply)
    assert (depths("cpu")["rendered_depth"] > 0).any(), "nothing is blended here: the test shows nothing"
    close("mini-splatting, render_depth", depths)  # worst seen: 3e-7
    close("faster-gs", raw)
"""

DEVICE_CHECKS = """
# What a checkout needs compiled beside its rasterizer.
modules = stand_ins("3dgs-mcmc", neighbours=True)
points = torch.randn(50, 3, generator=generator)
opacities, scales = torch.rand(50, 1, generator=generator), torch.rand(50, 3, generator=generator)
binoms = torch.tensor([[float(math.comb(n, k)) for k in range(51)] for n in range(51)])
images = torch.rand(2, 1, 3, 40, 50, generator=generator)


def neighbours(device):
    distances, nearest = modules["simple_knn._C"].distCUDA2(on(device, points))
    return {"distances": distances, "nearest": nearest}


def relocated(device):
    copies = torch.arange(50, device=device)[:, None] % 5 + 1
    relocate = modules["diff_gaussian_rasterization"].compute_relocation
    found = relocate(on(device, opacities), on(device, scales), copies, on(device, binoms), 51)
    return dict(zip(("opacity", "scale"), found, strict=True))


def similar(device):
    first, second = on(device, images)
    first.requires_grad_()
    results = {}
    for name in ("fused_ssim", "fused_ssim_"):
        for padding in ("same", "valid"):
            value = vars(stand_ins("taming")["fused_ssim"])[name](first, second, padding=padding)
            results[f"{name} {padding}"] = value
            results[f"{name} {padding} gradient"] = torch.autograd.grad(value.square().sum(), first)[0]
    binding = stand_ins("graphdeco-accel")["diff_gaussian_rasterization._C"]
    results["map"] = binding.fusedssim(1e-4, 9e-4, first, second)
    results["by map"] = binding.fusedssim_backward(1e-4, 9e-4, first, second, on(device, images[1]))
    return results


def moved(device):
    generator = torch.Generator().manual_seed(3)
    parameter = on(device, torch.randn(700, 16, 3, generator=generator)).requires_grad_()
    make = stand_ins("taming")["diff_gaussian_rasterization"].SparseGaussianAdam
    optimizer = make([{"params": [parameter], "lr": 0.1}], lr=0.0, eps=1e-15)
    for _ in range(3):
        parameter.grad = on(device, torch.randn(700, 16, 3, generator=generator))
        optimizer.step(on(device, torch.rand(700, generator=generator) < 0.5), 700)
    return {"parameter": parameter, **{key: value for key, value in optimizer.state[parameter].items() if value.ndim}}


for call in (neighbours, relocated, similar, moved):
    close(call.__name__, call)

# Nothing that trains waits for the GPU, but for Mini-Splatting's inverse matrices.
torch.cuda.set_sync_debug_mode("error")
for variant in NAMES:
    engine.ENGINES[DEVICE] = ENGINES[DEVICE]
    torch.cuda.set_sync_debug_mode("default")
    rasterizer, leaves, others = prepared(variant, DEVICE)
    rasterizer(**leaves, **others)
    torch.cuda.set_sync_debug_mode("error")
    rasterizer(**leaves, **others)[0].sum().backward()
torch.cuda.set_sync_debug_mode("default")
"""

VARIANTS_OF_CLASSES = (
    "graphdeco", "graphdeco-aa", "taming", "fastgs", "speedy-splat", "mini-splatting", "mini-splatting2", "3dgs-mcmc",
    "absgs", "mip-splatting", "efficientgs", "pixel-gs", "2dgs", "depth-and-alpha", "depth-acc", "confidence",
)  # fmt: skip
needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only"
)


@needs_triton
def test_interpreted() -> None:
    """Two variants whose results are not those of graphdeco's; `test_all_interpreted` has the others."""
    run_checks("cpu", f"NAMES, EXTRAS = {('taming', 'speedy-splat')}, False\n{CHECKS}", TRITON_INTERPRET="1")


@pytest.mark.slow
@needs_triton
def test_all_interpreted() -> None:
    run_checks("cpu", f"NAMES, EXTRAS = {VARIANTS_OF_CLASSES}, True\n{CHECKS}", TRITON_INTERPRET="1")


@pytest.mark.gpu
def test_compiled() -> None:
    run_checks("cuda", f"NAMES, EXTRAS = {VARIANTS_OF_CLASSES}, True\n{CHECKS}{DEVICE_CHECKS}")
