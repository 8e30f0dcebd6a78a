"""MASt3R inside: the two-view network that predicts pointmaps and descriptors (Leroy et al. 2024)."""
