"""Sea-Thru (Akkaynak & Treibitz 2019): linear images and metric depth, no restored ones, no poses, no lens.

    D1[/D1]/linearPNG/T_S02951.png     depth/depthT_S02951.tif     or depth_resized/         (Kaggle)
    3148_3248/Raw/T_S03647.ARW         depthMaps/depthT_S03647.tif  or tifs/, T_S04857.tiff  (the authors' site)

Images and depth maps pair by their number inside one scene. Sizes may differ; depth follows the image. Raw files of
the camera must be developed first, linearly, and are reported.
"""

from pathlib import Path

from swimm3r.datasets.layouts import Folder, counted, depth_maps, image_files, number
from swimm3r.datasets.sequences import Sequence, Shot, Skipped

_IMAGES = ("linearpng", "tifs", "raw", "developed")
_DEPTHS = ("depth", "depth_resized", "depthmaps")
_CAMERA_FILES = (".arw", ".dng", ".nef", ".cr2")
_FARTHEST = 30.0  # m
_NEAREST = {"D5": 1.0}  # a loader's rule: what D5 has below is noise


def is_scene(folder: Folder) -> bool:
    """Return whether a folder has the layout of a scene."""
    names = folder.children.keys()
    return "linearpng" in names or "depthmaps" in names


def read_scene(folder: Folder) -> tuple[Sequence | None, list[Skipped]]:
    """The scene of a folder, and what in it is not used."""
    files: list[Path] = []
    for name in _IMAGES:
        if name in folder.children:
            files = files or image_files(folder.children[name])
    files = files or image_files(folder.path)
    skipped = _camera_files(folder)
    depth_folder = folder.child(*_DEPTHS)
    if not files:
        why = "its images are raw files of the camera" if skipped else "no developed images are in it"
        return None, [Skipped(folder.path, why), *skipped]
    depth = {number(path): path for path in depth_maps(depth_folder)} if depth_folder else {}
    depth.pop(None, None)
    numbers = [number(path) for path in files]
    shots = tuple(Shot(path.stem, path, None, depth.get(n)) for path, n in zip(files, numbers, strict=True))
    skipped += [Skipped(path, "a depth map without an image") for n, path in depth.items() if n not in numbers]
    scene = folder.name.split("/")[-1]
    notes = ("the lens is not known, and depth is taken as along rays",)
    if missing := sum(s.depth is None for s in shots):
        notes += (f"{counted(missing, 'image')} without a depth map",)
    depth_range = (_NEAREST.get(scene, 1e-3), _FARTHEST)
    return Sequence(folder.name, "Sea-Thru", shots, "linear", depth_range, notes=notes), skipped


def _camera_files(folder: Folder) -> list[Skipped]:
    places = [folder.path, *(path for name, path in folder.children.items() if name not in _DEPTHS)]
    found = [p for place in places for p in sorted(place.iterdir()) if p.suffix.lower() in _CAMERA_FILES]
    developed = {number(p) for place in places for p in image_files(place)}
    left = [p for p in found if number(p) not in developed]
    if not left:
        return []
    why = f"{counted(len(left), 'raw file')} of the camera: develop to 16-bit TIFF with gamma 1 and no auto-brightness"
    return [Skipped(left[0].parent, f"{why}, into tifs/ beside it")]
