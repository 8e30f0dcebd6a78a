"""Reconstructions of other programs, matched to our frames."""
