"""Any folder of images that pair by name: raw/ clean/ depth/, and synthetic dives with their truth/.

    raw/NAME    clean/NAME    depth/NAME      float TIFF in metres, 16 bits in millimetres, .npz    cameras.json
    images/NAME                               truth/clear, truth/z_depth, truth/cameras.json        (swimm3r.write_dive)

raw/ or clean/ may be missing: images taken in air are clean/ alone, and get their water in training. input/ and
reference/ stand for raw/ and clean/, too. cameras.json as docs/conventions.md has it, in metres.
"""

from pathlib import Path

from swimm3r.datasets.layouts import Folder, by_stem, counted, depth_maps, image_files
from swimm3r.datasets.sequences import Lens, Sequence, Shot, Skipped
from swimm3r.io import cameras_json
from swimm3r.io.cameras_json import CameraTable
from swimm3r.scene.ground_truth import FOLDER

_RAW, _CLEAN, _DEPTH = ("raw", "input"), ("clean", "reference", "clear"), ("depth", "depth_mm", "z_depth")


def is_dive(folder: Folder) -> bool:
    """Return whether a folder is a synthetic dive."""
    return {"images", FOLDER} <= folder.children.keys()


def is_triples(folder: Folder) -> bool:
    """Return whether a folder has clean images beside raw ones or beside depth maps."""
    names = folder.children.keys()
    return bool(names & set(_CLEAN)) and bool(names & {*_RAW, *_DEPTH})


def read_dive(folder: Folder) -> tuple[Sequence | None, list[Skipped]]:
    """The dive of a folder; its truth is exact."""
    truth = folder.children[FOLDER]
    shots = tuple(
        Shot(
            path.stem,
            path,
            _if_file(truth / "clear" / f"{path.name}.png"),
            _if_file(truth / "z_depth" / f"{path.name}.npz"),
        )
        for path in image_files(folder.children["images"])
    )
    return _sequence(folder, "synthetic dive", shots, _if_file(truth / "cameras.json")), []


def read_triples(folder: Folder) -> tuple[Sequence | None, list[Skipped]]:
    """The pairs or triples of a folder, and what in it pairs with nothing."""
    raw_folder, clean_folder, depth_folder = (folder.child(*names) for names in (_RAW, _CLEAN, _DEPTH))
    raw, clean = (by_stem(image_files(f)) if f else {} for f in (raw_folder, clean_folder))
    depth = by_stem(depth_maps(depth_folder)) if depth_folder else {}
    leading = raw if raw_folder else clean
    shots = tuple(
        Shot(stem, raw.get(stem), clean.get(stem), depth.get(stem))
        for stem in leading
        if raw_folder is None or stem in clean
    )
    skipped = [Skipped(path, "a raw image without a clean one") for stem, path in raw.items() if stem not in clean]
    if raw_folder:
        skipped += [Skipped(path, "a clean image without a raw one") for stem, path in clean.items() if stem not in raw]
    skipped += [Skipped(path, "a depth map without an image") for stem, path in depth.items() if stem not in leading]
    if not shots:
        return None, [Skipped(folder.path, "no image in it has a partner of the same name"), *skipped]
    return _sequence(folder, "folder of pairs", shots, _if_file(folder.path / "cameras.json")), skipped


def _sequence(folder: Folder, kind: str, shots: tuple[Shot, ...], cameras: Path | None) -> Sequence | None:
    if not shots:
        return None
    notes: tuple[str, ...] = ()
    if missing := sum(s.depth is None for s in shots):
        notes += (f"{counted(missing, 'image')} without a depth map",)
    if cameras is None:
        notes += ("the lens is not known, and depth is taken as along rays",)
        return Sequence(folder.name, kind, shots, notes=notes)
    table = cameras_json.read_cameras(cameras)
    poses = {Path(name).stem: pose for name, pose in zip(table.names, table.cam2world, strict=True)}
    poses = {s.name: poses[s.name] for s in shots if s.name in poses}
    metric = table.units == "metres"
    return Sequence(folder.name, kind, shots, lens=_lens(table), cam2world=poses, metric=metric, notes=notes)


def _lens(table: CameraTable) -> Lens:
    distortion = tuple(float(v) for v in table.distortion[0])
    return Lens(table.width, table.height, table.K[0], table.model, distortion)


def _if_file(path: Path) -> Path | None:
    return path if path.is_file() else None
