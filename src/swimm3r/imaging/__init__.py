"""Image processing that needs no scene: filters, open-water regions, depth completion."""
