"""Scores of maps and restored frames: on held-out frames, against the truth where known, and without any reference."""
