"""Parts of a clip that were placed by themselves, each in axes and a unit of its own, and the points that two share.

Two parts see the same surface point where a frame is in both and its feature has a point in each, or where a verified
match joins features of two frames that have points in different parts.
"""

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap


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
