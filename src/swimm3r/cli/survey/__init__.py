"""Commands about a run as a survey: its place on the ground, its maps, and measurements in it."""
