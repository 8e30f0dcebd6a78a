"""Parts of a clip that were placed by themselves, each in axes and a unit of its own, and the points that two share.

Two parts see the same surface point where a frame is in both and its feature has a point in each, or where a verified
match joins features of two frames that have points in different parts.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array, triu
from scipy.sparse.csgraph import connected_components

from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

LEAST_FRAMES = 3  # of a part
_HOLDING = 15  # points that two frames must share to hold together, as many as a verified pair has matches
_DEPTH_RATIO = 3.0  # of two frames that share points
_FEW = 50  # shared points, below which the scale between two frames is weak, and their ratio of depths must be smaller
_RATIO_OF_FEW = 1.6  # stills of a survey differ by less than 1.5


@dataclass(frozen=True)
class Part:
    """Frames placed relative to each other; image ids are those of the whole clip's database."""

    cam_from_world: dict[int, Float[np.ndarray, "3 4"]]  # by image id
    point_of: dict[int, Int[np.ndarray, " f"]]  # by image id: the point of each feature, -1 without
    xyz: Float[np.ndarray, "p 3"]

    @property
    def images(self) -> tuple[int, ...]:
        """Image ids, sorted."""
        return tuple(sorted(self.cam_from_world))

    def observations(self, image: int) -> int:
        """Number of features of an image that have a point."""
        return int((self.point_of[image] >= 0).sum())


@dataclass(frozen=True)
class SharedPoints:
    """Surface points that two parts both have, each observed by an image of either part."""

    a: Int[np.ndarray, " n"]  # point of part a
    b: Int[np.ndarray, " n"]
    image_a: Int[np.ndarray, " n"]  # of part a
    image_b: Int[np.ndarray, " n"]
    feature_a: Int[np.ndarray, " n"]
    feature_b: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.a)


def part_of(model: "pycolmap.Reconstruction") -> Part:
    """A model whose images are named by their number in the clip, as `features.database` names them."""
    ids = {p: row for row, p in enumerate(sorted(model.point3D_ids()))}
    poses, points = {}, {}
    for i in model.reg_image_ids():
        image = model.images[i]
        number = int(image.name) + 1
        poses[number] = np.asarray(image.cam_from_world().matrix())
        points[number] = np.array([ids[p.point3D_id] if p.has_point3D() else -1 for p in image.points2D], np.int64)
    xyz = np.array([model.points3D[p].xyz for p in ids]).reshape(-1, 3)
    return Part(poses, points, xyz)


def coherent_parts(part: Part) -> list[Part]:
    """The part, cut where only few points hold it together, or where frames stand at quite another depth.

    Along a chain of frames that share little a mapper may lose the scale between two of them, and go on in another
    unit: the points that both share then stand elsewhere for one of them, or at the same depth for both, though all
    else that the one sees is far from that. Each piece has at least `LEAST_FRAMES` frames.
    """
    images = part.images
    rows = {image: np.unique(points[points >= 0]) for image, points in part.point_of.items()}
    indptr = np.concatenate([[0], np.cumsum([len(rows[image]) for image in images])])
    seen = csr_array(
        (np.ones(indptr[-1]), np.concatenate([rows[image] for image in images]), indptr), (len(images), len(part.xyz))
    )
    common = triu(seen @ seen.T, 1).tocoo()
    kept = np.array(
        [
            count >= _HOLDING and _in_one_scale(part, images[i], images[j], rows)
            for i, j, count in zip(common.row, common.col, common.data, strict=True)
        ],
        bool,
    )
    edges = coo_array((common.data[kept], (common.row[kept], common.col[kept])), shape=common.shape)
    _, label = connected_components(edges, directed=False)
    pieces = [[images[i] for i in np.flatnonzero(label == k)] for k in range(label.max() + 1)]
    return [_piece(part, own) for own in pieces if len(own) >= LEAST_FRAMES]


def coherent_models(model: "pycolmap.Reconstruction") -> "list[pycolmap.Reconstruction]":
    """The model cut where `coherent_parts` cuts it, the largest piece first; itself where that leaves it whole."""
    part = part_of(model)
    pieces = sorted(coherent_parts(part), key=lambda piece: len(piece.images), reverse=True)
    if not pieces or len(pieces[0].images) == len(part.images):
        return [model]
    return [_of_frames(model, piece) for piece in pieces]


def _of_frames(model: "pycolmap.Reconstruction", part: Part) -> "pycolmap.Reconstruction":
    """The model with the frames of a part of it alone."""
    import pycolmap

    kept = pycolmap.Reconstruction(model)
    for image_id in model.reg_image_ids():
        if int(model.images[image_id].name) + 1 not in part.cam_from_world:
            kept.deregister_frame(model.images[image_id].frame_id)
    return kept


def _in_one_scale(part: Part, i: int, j: int, rows: Mapping[int, Int[np.ndarray, " k"]]) -> bool:
    """Return whether two images have about the same depth, that of the points they share and that of all of theirs."""
    shared = np.intersect1d(rows[i], rows[j], assume_unique=True)
    ratios = (
        _depth(part, i, seen_i) / _depth(part, j, seen_j) for seen_i, seen_j in ((shared, shared), (rows[i], rows[j]))
    )
    most = _DEPTH_RATIO if len(shared) >= _FEW else _RATIO_OF_FEW
    return all(1 / most < ratio < most for ratio in ratios)


def _depth(part: Part, image: int, points: Int[np.ndarray, " k"]) -> float:
    """Median depth of some points in an image; hardly above 0 where they are behind it."""
    last_row = part.cam_from_world[image][2]
    return max(1e-12, float(np.median(part.xyz[points] @ last_row[:3] + last_row[3])))


def _piece(part: Part, images: list[int]) -> Part:
    return Part({i: part.cam_from_world[i] for i in images}, {i: part.point_of[i] for i in images}, part.xyz)


def shared_points(store: FeatureDatabase, parts: list[Part]) -> dict[tuple[int, int], SharedPoints]:
    """The points that each two parts (a < b) share, where there are any."""
    import pycolmap

    parts_of: defaultdict[int, list[int]] = defaultdict(list)
    for k, part in enumerate(parts):
        for image in part.images:
            parts_of[image].append(k)
    rows: defaultdict[tuple[int, int], list[np.ndarray]] = defaultdict(list)

    def collect(image_i: int, image_j: int, matches: Int[np.ndarray, "m 2"]) -> None:
        for i in parts_of[image_i]:
            for j in parts_of[image_j]:
                if i == j:
                    continue
                points = np.stack(
                    [parts[i].point_of[image_i][matches[:, 0]], parts[j].point_of[image_j][matches[:, 1]]]
                )
                known = (points >= 0).all(0)
                images = np.broadcast_to([[image_i], [image_j]], points.shape)
                found = np.concatenate([points, images, matches.T])[:, known]
                rows[min(i, j), max(i, j)].append(found if i < j else found[[1, 0, 3, 2, 5, 4]])

    for image, owners in list(parts_of.items()):
        if len(owners) > 1:  # a frame of both: each of its features matches itself
            features = np.arange(len(parts[owners[0]].point_of[image]))
            collect(image, image, np.stack([features, features], 1))
    with store.open() as database:
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            image_i, image_j = pycolmap.pair_id_to_image_pair(pair)
            if image_i in parts_of and image_j in parts_of:
                collect(image_i, image_j, np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2))
    return {pair: _unique(np.concatenate(found, axis=1)) for pair, found in rows.items()}


def _unique(rows: Int[np.ndarray, "6 n"]) -> SharedPoints:
    """One row per pair of points."""
    _, first = np.unique(rows[:2], axis=1, return_index=True)
    return SharedPoints(*rows[:, np.sort(first)])
