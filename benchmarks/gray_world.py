"""Mean colors of what people receive from a run, beside that of its restored frames.

    python benchmarks/gray_world.py RUN [RUN ...]

Prints the ratio per channel of the dense cloud, of the exported splat (drawn from the training cameras as a 3DGS viewer
draws it) and of the map's clear views to the restored frames. Frames count where their depth is known; splat and views
where the splat covers them as well.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from swimm3r.export.gaussians import draw_gaussians
from swimm3r.export.settings import SplatPlySettings
from swimm3r.export.splats import open_map
from swimm3r.imaging.undistortion import undistorted
from swimm3r.io import images
from swimm3r.pipeline.renders import display_style, shown_clear
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.rectified.run import run_frames
from swimm3r.splat.training_poses import as_mapped

_COVERED = 0.95  # alpha of a pixel that counts
_NEAR = 0.01  # of the map's working unit


def gray_world(run: Path) -> dict[str, torch.Tensor]:
    """Ratios to the restored frames, R, G, B."""
    found = open_map(run, SplatPlySettings())
    rec = load_reconstruction(run / "sfm", run_frames(run))
    assert rec.cloud is not None
    mapped, style = as_mapped(rec, found.scene.poses), display_style(found.scene, rec)
    of_frames, covered, splat, views = [], [], [], []
    for i, name in enumerate(rec.names):
        restored = torch.from_numpy(images.read_rgb(run / "sfm" / "restored" / f"{name}.png").astype(np.float32) / 255)
        known = rec.depth[name].z_depth > 0
        of_frames.append(restored[known])
        view = mapped.cameras[i].pinhole(found.scene.settings.long_side)
        straight, measured = undistorted(restored, known, mapped.cameras[i], view)
        drawn = draw_gaussians(found.gaussians, view, _NEAR * found.scene.length)
        own = found.scene.render(view, found.time)
        counts = (drawn.alpha > _COVERED) & measured
        covered.append(straight[counts])
        splat.append(drawn.clear.permute(1, 2, 0).clamp(0, 1)[counts])
        views.append(shown_clear(own, view, style).clamp(0, 1)[counts])
    frames, same, drawn, shown = (torch.cat(each).mean(0) for each in (of_frames, covered, splat, views))
    cloud = rec.cloud.shown(rec.white_balance).mean(0)
    return {"cloud": cloud / frames, "splat": drawn / same, "map's clear views": shown / same}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    torch.set_grad_enabled(False)
    for run in parser.parse_args().runs:
        for name, ratio in gray_world(run).items():
            print(f"{run.name:20s} {name:20s} {' '.join(f'{value:.3f}' for value in ratio)}")
