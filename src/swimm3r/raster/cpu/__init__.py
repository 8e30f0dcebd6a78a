"""The rasterizer in compiled loops for the CPU."""
