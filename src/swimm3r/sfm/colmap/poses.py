"""Poses and sparse points without weights: SIFT, verified matches, incremental or global mapping, one lens per clip.

`database.db` in the working folder keeps features and matches, so a killed run goes on from it; seeds are fixed, so it
ends where an undisturbed one does. Poses are free in scale and place: nothing here is metric.
"""

import itertools
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, cameras_of, rows_of_frames
from swimm3r.errors import InputError, RegistrationError, StorageError
from swimm3r.io.colmap.cameras import to_pycolmap_camera
from swimm3r.io.colmap.model import ColmapModel, from_pycolmap, silence_log, write_model
from swimm3r.io.files.atomic import atomic_path
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.placement import Navigator
from swimm3r.scene.reconstruction import (
    DepthMaps,
    Matches,
    Points,
    QualityWarning,
    Reconstruction,
    Tracks,
)
from swimm3r.scene.rig import first_of_instants
from swimm3r.sfm.colmap import calibration, mapping
from swimm3r.sfm.colmap.adjustment import adjust_through_port
from swimm3r.sfm.colmap.chunks.long_clip import is_long, map_long_clip
from swimm3r.sfm.colmap.chunks.parts import without_jumps
from swimm3r.sfm.colmap.navigated import with_navigation
from swimm3r.sfm.colmap.plausibility import depth_change, implausible
from swimm3r.sfm.features import vlad
from swimm3r.sfm.features.database import FeatureDatabase, fill_features, match_pairs, start_database
from swimm3r.sfm.features.sift import unit_descriptors
from swimm3r.sfm.lens import behind_port, with_calibration
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import thread_count

if TYPE_CHECKING:
    import pycolmap

PARTS = "parts"  # folder of the models that did not join the largest
_LEAST_OF_A_PART = 3  # frames
_LOST_SCALE = 1000.0  # change of the frames' median depth beyond which nothing of a model is right
_NONE, _NOWHERE = np.zeros(0), np.zeros((0, 2))  # what is joined where no pair matches


@dataclass(frozen=True)
class _Mapped:
    """The model that is used, those that did not join it, and warnings."""

    model: "pycolmap.Reconstruction"
    others: "list[pycolmap.Reconstruction]"
    lens_refined: bool  # from the images; else assumed, or held for the user
    warnings: list[QualityWarning]


def reconstruct(
    frames: Frames,
    settings: ColmapSettings,
    folder: Path,
    progress: Progress = silent,
    lens: Cameras | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    navigator: Navigator | None = None,
) -> Reconstruction:
    """Cameras, points, tracks and matches of the frames that can be placed; depth maps are for others to fill.

    `lens` (one camera, its pose unused) is held where it is given; else the settings say what is known of it. A
    `navigator` joins what shares no ground, and holds long paths straight. Raises InputError for fewer than 2 frames or
    navigation that contradicts them, and RegistrationError where too few can be placed.
    """

    if len(frames) < 2:
        raise InputError(
            f"structure from motion needs at least 2 frames, got {len(frames)}",
            cause="the clip is too short or the sampling too coarse",
            hint="a longer clip or a higher --fps",
        )
    silence_log()
    threads = settings.threads or thread_count()
    housed = None
    if lens is None:
        settings = with_calibration(settings, frames.width, frames.height, frames.calibration)
        settings, housed = behind_port(settings, frames.width, frames.height)
        camera = calibration.first_camera(frames.width, frames.height, settings)
    else:
        camera, settings = to_pycolmap_camera(lens), replace(settings, intrinsics="fixed")
        camera.has_prior_focal_length = True
    with _full_disk_said_plainly(folder):
        store = start_database(folder, frames, camera, settings.features)
        fill_features(store, frames, settings.features, threads, progress)
        pairs = choose_pairs(store, frames, settings)
        match_pairs(store, pairs, settings.features, threads, progress)
        for leftover in folder.glob(".mapping.*"):  # of a killed run
            shutil.rmtree(leftover)
        # mapping writes lenses, and matches of frames left over, into a copy: the database holds what all runs agree on
        working = FeatureDatabase(folder / "mapping.db", len(frames))
        try:
            with atomic_path(working.path) as draft:
                shutil.copyfile(store.path, draft)
            mapped = _map(working, frames, pairs, settings, progress, engine)
            if navigator is not None:
                mapped = _navigated(mapped, working, frames, folder, navigator, progress)
            _check_placed(mapped.model, len(frames), settings)
            rec = _record(mapped.model, working, frames, folder)
            if housed is not None:
                free = settings.intrinsics != "fixed"
                rec = adjust_through_port(rec, housed, settings.port.range, lens=free, progress=progress)
            sizes = [mapped.model.num_reg_images(), *_write_parts(mapped.model, mapped.others, frames, folder / PARTS)]
            if depth_change(rec) > _LOST_SCALE:
                raise _scale_lost(len(rec.names), len(frames))
            found = implausible(rec, working, frames)
        finally:
            working.path.unlink(missing_ok=True)
    warnings = [*mapped.warnings, *_registration_warnings(len(rec.names), sizes, frames)]
    if settings.housing == "flat" and housed is None:
        warnings.append(
            QualityWarning(
                "The refraction at the flat port is not modeled, as the lens in air is unknown; the focal length and"
                " radial distortion found in water stand for it.",
                "Give --focal or --calibration of the lens in air, and --port.distance and --port.thickness.",
            )
        )
    return replace(rec, warnings=(*found, *warnings))


def choose_pairs(store: FeatureDatabase, frames: Frames, settings: ColmapSettings) -> list[tuple[int, int]]:
    """The pairs of frames worth matching, (i < j), sorted."""
    n = len(frames)
    if settings.pairs == "exhaustive" or (settings.pairs == "auto" and n <= settings.exhaustive_to):
        return list(itertools.combinations(range(n), 2))
    with store.open() as database:
        described = vlad.describe_frames(
            n, lambda i: unit_descriptors(database.read_descriptors(i + 1).data), torch.Generator().manual_seed(0)
        )
    if not frames.ordered and settings.pairs == "auto":
        return vlad.alike_pairs(described, 5 * settings.loops)
    steps = {*range(1, settings.overlap + 1), *(2**k for k in range(settings.overlap.bit_length(), 8))}
    cameras = 1 if frames.rig is None else len(frames.rig.cameras)
    near = _near(frames, steps)
    return sorted(near | set(vlad.alike_pairs(described, settings.loops, apart=settings.overlap * cameras)))


def _near(frames: Frames, steps: set[int]) -> set[tuple[int, int]]:
    """Pairs of frames that lie so many steps apart.

    Of a rig each camera is paired with itself so many instants later, and all of them at an instant and with the next.
    """
    starts = first_of_instants([frame.instant for frame in frames])
    groups = [range(first, last) for first, last in pairwise([*starts, len(frames)])]
    camera = [frame.camera for frame in frames]
    found = {pair for group in groups for pair in itertools.combinations(group, 2)}
    for k, step in itertools.product(range(len(groups)), steps):
        if k + step < len(groups):
            both = itertools.product(groups[k], groups[k + step])
            found |= {(i, j) for i, j in both if step == 1 or camera[i] == camera[j]}
    return found


def absolute_pose(
    points2d: Float[Tensor, "n 2"], points3d: Float[Tensor, "n 3"], camera: Cameras, max_error: float = 4.0
) -> tuple[Float[Tensor, "4 4"], Bool[Tensor, " n"]] | None:
    """cam2world of one camera from pixels of known points (PnP with RANSAC), and its inliers; None where there is none.

    Only the intrinsics of `camera` (one) are used; `max_error` is in pixels.
    """
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error
    options.ransac.random_seed = 0
    lens = to_pycolmap_camera(camera)
    found = pycolmap.estimate_and_refine_absolute_pose(
        points2d.double().numpy(), points3d.double().numpy(), lens, estimation_options=options
    )
    if found is None:
        return None
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.from_numpy(found["cam_from_world"].inverse().matrix())
    return pose, torch.from_numpy(np.asarray(found["inlier_mask"], bool))


@contextmanager
def _full_disk_said_plainly(folder: Path) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:  # what pycolmap makes of SQLite's complaint
        if "disk" not in str(error):
            raise
        raise StorageError(
            f"the database in {folder} could not be written ({str(error).splitlines()[-1][:200]})",
            cause="the disk is full or read-only",
            hint="free some space, or choose another --out, and run the same command again: it goes on from here",
        ) from error


def _map(
    store: FeatureDatabase,
    frames: Frames,
    pairs: list[tuple[int, int]],
    settings: ColmapSettings,
    progress: Progress,
    engine: EngineSettings,
) -> "_Mapped":
    """The largest model, its lens refined. Raises RegistrationError where no two frames can be placed."""
    n, threads = len(frames), settings.threads or thread_count()
    long = is_long(n, settings.mapping)
    determined = False
    if long:
        in_chunks = map_long_clip(store, settings, ordered=frames.ordered, progress=progress, engine=engine)
        models, determined = in_chunks.models, in_chunks.lens_determined
    else:
        models = mapping.map_frames(store, settings, progress)
    if not models:
        raise _too_few(0, n, settings)
    model = without_jumps(models[0])
    if model.num_reg_images() < n:
        placed = {i - 1 for i in model.reg_image_ids()}
        again = [(i, j) for i, j in pairs if i not in placed or j not in placed]
        looser = replace(settings.features, max_ratio=settings.mapping.retry_ratio)
        match_pairs(store, again, looser, threads, progress, again=True)
        if not long:
            model = calibration.refine(store, model, settings, progress).model  # a better lens places more
        more = mapping.place_leftovers(store, model, settings, progress)
        more = mapping.replace_misplaced(store, more, settings, progress)
        more = without_jumps(more)
        model = more if more.num_reg_images() >= model.num_reg_images() else model
    if long:
        calibrated = calibration.Calibrated(model, refined=determined)
    else:
        calibrated = calibration.refine(store, model, settings, progress)
    warnings = []
    if not calibrated.refined and settings.intrinsics != "fixed":
        camera = calibrated.model.cameras[1]
        warnings.append(
            QualityWarning(
                f"The lens could not be calibrated from this clip; {camera.focal_length_x:.0f} px was assumed as its"
                " focal length.",
                "Shapes may be stretched in depth. Give --focal and --k1 of the camera, calibrated in water.",
            )
        )
    return _Mapped(calibrated.model, models[1:], calibrated.refined, warnings)


def _navigated(
    mapped: "_Mapped",
    store: FeatureDatabase,
    frames: Frames,
    folder: Path,
    navigator: Navigator,
    progress: Progress,
) -> "_Mapped":
    found = with_navigation(
        store,
        mapped.model,
        mapped.others,
        frames,
        navigator,
        lambda model: _record(model, store, frames, folder),
        progress,
        lens=mapped.lens_refined,
    )
    return replace(mapped, model=found.model, others=found.others, warnings=[*mapped.warnings, *found.warnings])


def _check_placed(model: "pycolmap.Reconstruction", frames: int, settings: ColmapSettings) -> None:
    """Raise RegistrationError where a model holds too small a share of the frames."""
    placed = model.num_reg_images()
    thin = model.compute_mean_observations_per_reg_image() < settings.mapping.thin_points
    share = settings.mapping.thin_share if thin else settings.mapping.min_share
    if placed < max(min(settings.mapping.min_frames, frames), share * frames):
        raise _too_few(placed, frames, settings)


def _write_parts(
    model: "pycolmap.Reconstruction", others: "list[pycolmap.Reconstruction]", frames: Frames, folder: Path
) -> list[int]:
    """Write models that did not join the largest as `folder`/1, 2, ... and return how many frames each has.

    Kept are those with at least three frames that no larger one has.
    """
    shutil.rmtree(folder, ignore_errors=True)
    known = {model.images[i].name for i in model.reg_image_ids()}
    sizes = []
    for other in sorted(others, key=lambda m: m.num_reg_images(), reverse=True):
        own = {other.images[i].name for i in other.reg_image_ids()}
        if len(own - known) < _LEAST_OF_A_PART:
            continue
        known |= own
        sizes.append(len(own))
        table = from_pycolmap(other)
        write_model(folder / f"{len(sizes)}", replace(table, names=tuple(frames.names[int(n)] for n in table.names)))
    return sizes


def _record(model: "pycolmap.Reconstruction", store: FeatureDatabase, frames: Frames, folder: Path) -> Reconstruction:
    table = from_pycolmap(model)
    index = [int(name) for name in table.names]
    table = replace(table, names=tuple(frames.names[i] for i in index))
    return Reconstruction(
        names=table.names,
        cameras=cameras_of(table),
        points=Points(torch.from_numpy(table.xyz), _colors(table, frames, index), torch.from_numpy(table.error)),
        tracks=Tracks(*(torch.from_numpy(a) for a in (table.track_point, table.track_frame, table.track_xy))),
        matches=verified_matches(store, index),
        depth=DepthMaps(folder / "z_depth"),
        backend="colmap",
    )


def _colors(table: ColmapModel, frames: Frames, index: list[int]) -> Float[Tensor, "p 3"]:
    total = torch.zeros(len(table.xyz), 3)
    point, frame = torch.from_numpy(table.track_point), torch.from_numpy(table.track_frame)
    x = torch.from_numpy(table.track_xy[:, 0]).long().clamp(0, frames.width - 1)
    y = torch.from_numpy(table.track_xy[:, 1]).long().clamp(0, frames.height - 1)
    for seen, i in zip(rows_of_frames(frame, len(index)), index, strict=True):
        total.index_add_(0, point[seen], frames.image(i)[y[seen], x[seen]])
    return total / torch.bincount(point, minlength=len(total)).clamp(min=1)[:, None]


def verified_matches(store: FeatureDatabase, index: list[int]) -> Matches:
    """The verified matches among the database's frames of these numbers; `index[k]` is frame k of the result."""
    import pycolmap

    row_of = {i: row for row, i in enumerate(index)}
    i, j, xy_i, xy_j = [], [], [], []
    with store.open() as database:
        xy = {k: database.read_keypoints(k + 1)[:, :2].astype(np.float64) for k in index}
        pairs, counts = database.read_two_view_geometry_num_inliers()
        for pair in sorted(pair for pair, count in zip(pairs, counts, strict=True) if count):
            a, b = (k - 1 for k in pycolmap.pair_id_to_image_pair(pair))
            if a not in row_of or b not in row_of:
                continue
            rows = np.asarray(database.read_two_view_geometry(a + 1, b + 1).inlier_matches, np.int64).reshape(-1, 2)
            i.append(np.full(len(rows), row_of[a]))
            j.append(np.full(len(rows), row_of[b]))
            xy_i.append(xy[a][rows[:, 0]])
            xy_j.append(xy[b][rows[:, 1]])
    first, second = (torch.from_numpy(np.concatenate([_NONE, *side]).astype(np.int64)) for side in (i, j))
    return Matches(
        i=first,
        j=second,
        xy_i=torch.from_numpy(np.concatenate([_NOWHERE, *xy_i])).float(),
        xy_j=torch.from_numpy(np.concatenate([_NOWHERE, *xy_j])).float(),
        confidence=torch.ones(len(first)),
    )


def _registration_warnings(placed: int, sizes: list[int], frames: Frames) -> list[QualityWarning]:
    if placed == len(frames):
        return []
    left = len(frames) - placed
    others = [size for size in sizes[1:] if size >= 3]
    if others:
        parts = " + ".join(str(size) for size in (placed, *others))
        return [
            QualityWarning(
                f"The frames fall into parts that did not join ({parts} of {len(frames)}); only the largest is used;"
                f" the others are COLMAP models in sfm/{PARTS}.",
                "Record lines that overlap by half, cross them with one line, and keep a slow turn between them; "
                "a higher --fps helps where the parts follow each other.",
            )
        ]
    return [
        QualityWarning(
            f"{left} of {len(frames)} frames could not be placed and are left out.",
            "They are blurred, show open water, or overlap too little with the rest: raise --fps, or swim slower.",
        )
    ]


def _too_few(placed: int, frames: int, settings: ColmapSettings) -> RegistrationError:
    return _not_placed(
        f"only {placed} of {frames} frames could be placed relative to each other"
        + (", and on too few points to be trusted" if placed > settings.mapping.min_share * frames else "")
    )


def _scale_lost(placed: int, frames: int) -> RegistrationError:
    return _not_placed(
        f"{placed} of {frames} frames were placed, but not in one scale: the same scene is more than"
        f" {_LOST_SCALE:,.0f} times as far in one frame as in another"
    )


def _not_placed(what: str) -> RegistrationError:
    return RegistrationError(
        what,
        cause="the frames share too little that stands still: open water, moving animals or divers fill the view, "
        "visibility is too poor, or the camera moved too fast or only turned",
        hint="film reef, rock or wreck slowly, from several sides, with 60 % overlap and within 3 m; "
        "mask out what moves (--masks); give a part of the clip where the bottom is in view; or raise --fps",
    )
