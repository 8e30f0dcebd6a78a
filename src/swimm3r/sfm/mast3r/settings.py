"""Every number of the MASt3R front end, with its reason; torch-free, so that --help is instant."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.settings import (
    Count,
    CountOrZero,
    NotNegative,
    Positive,
    PositiveShare,
    Range,
    Rate,
    Seed,
    Settings,
    Share,
)


@dataclass(frozen=True)
class Complete(Settings):
    """Every frame with every other: n (n - 1) / 2 pairs."""


@dataclass(frozen=True)
class SlidingWindow(Settings):
    """Every frame with the next few of an ordered sequence."""

    size: Count = 3
    """Number of following frames that each frame is paired with."""
    cyclic: bool = False
    """Pair the last frames with the first ones, for a closed path."""


@dataclass(frozen=True)
class LogWindow(Settings):
    """Every frame with those 1, 2, 4, 8 ... frames away: long baselines at logarithmic cost."""

    size: Annotated[int, Range(1, 30)] = 3
    """Number of powers of two, from 1 on, that frames are paired at."""
    cyclic: bool = False
    """Pair the last frames with the first ones, for a closed path."""


@dataclass(frozen=True)
class OneReference(Settings):
    """One frame with every other."""

    frame: CountOrZero = 0
    """Index of the frame that all others are paired with."""


@dataclass(frozen=True)
class Retrieval(Settings):
    """Key frames far apart, all paired; every other frame with its nearest key frame; all with their most similar."""

    key_frames: CountOrZero = 20
    """Number of key frames, far apart from each other."""
    neighbors: CountOrZero = 10
    """Number of most similar frames per frame; the frame itself counts as the first, as in the reference
    implementation."""
    seed: Seed = 0
    """Seed that draws the first key frame."""


@dataclass(frozen=True)
class VideoPairs(Settings):
    """An ordered window for the path and the most similar far-away frames to close its loops."""

    window: CountOrZero = 4
    """Number of following frames that each frame is paired with."""
    closures: CountOrZero = 2
    """Number of similar distant frames that each frame is paired with."""
    gap: CountOrZero = 10
    """Smallest distance in frames of a pair that closes a loop."""


PairGraph = Complete | SlidingWindow | LogWindow | OneReference | Retrieval | VideoPairs


@dataclass(frozen=True)
class MatchingSettings(Settings):
    """Reciprocal matching of two descriptor maps (`sfm/mast3r/matching.py`)."""

    subsample: Annotated[int, Range(1, 64)] = 8
    """Spacing in pixels of the matching's starting points, which are also the alignment's anchors."""
    border: CountOrZero = 3
    """Distance in pixels from an image's edge within which matches are dropped."""


@dataclass(frozen=True)
class AlignmentSettings(Settings):
    """Sparse global alignment (`sfm/alignment/`); the defaults are MASt3R-SfM's unless a line says otherwise."""

    subsample: Annotated[int, Range(1, 64)] = 8
    """Edge in pixels of the blocks whose depth is optimized as one."""
    coarse_iterations: CountOrZero = 300
    """Number of steps that optimize poses and scales by distances in space."""
    coarse_rate: Rate = 0.07
    """Learning rate of the coarse steps."""
    fine_iterations: CountOrZero = 300
    """Number of steps that also optimize focal lengths, principal points and depths by distances in the image."""
    fine_rate: Rate = 0.01
    """Learning rate of the fine steps."""
    intrinsics: Literal["free", "shared", "prior", "fixed"] = "free"
    """Treatment of the intrinsics: free per frame, shared by all, kept near the known ones (prior), or fixed to them.
    """
    prior_weight: NotNegative = 10.0
    """Weight of the squared relative deviation from known intrinsics, against a loss of about one pixel."""
    optimize_principal_point: bool = False
    """Optimize the principal point too, as the reference implementation does. On a path without roll it cannot be told
    from a turned camera."""
    optimize_depth: bool = True
    """Optimize the depths of the blocks in the fine steps."""
    depth: Literal["add", "multiply"] = "add"
    """Relation of a block's depth to its frame's scale: an offset from the focal plane (add), or a factor (multiply).
    """
    exponential_depth: bool = False
    """Optimize the logarithm of a block's depth instead of its depth."""
    tree: Literal["ward", "spanning"] = "ward"
    """Chain of frames that conditions the poses: by clusters of well-matched frames (ward), or by the most matches
    (spanning)."""
    confidence_threshold: NotNegative = 0.0
    """Confidence that one match of a pair must exceed; other pairs are aligned by their pointmaps."""
    parity: bool = False
    """Follow the reference implementation exactly: free root pose, pixel centers at whole numbers, result of the step
    before the last."""


@dataclass(frozen=True)
class LoraSettings(Settings):
    """Layers of the frozen network that get a trained low-rank update (`sfm/student/lora.py`)."""

    reading: Literal["A", "A2", "B", "C", "D"] = "A"
    """Layers that the paper's "patch embedding and projection layers" stand for. A: those named `proj` of patch
    embedding and self-attention (2,584,576 trained parameters); A2: those of patch embedding and encoder; B: patch and
    decoder embedding; C: A with qkv and the decoder embedding; D: patch embedding, every encoder layer, decoder
    embedding. All of them adapt the four projections of the decoder's cross-attention."""
    rank: Annotated[int, Range(1, 1024)] = 16
    """Rank of the update of the layers that `reading` selects."""
    cross_rank: Annotated[int, Range(1, 1024)] = 8
    """Rank of the update of the decoder's cross-attention projections."""
    alpha_per_rank: Positive = 1.0
    """Scale of the update, alpha / rank; the paper gives no alpha."""


@dataclass(frozen=True)
class ObjectiveSettings(Settings):
    """Training objective (`sfm/student/losses.py`); the defaults are the paper's, Eqs. 1 to 8."""

    encoder: NotNegative = 0.5
    """Weight of the distance between the encoder features of student and teacher (Eq. 1)."""
    decoder: NotNegative = 0.5
    """Weight of the distance between the decoder features of student and teacher (Eq. 1)."""
    descriptors: NotNegative = 2.0
    """Weight of the distance between the descriptors of student and teacher (Eq. 1)."""
    clean: NotNegative = 0.0
    """Weight of the same distances with the student on clear images (0.3 in Dark3R, absent from the paper)."""
    reduction: Literal["mean", "token", "sum"] = "mean"
    """Reduction of the squared norms of Eq. 1: mean over all elements; sum over channels and mean over tokens or pixels
    (token); or sum."""
    decoder_levels: Literal["last", "all"] = "last"
    """Decoder features that are compared: the normalized output, or the outputs of all blocks."""
    forward: NotNegative = 1.0
    """Weight of the forward loss L_for (Eq. 5)."""
    inverse: NotNegative = 1.0
    """Weight of the inverse loss L_inv (Eq. 6)."""
    saturation: NotNegative = 1.0
    """Weight of the saturation loss L_sat (Eq. 7)."""
    anchor: NotNegative = 0.5
    """Weight, within L_sat, of the distance of Binf to the color of dim pixels; 0 leaves it out."""
    anchor_quantile: Share = 0.05
    """Share of the dimmest pixels that the anchor term uses."""
    known_water: NotNegative = 0.0
    """Weight of the head's error in T_D and B where the augmentation drew the water. Absent from the paper; it counters
    the bias of L_inv toward clear water."""
    min_transmittance: PositiveShare = 0.05
    """Smallest transmittance of the inverse (eps_inv of Eq. 4), for which the paper gives no value."""

    @property
    def physics(self) -> bool:
        """Return whether the water is trained at all."""
        return max(self.forward, self.inverse, self.saturation, self.known_water) > 0
