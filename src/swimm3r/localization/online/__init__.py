"""Localization of a stream of images: each pose starts from the last one."""
