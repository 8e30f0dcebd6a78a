"""The kinds of water that a map may have."""

from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.medium.seasplat import SceneWater

Water = MediumField | SceneWater
"""Water between the primitives and the camera, or one layer over the finished image."""
