"""Files in general: written whole or not at all, checked when read back, locked, named safely."""
