"""Moving objects: found, tracked, located by trajectory triangulation, and given primitives that travel with them."""
