"""Calibrations of lenses by other programs: their files as one record, scaled to the frames of a run."""
