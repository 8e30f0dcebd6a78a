"""Primitives projected into a pinhole camera, as the rasterizer reads them."""
