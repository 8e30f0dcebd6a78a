"""Measurements that a camera writes into its video beside the images: GoPro's GPMF."""
