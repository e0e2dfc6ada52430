"""Stand in for packages that checkouts import and that are not installed.

Imports succeed, and so do the few functions that training calls. Any other name of these packages raises
`MissingExtraError` at its first use. An installed package is always preferred. Imports no torch before a call.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Mapping
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from lapgs_plugin.errors import MissingExtraError

if TYPE_CHECKING:
    from PIL import Image
    from torch import Tensor

__all__ = ["STOOD_IN", "NoLog", "absent_modules"]


def absent_modules(logs: bool = False) -> dict[str, ModuleType]:
    """Return stand-ins for the known packages that are not installed, by full module name.

    Args:
        logs: also for TensorBoard, which most checkouts do without by themselves.
    """
    absent: dict[str, ModuleType] = {}
    if logs and find_spec("tensorboard") is None:
        absent[_LOGS] = _AbsentModule(_LOGS, "tensorboard", {"SummaryWriter": NoLog})
    for package, (distribution, modules) in _PACKAGES.items():
        if package in sys.modules or find_spec(package) is not None:
            continue
        for name, contents in modules.items():
            absent[name] = _AbsentModule(name, distribution, contents)
            parent, _, child = name.rpartition(".")
            if parent:
                setattr(absent[parent], child, absent[name])
    return absent


class _AbsentModule(ModuleType):
    """Offer some names of a package that is not installed; any other raises an error that names the package."""

    def __init__(self, name: str, distribution: str, contents: Mapping[str, object]) -> None:
        super().__init__(name, f"Stands in for {name}, which is not installed.")
        self.__spec__ = ModuleSpec(name, None, is_package=True)
        self.__path__: list[str] = []
        self._distribution = distribution
        vars(self).update(contents)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # Python looks them up in every module
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        raise MissingExtraError(
            f"{self.__name__}.{name} is used by the checkout, and {self.__name__.partition('.')[0]} is not installed: "
            f"pip install {self._distribution}, or leave out the option that needs it"
        )


class _ToTensor:
    """Convert an 8-bit picture, grey or RGB, to a float tensor (c, h, w) in [0, 1]."""

    def __call__(self, picture: Image.Image) -> Tensor:
        import numpy as np
        import torch

        pixels = np.asarray(picture)
        if pixels.dtype != np.uint8:
            raise MissingExtraError(
                f"ToTensor got a picture of mode {picture.mode}, and without torchvision it takes 8-bit ones only: "
                "pip install torchvision"
            )
        return torch.from_numpy(np.atleast_3d(pixels).transpose(2, 0, 1).copy()).float() / 255


class _ToPILImage:
    """Convert a float tensor (1, h, w) or (3, h, w) in [0, 1] to an 8-bit picture, rounding down."""

    def __call__(self, tensor: Tensor) -> Image.Image:
        import numpy as np
        from PIL import Image
        from torch import Tensor

        if not (
            isinstance(tensor, Tensor) and tensor.is_floating_point() and tensor.ndim == 3 and len(tensor) in (1, 3)
        ):
            raise MissingExtraError(
                f"ToPILImage got {_described(tensor)}, and without torchvision it takes float tensors (1 or 3, h, w) "
                "only: pip install torchvision"
            )
        pixels = tensor.detach().cpu().mul(255).byte().permute(1, 2, 0).numpy()  # (h, w, c)
        return Image.fromarray(pixels[:, :, 0] if len(tensor) == 1 else np.ascontiguousarray(pixels))


def _described(value: object) -> str:
    from torch import Tensor

    return (
        f"a tensor {tuple(value.shape)} of {value.dtype}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
    )


def _dump(value: object, path: str) -> None:
    """Pickle a value to a file, which joblib can read."""
    Path(path).write_bytes(pickle.dumps(value))


def _nothing(*_: object, **__: object) -> None:
    """Do nothing, as choosing a backend that draws nothing."""


class NoLog:
    """Take the place of TensorBoard's SummaryWriter, and write nothing."""

    def __init__(self, *_: object, **__: object) -> None:
        """Take the arguments of the class."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


_LOGS = "torch.utils.tensorboard"

_PACKAGES: dict[str, tuple[str, dict[str, dict[str, object]]]] = {
    # Taming-3DGS finds edges with the two transforms; only LPIPS uses the networks.
    "torchvision": (
        "torchvision",
        {
            "torchvision": {},
            "torchvision.transforms": {"ToTensor": _ToTensor, "ToPILImage": _ToPILImage},
            "torchvision.models": {},
        },
    ),
    # graphdeco reads depth maps with it.
    "cv2": ("opencv-python-headless", {"cv2": {}}),
    # The viewers of FastGS and Taming-3DGS use it; they are off by default.
    "websockets": ("websockets", {"websockets": {}}),
    # Mip-Splatting imports it without using it.
    "open3d": ("open3d", {"open3d": {}}),
    # 2DGS draws curves and depths with it.
    "matplotlib": ("matplotlib", {"matplotlib": {"use": _nothing}, "matplotlib.pyplot": {}, "matplotlib.cm": {}}),
    # EfficientGS reads scenes that it has packed, and logs; its logs are left out.
    "joblib": ("joblib", {"joblib": {"dump": _dump}}),
    "h5py": ("h5py", {"h5py": {}}),
}
"""For each package, the distribution to install and the names that its modules offer here."""

STOOD_IN = tuple(_PACKAGES)
"""Packages that are stood in for where they are not installed."""
