"""The built-in trainer: a hierarchy without a checkout, on gsplat or on the CPU rasterizer."""
