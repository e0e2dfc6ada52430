"""Render on the CPU: with an oracle to read, or with a fast rasterizer to train with."""

from __future__ import annotations

from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.reference_raster.fast import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import OracleRasterizer

__all__ = ["CPU_RASTERIZERS", "CpuRasterizer", "OracleRasterizer"]

CPU_RASTERIZERS: dict[str, type[Rasterizer]] = {"cpu": CpuRasterizer, "oracle": OracleRasterizer}
"""By their names in manifests and on the command line."""
