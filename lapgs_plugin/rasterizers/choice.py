"""Which rasterizer renders a finished run here: the one it was trained with, or the nearest that there is."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from lapgs_plugin.adapters.registry import rasterizer_owners
from lapgs_plugin.errors import LapgsError, MissingExtraError, UserInputError
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.rasterizers import gsplat
from lapgs_plugin.rasterizers.extensions import CONSTANTS, CudaExtension, import_extension, options_of
from lapgs_plugin.rasterizers.signed_color import SignedColorRasterizer
from lapgs_plugin.reference_raster import CPU_RASTERIZERS, make_rasterizer
from lapgs_plugin.runs.archive import Manifest

logger = logging.getLogger(__name__)

DEVICES = ("auto", "cuda", "cpu")
RASTER_SETTINGS = "raster"
"""Key of a manifest's settings that holds those of the rasterizer which the images depend on, such as {"mult": 0.5}."""


@dataclass(frozen=True)
class PlacedRasterizer:
    """A rasterizer and where its fields have to be.

    Attributes:
        rasterizer: renders the run.
        device: of the fields.
        lost: settings of the run that it cannot honour.
    """

    rasterizer: Rasterizer
    device: torch.device
    lost: Mapping[str, Any]


def rasterizer_for(manifest: Manifest, device: str = "auto", rasterizer: str = "auto") -> PlacedRasterizer:
    """What renders a run, and one log line that says what and why.

    Left to itself it takes the rasterizer that the run was trained with, where it can be imported and there is a CUDA
    device for it; then gsplat, where there is one; then the fast CPU rasterizer.

    Args:
        manifest: of the run.
        device: "cuda" or "cpu"; "auto" takes CUDA where there is any.
        rasterizer: "auto" for what is said above, "cpu", "oracle", "gsplat", or the module of an extension. On a CPU
            that one's stand-in renders: exact in every setting, and slow.

    Raises:
        UserInputError: another device or name, or a device that this machine or the rasterizer does not have.
        MissingExtraError: the rasterizer asked for is not installed.
    """
    if device not in DEVICES:
        raise UserInputError(f"--device {device}: expected {', '.join(DEVICES)}")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserInputError("--device cuda: PyTorch sees no CUDA device; `lapgs doctor` says why, or use --device cpu")
    settings = _raster_settings(manifest)
    if rasterizer == "auto":
        placed, why = _best(manifest.rasterizer, device, settings)
    else:
        placed, why = _named(rasterizer, device, settings), "as asked for"
    _say(manifest, placed, why)
    return placed


def _raster_settings(manifest: Manifest) -> dict[str, Any]:
    """The run's settings that are not what every rasterizer does anyway."""
    given = manifest.settings.get(RASTER_SETTINGS, {})
    return {name: value for name, value in given.items() if value != CONSTANTS.get(name)}


def _best(trained: str, device: str, settings: Mapping[str, Any]) -> tuple[PlacedRasterizer, str]:
    """The nearest to the rasterizer a run was trained with, and why it is that one."""
    same = "the one it was trained with"
    if trained in CPU_RASTERIZERS and device != "cuda":
        return _named(trained, "cpu", settings), same
    if device == "cpu" or not torch.cuda.is_available():
        place = "on the CPU" if device == "cpu" else "without a CUDA device"
        return _named("cpu", "cpu", settings), f"the fastest {place}"
    obstacle = f"{trained} runs on the CPU only"
    if trained not in CPU_RASTERIZERS:
        try:
            return _named(trained, "cuda", settings), same
        except LapgsError as error:
            obstacle = str(error)
    reason = gsplat.missing()
    if not reason:
        return _named(gsplat.NAME, "cuda", settings), obstacle
    if device == "cuda":
        raise MissingExtraError(f"--device cuda: {obstacle}, and {reason}; install either, or leave --device out")
    return _named("cpu", "cpu", settings), f"{obstacle}, and {reason}"


def _named(name: str, device: str, settings: Mapping[str, Any]) -> PlacedRasterizer:
    """The rasterizer of that name with those of the settings that it knows."""
    if name in CPU_RASTERIZERS:
        if device == "cuda":
            raise UserInputError(f"--rasterizer {name} --device cuda: it runs on the CPU; leave --device out")
        return PlacedRasterizer(make_rasterizer(name), torch.device("cpu"), settings)
    if name == gsplat.NAME:
        if device == "cpu":
            raise UserInputError(f"--rasterizer {name} --device cpu: it runs on CUDA only; leave --device out")
        known, lost = _split(settings, {"antialiasing"})
        return PlacedRasterizer(gsplat.GsplatRasterizer(**known), torch.device("cuda"), lost)
    owners = rasterizer_owners()
    if name in owners:
        return _extension(name, owners[name].info.stand_in, device, settings)
    raise UserInputError(f"--rasterizer {name}: expected auto, {', '.join([*CPU_RASTERIZERS, gsplat.NAME, *owners])}")


def _extension(name: str, stand_in: str, device: str, settings: Mapping[str, Any]) -> PlacedRasterizer:
    if device == "cpu" or not torch.cuda.is_available():
        from lapgs_plugin.reference_raster.standins import stand_ins

        place, module = "cpu", stand_ins(stand_in)[name]
    else:
        place, module = "cuda", import_extension(name)
    known, lost = _split(settings, options_of(module))
    extension = CudaExtension(name, place, settings=known, module=module)
    return PlacedRasterizer(SignedColorRasterizer(extension), torch.device(place), lost)


def _split(settings: Mapping[str, Any], known: frozenset[str] | set[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    inside = {name: value for name, value in settings.items() if name in known}
    return inside, {name: value for name, value in settings.items() if name not in known}


def _say(manifest: Manifest, placed: PlacedRasterizer, why: str) -> None:
    name = placed.rasterizer.name
    place = torch.cuda.get_device_name() if placed.device.type == "cuda" else "the CPU"
    line = f"rendering with {name} on {place}: {why}"
    if name != manifest.rasterizer:
        line += f"; the run was trained with {manifest.rasterizer}, images may differ slightly"
    if placed.lost:
        values = ", ".join(f"{key} = {value}" for key, value in placed.lost.items())
        line += f"; {name} cannot honour {values} of the training"
        if manifest.rasterizer in rasterizer_owners():
            line += f" (--rasterizer {manifest.rasterizer} can, slowly on a CPU)"
    logger.info("%s", line)
