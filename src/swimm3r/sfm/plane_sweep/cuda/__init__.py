"""The plane sweep on CUDA, by NVIDIA Warp; imported only where it runs."""
