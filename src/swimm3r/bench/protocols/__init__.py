"""The tables of the paper and our own: one protocol per file."""
