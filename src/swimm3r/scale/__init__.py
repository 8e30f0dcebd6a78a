"""The unit and the place of a run: scale bars, markers, navigation and ground control to metres and coordinates."""
