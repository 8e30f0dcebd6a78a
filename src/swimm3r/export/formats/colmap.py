"""A COLMAP data set: sparse/0 (binary or text), the sparse points with their tracks, and images."""

from dataclasses import replace
from pathlib import Path

from swimm3r.export.dataset import contents, image_names, write_images
from swimm3r.export.result import Exported
from swimm3r.export.settings import ColmapExportSettings
from swimm3r.io.colmap import model as colmap
from swimm3r.io.files.atomic import atomic_folder
from swimm3r.io.files.outputs import check_empty
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames


def export_run(folder: Path, path: Path, settings: ColmapExportSettings) -> Exported:
    """Write a run with finished structure from motion into a folder that is new or empty."""
    check_empty(path)
    open_run(folder, "sfm")
    frames = run_frames(folder)
    rec = load_reconstruction(folder / "sfm", frames)
    model = colmap.to_pycolmap(replace(rec.colmap_model(), names=image_names(rec, settings.with_images)))
    with atomic_folder(path) as draft:
        (draft / "sparse" / "0").mkdir(parents=True)
        write = model.write_text if settings.text else model.write_binary
        write(str(draft / "sparse" / "0"))
        write_images(folder, rec, frames, settings.with_images, draft / "images")
    return Exported(path, contents(rec, settings.with_images))
