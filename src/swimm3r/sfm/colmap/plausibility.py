"""Plausibility of a reconstruction: repetitive ground registers every frame with wrong poses.

Each check says in plain words what it saw. The limits stand between the good and the bad real clips they were measured
on; the figures are beside them.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from swimm3r.cameras import project, rows_of_frames
from swimm3r.geometry import relative_poses, rotation_angle
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import QualityWarning, Reconstruction
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.features.sift import unit_descriptors

FOCAL_BOUNDS = (0.35, 3.0)  # focal length over image width: 110 degrees to 19 degrees across
_TWIN_ANGLE = 0.3  # radians between descriptors of things that look the same
_TWIN_APART = 16.0  # pixels: closer ones are one corner found twice
_TWIN_SHARE = 0.25  # tiled pool 0.63; reef, rock, wreck, open water with a dolphin 0 to 0.02
_SAMPLED_FRAMES = 8
_WEAK_LINK = 50  # shared points; skerki_wreck's lines hang together by fewer, single clips by 80 and more
_MIN_ANGLE = 1.5  # degrees between the rays of a typical point; good clips have 6 to 15
_MAX_DEPTH_CHANGE = 10.0  # of the frames' median depth along a clip; good clips have up to 3.2, the tiled pool 5.6
_MAX_STEP, _MAX_TURN = 15.0, 30.0  # times the median step, and degrees, in a median time between frames of a video


def implausible(rec: Reconstruction, store: FeatureDatabase, frames: Frames) -> tuple[QualityWarning, ...]:
    """Doubts about a reconstruction, in plain words; empty without any."""
    checks = (
        _repeated_texture(store),
        _bad_lens(rec),
        _no_parallax(rec),
        _runaway_depth(rec),
        _jump(rec, frames),
        _weak_link(rec),
    )
    return tuple(warning for warning in checks if warning is not None)


def twin_share(xy: Float[Tensor, "n 2"], descriptors: Float[Tensor, "n 128"]) -> float:
    """Share of a frame's keypoints that look like another one elsewhere in the same frame."""
    alike = descriptors @ descriptors.mT
    alike[torch.cdist(xy, xy) < _TWIN_APART] = -1.0
    return (alike.amax(1) > np.cos(_TWIN_ANGLE)).float().mean().item()


def _repeated_texture(store: FeatureDatabase) -> QualityWarning | None:
    shares = []
    with store.open() as database:
        for i in range(0, store.frames, max(1, store.frames // _SAMPLED_FRAMES)):
            xy = torch.from_numpy(database.read_keypoints(i + 1)[:, :2].copy())
            if len(xy) >= 2:
                shares.append(twin_share(xy, unit_descriptors(database.read_descriptors(i + 1).data)))
    share = float(np.median(shares)) if shares else 0.0
    if share < _TWIN_SHARE:
        return None
    return QualityWarning(
        f"The reconstruction is implausible: the scene repeats itself ({share:.0%} of the keypoints have a twin in the"
        " same frame), so frames may have been joined one tile, plank or bar off although all of them fit.",
        "Do not measure on it. Lay things that occur once (a slate, a tool) into the view, mask the pattern out, or "
        "compare the camera path with what you swam (--reference).",
    )


def _bad_lens(rec: Reconstruction) -> QualityWarning | None:
    ratio = float(rec.cameras.K[0, 0, 0]) / rec.cameras.width
    if FOCAL_BOUNDS[0] <= ratio <= FOCAL_BOUNDS[1]:
        return None
    return QualityWarning(
        f"The reconstruction is implausible: its focal length ({ratio:.2f} image widths) is that of no common lens.",
        "Shapes will be stretched in depth. Give --focal and --k1 of the camera, calibrated in water.",
    )


def _no_parallax(rec: Reconstruction) -> QualityWarning | None:
    if len(rec.tracks.point) == 0:
        return None
    to_camera = rec.cameras.centers[rec.tracks.frame] - rec.points.xyz[rec.tracks.point]
    to_camera = to_camera / to_camera.norm(dim=1, keepdim=True)
    count = torch.bincount(rec.tracks.point, minlength=len(rec.points.xyz)).clamp(min=1)
    mean = torch.zeros_like(rec.points.xyz).index_add_(0, rec.tracks.point, to_camera) / count[:, None]
    mean = mean / mean.norm(dim=1, keepdim=True).clamp(min=1e-12)
    cosine = (mean[rec.tracks.point] * to_camera).sum(1).clamp(-1, 1)
    widest = torch.zeros(len(count), dtype=cosine.dtype).scatter_reduce(0, rec.tracks.point, cosine.arccos(), "amax")
    angle = 2 * float(torch.rad2deg(widest.median()))
    if angle >= _MIN_ANGLE:
        return None
    return QualityWarning(
        f"The reconstruction is implausible: typical points are seen under rays only {angle:.1f} degrees apart.",
        "The camera turned more than it moved, or the scene is far away: depths are guesses. Swim sideways past it.",
    )


def depth_change(rec: Reconstruction) -> float:
    """Largest by smallest median depth of the frames' points; inf where the smallest is 0.

    Frames with fewer than 10 points do not count.
    """
    medians = []
    for i, rows in enumerate(rows_of_frames(rec.tracks.frame, len(rec.names))):
        seen = rec.points.xyz[rec.tracks.point[rows]]
        if len(seen) >= 10:
            medians.append(project(rec.cameras[i], seen[None])[1].median().item())
    if not medians:
        return 1.0
    return max(medians) / min(medians) if min(medians) > 0 else float("inf")


def _runaway_depth(rec: Reconstruction) -> QualityWarning | None:
    change = depth_change(rec)
    if change <= _MAX_DEPTH_CHANGE:
        return None
    return QualityWarning(
        f"The reconstruction is implausible: the scene is {change:.0f} times as far in one frame as in another.",
        "The scale drifts along the clip. Use a shorter part, or film so that the path crosses itself.",
    )


def _jump(rec: Reconstruction, frames: Frames) -> QualityWarning | None:
    camera = None if frames.rig is None else frames.rig.names[0]
    path = {name: k for k, name in enumerate(frame.name for frame in frames if frame.camera == camera)}
    order = sorted((i for i, name in enumerate(rec.names) if name in path), key=lambda i: path[rec.names[i]])
    if not frames.ordered or len(order) < 5:
        return None
    poses = rec.cameras.cam2world[order]
    step = poses[1:, :3, 3].sub(poses[:-1, :3, 3]).norm(dim=1)
    turn = torch.rad2deg(rotation_angle(relative_poses(poses[:-1], poses[1:])[..., :3, :3]))
    elapsed = torch.tensor(frames.times_of([rec.names[i] for i in order]), dtype=torch.float64).diff()
    longer = (elapsed / elapsed.median()).clamp(min=1)  # where a frame was held back for scores, two
    jumps = ((step > _MAX_STEP * longer * step.median()) | (turn > _MAX_TURN * longer)).nonzero().flatten().tolist()
    # a gap where frames are missing, or a cut of the film, is no jump
    numbers = [path[rec.names[i]] for i in order]
    jumps = [k for k in jumps if numbers[k + 1] == numbers[k] + 1]
    if not jumps:
        return None
    name = rec.names[order[jumps[0] + 1]]
    return QualityWarning(
        f"The camera path jumps {len(jumps)} time{'s' if len(jumps) > 1 else ''}, first at {name}.",
        "Where the film was cut there, split it; else a higher --fps makes neighboring frames overlap more.",
    )


def _weak_link(rec: Reconstruction) -> QualityWarning | None:
    at = (rec.tracks.point.numpy(), rec.tracks.frame.numpy())
    seen = coo_array((np.ones(len(at[0])), at), shape=(len(rec.points.xyz), len(rec.names))).tocsr()
    seen.data[:] = 1  # a point that a frame observes twice counts once
    shared = seen.T @ seen
    parts = sorted(np.bincount(connected_components(shared >= _WEAK_LINK)[1]).tolist(), reverse=True)
    if len(parts) == 1 or parts[1] < 2:
        return None
    return QualityWarning(
        f"Parts of {' + '.join(map(str, parts))} frames did not join well: they share fewer than {_WEAK_LINK} points,"
        " so their place relative to each other is uncertain.",
        "Let lines overlap by half, cross them with one more line, and turn slowly between them; or raise --fps.",
    )
