"""Points for cameras that somebody else placed: SIFT matches, triangulated where the given poses put them.

For files that name poses and no observations (transforms.json, cameras.xml): without points nobody knows where depth is
to be looked for. Poses and lenses stay as they are.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from swimm3r.io.colmap.cameras import to_pycolmap_camera
from swimm3r.io.colmap.model import from_pycolmap, silence_log, to_pycolmap
from swimm3r.io.files.atomic import DRAFT
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Points, Reconstruction, Tracks
from swimm3r.sfm.colmap.pairs import match_frames
from swimm3r.sfm.colmap.record import verified_matches
from swimm3r.sfm.features.database import fill_features, scaled_camera, start_database, with_overlap
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.sfm.tracks import MatchTracks, as_points
from swimm3r.tasks.threads import thread_count


def triangulate(
    rec: Reconstruction, frames: Frames, settings: FeatureSettings, folder: Path, progress: Progress = silent
) -> Reconstruction:
    """The reconstruction with the points that its frames' matches agree on, after those it has, and with the matches.

    `folder` keeps features and matches (`features.database`); the reconstruction may come out without any new point.
    """
    import pycolmap

    silence_log()
    order = [frames.index(name) for name in rec.names]
    placed, threads = frames.select(order), thread_count()
    table = rec.colmap_model()
    bare = replace(
        table, names=tuple(f"{i:06d}" for i in range(len(rec.names))),
        xyz=np.zeros((0, 3)), rgb=np.zeros((0, 3), np.uint8), error=np.zeros(0),
        track_point=table.track_point[:0], track_frame=table.track_frame[:0], track_xy=table.track_xy[:0],
    )  # fmt: skip
    model = to_pycolmap(bare)
    cameras = [to_pycolmap_camera(bare, i) for i in range(len(model.cameras))]
    for camera in cameras:
        camera.has_prior_focal_length = True
    store = start_database(folder, placed, cameras, settings)
    for each in model.cameras.values():
        own = scaled_camera(each, store.scale)
        each.width, each.height, each.params = own.width, own.height, own.params
    fill_features(store, placed, settings, threads, progress)
    match_frames(store, placed, ColmapSettings(features=settings), threads, progress)
    store = with_overlap(store)
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.num_threads = 1  # the same sums in the same order
    options.random_seed = 0
    options.triangulation.ignore_two_view_tracks = not store.little_overlap
    with tempfile.TemporaryDirectory(dir=folder, prefix=DRAFT) as scratch:
        progress("triangulating points", 0, 1)
        found = pycolmap.triangulate_points(model, str(store.path), str(folder), scratch, options=options)
        progress("triangulating points", 1, 1)
    made = from_pycolmap(found)
    track_xy = made.track_xy / store.scale
    rows = np.array([int(name) for name in made.names])
    tracks = MatchTracks(
        torch.from_numpy(made.xyz),
        torch.from_numpy(made.track_point),
        torch.from_numpy(rows[made.track_frame].astype(np.int64)),
        torch.from_numpy(track_xy).long(),
    )
    points, observations = as_points(tracks, torch.from_numpy(track_xy), rec.cameras, frames, order)
    old = rec.points
    return replace(
        rec,
        points=Points(*(torch.cat([getattr(p, n) for p in (old, points)]) for n in ("xyz", "rgb", "error"))),
        tracks=Tracks(observations.point + len(old.xyz), observations.frame, observations.xy),
        matches=verified_matches(store, list(range(len(rec.names)))),
    )
