"""Habitat figures of a map: of a surface, of squares, polygons and lines, and their tables."""
