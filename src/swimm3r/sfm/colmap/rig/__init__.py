"""Rigs in mapping: one pose per instant for all cameras, each with its own lens."""
