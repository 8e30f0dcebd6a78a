"""Mapping of long clips: chunks placed as small clips are, joined by shared points, and adjusted together."""
