"""COLMAP models on disk: reading, writing, and the check of their files before they are read."""
