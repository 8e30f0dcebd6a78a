"""FLSea-VI (Randall & Treibitz 2023): raw frames, their seaErra restorations and metric depth, twelve sequences.

    REGION/SEQUENCE[/SEQUENCE]/imgs/TS.tiff   seaErra/TS_SeaErra.tiff   depth/TS_SeaErra_abs_depth.tif

TS counts tenths of microseconds since 1970. There are no poses: a COLMAP model put into the sequence's folder (made, as
the paper does, on the restored frames) is read. Also uw_depth's small layout rgb/ depth/ features/ dataset.csv.
"""

from pathlib import Path

import numpy as np

from swimm3r.datasets.layouts import Folder, by_stem, counted, depth_maps, image_files
from swimm3r.datasets.sequences import Lens, Sequence, Shot, Skipped
from swimm3r.io.colmap import model as colmap

REGIONS = {
    "canyons": ("flatiron", "horse_canyon", "tiny_canyon", "u_canyon"),
    "red_sea": (
        "big_dice_loop",
        "coral_table_loop",
        "cross_pyramid_loop",
        "dice_path",
        "landward_path",
        "northeast_path",
        "pier_path",
        "sub_pier",
    ),
}
TEST = ("horse_canyon", "tiny_canyon", "sub_pier")  # the paper's split, by sequence
_STEREO = ("katzaa", "michmoret", "nachsholim", "satil")  # FLSea-Stereo: other cameras, other depth
_DEPTH_RANGE = (0.05, 20.0)  # m, of the set's public loaders
_TICKS = 1e7  # per second
# Kalibr's calibration of the set, pinhole-radtan k1 k2 p1 p2; of the Red Sea camera no distortion was published
_LENSES = {
    "canyons": Lens(
        968,
        608,
        np.array([[1175.3913431656817, 0, 466.2595428966926], [0, 1174.2805072235263, 271.2116633091501], [0, 0, 1]]),
        "OPENCV",
        (-0.13280386913948822, 0.09799479194607102, -0.004731205238184176, 0.0007132375646502103),
    ),
    "red_sea": Lens(
        968,
        608,
        np.array([[1296.666758476217, 0, 501.50386149846], [0, 1300.831316354508, 276.161712082695], [0, 0, 1]]),
    ),
}


def is_sequence(folder: Folder) -> bool:
    """Return whether a folder has the layout of a sequence, or uw_depth's."""
    return "imgs" in folder.children or {"rgb", "depth"} <= folder.children.keys()


def read_sequence(folder: Folder) -> tuple[Sequence | None, list[Skipped]]:
    """The sequence of a folder, and what in it is not used."""
    name = folder.name.split("/")[-1].lower()
    if name in _STEREO:
        return None, [Skipped(folder.path, "a sequence of FLSea-Stereo, which is another data set")]
    raw = [p for p in image_files(folder.children.get("imgs") or folder.children["rgb"]) if not _is_extra(p)]
    if not raw:
        return None, [Skipped(folder.path, "its image folder is empty")]
    clean_folder, depth_folder = folder.child("seaerra"), folder.child("depth")
    clean = by_stem(image_files(clean_folder)) if clean_folder else {}
    depth = by_stem(depth_maps(depth_folder)) if depth_folder else {}
    split = "test" if name in TEST else "train"
    shots = tuple(
        Shot(
            path.stem,
            path,
            _first(clean, f"{path.stem}_SeaErra", path.stem),
            _first(depth, *(path.stem + end for end in ("_SeaErra_abs_depth", "_abs_depth", "", "_depth"))),
            _seconds(path.stem),
            split,
        )
        for path in raw
    )
    skipped = _unpaired(clean, {s.clean for s in shots}, "a restored image without a raw one")
    skipped += _unpaired(depth, {s.depth for s in shots}, "a depth map without an image")
    region = next((r for r, names in REGIONS.items() if name in names), None)
    poses = _poses(folder)
    notes = (
        ()
        if region
        else (f"{name} is no sequence of FLSea-VI; its lens is not known, and depth is taken as along rays",)
    )
    if missing := sum(s.clean is None for s in shots):
        notes += (f"{counted(missing, 'image')} without a restored one",)
    if missing := sum(s.depth is None for s in shots):
        notes += (f"{counted(missing, 'image')} without a depth map",)
    return Sequence(
        folder.name, "FLSea-VI", shots, "srgb", _DEPTH_RANGE, _LENSES.get(region or ""), poses, False, notes
    ), skipped


def _is_extra(path: Path) -> bool:
    return path.stem.lower().endswith(("_skymask", "_mask"))  # added by others


def _first(files: dict[str, Path], *stems: str) -> Path | None:
    return next((files[stem] for stem in stems if stem in files), None)


def _seconds(stem: str) -> float | None:
    return int(stem) / _TICKS if stem.isdigit() and len(stem) == 17 else None


def _unpaired(files: dict[str, Path], used: set[Path | None], why: str) -> list[Skipped]:
    return [Skipped(path, why) for path in files.values() if path not in used]


def _poses(folder: Folder) -> dict[str, np.ndarray]:
    """By shot name, of a COLMAP model beside the images; its unit is its own."""
    place = folder.child("sparse", "colmap")
    if place is None:
        return {}
    model = colmap.read_model(place)
    stems = (Path(name).stem.removesuffix("_SeaErra") for name in model.names)
    return dict(zip(stems, model.cam2world, strict=True))
