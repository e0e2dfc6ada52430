"""Measure runs and their flicker, check rasterizers, and time them."""
