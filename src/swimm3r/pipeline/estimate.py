"""Time and disk that a run will take, roughly, told before it starts: frames times settings times measured rates.

The rates are processor-seconds on a computer with two x86 cores, from runs of six clips (17 to 200 frames of 320x214 to
960x640 pixels) and from docs/experiments/rasterizer.md. Expect the time to be wrong by a factor of two, and more where
matching is hard. Stages that a GPU or a network decides are not estimated.
"""

import shutil
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from swimm3r.errors import InputError, StorageError
from swimm3r.io.bags.bag import is_bag
from swimm3r.io.images import image_size
from swimm3r.pipeline.presets import RunSettings
from swimm3r.prepare import check_source, load_frames
from swimm3r.prepare.bag_rig import BagRig
from swimm3r.prepare.clip import open_clip
from swimm3r.prepare.image_folder import images_of
from swimm3r.scene.run_folder import STAGES
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, Mast3rSettings
from swimm3r.splat.settings import SplatSettings, UwbsSettings
from swimm3r.tasks.threads import thread_count

_TEST_SHARE = 1 / 8  # of the frames (prepare.frames_folder.TEST_EVERY)

_DECODE_S = 0.02  # per megapixel of a video's own frames
_WRITE_S = 0.12  # per megapixel of a prepared frame
_PLACE_S = 1.0  # per frame: features, mapping, and the share of the medium's fit
_PAIR_S = 0.01  # per pair of frames that are matched at 2048 features
_SWEEP_S = 2.0  # per megapixel of depth and source frame
_RESTORE_S = 2.5  # per megapixel of a prepared frame
_STEP_PRIMITIVE_S, _STEP_PIXEL_S = 1.1e-6, 0.6e-6  # of a training step, forward and backward
_RECIPE_STEP = {  # beside a step of uwbs-static; the last two by way of watersplatting, 3.6 and 2 times it
    "ubs": 0.55,
    "watersplatting": 1.75,
    "seasplat": 1.45,
    "oceansplat": 6.3,
    "3d-uir": 3.5,
}
_POSE_STEP = 0.7  # a step of pose refinement beside one of training
_OVERHEAD_S = 5.0  # per stage: imports, kernels from the cache, reading back

_PARALLEL = 0.75  # of the cores, on average over a run

_FRAME_BYTES = 1.8  # per pixel of a prepared frame, a PNG
_SFM_BYTES = 16.0  # per pixel of a frame: two passes of the plane sweep; later depth, confidence, restored images
_AREA = 0.15  # of the surface, in images, that a frame adds: surveys of 100 and 1,000 frames
_POINT_BYTES = 60.0  # of the restored and the raw cloud together
_PRIMITIVE_BYTES = 600.0  # map, and checkpoint with the optimizer's state
_VIEW_BYTES = 16.0  # per pixel of a rendered test frame, all its images
_FIXED_BYTES = 20e6  # report, flight, matches

_TITLES = {"prepare": "frames", "sfm": "structure from motion", "splat": "map", "eval": "scores"}


@dataclass(frozen=True)
class Estimate:
    """Seconds and bytes by stage; None for seconds that cannot be told beforehand."""

    frames: int
    width: int  # of a prepared frame
    height: int
    seconds: dict[str, float | None]
    bytes: dict[str, float]

    @property
    def total_bytes(self) -> float:
        """Disk that all stages together take."""
        return sum(self.bytes.values())

    def seconds_from(self, stage: str) -> float | None:
        """Seconds of a stage and those after it; None where one of them is not estimated."""
        names = list(self.seconds)
        left = [self.seconds[name] for name in names if STAGES.index(name) >= STAGES.index(stage)]
        return None if any(one is None for one in left) else sum(one for one in left if one is not None)

    def __str__(self) -> str:
        parts = [f"{_TITLES[name]} {duration(one)}" for name, one in self.seconds.items()]
        whole = sum(one for one in self.seconds.values() if one is not None)
        total = "" if len(parts) == 1 else f", {duration(whole)} in all"
        if None in self.seconds.values():
            total += " besides the parts that are not estimated"
        return (
            f"Rough estimate for {self.frames} frames of {self.width}x{self.height}: {', '.join(parts)}{total};"
            f" {size(self.total_bytes)} of disk"
        )


def estimate_run(
    source: Path,
    folder: Path,
    settings: RunSettings,
    stages: Collection[str] = STAGES,
    *,
    on_cpu: bool = True,
    cores: int | None = None,
) -> Estimate | None:
    """The time and disk of some stages of a run; None where the input does not tell how many frames there are.

    Where the frames are not among the stages, those that the folder holds count. `on_cpu` says where maps are trained.
    Raises InputError where the input cannot be used.
    """
    if "prepare" in stages:
        found = _frames_to_come(source, folder, settings.frames)
        if found is None:
            return None
        count, (width, height), decoded = found
    else:
        frames = load_frames(folder / "prepare")
        count, width, height, decoded = len(frames), frames.width, frames.height, 0.0
    frame = width * height
    wall = 1 / (_PARALLEL * max(1.0, cores if cores is not None else thread_count()))
    tests = count * _TEST_SHARE
    sfm = _sfm_seconds(count, frame, max(width, height), settings)
    step = _step_seconds(settings.splat, width, height) if on_cpu else None
    work: dict[str, float | None] = {
        "prepare": (decoded * _DECODE_S + count * frame * _WRITE_S) / 1e6,
        "sfm": sfm,
        "splat": None if step is None else settings.splat.iterations * step,
        "eval": None if step is None else tests * (settings.test.steps + 20) * step * _POSE_STEP,
    }
    restore = settings.sfm.restore
    times = count * _AREA / restore.max_points_area if restore.max_points_area else 1.0
    cloud = max(1.0, times) * restore.max_points * _POINT_BYTES
    view = frame * _scale(settings.splat.long_side, max(width, height)) ** 2
    disk = {
        "prepare": count * frame * _FRAME_BYTES,
        "sfm": count * frame * _SFM_BYTES + cloud,
        "splat": _most_primitives(settings.splat) * _PRIMITIVE_BYTES,
        "eval": tests * view * _VIEW_BYTES + _FIXED_BYTES,
    }
    kept = [stage for stage in STAGES if stage in stages]
    seconds = {name: None if (one := work[name]) is None else one * wall + _OVERHEAD_S for name in kept}
    return Estimate(count, width, height, seconds, {name: disk[name] for name in kept})


def check_disk(estimate: Estimate, folder: Path) -> str:
    """A warning where the disk of a folder may be too small, else "". Raises StorageError where it is, by far."""
    free = shutil.disk_usage(folder).free
    need = estimate.total_bytes
    if need <= free:
        return ""
    told = f"the run takes about {size(need)} of disk, and {size(free)} are free on the disk of {folder}"
    if need > 2 * free:  # estimates are within a factor of two
        raise StorageError(
            told,
            cause="the disk is nearly full, or the clip is longer or larger than it can hold",
            hint="free some space, choose an --out on another disk, or fewer or smaller frames (--fps, --long-side)",
        )
    return f"{told[0].upper()}{told[1:]}: it may become full."


def duration(seconds: float | None) -> str:
    """Seconds as people say them: 40 s, 7 min, 1.5 h."""
    if seconds is None:
        return "not estimated"
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def size(count: float) -> str:
    """Bytes as people say them."""
    return f"{count / 1e6:.0f} MB" if count < 1e9 else f"{count / 1e9:.1f} GB"


def _frames_to_come(source: Path, folder: Path, settings: FrameSettings) -> tuple[int, tuple[int, int], float] | None:
    """Number and size of the prepared frames, and pixels that are decoded for them."""
    source = check_source(source)
    if source.is_dir() and not is_bag(source):
        paths = images_of(source, [folder]).paths
        whole = next((found for path in paths[:5] if (found := _size_of(path)) is not None), None)
        if whole is None:
            return None
        count = decoded = len(paths)
        views = 1
    else:
        video = open_clip(source, settings)
        if video.seconds is None:
            return None
        seconds = max(0.0, min(settings.end or video.seconds, video.seconds) - settings.start)
        decoded = seconds * video.rate
        count = max(1, round(min(decoded, seconds * settings.fps if settings.fps else decoded)))
        whole = video.width, video.height
        views = len(video.rig.names) if isinstance(video, BagRig) else 1
    if settings.max_frames:
        count = min(count, settings.max_frames)
    scale = _scale(settings.long_side, max(whole))
    width, height = (max(1, round(side * scale)) for side in whole)
    return views * count, (width, height), float(views * decoded * whole[0] * whole[1])


def _size_of(path: Path) -> tuple[int, int] | None:
    """The size of an image; None where its header cannot be read, for the run leaves such images out by name."""
    try:
        return image_size(path)
    except InputError:
        return None


def _scale(long_side: int, own: int) -> float:
    return min(1.0, long_side / own) if long_side else 1.0


def _sfm_seconds(count: int, frame: int, long_side: int, settings: RunSettings) -> float | None:
    match settings.sfm:
        case Mast3rSettings():
            return None  # the network's speed is measured when it is loaded
        case ColmapSettings() as colmap:
            exhaustive = colmap.pairs == "exhaustive" or (colmap.pairs == "auto" and count <= colmap.exhaustive_to)
            near = count * (colmap.overlap + colmap.loops)
            pairs = count * (count - 1) // 2 if exhaustive else min(near, count * (count - 1) // 2)
            poses = count * _PLACE_S + pairs * _PAIR_S * (colmap.features.count / 2048) ** 2
            return poses + count * _frame_seconds(frame, long_side, colmap.depth)
        case ColmapModelSettings() as model:
            return count * _frame_seconds(frame, long_side, model.depth)


def _frame_seconds(frame: int, long_side: int, depth: PlaneSweepSettings) -> float:
    """Depth and restoration of one frame."""
    swept = frame * _scale(depth.long_side, long_side) ** 2
    return (swept * depth.sources * _SWEEP_S + frame * _RESTORE_S) / 1e6


def _step_seconds(settings: SplatSettings, width: int, height: int) -> float:
    pixels = width * height * _scale(settings.long_side, max(width, height)) ** 2
    plain = _most_primitives(settings) * _STEP_PRIMITIVE_S + pixels * _STEP_PIXEL_S
    return plain * _RECIPE_STEP.get(settings.recipe, 1.0)


def _most_primitives(settings: SplatSettings) -> int:
    return settings.densify.cap_max if isinstance(settings, UwbsSettings) else settings.cap_max
