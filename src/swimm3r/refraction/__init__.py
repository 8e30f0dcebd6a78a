"""Cameras behind flat and dome ports: rays through air, glass and water, and the central lens that comes closest."""
