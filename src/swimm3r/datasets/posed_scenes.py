"""Scenes of images with a COLMAP model: SeaThru-NeRF (Levy et al. 2023) and its undistorted copies, SaltPond.

    SCENE/images_wb/NAME.png   sparse/0/    or colmap/sparse/0/     (Images_wb in one scene of the published archive)
    SCENE/images/NAME          sparse[/0]/                          (WaterSplatting's and SeaSplat's copies)

Every eighth image of the sorted names is a test image. There is neither metric depth nor a restored image, so
such scenes serve evaluation and splatting, not training. poses_bounds.npy says what the model says and is not read.
"""

from pathlib import Path

from swimm3r.datasets.layouts import Folder, image_files
from swimm3r.datasets.sequences import Lens, Sequence, Shot, Skipped
from swimm3r.io.colmap import model as colmap

_TEST_EVERY = 8


def is_scene(folder: Folder) -> bool:
    """Return whether a folder has images and a COLMAP model."""
    names = folder.children.keys()
    return bool({"images_wb", "images"} & names) and bool({"sparse", "colmap"} & names)


def read_scene(folder: Folder) -> tuple[Sequence | None, list[Skipped]]:
    """The scene of a folder, and what in it is not used."""
    files = sorted(image_files(folder.child("images_wb", "images") or folder.path), key=lambda path: path.name)
    if not files:
        return None, [Skipped(folder.path, "its image folder is empty")]
    place = folder.children.get("sparse") or folder.children["colmap"]
    model = colmap.read_model(place)
    by_stem = dict(zip((Path(name).stem for name in model.names), model.cam2world, strict=True))
    shots = tuple(
        Shot(path.stem, path, split="test" if i % _TEST_EVERY == 0 else "train") for i, path in enumerate(files)
    )
    poses = {s.name: by_stem[s.name] for s in shots if s.name in by_stem}
    lens = Lens(model.width, model.height, model.K[0], model.model, tuple(float(v) for v in model.distortion[0]))
    unposed = [Skipped(s.raw, "the COLMAP model has no pose of it") for s in shots if s.raw and s.name not in poses]
    kind = "SeaThru-NeRF" if "images_wb" in folder.children else "images with a COLMAP model"
    notes = ("no metric depth and no restored images: not for training",)
    return Sequence(folder.name, kind, shots, lens=lens, cam2world=poses, metric=False, notes=notes), unposed
