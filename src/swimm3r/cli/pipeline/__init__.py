"""`swimm3r run`, `prepare`, `sfm` and `splat`: the pipeline, whole or up to a stage."""
