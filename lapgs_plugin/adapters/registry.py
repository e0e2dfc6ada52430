"""The backbones this project knows, by the traces they leave: files of a checkout, names of their extensions."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from lapgs_plugin.adapters.base import BackboneAdapter


@dataclass(frozen=True)
class KnownCheckout:
    """A code base that trains 3DGS.

    Attributes:
        name: as its authors write it.
        files: what its checkout has, relative to its root; all of them must be there.
        key: what `--backbone` calls it; None where `lapgs run` does not drive it.
        adapter: module and class that drive it.
    """

    name: str
    files: tuple[str, ...]
    key: str | None = None
    adapter: str = ""


GRAPHDECO_FILES = ("train.py", "gaussian_renderer/__init__.py", "scene/gaussian_model.py")

KNOWN_CHECKOUTS = (
    KnownCheckout("FastGS", (*GRAPHDECO_FILES, "utils/fast_utils.py"), "fastgs", "fastgs:FastGSAdapter"),
    KnownCheckout("Taming-3DGS", (*GRAPHDECO_FILES, "utils/taming_utils.py"), "taming", "taming:TamingAdapter"),
    KnownCheckout("graphdeco 3DGS or a fork of it", GRAPHDECO_FILES, "graphdeco", "graphdeco:GraphdecoAdapter"),
    KnownCheckout("gsplat", ("gsplat/rendering.py", "examples/simple_trainer.py")),
)
"""Most specific first: FastGS and Taming-3DGS are forks of graphdeco's code, and FastGS took over files of Taming's."""

DRIVABLE = {checkout.key: checkout for checkout in KNOWN_CHECKOUTS if checkout.key is not None}
"""Those that `lapgs run` drives, by what `--backbone` calls them."""

KNOWN_EXTENSIONS = {
    "diff_gaussian_rasterization": "rasterizer of graphdeco 3DGS and Taming-3DGS",
    "diff_gaussian_rasterization_fastgs": "rasterizer of FastGS",
    "simple_knn._C": "nearest neighbours of graphdeco 3DGS and its forks",
    "fused_ssim": "fast SSIM of several of them",
}
"""Compiled modules that their training scripts import, and what for."""


def recognise_checkout(folder: Path) -> KnownCheckout | None:
    """The code base whose checkout `folder` is the root of, None when it is none that is known."""
    for checkout in KNOWN_CHECKOUTS:
        if all((folder / name).is_file() for name in checkout.files):
            return checkout
    return None


def adapter_class(folder: Path, key: str | None = None) -> type[BackboneAdapter]:
    """The adapter for the checkout whose root is `folder`, or the one called `key`.

    Raises:
        UserInputError: the checkout is none that is known, or no adapter is called that.
    """
    if key is not None and key not in DRIVABLE:
        raise UserInputError(f"--backbone {key}: expected {', '.join(DRIVABLE)}")
    found = recognise_checkout(folder) if key is None else DRIVABLE[key]
    if found is None or found.key is None:
        names = ", ".join(checkout.name for checkout in DRIVABLE.values())
        raise UserInputError(
            f"{folder} is not the root of a checkout that `lapgs run` knows ({names}), which have "
            f"{', '.join(GRAPHDECO_FILES)}; name it with --backbone, or use `lapgs train` without a checkout"
        )
    return _adapter(found)


def adapters() -> dict[str, type[BackboneAdapter]]:
    """All adapters by what `--backbone` calls them."""
    return {name: _adapter(checkout) for name, checkout in DRIVABLE.items()}


def _adapter(checkout: KnownCheckout) -> type[BackboneAdapter]:
    module, name = checkout.adapter.split(":")
    adapter: Any = getattr(import_module(f"lapgs_plugin.adapters.{module}"), name)
    return adapter  # type: ignore[no-any-return]  # found by name
