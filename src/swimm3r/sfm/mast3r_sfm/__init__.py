"""MASt3R over all pairs of a clip, with everything that is computed once kept on disk."""
