"""COLMAP's database of one dive: keypoints per frame, verified matches per pair; what is in it is not computed again.

Frames stand in it as 000000, 000001, ... in the order of `Frames`, all of one camera, or each of its own where poses
with several lenses are given; keypoints of a calibrated rig's frames that have another lens stand where the one lens
has their rays. Its pixels are those of the images that keypoints are found in: COLMAP's limits of a few pixels are
meant for keypoints that are exact to one, and those of an image of 3840 pixels that was reduced to 1000 would be four
times as far off. Two-view geometry is verified by fundamental matrix and homography as long as nobody knows the focal
length, so that matches outlive any guess of it.

Nothing is written in COLMAP's transactions: one that meets a full disk aborts the process. Instead the last write of a
frame (keypoints) and of a pair (two-view geometry) says that it is complete.
"""

import itertools
import json
import logging
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.errors import StorageError
from swimm3r.io.files.atomic import write_text
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import Features, extract_features, match_descriptors, unit_descriptors

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

MIN_INLIERS = 15  # of a pair; COLMAP's limit, below it chance agrees with some geometry
_HINT_OF_OVERLAP = 8  # matches
_SEEN_TWICE = 0.5  # of the matched features; 0.12 to 0.35 of most clips' and 0.60 to 0.73 of an AUV's stills' match so
_BATCH = 32  # frames or pairs worked on together: what a killed run loses
_HELD = 64  # frames in memory while matching: 0.1 GB
_NOT_WRITABLE = ("disk is full", "disk I/O", "readonly")  # in SQLite's messages; a malformed "disk image" is damage


@dataclass(frozen=True)
class FeatureDatabase:
    """A database file and the number of its frames; image i of `Frames` has id i + 1."""

    path: Path
    frames: int
    scale: float = 1.0  # pixels of the database per pixel of the frames
    little_overlap: bool = False  # most features match in one other frame alone (`with_overlap`)

    @contextmanager
    def open(self) -> "Iterator[pycolmap.Database]":
        """The open database."""
        import pycolmap

        database = pycolmap.Database.open(str(self.path))
        try:
            yield database
        finally:
            database.close()


def start_database(
    folder: Path,
    frames: Frames,
    camera: "pycolmap.Camera | Sequence[pycolmap.Camera]",
    settings: FeatureSettings,
    lenses: Sequence[Sequence[float]] = (),
) -> FeatureDatabase:
    """The database in `folder`, new unless the one there was made of the same frames with the same settings.

    `camera` is that of all frames, or a list with one for each, with ids 1, 2, ...; in pixels of the frames. `lenses`
    are the numbers of those that keypoints are moved from, see `fill_features`.
    """
    import pycolmap

    cameras = [camera] if isinstance(camera, pycolmap.Camera) else list(camera)
    path, about = folder / "database.db", folder / "database.json"
    content = {
        "frames": [[frame.name, round(frame.sharpness, 3), str(frame.mask)] for frame in frames],
        "size": [frames.width, frames.height],
        "features": asdict(settings),
        **(_described(cameras[0]) if len(cameras) == 1 else {"cameras": [_described(each) for each in cameras]}),
    }
    if lenses:
        content["lenses"] = [list(numbers) for numbers in lenses]
    scale = min(1.0, settings.long_side / max(frames.width, frames.height))
    if scale < 1:
        content["scale"] = scale
        cameras = [scaled_camera(each, scale) for each in cameras]
    out = FeatureDatabase(path, len(frames), scale)
    described = json.dumps(content)
    if path.is_file() and about.is_file() and about.read_bytes() == described.encode():
        if _is_whole(path, len(frames)):
            with out.open() as database:
                for each in cameras:
                    database.update_camera(each)
            return out
        log.warning("%s is damaged: features and matches are found again", path)
    folder.mkdir(parents=True, exist_ok=True)
    about.unlink(missing_ok=True)
    remove_database(path)
    with out.open() as database:
        _write_frames(database, cameras, range(len(frames)))
    write_text(about, described)
    return out


@contextmanager
def full_disk_said_plainly(folder: Path) -> Iterator[None]:
    """Raise StorageError where a database in `folder` cannot be written."""
    try:
        yield
    except RuntimeError as error:  # what pycolmap makes of SQLite's complaint
        if not any(words in str(error) for words in _NOT_WRITABLE):
            raise
        raise StorageError(
            f"the database in {folder} could not be written ({str(error).splitlines()[-1][:200]})",
            cause="the disk is full or read-only",
            hint="free some space, or choose another --out, and run the same command again: it goes on from here",
        ) from error


def remove_database(path: Path) -> None:
    """Remove a database, if there is one, with the journal that a killed process may have left beside it.

    SQLite would replay the journal into the next database of that name.
    """
    for file in path.parent.glob(f"{path.name}*"):
        file.unlink()


def _described(camera: "pycolmap.Camera") -> dict[str, object]:
    """The lens of a camera as far as it is known, for the file that says what a database was made of."""
    if not camera.has_prior_focal_length:
        return {"camera": "unknown", "params": []}
    return {"camera": camera.model.name, "params": camera.params.tolist()}


def scaled_camera(camera: "pycolmap.Camera", scale: float) -> "pycolmap.Camera":
    """The camera of images that are enlarged by a factor; width and height are rounded, the lens is not."""
    import pycolmap

    pixels = {*camera.focal_length_idxs(), *camera.principal_point_idxs()}
    params = [value * scale if i in pixels else value for i, value in enumerate(camera.params)]
    out = pycolmap.Camera(
        model=camera.model,
        width=round(camera.width * scale),
        height=round(camera.height * scale),
        params=params,
        camera_id=camera.camera_id,
    )
    out.has_prior_focal_length = camera.has_prior_focal_length
    return out


def flat_share(store: FeatureDatabase) -> float:
    """Share of the verified pairs whose matches fit a homography: flat ground, or a camera that only turns."""
    import pycolmap

    kinds = pycolmap.TwoViewGeometryConfiguration
    with store.open() as database:
        found = [geometry.config for geometry in database.read_two_view_geometries()[1]]
    flat = sum(kind in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC) for kind in found)
    return flat / max(1, sum(kind not in (kinds.UNDEFINED, kinds.DEGENERATE) for kind in found))


def with_overlap(store: FeatureDatabase) -> FeatureDatabase:
    """The database with what its matches say of overlap: little where most of the matched features match in one other
    frame alone, as in stills that see ground twice.

    Points of two frames then have to hold the poses, too; COLMAP leaves them out where that is not asked for.
    """
    import pycolmap

    partners = {i: np.zeros(0, np.int64) for i in range(1, store.frames + 1)}
    with store.open() as database:
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            if len(geometry.inlier_matches) < MIN_INLIERS:
                continue
            matched = np.asarray(geometry.inlier_matches, np.int64)
            for image, features in zip(pycolmap.pair_id_to_image_pair(pair), matched.T, strict=True):
                seen = np.bincount(features, minlength=len(partners[image]))
                seen[: len(partners[image])] += partners[image]
                partners[image] = seen
    count = np.concatenate(list(partners.values()))
    return replace(store, little_overlap=bool((count == 1).sum() > _SEEN_TWICE * (count > 0).sum()))


def match_counts(store: FeatureDatabase) -> dict[tuple[int, int], int]:
    """Number of verified matches of every pair of frames (i < j, counted from 0) that has enough of them."""
    import pycolmap

    with store.open() as database:
        pairs, counts = database.read_two_view_geometry_num_inliers()
    named = ((pycolmap.pair_id_to_image_pair(pair), count) for pair, count in zip(pairs, counts, strict=True))
    return {(min(i, j) - 1, max(i, j) - 1): int(count) for (i, j), count in named if count >= MIN_INLIERS}


def write_excerpt(store: FeatureDatabase, path: Path, images: Sequence[int]) -> FeatureDatabase:
    """A new database of some frames alone: keypoints and verified matches, as mapping needs them.

    Frames keep their names; the k-th of `images` (ids) has id k + 1.
    """
    with store.open() as database, FeatureDatabase(path, len(images)).open() as excerpt:
        _write_frames(excerpt, [database.read_camera(1)], [image - 1 for image in images])
        new_id = {image: k + 1 for k, image in enumerate(images)}
        for image in images:
            excerpt.write_keypoints(new_id[image], database.read_keypoints(image))
        for i, j in itertools.combinations(images, 2):
            if database.exists_two_view_geometry(i, j):
                excerpt.write_two_view_geometry(new_id[i], new_id[j], database.read_two_view_geometry(i, j))
    return replace(store, path=path, frames=len(images))


def _write_frames(database: "pycolmap.Database", cameras: "Sequence[pycolmap.Camera]", numbers: Sequence[int]) -> None:
    """Write images of one camera or of one each, every image a frame of its own, named by their numbers in the clip."""
    import pycolmap

    rigs = []  # of each camera: its sensor and the id of its rig
    for camera in cameras:
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, database.write_camera(camera, use_camera_id=True))
        rig = pycolmap.Rig()
        rig.add_ref_sensor(sensor)
        rigs.append((sensor, database.write_rig(rig)))
    for k, number in enumerate(numbers):
        sensor, rig_id = rigs[k if len(rigs) > 1 else 0]
        image = pycolmap.Image(name=f"{number:06d}", camera_id=sensor.id, image_id=k + 1)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame()
        frame.rig_id = rig_id
        frame.add_data_id(pycolmap.data_t(sensor, k + 1))
        database.write_frame(frame)


def _is_whole(path: Path, frames: int) -> bool:
    """Return whether a file is a database that SQLite finds no fault with, of so many frames."""
    try:
        with closing(sqlite3.connect(path)) as database:
            (verdict,) = database.execute("PRAGMA quick_check(1)").fetchone()
            (found,) = database.execute("SELECT COUNT(*) FROM images").fetchone()
    except sqlite3.DatabaseError:
        return False
    return verdict == "ok" and found == frames


def fill_features(
    store: FeatureDatabase,
    frames: Frames,
    settings: FeatureSettings,
    threads: int,
    progress: Progress = silent,
    under_one_lens: Callable[[int, Features], Features] | None = None,
) -> None:
    """Extract the keypoints of the frames that have none yet.

    `under_one_lens` gives those of a frame, by its number, as the lens of the database would have them, in pixels of
    the frames.
    """
    import pycolmap

    with store.open() as database:
        missing = [i for i in range(store.frames) if not database.exists_keypoints(i + 1)]
    done = store.frames - len(missing)

    def extract(i: int) -> tuple[int, Features]:
        found = extract_features(frames.image(i), frames.mask(i), settings)
        found = found if under_one_lens is None else under_one_lens(i, found)
        if store.scale < 1:
            found.keypoints[:, :3] *= store.scale  # column, row, size
        return i, found

    progress("finding features", done, store.frames)
    for start in range(0, len(missing), _BATCH):
        with ThreadPoolExecutor(threads) as pool, store.open() as database:
            for i, found in pool.map(extract, missing[start : start + _BATCH]):
                described = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, found.descriptors)
                if not database.exists_descriptors(i + 1):
                    database.write_descriptors(i + 1, described)
                database.write_keypoints(i + 1, found.keypoints)
                done += 1
                progress("finding features", done, store.frames)


def match_pairs(
    store: FeatureDatabase,
    pairs: Sequence[tuple[int, int]],
    settings: FeatureSettings,
    threads: int,
    progress: Progress = silent,
    *,
    again: bool = False,
) -> None:
    """Match and verify the pairs (i < j) that have not been looked at yet; `again`: all, keeping the better."""
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = MIN_INLIERS
    verification.ransac.random_seed = 0
    what = "matching the frames left over" if again else "matching frames"
    with store.open() as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        camera_of = {image.image_id - 1: cameras[image.camera_id] for image in database.read_all_images()}
        if again:  # pairs without even a few matches at the first look have nothing in common
            missing = [(i, j) for i, j in pairs if len(database.read_matches(i + 1, j + 1)) >= _HINT_OF_OVERLAP]
        else:
            missing = [(i, j) for i, j in pairs if not database.exists_two_view_geometry(i + 1, j + 1)]
    done = len(pairs) - len(missing)
    held: dict[int, tuple[np.ndarray, Float[Tensor, "n 128"]]] = {}

    def match(pair: tuple[int, int]) -> "tuple[np.ndarray, pycolmap.TwoViewGeometry]":
        (xy_i, d_i), (xy_j, d_j) = held[pair[0]], held[pair[1]]
        matches = match_descriptors(d_i, d_j, settings.max_ratio).numpy().astype(np.uint32)
        if len(matches) < MIN_INLIERS:
            return matches, pycolmap.TwoViewGeometry()
        camera_i, camera_j = camera_of[pair[0]], camera_of[pair[1]]
        return matches, pycolmap.estimate_two_view_geometry(camera_i, xy_i, camera_j, xy_j, matches, verification)

    torch_threads = torch.get_num_threads()
    torch.set_num_threads(1)  # pairs are the parallel unit
    try:
        progress(what, done, len(pairs))
        for start in range(0, len(missing), _BATCH):
            batch = missing[start : start + _BATCH]
            with ThreadPoolExecutor(threads) as pool, store.open() as database:
                _hold_features(held, {i for pair in batch for i in pair}, database)
                for (i, j), (matches, geometry) in zip(batch, pool.map(match, batch), strict=True):
                    if again:
                        old = database.read_two_view_geometry(i + 1, j + 1)
                        if len(old.inlier_matches) < len(geometry.inlier_matches):
                            database.update_two_view_geometry(i + 1, j + 1, geometry)
                    else:
                        if not database.exists_matches(i + 1, j + 1):
                            database.write_matches(i + 1, j + 1, matches)
                        database.write_two_view_geometry(i + 1, j + 1, geometry)
                    done += 1
                    progress(what, done, len(pairs))
    finally:
        torch.set_num_threads(torch_threads)


def _hold_features(
    held: dict[int, tuple[np.ndarray, Float[Tensor, "n 128"]]], needed: set[int], database: "pycolmap.Database"
) -> None:
    """Load what is needed; drop what is not while there is too much."""
    for i in needed - held.keys():
        keypoints = database.read_keypoints(i + 1)[:, :2].astype(np.float64)
        held[i] = keypoints, unit_descriptors(database.read_descriptors(i + 1).data)
    for i in list(held):
        if len(held) > _HELD and i not in needed:
            del held[i]
