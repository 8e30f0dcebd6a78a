"""Reconstructions made by other programs, read from their own files: poses, lens, points, sightings, depth, scale."""
