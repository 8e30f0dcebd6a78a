"""The training of a map: its scene, its loop, its losses and scattering-aware gradients."""
