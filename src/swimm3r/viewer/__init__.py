"""A finished run, or a map in training, in the browser: pictures drawn here as the camera moves there (viser)."""
