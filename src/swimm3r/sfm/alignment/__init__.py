"""Global alignment of pairwise pointmaps: poses, intrinsics and depth of all frames."""
