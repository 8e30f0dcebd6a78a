"""What each published method trains: its losses and its schedule."""
