"""Depth maps of a visit in the unit and along the adjusted poses of the first: one factor per frame."""

from dataclasses import dataclass, replace

from swimm3r.cameras import project, rows_of_frames
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Reconstruction

_LEAST_OBSERVED = 8  # points of a frame that tell how its depth has changed


@dataclass(frozen=True)
class ScaledDepthMaps(DepthMaps):
    """Depth maps as stored, each frame's times a factor."""

    factors: dict[str, float]

    def __getitem__(self, name: str) -> DepthMap:
        stored = super().__getitem__(name)
        return DepthMap(stored.z_depth * self.factors[name], stored.confidence)


def with_depth(stored: Reconstruction, placed: Reconstruction, scale: float) -> Reconstruction:
    """The placed reconstruction with the depth maps of its run, `stored`, made to fit its poses and points.

    A frame's factor is the median of depth now by depth then over the points that it observes; `scale` where those are
    few.
    """
    factors = dict.fromkeys(stored.names, scale)
    for i, rows in enumerate(rows_of_frames(stored.tracks.frame, len(stored.names))):
        mine = stored.tracks.point[rows]
        then, now = (project(rec.cameras[i], rec.points.xyz[mine].double()[None])[1][0] for rec in (stored, placed))
        good = (then > 0) & (now > 0)
        if int(good.sum()) >= _LEAST_OBSERVED:
            factors[stored.names[i]] = float((now[good] / then[good]).median())
    return replace(placed, depth=ScaledDepthMaps(stored.depth.folder, factors))
