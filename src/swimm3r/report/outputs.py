"""The files of a run with their sizes, as links relative to the page."""

from dataclasses import dataclass
from pathlib import Path

from swimm3r.io.files.folder_lock import LOCK

OUTPUTS = {  # path in the run folder -> contents
    "summary.json": "Every number of this page, for scripts",
    "georeference.json": "Unit and place of the coordinates",
    "scale.json": "Sources of scale with their residuals",
    "prepare": "Frames as used",
    "sfm/points.ply": "Dense point cloud in the colors shown here",
    "sfm/points_physical.ply": "The same points without the water, before the white balance",
    "sfm/points_raw.ply": "The same points, colors as filmed",
    "sfm/backdrop.ply": "Surfaces that no second frame confirmed, at a guessed depth",
    "sfm/cameras.json": "Camera poses and lens",
    "sfm/cameras_between.json": "Camera poses of the frames between keyframes",
    "sfm/cameras_imported.json": "Camera poses of all frames in the imported model",
    "sfm/trajectory.tum": "Path of the camera with times (TUM)",
    "sfm/sparse": "COLMAP model",
    "sfm/parts": "COLMAP models of frames that did not join the rest",
    "sfm/medium.json": "Coefficients of the water with their uncertainty",
    "sfm/white_balance.json": "White balance of everything displayed",
    "sfm/z_depth": "Depth maps",
    "sfm/matches.npz": "Matches between frames",
    "sfm/restored": "Frames without the water, as displayed",
    "sfm/restored_physical": "Frames without the water, before the white balance, 16 bits",
    "splat/map.safetensors": "Splatting map",
    "splat/blocks": "Its blocks, with the record of their training",
    "splat/cameras.json": "Camera poses as the map's training refined them",
    "splat/metrics.jsonl": "Record of the training",
    "renders/test": "Test frames as the map renders them",
    "renders/flythrough.mp4": "Flight along the path of the camera",
    "settings.yaml": "All settings",
    "versions.json": "Versions of the programs used",
    "log.jsonl": "Times of all stages",
}
FURTHER = {  # pattern of what later commands add -> contents
    "sfm/points*.glb": "Point cloud as glTF",
    "splat/gaussians*": "Map without its water as Gaussians",
    "export/*": "Exported for other programs",
    "renders/views": "Views from other cameras",
    "renders/protocols": "Test frames by other protocols",
    "products": "Maps from above",
    "localization": "Poses of localized images",
}


@dataclass(frozen=True)
class Output:
    """One file or folder that is there."""

    path: str  # relative to the page; a folder ends in a slash
    contents: str
    size: str
    files: int  # in a folder; 0 for a file


def outputs_of(folder: Path) -> list[Output]:
    """The known outputs of a run that exist, in the order of the pipeline, then what later commands added."""
    listed = [(folder / name, contents) for name, contents in OUTPUTS.items()]
    for pattern, contents in FURTHER.items():
        listed += [(path, contents) for path in sorted(folder.glob(pattern)) if not path.name.startswith(".")]
    found = []
    for path, contents in listed:
        name = path.relative_to(folder).as_posix()
        if path.is_file():
            found.append(Output(name, contents, human_size(path.stat().st_size), 0))
        elif path.is_dir():
            files = [file for file in path.rglob("*") if file.is_file() and file.name != LOCK]
            if files:
                total = sum(file.stat().st_size for file in files)
                found.append(Output(f"{name}/", contents, human_size(total), len(files)))
    return found


def human_size(count: int) -> str:
    """Bytes as people say them: 812 bytes, 14 kB, 3.2 MB, 1.4 GB."""
    if count < 1000:
        return f"{count} bytes"
    value, unit = next((count / 10**p, u) for p, u in ((9, "GB"), (6, "MB"), (3, "kB")) if count >= 0.9995 * 10**p)
    return f"{value:.1f} {unit}" if value < 9.95 else f"{value:.0f} {unit}"
