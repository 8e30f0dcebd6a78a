"""Moving objects in the frames of a reconstruction, as masks that keep them out of depth, water and maps."""
