"""The scores of a trained map on held-out frames, as the rendering tables print them."""

from pathlib import Path

from swimm3r import devices
from swimm3r.bench.cells import Scores
from swimm3r.bench.scores import columns
from swimm3r.evaluate import NotComputed
from swimm3r.imaging.undistortion import undistorted
from swimm3r.io import images
from swimm3r.io.files.metrics_log import read_rows
from swimm3r.io.view_names import view_stems
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.pipeline.scores import held_out
from swimm3r.pipeline.scores.truth import truth_section
from swimm3r.progress import Progress, silent
from swimm3r.splat import train
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import PoseRefinementSettings, SplatSettings

COLUMNS = columns(
    "psnr", "psnr_observed", "ssim_3dgs", "lpips_vgg", "sharpness", "sharpness_observed", "blur4_psnr",
    "psnr_affine", "flow_px",
    "flow_px_p90", "clear_psnr", "T_D_abs", "B_abs", "from_reference_pct", "train_cpu_seconds",
)  # fmt: skip


def trained(sfm: FinishedSfm, settings: SplatSettings, folder: Path, progress: Progress = silent) -> SplatMap:
    """The map in a cell's folder, trained there where it is not finished yet."""
    path = folder / "map.safetensors"
    if path.is_file():
        return load_map(path).to(devices.for_maps())
    return train(sfm.rec, sfm.frames, settings, folder, progress)


def map_scores(
    sfm: FinishedSfm,
    scene: SplatMap,
    poses: dict[str, held_out.FirstPose],
    folder: Path,
    test: PoseRefinementSettings,
    progress: Progress = silent,
) -> Scores:
    """Refines each test frame's pose on the frozen map, renders it into folder/test beside NAME_target.png, scores it.

    `poses` are where refinement starts, in the reconstruction's axes. A synthetic dive adds the errors of the clear
    colors and of the water.
    """
    there = held_out.in_axes_of(scene, sfm.rec, poses)
    views = held_out.score_views(
        scene, sfm.rec, sfm.frames, there, folder / "test", test, sfm.settings.sfm.restore, progress
    )
    stems = view_stems(sfm.frames.names)
    for view in views:
        f, window = sfm.frames.index(view.name), (view.window.rows, view.window.columns)
        target, _ = undistorted(sfm.frames.image(f), sfm.frames.mask(f), view.lens, view.canvas)
        images.write_rgb(folder / "test" / f"{stems[view.name]}_target.png", target[window].numpy())
    means = held_out.mean_scores(views)
    same = ("psnr", "sharpness", "blur4_psnr", "psnr_observed", "sharpness_observed")
    same += ("psnr_affine", "flow_px", "flow_px_p90")
    scores = {name: means[name] for name in same} | {
        "ssim_3dgs": means["ssim"],
        "lpips_vgg": means["lpips"],
        "from_reference_pct": 100 * sum(view.first.source == "reference" for view in views) / max(1, len(views)),
        "train_cpu_seconds": _training_seconds(folder, scene.settings),
    }
    if sfm.truth is not None and sfm.truth.medium is not None:
        of_map = truth_section(sfm.rec, sfm.frames, sfm.truth, scene, views, progress).get("splat")
        of_map = of_map if isinstance(of_map, dict) else {}
        for name in ("clear_psnr", "T_D_abs", "B_abs"):
            value = of_map.get(name)
            if value is None:
                value = NotComputed(of_map.get(f"{name}_reason") or "the poses do not align with the truth")
            scores[name] = sum(value) / len(value) if isinstance(value, list) else value
    return scores


def _training_seconds(folder: Path, settings: SplatSettings) -> float | NotComputed:
    """By the record of the training, so that a map scored again keeps what it took."""
    rows = read_rows(folder / "metrics.jsonl")
    if not rows or "cpu_seconds_per_step" not in rows[-1]:
        return NotComputed("the map came without the record of its training")
    return rows[-1]["cpu_seconds_per_step"] * settings.iterations
