"""SIFT matches of neighboring frames in luma and in the gray that the features look at.

    python benchmarks/feature_gray.py FOLDER ...

FOLDER are folders of images of clips. Of four pairs of frames, two apart in the order of their names (neighbors of
fewer than 15 images), means per clip:

    gain                texture in the gray that shows the most of it, over that in luma; features look at it from 1.5
    keypoints           of the first frame, luma -> gray
    matches             luma -> gray
    inliers             of a fundamental matrix within 1 px, luma -> gray
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.imaging.gray import FEATURE_SIDE, LUMA, strongest, texture_moments, texture_shown
from swimm3r.io.image_folder import find_images
from swimm3r.io.images import read_rgb
from swimm3r.sfm.features import sift
from swimm3r.sfm.features.settings import FeatureSettings

PAIRS = 4
FEW = 15  # images, below which neighbors are matched


def gain(image: Float[Tensor, "h w 3"]) -> float:
    """Texture in the gray that shows the most of it, noise being equal, over that in luma."""
    moments = texture_moments(image, torch.ones(image.shape[:2], dtype=torch.bool), FEATURE_SIDE)
    return texture_shown(moments, strongest(moments)) / texture_shown(moments, LUMA)


def matched(pair: list[Float[Tensor, "h w 3"]]) -> list[float]:
    """Keypoints of the first image, matches and inliers."""
    settings = FeatureSettings()
    a, b = (sift.extract_features(im, torch.ones(im.shape[:2], dtype=torch.bool), settings) for im in pair)
    there, here = (sift.unit_descriptors(each.descriptors) for each in (a, b))
    rows = sift.match_descriptors(there, here, settings.max_ratio).numpy()
    if len(rows) < 8:
        return [len(a.keypoints), len(rows), 0]
    xy = a.keypoints[rows[:, 0], :2], b.keypoints[rows[:, 1], :2]
    _, inliers = cv2.findFundamentalMat(*xy, cv2.USAC_MAGSAC, 1.0, 0.999, 5000)
    return [len(a.keypoints), len(rows), 0 if inliers is None else int(inliers.sum())]


def row_of(folder: Path) -> list[float]:
    """Gain, then keypoints, matches and inliers of luma and of the gray."""
    paths = find_images(folder).paths
    apart = 1 if len(paths) < FEW else 2
    own = sift.weights_for_features
    rows = []
    for i in np.linspace(0, len(paths) - 1 - apart, PAIRS).round().astype(int):
        pair = [torch.from_numpy(read_rgb(paths[k])).float() / 255 for k in (i, i + apart)]
        sift.weights_for_features = lambda *_: LUMA
        luma = matched(pair)
        sift.weights_for_features = own
        rows.append([gain(pair[0]), *luma, *matched(pair)])
    return np.mean(rows, axis=0).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    print("| clip | gain | keypoints | matches | inliers |\n| --- | --- | --- | --- | --- |")
    for folder in parser.parse_args().folders:
        ratio, *counts = row_of(folder)
        cells = [f"{counts[i]:.0f} -> {counts[i + 3]:.0f}" for i in range(3)]
        print(f"| {folder} | {ratio:.2f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
