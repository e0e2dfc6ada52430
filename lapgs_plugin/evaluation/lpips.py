"""Measure LPIPS v0.1 (Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR
2018) without torchvision.

The packages lpips and torchmetrics take their networks from torchvision, which is built for one version of PyTorch and
often missing. The networks are small and fixed, so they are defined here. Their weights come from a file in
torchvision's layout or from torchvision's download cache; nothing is downloaded. The learned layers come from the same
file, or from one of the two packages.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn

from lapgs_plugin.errors import MissingExtraError, UserInputError, first_line

SHIFT = -0.030, -0.088, -0.188
"""Mean of each channel, by which LPIPS normalizes an image in [-1, 1]."""
SCALE = 0.458, 0.448, 0.450
"""Deviation of each channel."""
EPSILON = 1e-8
"""Added to the squared lengths of feature vectors, as in torchmetrics; lpips adds 1e-10 to the length."""
DOWNLOADS = "https://download.pytorch.org/models/"
"""Where torchvision's weights are, by their file names."""
LINEAR_FILES = {"torchmetrics": "functional/image/lpips_models/{}.pth", "lpips": "weights/v0.1/{}.pth"}
"""The learned layers' files inside packages."""


class _Fire(nn.Module):
    """Apply SqueezeNet's fire module, with torchvision's names."""

    def __init__(self, before: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(before, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, values: Tensor) -> Tensor:
        """(n, before, h, w) -> (n, 2 expanded, h, w)."""
        values = self.squeeze(values).relu()
        return torch.cat([self.expand1x1(values).relu(), self.expand3x3(values).relu()], dim=1)


def _pool(ceil: bool = False) -> nn.Module:
    return nn.MaxPool2d(3, 2, ceil_mode=ceil)


def _alexnet() -> list[nn.Module]:
    return [
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), _pool()),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), _pool()),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    ]


def _vgg16() -> list[nn.Module]:
    layers: list[nn.Module] = []
    channels = 3
    for block, (width, depth) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        layers += [nn.MaxPool2d(2)] * (block > 0)
        for _ in range(depth):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return layers


def _squeezenet() -> list[nn.Module]:
    return [
        *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), _pool(ceil=True)),
        *(_Fire(64, 16, 64), _Fire(128, 16, 64), _pool(ceil=True)),
        *(_Fire(128, 32, 128), _Fire(256, 32, 128), _pool(ceil=True)),
        *(_Fire(256, 48, 192), _Fire(384, 48, 192), _Fire(384, 64, 256), _Fire(512, 64, 256)),
    ]


@dataclass(frozen=True)
class Network:
    """Describe a network whose features LPIPS compares.

    Attributes:
        title: its name in tables.
        make: builds its layers up to the last tap.
        taps: indices of the layers whose outputs are compared.
        channels: of these outputs.
        cached_as: file name of torchvision's weights in PyTorch's download cache.
        smallest: least shorter side of an image, in pixels, for which every layer has an output.
    """

    title: str
    make: Callable[[], list[nn.Module]]
    taps: tuple[int, ...]
    channels: tuple[int, ...]
    cached_as: str
    smallest: int

    def layers(self) -> nn.Sequential:
        """Return the layers up to the last tap with shapes but no values, on PyTorch's device "meta"."""
        with torch.device("meta"):
            return nn.Sequential(*self.make())


NETWORKS = {
    "vgg": Network("VGG", _vgg16, (3, 8, 15, 22, 29), (64, 128, 256, 512, 512), "vgg16-397923af.pth", 16),
    "alex": Network("AlexNet", _alexnet, (1, 4, 7, 9, 11), (64, 192, 384, 256, 256), "alexnet-owt-7be5be79.pth", 31),
    "squeeze": Network(
        "SqueezeNet",
        _squeezenet,
        (1, 4, 7, 9, 10, 11, 12),
        (64, 128, 256, 384, 384, 512, 512),
        "squeezenet1_1-b8a52dc0.pth",
        17,
    ),
}
AS_3DGS = "vgg_3dgs"
"""The VGG distance as 3DGS codebases compute it and papers print it: images in [0, 1] go into a network that expects
[-1, 1]."""
VARIANTS = (*NETWORKS, AS_3DGS)
LPIPS_KEY = "lpips_{}"
"""Key of a variant in metrics.json."""


def network_of(variant: str) -> str:
    """Return the key in `NETWORKS` of one of `VARIANTS`."""
    return "vgg" if variant == AS_3DGS else variant


def lpips_titles(keys: Container[str]) -> dict[str, str]:
    """Return the titles of the variants whose key in metrics.json is among these keys, by key."""
    titles = {
        LPIPS_KEY.format(name): f"LPIPS ({NETWORKS[network_of(name)].title}{' as 3DGS' if name == AS_3DGS else ''})"
        for name in VARIANTS
    }
    return {key: title for key, title in titles.items() if key in keys}


class Lpips(nn.Module):
    """Measure the LPIPS distance of two images under one network.

    Args:
        name: key in `NETWORKS`.
        weights: `features.<layer>...` of the network and `lin<k>.weight`, (1, c, 1, 1), of the learned layers.

    Raises:
        UserInputError: weights are missing or have other shapes; the message names the first.
    """

    def __init__(self, name: str, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        network = NETWORKS[name]
        self._taps = network.taps
        self.features = network.layers()
        self.learned = nn.ParameterList(
            [nn.Parameter(torch.empty(1, c, 1, 1, device="meta")) for c in network.channels]
        )
        renamed = {re.sub(r"^lin(\d)\.weight$", r"learned.\1", key): value for key, value in weights.items()}
        for key, own in self.state_dict().items():
            if key not in renamed or renamed[key].shape != own.shape:
                shape = tuple(renamed[key].shape) if key in renamed else "nothing"
                raise UserInputError(
                    f"LPIPS weights of {network.title}: {key} is {shape}, expected {tuple(own.shape)}; give a file of "
                    "torchvision's weights, or one with the learned layers lin<k>.weight too"
                )
        self.load_state_dict({key: renamed[key].float() for key in self.state_dict()}, assign=True)
        self.requires_grad_(False)
        self.eval()

    @torch.no_grad()
    def forward(self, image: Tensor, target: Tensor, as_3dgs: bool = False) -> float:
        """Return the distance of two images, 0 for equal ones.

        Args:
            image, target: (3, h, w) on the network's device, clamped to [0, 1] here.
            as_3dgs: do not map [0, 1] to [-1, 1], see `AS_3DGS`.
        """
        total = 0.0
        outputs = zip(self._outputs(image, as_3dgs), self._outputs(target, as_3dgs), self.learned, strict=True)
        for one, other, learned in outputs:
            total += float(nn.functional.conv2d((one - other).square(), learned).mean())
        return total

    def _outputs(self, image: Tensor, as_3dgs: bool) -> Iterable[Tensor]:
        """Yield the output of each tapped layer, (1, c, h', w'), with feature vectors of unit length."""
        like = self.learned[0]
        values = image.clamp(0.0, 1.0).to(like.dtype)[None]
        values = values if as_3dgs else 2.0 * values - 1.0
        values = (values - like.new_tensor(SHIFT)[:, None, None]) / like.new_tensor(SCALE)[:, None, None]
        for index, layer in enumerate(self.features):
            values = layer(values)
            if index in self._taps:
                yield values / (values.square().sum(dim=1, keepdim=True) + EPSILON).sqrt()


@dataclass(frozen=True)
class LpipsMetrics:
    """Hold the loaded networks, and the distances to measure of every view.

    Attributes:
        networks: by key in `NETWORKS`, those with weights.
        variants: those of `VARIANTS` that can be measured.
        missing: by variant, why another requested one cannot be measured.
    """

    networks: Mapping[str, Lpips]
    variants: tuple[str, ...]
    missing: Mapping[str, str]

    def measure(self, image: Tensor, target: Tensor) -> dict[str, float]:
        """Return each variant's distance of two images, (3, h, w)."""
        return {v: self.networks[network_of(v)](image, target, as_3dgs=v == AS_3DGS) for v in self.variants}


def missing_lines(missing: Mapping[str, str]) -> list[str]:
    """Return a line for each reason in `LpipsMetrics.missing`."""
    variants = {reason: [name for name in missing if missing[name] == reason] for reason in missing.values()}
    return [f"LPIPS ({', '.join(names)}) not measured: {reason}" for reason, names in variants.items()]


@dataclass(frozen=True)
class LpipsRequest:
    """Choose the distances to measure.

    Attributes:
        variants: of `VARIANTS`; None for those of the files' networks, or of VGG without files.
        files: of weights, whose shapes tell the network.
    """

    variants: tuple[str, ...] | None = None
    files: tuple[Path, ...] = ()

    @classmethod
    def parse(cls, variants: str | None, files: Iterable[Path] = ()) -> LpipsRequest:
        """Parse the command line's value: variants separated by commas, or "none".

        Raises:
            UserInputError: a variant is not known, or a file does not exist.
        """
        files = tuple(files)
        if absent := [file for file in files if not file.is_file()]:
            raise UserInputError(f"--lpips-weights {absent[0]}: no such file; expected the weights of an LPIPS network")
        if variants is None:
            return cls(None, files)
        words = () if variants.strip() == "none" else tuple(dict.fromkeys(word.strip() for word in variants.split(",")))
        for word in words:
            if word not in VARIANTS:
                raise UserInputError(
                    f"--lpips {word}: expected none, or some of {', '.join(VARIANTS)} with commas between"
                )
        return cls(words, files)


def lpips_metrics(request: LpipsRequest, smallest_side: int, device: torch.device) -> LpipsMetrics:
    """Load the networks of a request whose weights are present, for images of at least `smallest_side` pixels.

    Raises:
        UserInputError: a named file cannot be read, or belongs to no known network.
        MissingExtraError: a file is .safetensors, and that package is not installed.
    """
    named = dict(_read_named(path) for path in request.files)
    networks: dict[str, Lpips] = {}
    missing: dict[str, str] = {}
    variants = request.variants
    if variants is None:
        variants = tuple(variant for variant in VARIANTS if network_of(variant) in (named or {"vgg"}))
    for variant in variants:
        name = network_of(variant)
        if name in networks:
            continue
        cached = _cache_path(name)
        weights = named.get(name) or (_read(cached) if cached.is_file() else None)
        if weights is None:
            missing[variant] = f"no weights; {_how_to_get(name)}"
        elif smallest_side < NETWORKS[name].smallest:
            missing[variant] = f"images of {smallest_side} pixels are too small, expected {NETWORKS[name].smallest}"
        elif (complete := _with_learned(name, weights)) is None:
            missing[variant] = "no learned layers in the weights: pip install 'lapgs_plugin[lpips]'"
        else:
            networks[name] = Lpips(name, complete).to(device)
    return LpipsMetrics(networks, tuple(v for v in variants if network_of(v) in networks), missing)


def _read_named(path: Path) -> tuple[str, Mapping[str, Tensor]]:
    """Read a file and recognise the network that its weights belong to."""
    weights = _read(path)
    for name, network in NETWORKS.items():
        expected = network.layers().state_dict()
        if all(
            f"features.{key}" in weights and weights[f"features.{key}"].shape == expected[key].shape for key in expected
        ):
            return name, weights
    raise UserInputError(
        f"--lpips-weights {path}: fits none of {', '.join(n.title for n in NETWORKS.values())}; "
        "expected torchvision's names and shapes, such as features.0.weight"
    )


def _read(path: Path) -> Mapping[str, Tensor]:
    """Read a file of tensors by name, .safetensors or .pth.

    Raises:
        UserInputError: the file cannot be read.
        MissingExtraError: the package that reads .safetensors is not installed.
    """
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        weights = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(weights, dict):
            raise TypeError(f"a {type(weights).__name__}, expected a dictionary of tensors")
    except ImportError as error:
        raise MissingExtraError(
            f"LPIPS weights {path}: reading .safetensors needs a package; pip install 'lapgs_plugin[lpips]'"
        ) from error
    except Exception as error:  # torch and safetensors raise many types for damaged files
        raise UserInputError(
            f"LPIPS weights {path} cannot be read ({first_line(error)}); expected tensors by name, .safetensors or .pth"
        ) from error
    return weights


def _cache_path(name: str) -> Path:
    """Return where torchvision downloads the weights of a network to."""
    return Path(torch.hub.get_dir()) / "checkpoints" / NETWORKS[name].cached_as


def _how_to_get(name: str) -> str:
    """Return the command that downloads the weights of a network to where they are found."""
    target = shlex.quote(str(_cache_path(name)))
    return (
        f"get them with: curl -fL --create-dirs -o {target} {DOWNLOADS}{NETWORKS[name].cached_as} (or copy that file "
        "from another machine and name it with --lpips-weights)"
    )


def _with_learned(name: str, weights: Mapping[str, Tensor]) -> Mapping[str, Tensor] | None:
    """Add the learned layers of an installed package to weights that lack them; None where there are none."""
    if "lin0.weight" in weights:
        return weights
    for package, pattern in LINEAR_FILES.items():
        spec = find_spec(package)
        for folder in (spec and spec.submodule_search_locations) or ():
            path = Path(folder) / pattern.format(name)
            if path.is_file():
                learned = _read(path)
                return {**weights, **{key.replace(".model.1.", "."): value for key, value in learned.items()}}
    return None
