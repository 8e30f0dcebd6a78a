"""SIFT features, image retrieval and the graph of image pairs."""
