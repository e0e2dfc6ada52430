"""The built-in trainer: a hierarchy without a checkout, on the CPU rasterizer."""
