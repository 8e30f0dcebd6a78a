"""The primitives of a map: beta splats and Gaussians, and their spherical harmonics."""
