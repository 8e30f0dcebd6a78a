"""Densification: new primitives where they are needed, dead ones relocated or removed."""
