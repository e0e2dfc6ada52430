"""Test `cuda_on_cpu`: a script for "cuda" runs inside, and everything is restored afterwards."""

from __future__ import annotations

import sys
import threading
import time
from importlib import import_module
from importlib.util import find_spec
from multiprocessing.pool import ThreadPool
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn
from torch.utils._device import _device_constructors

from lapgs_plugin.checkouts import absent_modules as absent
from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
from lapgs_plugin.errors import MissingExtraError, UserInputError

CUDA = ["cuda", "cuda:0", torch.device("cuda"), torch.device("cuda", 1)]


def on_cpu(tensor: Tensor) -> bool:
    return tensor.device == torch.device("cpu") and not tensor.is_cuda


def missing(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Hide packages, whether this machine has them or not."""
    for name in [key for key in sys.modules if key.partition(".")[0] in names]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(absent, "find_spec", lambda name: None if name in names else find_spec(name))


def test_threads_that_are_started_inside_name_devices_too() -> None:
    """As checkouts that load photos in a pool of threads."""
    run = threading.Thread.run
    with cuda_on_cpu("fastgs"), ThreadPool(2) as pool:
        assert all(on_cpu(made) for made in pool.map(lambda _: torch.ones(2, device="cuda").cuda(), range(4)))
    assert threading.Thread.run is run


@pytest.mark.parametrize("device", CUDA, ids=repr)
def test_every_way_to_name_a_device_means_the_cpu(device: Any) -> None:
    with cuda_on_cpu("fastgs"):
        ones = torch.ones(2, 3, device=device)
        tensors = [
            ones,
            torch.tensor([1.0], device=device),
            torch.rand(3, device=device),
            torch.eye(3, 4, device=device),
            torch.arange(4, device=device),
            torch.zeros_like(ones, dtype=torch.bool, device=device),
            torch.as_tensor(np.zeros(2), device=device),
            ones.new_zeros(2, device=device),
            ones.to(device),
            ones.to(device, torch.float64),
            ones.to(device=device, non_blocking=True),
            ones.cuda(device),
            ones.cuda(non_blocking=True),
            nn.Linear(2, 3, device=device).weight,
            nn.Linear(2, 3).to(device).weight,
            nn.Linear(2, 3).cuda().bias,
        ]
        assert all(on_cpu(tensor) for tensor in tensors)
        assert ones.to(device, torch.float64).dtype == torch.float64


def calls_that_work(function: Any) -> Any:
    """Return arguments for a function of torch that takes a device; None if no common ones fit."""
    ones = torch.ones(2, 2)
    options = (
        (),
        (2,),
        (2, 2),
        ([1.0],),
        (ones,),
        (ones, 2.0),
        ((2, 2), (2, 1)),
        ((2, 2), 1.0),
        (0, 5),
        (0, 5, 3),
    )
    for arguments in options:
        try:
            function(*arguments, device="cpu")
        except (TypeError, RuntimeError, ValueError, UserWarning):
            continue
        return arguments
    return None


def test_every_factory_of_torch_takes_cuda() -> None:
    """All functions of torch that make tensors take a device, by its own list."""
    likes = [getattr(torch, name) for name in dir(torch) if name.endswith("_like")]
    arguments = {function: calls_that_work(function) for function in [*_device_constructors(), *likes]}
    tried = {function: given for function, given in arguments.items() if given is not None}
    assert len(tried) >= 25  # 34 of 43 in torch 2.13; the others take uncommon arguments
    with cuda_on_cpu("graphdeco"):
        for function, given in tried.items():
            tensor = function(*given, device="cuda")
            assert tensor.device.type == "cpu", function


def test_numbers_are_devices_only_where_torch_takes_them_for_such() -> None:
    with cuda_on_cpu("fastgs"):
        assert on_cpu(torch.ones(2).to(0))
        assert on_cpu(torch.ones(2).cuda(0))
        assert torch.ones(2).to(torch.int32).dtype == torch.int32
        assert torch.ones(2).to(torch.ones(1, dtype=torch.int64)).dtype == torch.int64
        assert torch.ones(2, device="meta").device.type == "meta"


def test_cuda_is_known_in_hooks_and_in_backward_passes() -> None:
    class Doubled(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: Tensor) -> Tensor:
            return x * torch.full((1,), 2.0, device="cuda")

        @staticmethod
        def backward(ctx: Any, grad: Tensor) -> Tensor:
            return grad * torch.full((1,), 2.0, device="cuda")

    x = torch.ones(3, requires_grad=True)
    with cuda_on_cpu("fastgs"):
        y = Doubled.apply(x)
        y.register_hook(lambda grad: grad + torch.ones(3, device="cuda"))
        y.backward(gradient=torch.ones(3).cuda(), retain_graph=True)
        assert x.grad is not None
        assert x.grad.tolist() == [4.0, 4.0, 4.0]
        y.sum().backward(inputs=[x], retain_graph=True)
        assert torch.autograd.grad(y.sum(), x)[0].tolist() == [4.0, 4.0, 4.0]
    assert x.grad.tolist() == [8.0, 8.0, 8.0]


def test_events_measure_and_the_rest_of_torch_cuda_does_nothing() -> None:
    with cuda_on_cpu("taming"):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        with pytest.raises(RuntimeError, match="recorded"):
            start.elapsed_time(end)
        stream = torch.cuda.Stream()
        with torch.cuda.stream(stream), torch.cuda.device(0):
            start.record()
            time.sleep(0.02)
            end.record(torch.cuda.current_stream())
        stream.wait_event(end)
        stream.wait_stream(torch.cuda.default_stream())
        end.synchronize()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.set_device(torch.device("cuda:0"))
        torch.cuda.manual_seed_all(3)
        assert 20 <= start.elapsed_time(end) < 2000
        assert end.query()
        assert torch.cuda.max_memory_allocated() == 0
        assert not torch.cuda.is_available()
        assert torch.ones(2).pin_memory().tolist() == [1, 1]


def test_checkpoints_of_a_gpu_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"xyz": torch.arange(6.0).reshape(2, 3)}
    with monkeypatch.context() as patch:
        patch.setattr(torch.serialization, "location_tag", lambda storage: "cuda:0")
        torch.save(values, tmp_path / "chkpnt.pth")
    with cuda_on_cpu("graphdeco"):
        for loaded in (torch.load(tmp_path / "chkpnt.pth"), torch.load(tmp_path / "chkpnt.pth", map_location="cuda")):
            assert on_cpu(loaded["xyz"])
            assert torch.equal(loaded["xyz"], values["xyz"])


def test_same_random_numbers_as_without() -> None:
    torch.manual_seed(5)
    plain = torch.rand(4), torch.randperm(9)
    with cuda_on_cpu("fastgs"):
        torch.manual_seed(5)
        assert torch.equal(torch.rand(4, device="cuda"), plain[0])
        assert torch.equal(torch.randperm(9, device="cuda"), plain[1])
        generator = torch.Generator(device="cuda").manual_seed(5)
        assert torch.equal(torch.rand(4, generator=generator, device="cuda"), plain[0])
    assert isinstance(generator, torch.Generator)


def state() -> dict[str, Any]:
    """Return all state that the context changes: modules, names of torch and torch.cuda, and torch's modes."""
    symbols = {f"torch.cuda.{name}": value for name, value in vars(torch.cuda).items()}
    symbols |= {f"torch.autograd.{name}": value for name, value in vars(torch.autograd).items()}
    symbols |= {f"torch.{name}": value for name, value in vars(torch).items()}
    symbols |= {f"Tensor.{name}": value for name, value in vars(Tensor).items()}
    symbols |= {f"Module.{name}": value for name, value in vars(nn.Module).items()}
    symbols |= {f"sys.modules {name}": module for name, module in sys.modules.items()}
    symbols["modes"] = torch._C._len_torch_function_stack()
    return symbols


def test_everything_is_restored_by_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    missing(monkeypatch, "torchvision", "cv2", "websockets")
    with cuda_on_cpu("taming"):
        assert on_cpu(torch.ones(1, device="cuda"))  # torch imports some modules at first use
    before = state()
    with cuda_on_cpu("taming"):
        inside = state()
    with pytest.raises(ZeroDivisionError), cuda_on_cpu("taming"):
        divmod(1, 0)
    after = state()
    assert {name for name in inside if inside[name] is not before.get(name)} >= {
        "torch.load", "torch.autograd._engine_run_backward", "modes", "torch.cuda.Event", "torch.cuda.synchronize",
        "sys.modules diff_gaussian_rasterization",
        "sys.modules torchvision.transforms", "sys.modules cv2",
    }  # fmt: skip
    assert before.keys() == after.keys()
    assert [name for name in before if before[name] is not after[name]] == []


def test_a_failed_start_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    before = state()
    with pytest.raises(UserInputError, match="'nothing'"), cuda_on_cpu("nothing"):
        pass
    monkeypatch.setitem(sys.modules, "simple_knn", ModuleType("simple_knn"))
    with pytest.raises(UserInputError, match="simple_knn is already imported"), cuda_on_cpu("fastgs"):
        pass
    monkeypatch.delitem(sys.modules, "simple_knn")
    assert [name for name, value in state().items() if value is not before.get(name)] == []


def test_an_installed_package_is_preferred(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = ModuleType("cv2")
    missing(monkeypatch, "websockets")
    monkeypatch.setitem(sys.modules, "cv2", mine)
    with cuda_on_cpu("graphdeco-aa"):
        assert import_module("cv2") is mine
        assert "not installed" in str(import_module("websockets").__doc__)
    assert sys.modules["cv2"] is mine
    assert "websockets" not in sys.modules


def test_packages_that_are_not_there_are_named_when_they_are_called(monkeypatch: pytest.MonkeyPatch) -> None:
    missing(monkeypatch, "torchvision", "cv2", "websockets")
    with cuda_on_cpu("fastgs"):
        models = import_module("torchvision.models")
        with pytest.raises(MissingExtraError, match=r"torchvision\.models\.vgg16 .*pip install torchvision"):
            models.vgg16()
        with pytest.raises(MissingExtraError, match="pip install opencv-python-headless"):
            import_module("cv2").imread("depth.png")
        with pytest.raises(MissingExtraError, match=r"websockets\.serve"):
            import_module("websockets").serve()
        assert not hasattr(models, "__file__")  # inspect asks every module for it
        with pytest.raises(ModuleNotFoundError):
            import_module("torchvision.io")


def test_edges_are_those_of_eight_bit_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The two transforms multiply by 255 and round down, and divide by 255."""
    missing(monkeypatch, "torchvision")
    levels = np.random.default_rng(0).integers(0, 256, (3, 4, 5))
    between = torch.from_numpy((levels + 0.4) / 255.4).float()
    with cuda_on_cpu("taming"):
        transforms = import_module("torchvision.transforms")
        picture = transforms.ToPILImage()(torch.from_numpy(levels / 255).float().cuda())
        assert picture.mode == "RGB"
        assert picture.size == (5, 4)
        assert np.abs(np.asarray(picture).transpose(2, 0, 1) - levels).max() <= 1  # k / 255 * 255 can be below k
        cut = np.floor(between.numpy() * np.float32(255))
        assert np.array_equal(np.asarray(transforms.ToPILImage()(between)).transpose(2, 0, 1), cut)
        assert np.array_equal(np.asarray(transforms.ToPILImage()(between[:1])), cut[0])
        back = transforms.ToTensor()(picture)
        assert back.shape == (3, 4, 5)
        assert np.array_equal((back * 255).round().numpy(), np.asarray(picture).transpose(2, 0, 1))
        assert transforms.ToTensor()(picture.convert("L")).shape == (1, 4, 5)
        with pytest.raises(MissingExtraError, match="mode F"):
            transforms.ToTensor()(Image.new("F", (2, 2)))
        with pytest.raises(MissingExtraError, match=r"\(2, 4, 5\)"):
            transforms.ToPILImage()(between[:2])
        with pytest.raises(MissingExtraError, match="ndarray"):
            transforms.ToPILImage()(between.numpy())


SCRIPT = """
import torch
from diff_gaussian_rasterization_fastgs import GaussianRasterizationSettings, GaussianRasterizer
from fused_ssim import fused_ssim
from simple_knn._C import distCUDA2

torch.cuda.set_device(torch.device("cuda:0"))
torch.manual_seed(0)
points = torch.rand(40, 3).cuda() + torch.tensor([-0.5, -0.5, 2.0], device="cuda")
view = torch.eye(4).cuda()
projection = torch.tensor([[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]], device="cuda")
settings = GaussianRasterizationSettings(
    image_height=24, image_width=24, tanfovx=0.5, tanfovy=0.5, bg=torch.zeros(3, device="cuda"), scale_modifier=1.0,
    viewmatrix=view, projmatrix=projection, sh_degree=0, campos=torch.zeros(3, device="cuda"), mult=0.5,
    prefiltered=False, debug=False, get_flag=None, metric_map=torch.zeros(576, dtype=torch.int, device="cuda"),
)
target = torch.rand(3, 1, 1, device="cuda").expand(3, 24, 24)
colors = torch.nn.Parameter(torch.zeros(40, 3, device="cuda"))
scales = torch.sqrt(distCUDA2(points))[:, None].repeat(1, 3)
optimizer = torch.optim.Adam([colors], lr=0.05)
losses = []
for _ in range(20):
    screen = torch.zeros(40, 4, device="cuda", requires_grad=True)
    image, radii, _ = GaussianRasterizer(settings)(
        points, screen, torch.full((40, 1), 0.9, device="cuda"), colors_precomp=colors, scales=scales,
        rotations=torch.eye(1, 4, device="cuda").repeat(40, 1),
    )
    loss = (image - target.cuda()).abs().mean() + 1 - fused_ssim(image[None], target[None].contiguous())
    loss.backward()
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    losses.append(loss.item())
"""


def test_a_script_trains() -> None:
    names: dict[str, Any] = {}
    with cuda_on_cpu("fastgs"):
        exec(compile(SCRIPT, "train.py", "exec"), names)
    assert names["losses"][-1] < 0.7 * names["losses"][0]
