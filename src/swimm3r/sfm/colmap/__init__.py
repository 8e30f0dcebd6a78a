"""Camera poses and sparse points by COLMAP, with checks that its models are plausible."""
