"""Find the backbone of a checkout: every file beside this one defines a backbone, and other packages add theirs.

Imports no torch, and neither does any adapter here when it is imported.
"""

from __future__ import annotations

import pkgutil
from pathlib import Path

from lapgs_plugin import adapters
from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.generic import Adapter as GenericAdapter
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.source import readable_source
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.registry import Registry

GROUP = "lapgs_plugin.backbones"
"""Entry point group whose members are subclasses of `BackboneAdapter`; an entry's name is the adapter's `info.name`."""

OWN = tuple(
    module.name
    for module in pkgutil.iter_modules(adapters.__path__)
    if module.name not in ("base", "generic", "info", "registry")
)
"""Names of the backbones in this package: `adapters/<name>.py` defines `Adapter`."""

BACKBONES: Registry[type[BackboneAdapter]] = Registry(
    "--backbone",
    GROUP,
    BackboneAdapter,
    {name: f"{adapters.__name__}.{name}:Adapter" for name in OWN},
    classes=True,
)
"""Backbones by name."""


GENERIC = GenericAdapter.info.name
"""Name of the adapter of checkouts that no backbone recognises, for `--backbone`."""


def all_adapters() -> tuple[type[BackboneAdapter], ...]:
    """Return the adapters of all backbones, this package's first.

    Raises:
        UserInputError: an installed package's cannot be loaded, or has another name; the line names it.
    """
    adapters = {name: BACKBONES[name] for name in BACKBONES}
    for name, adapter in adapters.items():
        if not isinstance(getattr(adapter, "info", None), BackboneInfo):
            raise UserInputError(
                f"--backbone {name}: {adapter.__module__}.{adapter.__qualname__} has no BackboneInfo called info; fix "
                "or uninstall the package that brings it"
            )
        if adapter.info.name != name:
            raise UserInputError(
                f"--backbone {name}: the info of {adapter.__module__}.{adapter.__qualname__} has the name "
                f"{adapter.info.name}, expected {name}; fix or uninstall the package that brings it"
            )
    return tuple(adapters.values())


def recognise(folder: Path) -> type[BackboneAdapter] | None:
    """Return the adapter of the checkout whose root is `folder`, None if it has no training script of 3DGS.

    A checkout that no backbone recognises has the generic adapter. A fork keeps the files of the code that it was
    forked from, so both may recognise it, and the fork's adapter is returned. A backbone is a fork of another if it
    says so, or if it asks for all of the other's files and more.

    Raises:
        UserInputError: several recognise it, none a fork of the others, or an installed package's cannot be loaded.
    """
    recognising = [adapter for adapter in all_adapters() if adapter.recognises(folder)]
    if not recognising and readable_source(folder) is not None:
        return GenericAdapter
    left = [adapter for adapter in recognising if not any(other.info.is_fork_of(adapter.info) for other in recognising)]
    if len(left) > 1:
        names = " and ".join(adapter.info.name for adapter in left)
        raise UserInputError(f"{folder} is recognised as a checkout of {names}; choose one with --backbone")
    return left[0] if left else None


def adapter_class(folder: Path, name: str | None = None) -> type[BackboneAdapter]:
    """Return the adapter called `name`, or the one that recognises the checkout whose root is `folder`.

    Raises:
        UserInputError: it is no checkout, no backbone is called that, or it lacks files that this backbone's have.
    """
    if name == GENERIC:
        return GenericAdapter
    if name is not None:
        if name not in list(BACKBONES):
            raise UserInputError(f"--backbone {name}: expected {', '.join([*BACKBONES, GENERIC])}")
        chosen = BACKBONES[name]
        missing = [file for file in chosen.info.own_files if not (folder / file).is_file()]
        if missing and not chosen.recognises(folder):
            raise UserInputError(
                f"--backbone {name}: {folder} has no {missing[0]}, expected a checkout of {chosen.info.title}; leave "
                f"it out, or take {GENERIC} for any fork"
            )
        return chosen
    adapter = recognise(folder)
    if adapter is None:
        raise UserInputError(
            f"{folder} is not the root of a 3DGS checkout: none of its train*.py imports a class of Gaussians; "
            "expected a checkout, whose train.py `lapgs run` is given; `lapgs train` trains without one"
        )
    return adapter


def known_extensions() -> dict[str, str]:
    """Return the compiled modules that the backbones' training scripts import, each with its purpose."""
    users: dict[tuple[str, str], list[str]] = {}
    for adapter in all_adapters():
        for module, purpose in adapter.info.extensions.items():
            users.setdefault((module, purpose), []).append(adapter.info.title)
    return {module: f"{purpose} of {', '.join(titles)}" for (module, purpose), titles in users.items()}


def rasterizer_owners() -> dict[str, type[BackboneAdapter]]:
    """Return the adapter that describes each CUDA rasterizer, by the name of the rasterizer's module."""
    owners: dict[str, type[BackboneAdapter]] = {}
    for adapter in all_adapters():
        if adapter.rasterizer_semantics() is not None:
            owners.setdefault(adapter.info.rasterizer, adapter)
    return owners
