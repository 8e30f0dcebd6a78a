"""Structure from motion by the MASt3R network: images -> pairs -> matches and canonical views -> alignment -> record.

Everything slow lies on disk as soon as it is known (`encodings`, `pair_store`), under names that are hashes of what it
was made from: a killed run goes on, and nothing stale is used. Memory is bounded for any number of frames: one pair's
maps, a fixed budget of encodings and sums, and at most `max_matches` matches.
"""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r import weights
from swimm3r.cameras import Cameras, project_visible
from swimm3r.errors import RegistrationError
from swimm3r.imaging.gray import LUMA
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import MASKS, Frames
from swimm3r.scene.gravity import with_measured_up
from swimm3r.scene.placement import Navigator
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, QualityWarning, Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction, write_unfiltered_matches
from swimm3r.sfm import tracks as match_tracks
from swimm3r.sfm.alignment import depth_cleaning
from swimm3r.sfm.alignment.canonical import AnchoredFrame, anchors_of
from swimm3r.sfm.alignment.optimize import Alignment, align, dense_z_depth
from swimm3r.sfm.alignment.problem import AnchoredPair, Known
from swimm3r.sfm.colmap.adjustment import bundle_adjust
from swimm3r.sfm.features.pair_graph import groups, parse_graph
from swimm3r.sfm.lens import check_calibration
from swimm3r.sfm.mast3r.matching import PixelMatches
from swimm3r.sfm.mast3r_sfm.encodings import EncodingStore
from swimm3r.sfm.mast3r_sfm.network_frames import NetworkImages, network_images
from swimm3r.sfm.mast3r_sfm.pair_store import PairRecord
from swimm3r.sfm.mast3r_sfm.run_pairs import PairResults, apply_adapter, load_network, run_pairs
from swimm3r.sfm.medium import from_head
from swimm3r.sfm.medium.apply import with_water
from swimm3r.sfm.moving.find import with_moving
from swimm3r.sfm.plane_sweep.views import on_frame_grid
from swimm3r.sfm.rig_poses import with_loose_rig
from swimm3r.sfm.settings import Mast3rSettings
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.physics_head import PhysicsHead
from swimm3r.sfm.tracks import FrameMatches, MatchTracks
from swimm3r.tasks.settings import EngineSettings

_WATER = "water"  # of what the physics head read, in the working folder
_FOLDER = "mast3r"  # of what is kept until the run is done, in the working folder


def check_files(settings: Mast3rSettings) -> None:
    """Raise UsageError for a pair graph that is none, WeightsError for weights or an adapter that cannot be used, and
    InputError or UsageError for a calibration file that cannot.
    """
    parse_graph(settings.graph)
    check_calibration(settings)
    weights.require("mast3r", settings.weights)
    if settings.adapter is not None:
        adapter_file.describe(settings.adapter)


def reconstruct(
    frames: Frames,
    settings: Mast3rSettings,
    folder: Path,
    progress: Progress = silent,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    navigator: Navigator | None = None,
) -> Reconstruction:
    """Cameras, points, matches, dense depth, water and restored cloud of the frames that hang together.

    All is done in this process, whatever the `engine`: one network holds the device.

    Raises UsageError for settings that contradict each other, WeightsError for a missing, damaged or wrong checkpoint
    or one that predicts no numbers, DeviceError, and RegistrationError where the frames do not hang together.
    """
    cache = settings.cache or folder / _FOLDER
    if not (folder / "reconstruction.json").is_file():
        graph = parse_graph(settings.graph)
        images = network_images(frames, settings)
        network = load_network(settings)
        head = None if settings.adapter is None else apply_adapter(network, settings.adapter, settings)
        said = run_pairs(network, images, graph, settings, cache, progress)
        read_water = None
        if head is not None:
            encodings = EncodingStore(network, images, cache / "encodings")
            read_water = _WaterReader(head, encodings, folder / _WATER)
        rec = _place(said, images, settings, folder, progress, read_water)
        rec = rec if frames.rig is None else with_loose_rig(rec)
        with_measured_up(rec, frames).save(folder, frames)
    rec = load_reconstruction(folder, frames)  # also where it was just made: the same bits as after an interruption
    if settings.moving == "auto":
        rec = with_moving(rec, frames, folder / MASKS, progress)
    if settings.adapter is None:
        rec = with_water(rec, frames, settings, folder, progress)
    else:
        facts = adapter_file.head_facts(settings.adapter)
        predicted = from_head.read(folder / _WATER, network_images(frames, settings), facts)
        rec = with_water(rec, frames, settings, folder, progress, predicted)
    rec.save(folder, frames)
    if settings.cache is None:
        shutil.rmtree(cache, ignore_errors=True)
    return rec


@dataclass(frozen=True)
class _WaterReader:
    """Reads each frame's water from its encoding and keeps it."""

    head: PhysicsHead
    encodings: EncodingStore
    folder: Path

    def keep(self, f: int, name: str, scale: float) -> None:
        """The water of frame `f`; `scale` is the reconstruction's unit per metre of the network."""
        with torch.no_grad():
            maps = self.head(self.encodings[f])
        from_head.write(maps, scale, self.folder, name)


def _place(
    said: PairResults,
    images: NetworkImages,
    settings: Mast3rSettings,
    folder: Path,
    progress: Progress,
    water: _WaterReader | None = None,
) -> Reconstruction:
    """The aligned record, without water; depth maps are written on the way."""
    frames = images.frames
    pairs, kept, warnings = _joined_frames(said, frames, settings)
    aligned = _align(said, pairs, kept, images, settings, progress)
    lens, canvas = images.cameras(aligned.alignment.K, aligned.alignment.cam2world)
    matches = aligned.matches.select(match_tracks.consistent(aligned.matches, canvas, settings.max_error))
    found = _tracks(matches, canvas, settings)
    tracks = match_tracks.most_seen(found, settings.max_points)
    write_unfiltered_matches(folder, _on_frames(aligned.matches, images))
    points, observations = match_tracks.as_points(tracks, images.to_frame(tracks.xy + 0.5), lens, frames, kept)
    rec = Reconstruction(
        names=tuple(frames.names[f] for f in kept),
        cameras=lens,
        points=points,
        tracks=observations,
        matches=_on_frames(matches, images),
        depth=DepthMaps(folder / "z_depth"),
        backend=settings.backend,
        metric=_is_metric(images, kept),
        warnings=tuple(warnings),
        points_found=len(found.xyz),
    )
    if settings.bundle_adjustment:
        rec = bundle_adjust(rec)
    _write_depth(rec, said, kept, pairs, aligned.alignment, images, settings, progress)
    if water is not None:
        for k, f in enumerate(kept):
            before = said.frame_store.read(f).anchored.anchor_depth.clamp(min=1e-9)
            water.keep(f, rec.names[k], float((aligned.alignment.anchor_z_depth[k] / before).median().clamp(min=1e-9)))
    return rec


def _on_frames(matches: FrameMatches, images: NetworkImages) -> Matches:
    """Matches of the network's pixels in pixels of the prepared frames."""
    xy_i, xy_j = (images.to_frame(xy + 0.5).float() for xy in (matches.xy_i, matches.xy_j))
    return Matches(matches.i, matches.j, xy_i, xy_j, matches.confidence)


def _is_metric(images: NetworkImages, kept: list[int]) -> bool:
    """Two known camera centers settle the unit; the network's own metres nobody measured."""
    poses = images.poses
    return poses is not None and poses.metric and int(poses.posed[kept].sum()) >= 2


def _joined_frames(
    said: PairResults, frames: Frames, settings: Mast3rSettings
) -> tuple[dict[tuple[int, int], PairRecord], list[int], list[QualityWarning]]:
    """The pairs that match, each with what is known of it, and the frames they join."""
    n = len(frames)
    records = {pair: said.pair_store.read(*(said.names[f] for f in pair)) for pair in said.pairs}
    most = max((len(record.matches.confidence) for record in records.values()), default=0)
    if most == 0:
        raise RegistrationError(
            f"not one pixel of the {n} frames matches between any two of them",
            cause="the frames show different places, or open water only",
            hint="a clip with the bottom in view and more overlap",
        )
    found = {pair: record for pair, record in records.items() if len(record.matches.confidence) >= settings.min_matches}
    parts = groups(n, list(found))
    kept = sorted(parts[0])
    if len(kept) < max(2, settings.min_share * n):
        sizes = ", ".join(str(len(part)) for part in parts[:5]) + (" ..." if len(parts) > 5 else "")
        raise RegistrationError(
            f"the frames fall into {len(parts)} groups without enough matches between them, of {sizes} frames",
            cause="a cut in the clip, or a stretch of open water",
            hint="take the longest stretch only, more frames per second, or a graph with more pairs (--graph)",
        )
    warnings = []
    if len(kept) < n:
        warnings.append(
            QualityWarning(
                f"{n - len(kept)} of {n} frames match no other and are left out.",
                "They are blurred, show open water, or overlap too little with the rest: raise --fps, or swim slower.",
            )
        )
    number = {f: k for k, f in enumerate(kept)}
    joined = {(number[i], number[j]): record for (i, j), record in found.items() if i in number}
    share = max(settings.min_matches, settings.max_matches // len(joined))
    return {pair: _thinned(record, share) for pair, record in joined.items()}, kept, warnings


def _thinned(record: PairRecord, most: int) -> PairRecord:
    m = record.matches
    if len(m.confidence) <= most:
        return record
    rows = torch.randperm(len(m.confidence), generator=torch.Generator().manual_seed(0))[:most].sort().values
    return replace(record, matches=PixelMatches(m.xy1[rows], m.xy2[rows], m.confidence[rows]))


@dataclass(frozen=True)
class _Aligned:
    alignment: Alignment
    matches: FrameMatches


def _align(
    said: PairResults,
    pairs: dict[tuple[int, int], PairRecord],
    kept: list[int],
    images: NetworkImages,
    settings: Mast3rSettings,
    progress: Progress,
) -> _Aligned:
    """The alignment of the kept frames; canonical views are read one at a time."""
    alignment = settings.alignment
    anchored: list[AnchoredFrame] = []
    hung: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}  # (pair, side): anchors and relative depths
    touching: list[list[tuple[int, int]]] = [[] for _ in kept]
    for number, (i, j) in enumerate(pairs):
        touching[i].append((number, 0))
        touching[j].append((number, 1))
    records = list(pairs.values())
    for k, f in enumerate(kept):
        frame = said.frame_store.read(f)
        anchored.append(frame.anchored)
        for number, side in touching[k]:
            xy = (records[number].matches.xy1, records[number].matches.xy2)[side]
            hung[number, side] = anchors_of(frame.view, xy, alignment.subsample)
    anchored_pairs = []
    for number, ((i, j), record) in enumerate(pairs.items()):
        (anchor_i, relative_i), (anchor_j, relative_j) = hung[number, 0], hung[number, 1]
        m = record.matches
        anchored_pairs.append(
            AnchoredPair(
                i,
                j,
                m.xy1,
                m.xy2,
                anchor_i,
                anchor_j,
                relative_i,
                relative_j,
                m.confidence,
                record.i_in_j,
                record.j_in_i,
            )
        )
    if images.lens.model != "PINHOLE":  # its distortion belongs to its focal length
        alignment = replace(alignment, intrinsics="fixed")
    known = Known(K=None if images.K is None else images.K.repeat(len(kept), 1, 1))
    if images.poses is not None:
        known = replace(known, cam2world=images.poses.cam2world[kept], posed=images.poses.posed[kept])
    found = align(anchored, anchored_pairs, alignment, known, progress)
    matches = FrameMatches(
        torch.cat([torch.full_like(p.anchor_i, p.i) for p in anchored_pairs]),
        torch.cat([torch.full_like(p.anchor_j, p.j) for p in anchored_pairs]),
        torch.cat([p.xy_i for p in anchored_pairs]),
        torch.cat([p.xy_j for p in anchored_pairs]),
        torch.cat([p.confidence for p in anchored_pairs]),
        found.points,
    )
    return _Aligned(found, matches)


def _tracks(matches: FrameMatches, canvas: Cameras, settings: Mast3rSettings) -> MatchTracks:
    if len(matches):
        tracks = match_tracks.join(matches, canvas.width, canvas.height)
        errors = match_tracks.reprojection_errors(canvas, tracks.frame, tracks.xy + 0.5, tracks.xyz[tracks.point])
        tracks = match_tracks.without(tracks, errors > settings.max_error)
        if len(tracks.xyz):
            return tracks
    raise RegistrationError(
        f"after the alignment no match lies within {settings.max_error:g} pixels of its point",
        cause="the matches contradict each other: what moves fills the view, or the weights are not MASt3R's",
        hint="mask out what moves (--masks), or swimm3r weights verify mast3r",
    )


def _write_depth(
    rec: Reconstruction,
    said: PairResults,
    kept: list[int],
    pairs: dict[tuple[int, int], PairRecord],
    found: Alignment,
    images: NetworkImages,
    settings: Mast3rSettings,
    progress: Progress,
) -> None:
    """Depth maps on the grid of the prepared frames."""
    _, canvas = images.cameras(found.K, rec.cameras.cam2world)
    neighbors: list[list[int]] = [[] for _ in kept]
    for i, j in pairs:
        neighbors[i].append(j)
        neighbors[j].append(i)

    def dense(k: int) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        view = said.frame_store.read(kept[k]).view
        z_depth = dense_z_depth(
            found.anchor_z_depth[k], view.relative_depth, float(found.focal_before[k]), float(found.K[k, 0, 0]),
            settings.alignment.subsample,
        )  # fmt: skip
        if settings.bundle_adjustment:  # which moved the points
            z_depth = z_depth * _scale_to_points(z_depth, rec, canvas[k], k)
        return z_depth, view.confidence

    def finish(k: int, z_depth: Float[Tensor, "h w"], confidence: Float[Tensor, "h w"]) -> None:
        f = kept[k]
        mask = images.mask(f)
        usable = (confidence >= settings.min_confidence) & (z_depth > 0)
        usable = usable if mask is None else usable & mask
        inverse = torch.where(usable, 1 / z_depth.clamp(min=1e-12), 0.0)
        share = torch.where(usable, depth_cleaning.confidence_share(confidence), 0.0)
        gray = (images.image(f).permute(1, 2, 0) / 2 + 0.5) @ LUMA
        q, share = on_frame_grid(inverse, share, gray, images.frames.image(f) @ LUMA, rec.cameras[k], canvas[k])
        known = (q > 0) & images.frames.mask(f)
        z = torch.where(known, 1 / q.clamp(min=1e-12), 0.0)
        rec.depth.write(rec.names[k], DepthMap(z, torch.where(known, share, 0.0)))

    depth_cleaning.cleaned(range(len(kept)), neighbors, canvas, dense, settings.memory_mb << 20, finish, progress)


def _scale_to_points(z_depth: Float[Tensor, "h w"], rec: Reconstruction, canvas: Cameras, k: int) -> float:
    """Ratio of the depths of frame k's sparse points to its depth map."""
    mine = rec.tracks.point[rec.tracks.frame == k]
    uv, z, visible = project_visible(canvas, rec.points.xyz[mine].double()[None])
    if not visible.any():
        return 1.0
    column, row = uv[visible].long().unbind(-1)
    return float((z[visible] / z_depth[row, column]).median())
