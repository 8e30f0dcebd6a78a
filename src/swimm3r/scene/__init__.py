"""The records of a scene, frames and reconstruction, and the folder of a run that holds them."""
