"""Restored frames of a dive whose camera exposed and balanced by itself: as filmed, and in common colors.

    python benchmarks/exposures.py RUN:TRUTH ...

RUN are finished run folders of synthetic dives, TRUTH their folders truth/. Every third training frame is restored from
its colors as filmed, and from those that the dive has on average where the run keeps maps of single frames
(sfm/frame_colors.json), and compared with the true clear colors where its depth was measured:

    filmed, common   mean PSNR of the restored frames, dB
    spread           standard deviation between frames of the mean error, per channel
"""

import argparse

import torch
from dive_runs import dive_run
from jaxtyping import Float
from torch import Tensor

from swimm3r.evaluate.images import psnr
from swimm3r.imaging.undistortion import frame_rays
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.scene.frames import Frames
from swimm3r.sfm.medium.restore import restore_image

EVERY = 3  # training frames


def errors(sfm: FinishedSfm, frames: Frames) -> tuple[float, Float[Tensor, "3"]]:
    """Mean PSNR of the restored frames, and the spread of their mean errors."""
    rec, truth = sfm.rec, sfm.truth
    assert rec.medium is not None
    assert truth is not None
    scores, off = [], []
    for i in range(0, len(rec.names), EVERY):
        name = rec.names[i]
        depth, true = rec.depth[name], truth.clear(name)
        assert true is not None
        image = frames.image(frames.index(name))
        clear = restore_image(image, depth, frame_rays(rec.cameras[i]), rec.medium).clear
        measured = depth.z_depth > 0
        scores.append(float(psnr(clear[measured], true[measured])))
        off.append((clear - true)[measured].mean(0))
    return sum(scores) / len(scores), torch.stack(off).std(0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN:TRUTH")
    print("| dive | filmed | common | spread as filmed | spread in common colors |\n| --- | --- | --- | --- | --- |")
    for sfm in parser.parse_args().runs:
        both = [errors(sfm, frames) for frames in (sfm.rec.still(sfm.frames), sfm.rec.evened(sfm.frames))]
        spreads = (", ".join(f"{value:.3f}" for value in spread.tolist()) for _, spread in both)
        print(f"| {sfm.folder.name} | {both[0][0]:.1f} | {both[1][0]:.1f} | {' | '.join(spreads)} |")


if __name__ == "__main__":
    main()
