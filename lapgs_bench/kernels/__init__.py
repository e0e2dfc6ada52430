"""Time parts of an iteration: the CPU rasterizer, blending on a GPU, and each operation in all its versions."""
