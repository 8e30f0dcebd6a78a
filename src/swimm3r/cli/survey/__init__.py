"""Commands about the place of a run on the ground."""
