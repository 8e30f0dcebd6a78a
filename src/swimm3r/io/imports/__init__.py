"""Reconstructions made by other programs, read from their own files."""
