"""Numbers of the plane sweep, each with its reason; torch-free."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.settings import CountOrZero, LongSide, NotNegative, PositiveShare, Range, Settings, Share, Threads


@dataclass(frozen=True)
class PlaneSweepSettings(Settings):
    """Dense depth of posed frames (`sfm/plane_sweep/estimate.py`)."""

    long_side: LongSide = 640
    """Longer side in pixels at which depth is computed; for larger frames it is upsampled along image edges."""
    sources: Annotated[int, Range(1, 16)] = 5
    """Number of neighboring frames that each frame is compared with."""
    angle_deg: Annotated[float, Range(above=0, most=90)] = 8.0
    """Preferred triangulation angle in degrees: smaller angles are imprecise, larger ones hide surfaces."""
    planes: Annotated[int, Range(32, 1024)] = 128
    """Largest number of planes of the coarse sweep, uniform in inverse depth; close views use fewer, one per pixel of
    motion."""
    window: Annotated[int, Range(1, 16)] = 3
    """Half width of the coarse sweep's NCC window, in pixels of the half-size image."""
    noise: PositiveShare = 0.8 / 255
    """Standard deviation of gray values below which a window is too uniform to be matched."""
    smooth: NotNegative = 0.15
    """Penalty for one plane of disagreement between neighboring pixels in the semi-global step; a jump costs eight
    times as much."""
    rounds: Annotated[int, Range(0, 32)] = 3
    """Number of slanted-plane refinement rounds at full working size."""
    smooth_fine: NotNegative = 0.05
    """Penalty in the refinement for one source pixel of disagreement with neighboring pixels."""
    min_ncc: Annotated[float, Range(0, below=1)] = 0.4
    """Smallest correlation with the sources at which a depth is kept."""
    min_peak: NotNegative = 0.12
    """Smallest share by which 1 - NCC must rise 2.5 pixels beside a match; flatter peaks are dropped as undetermined.
    """
    tolerance: Share = 0.015
    """Largest relative difference in depth at which two frames agree; the reprojection error may allow more."""
    agreeing: Annotated[int, Range(0, 16)] = 2
    """Number of other frames that must agree with a depth; of ground that fewer of them see, all."""
    most_behind: Annotated[float, Range(0, 1000)] = 0.125
    """Largest number of frames that measured a surface more than 7 % behind a point, per frame that measured the point:
    they look through it, and its depth is dropped. Where frames usually differ by more than 1.4 %, five times that
    counts."""
    speck: CountOrZero = 48
    """Size in working pixels below which connected patches of depth are dropped; up to eight times that, patches that
    few frames share have to fit the depth around them."""
    threads: Threads = 0
    """Number of frames computed at once; 0 uses all cores, at most 8."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Processor of the sweep; "auto" uses a CUDA device where there is one."""
