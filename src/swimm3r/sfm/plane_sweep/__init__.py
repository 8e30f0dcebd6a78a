"""Dense depth by plane-sweep stereo from known poses."""
