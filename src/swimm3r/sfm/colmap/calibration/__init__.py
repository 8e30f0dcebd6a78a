"""The one lens of a clip: begun with, refined once the frames are in place, and chosen among those they allow.

On small hazy images a self-calibrating mapper drifts to any focal length and then loses frames. So a lens is held
while frames are placed (`mapping`), and only with every frame in place are the intrinsics refined: what comes out is
kept only if it is a lens.
"""
