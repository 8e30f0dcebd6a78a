"""The water of a map: the ambient medium field, and SeaSplat's single water."""
