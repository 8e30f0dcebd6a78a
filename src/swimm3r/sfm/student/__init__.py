"""The student network: MASt3R with low-rank adapters and the physics head, and its losses."""
