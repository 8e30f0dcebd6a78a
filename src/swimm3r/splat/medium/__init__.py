"""The water of a map: the ambient medium field, SeaSplat's single water, and what light does to colors."""
