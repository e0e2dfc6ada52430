"""Measure runs and their flicker, and check rasterizers."""
