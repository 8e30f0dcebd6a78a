"""The rasterizer for CUDA devices, in NVIDIA Warp."""
