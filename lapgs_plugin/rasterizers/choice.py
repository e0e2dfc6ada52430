"""Choose the rasterizer that renders a finished run: the one of its training, or the most similar one available."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from lapgs_plugin.adapters.registry import rasterizer_owners
from lapgs_plugin.environment.device import chosen_device
from lapgs_plugin.errors import LapgsError, MissingExtraError, UserInputError, typed_line
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.fields.units import in_unit
from lapgs_plugin.rasterizers import faster_gs
from lapgs_plugin.rasterizers.extensions import CONSTANTS, CudaExtension, constants_of, import_extension
from lapgs_plugin.rasterizers.gsplat import rasterizer as gsplat
from lapgs_plugin.rasterizers.signed_color import SignedColorRasterizer
from lapgs_plugin.reference_raster import CPU_RASTERIZERS
from lapgs_plugin.registry import Registry
from lapgs_plugin.runs.manifest import Manifest

logger = logging.getLogger(__name__)

RASTER_SETTINGS = "raster"
"""Key of a manifest's settings for the rasterizer settings that change images, such as {"mult": 0.5}."""

RAYS = "rays"
"""Argument by which rasterizers evaluate Gaussians along rays, as cameras with a lens need it."""

OWN: dict[str, type[Rasterizer]] = {
    gsplat.NAME: gsplat.GsplatRasterizer,
    **CPU_RASTERIZERS,
    faster_gs.NAME: faster_gs.FasterGsRasterizer,
}
RASTERIZERS: Registry[type[Rasterizer]] = Registry(
    "--rasterizer", "lapgs_plugin.rasterizers", Rasterizer, OWN, classes=True
)
"""Rasterizers by name. Other packages add subclasses of `Rasterizer`, made without arguments, as entry points."""


@dataclass(frozen=True)
class PlacedRasterizer:
    """Hold a rasterizer and the device of its fields.

    Attributes:
        rasterizer: renders the run.
        device: of the fields.
        unsupported: settings of the run that it does not have.
    """

    rasterizer: Rasterizer
    device: torch.device
    unsupported: Mapping[str, Any]


def rasterizer_for(manifest: Manifest, device: str = "auto", rasterizer: str = "auto") -> PlacedRasterizer:
    """Choose the rasterizer of a finished run and its device, and log the choice with its reason.

    "auto" takes the rasterizer of the training if it can be imported and has its device, then gsplat if it can render
    here, then the fast CPU rasterizer.

    Args:
        manifest: of the run.
        device: "cuda" or "cpu"; "auto" takes CUDA if there is a device.
        rasterizer: "auto", "cpu", "oracle", "gsplat", "faster-gs", one of an installed package, or the
            module of an extension. On a CPU the extension's stand-in renders, which has all its settings and is slow.

    Raises:
        UserInputError: an unknown device or name, or a device that this machine or the rasterizer does not have.
        MissingExtraError: the requested rasterizer is not installed.
    """
    chosen_device(device)
    settings = _raster_settings(manifest)
    if rasterizer == "auto":
        placed, why = _most_similar(manifest.rasterizer, device, settings)
    else:
        placed, why = _named(rasterizer, device, settings), "as asked for"
    _log_choice(manifest, placed, why)
    return replace(placed, rasterizer=in_unit(placed.rasterizer, manifest.scene.unit))


def _raster_settings(manifest: Manifest) -> dict[str, Any]:
    """Return the run's rasterizer settings that differ from the defaults."""
    recorded = manifest.settings.get(RASTER_SETTINGS, {})
    along_rays = {RAYS: True} if manifest.scene.distorted else {}
    return along_rays | {name: value for name, value in recorded.items() if value != CONSTANTS.get(name)}


def is_antialiased(manifest: Manifest) -> bool:
    """Return whether a run's rasterizer dims Gaussians that are smaller than a pixel."""
    return bool(_raster_settings(manifest).get("antialiasing", False))


def _most_similar(trained: str, device: str, settings: Mapping[str, Any]) -> tuple[PlacedRasterizer, str]:
    """Return the available rasterizer that is most similar to that of the training, and the reason."""
    on_gpu, obstacle = device != "cpu" and torch.cuda.is_available(), ""
    if on_gpu or trained in RASTERIZERS:  # on a CPU an extension has a stand-in only, which is slow
        try:
            return _named(trained, device, settings), "as in training"
        except LapgsError as error:
            obstacle = str(error).partition("; ")[0]  # without advice: another one renders
    if not on_gpu:
        where = "on the CPU" if device == "cpu" else "without a CUDA device"
        failed = "" if trained in OWN or not obstacle else f", because {obstacle}"
        return _named("cpu", "cpu", settings), f"the fastest {where}{failed}"
    reason = gsplat.missing(direct=RAYS not in settings)
    if not reason:
        return _named(gsplat.NAME, "cuda", settings), obstacle
    if device == "cuda":
        raise MissingExtraError(f"--device cuda: {obstacle}, and {reason}; install either, or leave --device out")
    return _named("cpu", "cpu", settings), f"{obstacle}, and {reason}"


def _named(name: str, device: str, settings: Mapping[str, Any]) -> PlacedRasterizer:
    """Return the rasterizer of a name with the settings that it has."""
    owners = rasterizer_owners()
    if name in owners:
        return _extension(name, owners[name].info.stand_in, device, settings)
    if name not in RASTERIZERS:
        raise UserInputError(f"--rasterizer {name}: expected auto, {', '.join([*RASTERIZERS, *owners])}")
    return placed_rasterizer(name, device, settings)


def placed_rasterizer(name: str, device: str = "auto", settings: Mapping[str, Any] | None = None) -> PlacedRasterizer:
    """Return a rasterizer of `RASTERIZERS`, and the first of its devices that is there and asked for.

    Args:
        name: of the rasterizer.
        device: "cuda", "cpu" or "auto".
        settings: of a run; it is made with those that it has arguments for.

    Raises:
        UserInputError: it cannot be made, has another name, or does not render on the device; the line names it.
        MissingExtraError: this package's needs what is not installed.
    """
    kind = RASTERIZERS[name]
    label = f"--rasterizer {name}" if name in OWN else f"--rasterizer {name}: {kind.__module__}.{kind.__qualname__}"
    try:
        known, unsupported = _split(settings or {}, inspect.signature(kind).parameters)
        _require_rays(label, unsupported)
        rasterizer = kind(**known)
    except Exception as error:
        if name in OWN or isinstance(error, LapgsError):
            raise
        # Whatever a package's code does wrong, the user must learn which package it was.
        raise UserInputError(
            f"{label} cannot be made without arguments: {typed_line(error)}; fix or uninstall its package"
        ) from error
    if rasterizer.name != name:
        raise UserInputError(f"{label} has the name {rasterizer.name}, expected that of its entry point, {name}")
    here = ("cuda", "cpu") if torch.cuda.is_available() else ("cpu",)
    usable = [supported for supported in rasterizer.devices if supported in here and device in ("auto", supported)]
    if not usable:
        why = "this machine has no CUDA device" if device == "auto" else f"not on --device {device}"
        raise UserInputError(f"{label} renders on {' or '.join(rasterizer.devices)}, {why}; choose another rasterizer")
    return PlacedRasterizer(rasterizer, torch.device(usable[0]), unsupported)


def _extension(name: str, stand_in: str, device: str, settings: Mapping[str, Any]) -> PlacedRasterizer:
    """Return an extension, or its stand-in on a CPU."""
    if device == "cpu" or not torch.cuda.is_available():
        from lapgs_plugin.family import stand_ins

        modules = stand_ins(stand_in) if stand_in else {}
        if name not in modules:
            raise UserInputError(
                f"--rasterizer {name}: it has no stand-in for a CPU; leave the option out, or render on a CUDA device"
            )
        where, module = "cpu", modules[name]
    else:
        where, module = "cuda", import_extension(name)
    known, unsupported = _split(settings, constants_of(module))
    _require_rays(f"--rasterizer {name}", unsupported)
    extension = CudaExtension(name, where, settings=known, module=module)
    return PlacedRasterizer(SignedColorRasterizer(extension), torch.device(where), unsupported)


def _require_rays(label: str, unsupported: Container[str]) -> None:
    """Raise a UserInputError if a rasterizer, named by a label, does not have the setting for cameras with a lens."""
    if RAYS in unsupported:
        others = [name for name, kind in OWN.items() if RAYS in inspect.signature(kind).parameters]
        raise UserInputError(
            f"{label} renders pinholes alone, and a run with --distorted is rendered along rays; choose "
            f"{' or '.join(others)}"
        )


def _split(settings: Mapping[str, Any], known: Container[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split settings into known and other ones."""
    inside = {name: value for name, value in settings.items() if name in known}
    return inside, {name: value for name, value in settings.items() if name not in known}


def _log_choice(manifest: Manifest, placed: PlacedRasterizer, why: str) -> None:
    name = placed.rasterizer.name
    device_name = torch.cuda.get_device_name() if placed.device.type == "cuda" else "the CPU"
    line = f"rendering with {'the CPU rasterizer' if name == 'cpu' else f'{name} on {device_name}'}: {why}"
    if name != manifest.rasterizer:
        line += f"; the run was trained with {manifest.rasterizer}, images may differ slightly"
    if placed.unsupported:
        values = ", ".join(f"{key} = {value}" for key, value in placed.unsupported.items())
        line += f"; {name} cannot honour {values} of the training"
        owner = rasterizer_owners().get(manifest.rasterizer)
        if owner is not None and owner.info.stand_in:
            line += f" (--rasterizer {manifest.rasterizer} can, slowly on a CPU)"
    logger.info("%s", line)
