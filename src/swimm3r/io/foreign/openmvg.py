"""OpenMVG's sfm_data.json: x_camera = R (X - C); pixels as the file has them, as in OpenMVG's own export to COLMAP.

cereal writes the name of an intrinsic's class at its first use only; later entries repeat its number without the top
bit.
"""

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from swimm3r.io.foreign.lens import nearest_opencv, radial
from swimm3r.io.foreign.model import ForeignModel, one_size, without_points

_TOP_BIT = 1 << 31


def read(path: Path, document: dict[str, Any]) -> ForeignModel:
    """Poses, lenses, points and sightings of the placed views. Raises KeyError or ValueError for a damaged file."""
    poses = {int(entry["key"]): entry["value"] for entry in document["extrinsics"]}
    lenses = _lenses(document["intrinsics"])
    views = sorted(
        (view["value"]["ptr_wrapper"]["data"] for view in document["views"]), key=lambda v: int(v["id_view"])
    )
    placed = [view for view in views if int(view["id_pose"]) in poses and int(view["id_intrinsic"]) in lenses]
    if not placed:
        raise ValueError("no view in it has a pose and an intrinsic")
    used = [lenses[int(view["id_intrinsic"])] for view in placed]
    kinds = {kind for kind, *_ in used}
    if len(kinds) > 1:
        raise ValueError(f"it mixes lenses: {', '.join(sorted(kinds))}")
    cam2world = np.tile(np.eye(4), (len(placed), 1, 1))
    for pose, view in zip(cam2world, placed, strict=True):
        known = poses[int(view["id_pose"])]
        pose[:3, :3] = np.array(known["rotation"], np.float64).reshape(3, 3).T
        pose[:3, 3] = known["center"]
    names = tuple(str(PurePosixPath(str(view.get("local_path", "")).strip("/")) / view["filename"]) for view in placed)
    model = without_points(
        names,
        kinds.pop(),
        one_size({size for _, size, _, _ in used}),
        np.stack([K for _, _, K, _ in used]),
        np.stack([distortion for *_, distortion in used]),
        cam2world,
    )
    row = {int(view["id_view"]): i for i, view in enumerate(placed)}
    structure = [entry["value"] for entry in document.get("structure", [])]
    sightings = [
        (p, row[int(seen["key"])], seen["value"]["x"])
        for p, point in enumerate(structure)
        for seen in point["observations"]
        if int(seen["key"]) in row
    ]
    points = {
        "xyz": np.array([point["X"] for point in structure], np.float64).reshape(-1, 3),
        "rgb": np.zeros((len(structure), 3), np.uint8),
        "error": np.zeros(len(structure)),
        "track_point": np.array([p for p, _, _ in sightings], np.int64),
        "track_frame": np.array([frame for _, frame, _ in sightings], np.int64),
        "track_xy": np.array([xy for _, _, xy in sightings], np.float64).reshape(-1, 2),
    }
    return ForeignModel("OpenMVG", type(model)(**{**vars(model), **points}), coloured=False)


def _lenses(entries: list[dict[str, Any]]) -> dict[int, tuple[str, tuple[int, int], np.ndarray, np.ndarray]]:
    names: dict[int, str] = {}
    found = {}
    for entry in entries:
        value = entry["value"]
        number = int(value["polymorphic_id"]) & ~_TOP_BIT if "polymorphic_id" in value else -1
        if "polymorphic_name" in value:
            names[number] = str(value["polymorphic_name"])
        data = value["ptr_wrapper"]["data"]
        data = {**data.get("value0", {}), **data}  # some versions nest what all lenses have
        found[int(entry["key"])] = _lens(names[number], data)
    return found


def _lens(name: str, data: dict[str, Any]) -> tuple[str, tuple[int, int], np.ndarray, np.ndarray]:
    width, height = int(data["width"]), int(data["height"])
    f, (cx, cy) = float(data["focal_length"]), data["principal_point"]
    K = np.array([[f, 0, float(cx)], [0, f, float(cy)], [0, 0, 1]])
    p1 = p2 = 0.0
    match name:
        case "pinhole":
            return "PINHOLE", (width, height), K, np.zeros(0)
        case "fisheye":
            return "OPENCV_FISHEYE", (width, height), K, np.array(data["fisheye"], np.float64).reshape(4)
        case "pinhole_radial_k1":
            first = data["disto_k1"]
            k = (float(first[0] if isinstance(first, list) else first),)
        case "pinhole_radial_k3":
            k = tuple(map(float, data["disto_k3"]))
        case "pinhole_brown_t2":
            *radials, p1, p2 = map(float, data["disto_t2"])
            k = tuple(radials)
        case _:
            raise ValueError(f"its lens is of the kind {name}, which is not supported")

    def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r2 = x * x + y * y
        dx = x * radial(k, r2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        return dx, y * radial(k, r2) + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    return "OPENCV", (width, height), K, nearest_opencv(distort, K, width, height)
