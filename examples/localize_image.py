"""Find the pose of images in a map.

    python examples/localize_image.py RUN IMAGE... [--time SECONDS]

RUN is a run folder, or the WORK folder of reconstruct_and_train.py; the images were taken by the same camera. `swimm3r
localize RUN IMAGE...` does the same, and writes poses and images of the matches.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import swimm3r
from swimm3r.io.images import read_rgb
from swimm3r.localization.localizer import Localizer
from swimm3r.sfm.rectified.run import run_rectification


def main(arguments: Sequence[str] | None = None) -> list[torch.Tensor]:
    """Print and return the camera-to-world poses, in the axes and unit of RUN/sfm/cameras.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--time", type=float, help="second of the clip at which a dynamic map is rendered")
    given = parser.parse_args(arguments)

    frames, rectification = swimm3r.run_frames(given.run), run_rectification(given.run)
    rec = swimm3r.load_reconstruction(given.run / "sfm", frames)
    scene = swimm3r.load_map(given.run / "splat" / "map.safetensors")
    localizer = Localizer(scene, rec, rec.still(frames))  # features of the references are computed once
    poses = []
    for path in given.images:
        stored = read_rgb(path)
        if rectification is not None:  # the map is of rectified frames
            stored = rectification.any_image(stored)
        image = torch.from_numpy(stored.astype(np.float32) / np.iinfo(stored.dtype).max)
        try:
            found = localizer.locate(image, time=given.time)
        except swimm3r.Swimm3rError as error:
            print(f"{path.name}: {error}")
            continue
        poses.append(localizer.in_axes_of_sfm(found.cam2world))
        center = ", ".join(f"{value:.3f}" for value in poses[-1][:3, 3].tolist())
        print(f"{path.name}: {found.stage} pose at ({center}), nearest references {', '.join(found.candidates[:3])}")
    return poses


if __name__ == "__main__":
    main()
