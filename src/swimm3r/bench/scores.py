"""The columns of the paper's tables. A score's name tells its metric's variant, its note says it in words."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Column:
    """One score as tables print it."""

    score: str  # its name in cells, CSV and JSON
    label: str
    digits: int
    best: Literal["high", "low", "neither"]
    note: str = ""  # the variant in words


_PAIRS = "pairs i < j, W_i W_j^-1, baselines as lines, an unplaced frame fails its pairs"
_MAP_PAIRS = f"a test frame with each training frame; {_PAIRS}"
_TRAINING_PAIRS = "two training frames, the map's own poses against the reference: what localization can reach"
_QUERY_PAIRS = f"two test frames; {_PAIRS}"
_EPIPOLAR = (
    "mean of both distances, original pixels, under each method's own poses, over the matches its map was made from:"
    " COLMAP's verified two-view ones, all of MASt3R's; of imported models observations of one point"
)
_RECOLORED = "after the affine map of the rendering's colors that fits best"
_FLOW = "dense optical flow on measured ground with texture, images of at most 480 px"
_DEPTH = "z depth, each frame scaled by its median, mean over frames"
_AFTER = "over located frames, after the similarity of the training frames"
_FIRST_POSES = "test frames whose refinement began at the reference's pose; else at one from 2D-3D matches"
_WATER = "mean over held-out pixels at true ray depth and over channels"
_IN_TRUTH = "the first visit is placed by its true camera centers"
_STATED = "three stated standard deviations"
_RIGHT = "reported cells whose truth has changed by one stated standard deviation or more, in that direction"
_COLORS = "physical colors unless the row says white-balanced"

COLUMNS = (
    Column("psnr", "PSNR", 2, "high", "dB, test frames as 8-bit images, their poses refined on the frozen map"),
    Column("psnr_observed", "PSNR, observed", 2, "high", "dB of the pixels that some training frame saw, by the map"),
    Column("ssim_3dgs", "SSIM", 4, "high", "11 x 11 Gaussian of sigma 1.5, zero padding, as 3DGS"),
    Column("lpips_vgg", "LPIPS", 4, "low", "v0.1, VGG-16, inputs 0..1 as 3DGS feeds them"),
    Column("sharpness", "Sharpness", 3, "neither", "mean gradient magnitude, rendering : test frame; 1 is as sharp"),
    Column("sharpness_observed", "Sharpness, observed", 3, "neither", "of the pixels that some training frame saw"),
    Column("blur4_psnr", "Blurred by 4 px", 2, "neither", "dB of the test frame against itself blurred, sigma 4 px"),
    Column("psnr_affine", "PSNR, recolored", 2, "high", f"dB on measured ground, {_RECOLORED}"),
    Column("flow_px", "Flow, px", 2, "low", f"median displacement of rendering against test frame, {_FLOW}"),
    Column("flow_px_p90", "Flow p90, px", 2, "low", f"90th percentile of the displacement, {_FLOW}"),
    Column("clear_psnr", "Clear PSNR", 2, "high", "dB of the image without water where true T_D > 0.05"),
    Column("T_D_abs", "T_D error", 4, "low", f"absolute error of the direct transmittance, {_WATER}"),
    Column("B_abs", "B error", 4, "low", f"absolute error of the backscatter, {_WATER}"),
    Column("from_reference_pct", "By reference, %", 0, "neither", _FIRST_POSES),
    Column("train_cpu_seconds", "Training, CPU s", 0, "low", "processor seconds per step times steps"),
    Column("registered_pct", "Reg., %", 1, "high", "training frames placed, in the largest model; mean over scenes"),
    Column("epipolar_mean_px", "EpiErr, px", 3, "low", _EPIPOLAR),
    Column("inlier_1px_pct", "Inlier@1px, %", 1, "high", f"share with that error below 1; {_EPIPOLAR}"),
    Column("points", "#Points", 0, "neither", "sparse points seen by several frames, before any cap"),
    Column("dense_points", "#Dense points", 0, "neither", "surface points of the fused depth maps, not thinned"),
    Column("sfm_cpu_seconds", "SfM, CPU s", 0, "low", "poses, dense depth, water and cloud"),
    Column("absrel_median", "AbsRel", 4, "low", _DEPTH),
    Column("delta125_median", "δ<1.25", 2, "high", f"%, {_DEPTH}"),
    Column("rmselog_median", "RMSE log", 4, "low", f"natural logarithm, {_DEPTH}"),
    Column("depth_coverage_pct", "Depth, %", 1, "neither", "of the truly known pixels those that are scored"),
    Column("rra15", "RRA@15", 2, "high", _PAIRS),
    Column("rta15", "RTA@15", 2, "high", _PAIRS),
    Column("maa30", "mAA(30)", 2, "high", f"whole-degree bins of the larger error; {_PAIRS}"),
    Column("reference_pct", "In reference, %", 1, "neither", "frames that the reference knows; others do not count"),
    Column(
        "uiqm_funie",
        "UIQM",
        3,
        "high",
        f"FUnIE-GAN variant, native size; {_COLORS}",
    ),
    Column("uciqe_cielab", "UCIQE", 2, "high", f"CIELAB's own units; {_COLORS}"),
    Column("uranker", "URank", 3, "high", "URanker"),
    Column("scored_pct", "Scored, %", 1, "neither", "of the training frames; rows of other frames do not compare"),
    Column("located_pct", "Located, %", 1, "high", "test frames that were given a pose"),
    Column("inlier_5px_pct", "Inlier@5px, %", 1, "high", "of query-to-render matches; 0 where not located"),
    Column("reprojection_px", "Reproj., px", 2, "low", "median over located frames of the median over inliers"),
    Column("rra2_map", "RRA@2", 1, "high", _MAP_PAIRS),
    Column("rta5_map", "RTA@5", 1, "high", _MAP_PAIRS),
    Column("rra15_map", "RRA@15", 1, "high", _MAP_PAIRS),
    Column("rta15_map", "RTA@15", 1, "high", _MAP_PAIRS),
    Column("rra2_queries", "RRA@2 (queries)", 1, "high", _QUERY_PAIRS),
    Column("rta5_queries", "RTA@5 (queries)", 1, "high", _QUERY_PAIRS),
    Column("rra15_queries", "RRA@15 (queries)", 1, "high", _QUERY_PAIRS),
    Column("rta15_queries", "RTA@15 (queries)", 1, "high", _QUERY_PAIRS),
    Column("rra2_training", "RRA@2 (training)", 1, "neither", _TRAINING_PAIRS),
    Column("rta5_training", "RTA@5 (training)", 1, "neither", _TRAINING_PAIRS),
    Column("rotation_median_deg", "Rotation, deg", 3, "low", f"median, {_AFTER}"),
    Column("position_median_pct", "Position, %", 2, "low", f"median, of the path's spread, {_AFTER}"),
    *(
        Column(f"fps_{stage}", f"{stage}, FPS", 2, "high", "located frames per second of wall time")
        for stage in ("retrieve", "coarse", "render", "match", "refine")
    ),
    Column("fps_localize", "Loc. FPS", 3, "high", "all stages together, without what is done once per map"),
    Column("peak_mb", "Peak, MB", 0, "low", "resident memory of a process that localizes in this map alone"),
    Column("ate_pct", "ATE, %", 4, "low", "of the path's length, after the similarity of the camera centers"),
    Column("rotation_deg", "Rotation, deg", 3, "low", "mean over frames, after the rotation of all orientations"),
    *(
        Column(f"cpu_{part}", f"{part}, CPU s", 2, "low", "processor seconds per frame")
        for part in ("prepare", "mapping", "depth", "water", "map", "scores")
    ),
    Column("cpu_minutes_100m", "100 m, CPU min", 1, "low", "processor minutes of all parts per 100 m of path"),
    Column("peak_run_mb", "Peak, MB", 0, "low", "resident memory of the process, the largest of its stages"),
    Column(
        "alignment_pct",
        "Alignment, %",
        3,
        "low",
        f"RMS of the later cameras, of the site's extent; {_IN_TRUTH}",
    ),
    Column("height_recall_pct", "Height recall, %", 1, "high", f"of cells whose true change is above {_STATED}"),
    Column("height_precision_pct", "Height precision, %", 1, "high", _RIGHT),
    Column("volume_error_pct", "Volume, %", 1, "neither", "error of the volume of all reported cells, of the true one"),
    Column("bleached_cells", "Bleached cells", 0, "neither", "of bleached corals, on ground that both visits saw"),
    Column("bleached_recall_pct", "Bleached recall, %", 1, "high", "cells of bleached corals, reported as paler"),
    Column("paler_precision_pct", "Paler precision, %", 1, "high", _RIGHT),
    Column("false_area_pct", "False area, %", 2, "low", "of unchanged ground, reported as changed in height or color"),
    Column("peak_vram_mb", "Peak VRAM, MB", 0, "low", "allocated by torch on the GPU while it localized"),
)


def columns(*names: str) -> tuple[Column, ...]:
    """The columns of these scores."""
    by_name = {column.score: column for column in COLUMNS}
    return tuple(by_name[name] for name in names)
