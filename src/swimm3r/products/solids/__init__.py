"""Cloud and mesh of a run in the local frame, in the formats of other programs."""
