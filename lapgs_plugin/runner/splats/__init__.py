"""Train levels in scripts whose class trains splats with gsplat's `rasterization`."""
