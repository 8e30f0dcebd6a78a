"""The path of a vehicle and the path of the cameras: matched in time, aligned, and placed on the map."""
