"""Frames drawn anew where no lens of COLMAP's models, or no single instant, explains those that were prepared.

Structure from motion finds a lens beyond models, or turns of the camera within frames, and raises a RectifiableError
(`frames`). The frames are redrawn once, into a folder of the run (`run`), and all that follows works on them.
"""
