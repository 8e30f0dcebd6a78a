"""Formats <-> numpy arrays and records; no mathematics."""
