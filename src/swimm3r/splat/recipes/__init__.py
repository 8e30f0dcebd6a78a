"""The recipes: losses and schedule of each published method."""
