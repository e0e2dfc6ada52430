"""The backbones this project knows, by the traces they leave: files of a checkout, names of their extensions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class KnownCheckout:
    """A code base that trains 3DGS.

    Attributes:
        name: as its authors write it.
        files: what its checkout has, relative to its root; all of them must be there.
    """

    name: str
    files: tuple[str, ...]


GRAPHDECO_FILES = ("train.py", "gaussian_renderer/__init__.py", "scene/gaussian_model.py")

KNOWN_CHECKOUTS = (
    KnownCheckout("FastGS", (*GRAPHDECO_FILES, "utils/fast_utils.py")),
    KnownCheckout("Taming-3DGS", (*GRAPHDECO_FILES, "utils/taming_utils.py")),
    KnownCheckout("graphdeco 3DGS or a fork of it", GRAPHDECO_FILES),
    KnownCheckout("gsplat", ("gsplat/rendering.py", "examples/simple_trainer.py")),
)
"""Most specific first: FastGS and Taming-3DGS are forks of graphdeco's code, and FastGS took over files of Taming's."""

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
