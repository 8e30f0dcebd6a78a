"""Maps as large as the dive: the ground in blocks, each trained on the views that see it, all in one water."""
