"""Visits of one site in one frame: matches, the similarity between two of them, joint mapping, and its worth."""
