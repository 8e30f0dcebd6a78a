"""The water of a reconstruction: its coefficients, and the images and points restored with them."""
