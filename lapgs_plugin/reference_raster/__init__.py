"""Render on the CPU: with an oracle to read, or with a fast rasterizer to train with."""

from __future__ import annotations

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.reference_raster.fast import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import OracleRasterizer

__all__ = ["CPU_RASTERIZERS", "CpuRasterizer", "OracleRasterizer", "make_rasterizer"]

CPU_RASTERIZERS: dict[str, type[Rasterizer]] = {"cpu": CpuRasterizer, "oracle": OracleRasterizer}
"""By their names in manifests and on the command line."""


def make_rasterizer(name: str) -> Rasterizer:
    """Return the rasterizer that manifests and the command line call `name`.

    Raises:
        UserInputError: there is none of that name.
    """
    if name not in CPU_RASTERIZERS:
        raise UserInputError(f"--rasterizer {name}: expected {' or '.join(CPU_RASTERIZERS)}")
    return CPU_RASTERIZERS[name]()
