"""Rows exposed one after another: along the path of a film (`readout`), or as each frame tells (`turning`)."""
