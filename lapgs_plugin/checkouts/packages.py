"""Find packages that a checkout cannot do without and that are not installed. Executes nothing, imports no torch."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass

from lapgs_plugin.checkouts.source import CheckoutSource, OwnPackage
from lapgs_plugin.environment import is_installed

DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "git": "gitpython",
    "hydra": "hydra-core",
    "mpl_toolkits": "matplotlib",
    "PIL": "pillow",
    "pylab": "matplotlib",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
}
"""Distributions whose names differ from those of their packages."""

BUILT_IN = sys.stdlib_module_names | {"__main__"}
"""Modules of Python, some of them of other systems."""

OWN = "checkout"
"""The checkout's rasterizer."""
OURS = "lapgs"
"""Our rasterizer, by the rules of the checkout's."""
AUTO = "auto"
"""The faster of both where they agree; ours where the checkout's own is not to be had."""
CHOICES = (AUTO, OWN, OURS)
"""Values of `--rasterizer`: whose rasterizer renders a checkout."""

COMPANIONS = ("simple_knn", "fused_ssim")
"""Compiled packages of the family besides its rasterizers."""

INDEX = "pip install "
"""How a package of the index is installed."""
README = "install it as the checkout's README says"
"""How a package is installed whose name on the index is not known."""


@dataclass(frozen=True)
class MissingPackage:
    """Name a package that is not installed.

    Attributes:
        name: of the package.
        where: file and line of its first import.
        own: the folder of the checkout that it is installed from, if there is one.
        extension: whether it is a compiled part of the family, of which a package index may hold a stranger's.
    """

    name: str
    where: str
    own: OwnPackage | None
    extension: bool

    @property
    def distribution(self) -> str:
        """Its name in the package index, if it is there; empty for parts of checkouts."""
        return "" if self.extension or self.own is not None else DISTRIBUTIONS.get(self.name, self.name)

    @property
    def install(self) -> str:
        """How to install it."""
        if self.own is not None:
            return self.own.install
        return f"{INDEX}{self.distribution}" if self.distribution else README


def missing_packages(source: CheckoutSource, extensions: Iterable[str]) -> list[MissingPackage]:
    """Return the packages that importing a checkout's script needs and that cannot be found, by name.

    Args:
        source: the checkout.
        extensions: compiled modules of the family.
    """
    compiled = {package_of(module) for module in (*extensions, *source.rasterizer_modules)}
    needed = {package_of(one.name): one.where for one in reversed(source.externals) if not one.optional}
    absent = [name for name in sorted(needed.keys() - BUILT_IN) if not is_installed(name)]
    return [MissingPackage(name, needed[name], source.own_package(name), name in compiled) for name in absent]


def how_to_install(missing: Iterable[MissingPackage]) -> str:
    """Return how to install packages, those of the package index in one command."""
    alike: dict[str, list[MissingPackage]] = {}
    for one in missing:
        alike.setdefault(INDEX if one.distribution else one.install, []).append(one)
    return "; ".join(
        f"{', '.join(one.name for one in several)}: {how}{' '.join(dict.fromkeys(one.distribution for one in several))}"
        for how, several in alike.items()
    )


def changes_path(source: CheckoutSource) -> bool:
    """Return whether a checkout changes the path of imports itself: only importing says what is missing there."""
    texts = (path.read_text(encoding="utf-8", errors="replace") for path in source.modules.values())
    return any("sys.path" in text for text in texts)


def package_of(module: str) -> str:
    """Return the package that a module is in."""
    return module.partition(".")[0]
