"""The ways from frames to a reconstruction: COLMAP, MASt3R, or another program's result."""
