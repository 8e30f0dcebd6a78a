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
    cyclic: bool = False
    """The last frames pair with the first: for a path that closes on itself."""


@dataclass(frozen=True)
class LogWindow(Settings):
    """Every frame with those 1, 2, 4, 8 ... frames away: long baselines at logarithmic cost."""

    size: Annotated[int, Range(1, 30)] = 3
    """How many powers of two, from 1 on."""
    cyclic: bool = False


@dataclass(frozen=True)
class OneReference(Settings):
    """One frame with every other."""

    frame: CountOrZero = 0


@dataclass(frozen=True)
class Retrieval(Settings):
    """Key frames far apart, all paired; every other frame with its nearest key frame; all with their most similar."""

    key_frames: CountOrZero = 20
    neighbors: CountOrZero = 10
    """Counted as the reference does: the frame itself is the first of them."""
    seed: Seed = 0
    """Draws the first key frame."""


@dataclass(frozen=True)
class VideoPairs(Settings):
    """An ordered window for the path and the most similar far-away frames to close its loops."""

    window: CountOrZero = 4
    """At 2-5 frames per second a diver still sees half of the scene this many frames later."""
    closures: CountOrZero = 2
    """Far-away partners per frame; two, because one may be a false friend."""
    gap: CountOrZero = 10
    """Nearer frames than this are the window's business, not a loop."""


PairGraph = Complete | SlidingWindow | LogWindow | OneReference | Retrieval | VideoPairs


@dataclass(frozen=True)
class MatchingSettings(Settings):
    """Reciprocal matching of two descriptor maps (`sfm/mast3r/matching.py`)."""

    subsample: Annotated[int, Range(1, 64)] = 8
    """One search starts in every cell of this many pixels; the sparse alignment's anchors have the same spacing."""
    border: CountOrZero = 3
    """Matches nearer to an image's edge than this many pixels are dropped: the network guesses there."""


@dataclass(frozen=True)
class AlignmentSettings(Settings):
    """Sparse global alignment (`sfm/alignment/`); the defaults are MASt3R-SfM's unless a line says otherwise."""

    subsample: Annotated[int, Range(1, 64)] = 8
    """One depth per block of this many pixels is optimized; the rest of the block follows it."""
    coarse_iterations: CountOrZero = 300
    """Poses and scales, on distances in space."""
    coarse_rate: Rate = 0.07
    fine_iterations: CountOrZero = 300
    """Also focals, principal points and depths, on distances in the image."""
    fine_rate: Rate = 0.01
    intrinsics: Literal["free", "shared", "prior", "fixed"] = "free"
    """`prior` and `fixed` need known intrinsics; `prior` keeps them near, `fixed` does not move them."""
    prior_weight: NotNegative = 10.0
    """Of the squared relative deviation of focal and principal point, against a loss of about one pixel."""
    optimize_principal_point: bool = False
    """The reference does. But on a path without roll a shifted principal point and a turned camera look the same: on an
    exact scene of five 512 x 384 frames it costs 0.9 degrees and 3 % of focal length, against 0.03 degrees without."""
    optimize_depth: bool = True
    depth: Literal["add", "multiply"] = "add"
    """How a block's depth follows its frame's scale: as an offset from the focal plane, or as a factor."""
    exponential_depth: bool = False
    tree: Literal["ward", "spanning"] = "ward"
    """What chain of frames conditions the poses: by clusters of well-matched frames, or by the most matches."""
    confidence_threshold: NotNegative = 0.0
    """Pairs without any match above it are aligned by their pointmaps instead; the reference's function has 5, its
    authors recommend 0."""
    parity: bool = False
    """The reference's habits: the root's pose is free, pixel centers are at whole numbers, and the result is the one
    before the last step."""


@dataclass(frozen=True)
class LoraSettings(Settings):
    """Which layers of the frozen network get a trained low-rank update (`sfm/student/lora.py`)."""

    reading: Literal["A", "A2", "B", "C", "D"] = "A"
    """What the paper's "patch embedding and projection layers" are. A: the layers called `proj` of patch embedding and
    self-attention (2,584,576 trained numbers); A2: those of patch embedding and encoder; B: patch and decoder
    embedding; C: A with qkv and the decoder embedding; D: patch embedding, every layer of the encoder, decoder
    embedding. All of them adapt the four projections of the decoder's cross-attention."""
    rank: Annotated[int, Range(1, 1024)] = 16
    """Of those layers (paper, implementation details)."""
    cross_rank: Annotated[int, Range(1, 1024)] = 8
    """Of the decoder's cross-attention projections."""
    alpha_per_rank: Positive = 1.0
    """The update is alpha / rank times B A; the paper gives no alpha."""


@dataclass(frozen=True)
class ObjectiveSettings(Settings):
    """What is minimized (`sfm/student/losses.py`); the defaults are the paper's, Eqs. 1 to 8."""

    encoder: NotNegative = 0.5
    decoder: NotNegative = 0.5
    descriptors: NotNegative = 2.0
    clean: NotNegative = 0.0
    """Weight of the same distances with the student on the clear images; Dark3R's 0.3, not in this paper."""
    reduction: Literal["mean", "token", "sum"] = "mean"
    """The paper writes squared norms without saying over what: mean over all elements; sum over channels and mean over
    tokens or pixels; or the sum, which makes the encoder's term thousands of times larger than the descriptors'."""
    decoder_levels: Literal["last", "all"] = "last"
    """The decoder's normalized output, or the outputs of all its blocks."""
    forward: NotNegative = 1.0
    inverse: NotNegative = 1.0
    saturation: NotNegative = 1.0
    anchor: NotNegative = 0.5
    """Inside L_sat, of the veiling light's distance to the dim pixels' color. It pulls Binf below the truth wherever
    the dimmest pixels are nearer than the open water; 0 leaves it out."""
    anchor_quantile: Share = 0.05
    known_water: NotNegative = 0.0
    """Weight of the head's mistake in T_D and B themselves, in images whose water the augmentation drew. Not in the
    paper: L_inv makes a head that is not sure err on the side of clear water, and this does not."""
    min_transmittance: PositiveShare = 0.05
    """eps_inv of Eq. 4; the paper gives none. At 1/20 a noise of 1/255 stays below 0.08."""

    @property
    def physics(self) -> bool:
        """Whether the water is trained at all."""
        return max(self.forward, self.inverse, self.saturation, self.known_water) > 0
