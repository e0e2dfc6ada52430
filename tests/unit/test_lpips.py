"""Test LPIPS against torchmetrics in float64 on networks built here, and the refusal of unusable files."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation import lpips
from lapgs_plugin.evaluation.lpips import AS_3DGS, NETWORKS, Lpips, LpipsRequest, lpips_metrics

CPU = torch.device("cpu")


class Fire(nn.Module):
    """SqueezeNet's fire module, written from its paper."""

    def __init__(self, channels: int, squeeze: int, expand: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.squeeze(x))
        return torch.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], 1))


def from_text(text: str) -> nn.Sequential:
    """Build a network from layers such as "conv 3 64 11 4 2", "relu", "pool 3 2", "fire 64 16 64"."""
    layers: list[nn.Module] = []
    for line in text.split(","):
        kind, *numbers = line.split()
        values = [int(number) for number in numbers]
        if kind == "conv":
            before, after, size, stride, padding = values
            layers.append(nn.Conv2d(before, after, size, stride, padding))
        elif kind == "relu":
            layers.append(nn.ReLU())
        elif kind == "fire":
            layers.append(Fire(*values))
        else:
            layers.append(nn.MaxPool2d(values[0], values[1], ceil_mode=kind == "ceilpool"))
    return nn.Sequential(*layers)


def vgg_text() -> str:
    channels, lines = 3, []
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width:
            lines += [f"conv {channels} {width} 3 1 1", "relu"]
            channels = width
        else:
            lines.append("pool 2 2")
    return ",".join(lines)


TEXTS = {
    "alexnet": "conv 3 64 11 4 2,relu,pool 3 2,conv 64 192 5 1 2,relu,pool 3 2,conv 192 384 3 1 1,relu,"
    "conv 384 256 3 1 1,relu,conv 256 256 3 1 1,relu",
    "vgg16": vgg_text(),
    "squeezenet1_1": "conv 3 64 3 2 0,relu,ceilpool 3 2,fire 64 16 64,fire 128 16 64,ceilpool 3 2,fire 128 32 128,"
    "fire 256 32 128,ceilpool 3 2,fire 256 48 192,fire 384 48 192,fire 384 64 256,fire 512 64 256",
}
NAMES = {"alex": "alexnet", "vgg": "vgg16", "squeeze": "squeezenet1_1"}


def random_weights(name: str, learned: bool = True) -> dict[str, Tensor]:
    """Make weights in torchvision's layout with a classifier; learned layers are positive, as those of LPIPS."""
    with torch.device("meta"):
        shapes = {key: value.shape for key, value in from_text(TEXTS[NAMES[name]]).state_dict().items()}
    # He's initialisation, so that outputs neither explode nor vanish.
    weights = {f"features.{k}": torch.randn(s) * math.sqrt(2 / max(1, math.prod(s[1:]))) for k, s in shapes.items()}
    weights["classifier.1.weight"] = torch.zeros(2, 2)
    if learned:
        for index, channels in enumerate(NETWORKS[name].channels):
            weights[f"lin{index}.weight"] = torch.rand(1, channels, 1, 1)
    return weights


@pytest.fixture
def reference(monkeypatch: pytest.MonkeyPatch) -> Callable[..., float]:
    """Compute the distance with torchmetrics, in float64, on this file's networks instead of torchvision's."""
    theirs = pytest.importorskip("torchmetrics.functional.image.lpips")

    def distance(name: str, weights: dict[str, Tensor], image: Tensor, target: Tensor, rescaled: bool = True) -> float:
        with torch.device("meta"):
            network = from_text(TEXTS[NAMES[name]])
        features = {key.removeprefix("features."): v for key, v in weights.items() if key.startswith("features.")}
        network.load_state_dict(features, assign=True)
        monkeypatch.setattr(theirs, "_get_tv_model_features", lambda _, pretrained: network)
        model: Any = theirs._LPIPS(net=name, pnet_rand=True)  # with its own learned layers
        for index in range(len(NETWORKS[name].channels)):
            if f"lin{index}.weight" in weights:
                getattr(model, f"lin{index}").model[-1].weight.data = weights[f"lin{index}.weight"]
        return float(model.double()(image.double()[None], target.double()[None], normalize=rescaled))

    return distance


def images(height: int = 44, width: int = 53) -> tuple[Tensor, Tensor]:
    target = torch.rand(3, height, width)
    return (target + 0.2 * torch.randn(3, height, width)).clamp(0, 1), target


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("learned", [True, False])
def test_distances_are_those_of_torchmetrics(
    name: str, learned: bool, tmp_path: Path, reference: Callable[..., float]
) -> None:
    weights = random_weights(name, learned)
    torch.save(weights, tmp_path / "weights.pth")
    metrics = lpips_metrics(LpipsRequest(files=(tmp_path / "weights.pth",)), 44, CPU)
    assert metrics.missing == {}
    image, target = images()
    distances = metrics.measure(image, target)
    assert set(distances) == ({name, AS_3DGS} if name == "vgg" else {name})
    expected = reference(name, weights, image, target)
    assert distances[name] == pytest.approx(expected, rel=4e-6)  # float32 against float64; 4e-7 seen
    if name == "vgg":
        unscaled = reference(name, weights, image, target, rescaled=False)
        assert distances[AS_3DGS] == pytest.approx(unscaled, rel=4e-6)
        assert abs(unscaled - expected) > 1e-3 * expected  # or the two would not be told apart


def test_a_safetensors_file_and_what_is_shown(tmp_path: Path) -> None:
    safetensors = pytest.importorskip("safetensors.torch")
    safetensors.save_file(random_weights("alex"), tmp_path / "alex.safetensors")
    metrics = lpips_metrics(LpipsRequest(files=(tmp_path / "alex.safetensors",)), 44, CPU)
    image, target = images()
    assert metrics.measure(target, target) == {"alex": 0.0}
    assert metrics.measure(target + 2.0, torch.ones_like(target)) == {"alex": 0.0}  # clamped to what is shown
    assert metrics.measure(image, target)["alex"] > 0
    assert metrics.measure(image, target) == metrics.measure(target, image)


def test_published_weights_of_alexnet(shared_data: Path, reference: Callable[..., float]) -> None:
    path = shared_data.parent / "lpips" / "alexnet.safetensors"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    weights = pytest.importorskip("safetensors.torch").load_file(path)
    image, target = images()
    distance = Lpips("alex", weights)(image, target)
    assert distance == pytest.approx(reference("alex", weights, image, target), rel=1e-5)  # 2e-7 seen
    without = {key: value for key, value in weights.items() if key.startswith("features.")}
    # The learned layers that torchmetrics ships are these.
    assert distance == pytest.approx(reference("alex", without, image, target), rel=1e-5)


def test_missing_weights_are_reported_and_not_downloaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    metrics = lpips_metrics(LpipsRequest(), 44, CPU)
    assert set(metrics.missing) == {"vgg", AS_3DGS}
    assert all("--lpips-weights" in reason for reason in metrics.missing.values())
    assert metrics.measure(*images()) == {}
    assert lpips_metrics(LpipsRequest.parse("none"), 44, CPU).missing == {}

    (tmp_path / "checkpoints").mkdir()
    torch.save(random_weights("squeeze"), tmp_path / "checkpoints" / NETWORKS["squeeze"].cached_as)
    metrics = lpips_metrics(LpipsRequest.parse("squeeze,alex"), 44, CPU)
    assert set(metrics.measure(*images())) == {"squeeze"}
    assert set(metrics.missing) == {"alex"}

    monkeypatch.setattr(lpips, "LINEAR_FILES", {})
    torch.save(random_weights("alex", learned=False), tmp_path / "checkpoints" / NETWORKS["alex"].cached_as)
    assert "lapgs_plugin[lpips]" in lpips_metrics(LpipsRequest.parse("alex"), 44, CPU).missing["alex"]


@pytest.mark.parametrize("name", NETWORKS)
def test_the_smallest_image_is_measured_and_a_smaller_one_reported(name: str, tmp_path: Path) -> None:
    torch.save(random_weights(name), tmp_path / "weights.pth")
    smallest, request = NETWORKS[name].smallest, LpipsRequest((name,), (tmp_path / "weights.pth",))
    metrics = lpips_metrics(request, smallest, CPU)
    assert metrics.measure(*images(smallest, 40))[name] > 0
    assert "too small" in lpips_metrics(request, smallest - 1, CPU).missing[name]


def test_unusable_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    for contents, message in (
        ({"features.0.weight": torch.zeros(8, 3, 3, 3)}, "weights.pth: fits none.*expected"),
        ([1, 2], "weights.pth cannot be read .a list.*expected"),
        (b"PK\x03\x04 cut short", "weights.pth cannot be read .*expected"),
        (
            {**random_weights("alex"), "lin2.weight": torch.zeros(1, 5, 1, 1)},
            r"learned.2 is \(1, 5, 1, 1\), expected \(1, 384, 1, 1\)",
        ),
    ):
        path.write_bytes(contents) if isinstance(contents, bytes) else torch.save(contents, path)
        with pytest.raises(UserInputError, match=message) as raised:
            lpips_metrics(LpipsRequest(files=(path,)), 44, CPU)
        assert "\n" not in str(raised.value)
    with pytest.raises(UserInputError, match=r"nowhere\.safetensors cannot be read .*No such file"):
        lpips_metrics(LpipsRequest(files=(tmp_path / "nowhere.safetensors",)), 44, CPU)


def test_requests_that_cannot_be_met_are_refused_before_images_are_read(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"--lpips vgg19: expected none, or some of vgg, alex, squeeze, vgg_3dgs"):
        LpipsRequest.parse("alex,vgg19")
    with pytest.raises(UserInputError, match=r"--lpips-weights .*nowhere\.pth: no such file"):
        LpipsRequest.parse(None, [tmp_path / "nowhere.pth"])
