"""Metrics of runs, conformance of rasterizers, and the raster benchmark."""
