"""Matchers of localization: similarity of images, and correspondences between their pixels.

SIFT needs no weights: keypoints matched by their descriptors, images compared by VLAD over a vocabulary learned from
the references. MASt3R matches every pixel, and compares images by their encoder's tokens, as the paper does.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r import weights
from swimm3r.io.colmap.model import silence_log
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.sfm.features import asmk, vlad
from swimm3r.sfm.features.sift import extract_features, match_descriptors, unit_descriptors
from swimm3r.sfm.mast3r.inference import ViewPrediction, predict_pair
from swimm3r.sfm.mast3r.matching import DescriptorMap, match_views
from swimm3r.sfm.mast3r.network import Encoded, Mast3r
from swimm3r.sfm.mast3r.preprocess import Framing, framing, mask_to_network, pixels_to_image, to_network
from swimm3r.sfm.mast3r_sfm.run_pairs import load_network
from swimm3r.sfm.settings import Mast3rSettings

Pixels = Float[Tensor, "m 2"]  # of images as they were described, centers at +0.5
Likeness = Callable[[Any], Float[Tensor, " k"]]  # of a described image to each reference
_SAMPLE = 64  # references, spread evenly, that a vocabulary or a mean is learned from


@runtime_checkable  # so that the suite can check calls against it
class Matcher(Protocol):
    """A kind of features; what `describe` returns is its own affair."""

    name: str

    def describe(self, image: Float[Tensor, "h w 3"], usable: Bool[Tensor, "h w"]) -> Any:
        """The data of an image that the other methods take."""
        ...

    def index(self, names: Sequence[str], described: Callable[[str], Any]) -> Likeness:
        """Similarity of an image to each of the references, which are read one at a time."""
        ...

    def match(self, a: Any, b: Any) -> tuple[Pixels, Pixels]:
        """Pixels of two images that show the same place."""
        ...


@dataclass(frozen=True)
class _Keypoints:
    xy: Pixels
    descriptors: Float[Tensor, "n 128"]  # of unit length


class SiftMatcher:
    """Keypoints; no weights."""

    name = "SIFT"

    def __init__(self, settings: LocalizationSettings) -> None:

        silence_log()
        self.settings = settings.features

    def describe(self, image: Float[Tensor, "h w 3"], usable: Bool[Tensor, "h w"]) -> _Keypoints:
        """The image's keypoints outside its mask."""
        found = extract_features(image, usable, self.settings)
        return _Keypoints(torch.from_numpy(found.keypoints[:, :2]).double(), unit_descriptors(found.descriptors))

    def index(self, names: Sequence[str], described: Callable[[str], _Keypoints]) -> Likeness:
        """Cosines of VLAD descriptors; -1 for an image without keypoints."""
        sample = [described(name).descriptors for name in names[:: -(-len(names) // _SAMPLE)]]
        sample = [descriptors for descriptors in sample if len(descriptors)]
        if not sample:
            return lambda _: torch.full((len(names),), -1.0)
        words = vlad.vocabulary(sample, torch.Generator().manual_seed(0))

        def summed(keypoints: _Keypoints) -> Tensor | None:
            return vlad.summed(keypoints.descriptors, words) if len(keypoints.descriptors) else None

        known = [summed(described(name)) for name in names]

        def likeness(query: _Keypoints) -> Float[Tensor, " k"]:
            own = summed(query)
            unlike = torch.tensor(-1.0)
            return torch.stack([unlike if own is None or v is None else own @ v for v in known])

        return likeness

    def match(self, a: _Keypoints, b: _Keypoints) -> tuple[Pixels, Pixels]:
        """Mutual nearest descriptors that pass the ratio test."""
        pairs = match_descriptors(a.descriptors, b.descriptors, self.settings.max_ratio)
        return a.xy[pairs[:, 0]], b.xy[pairs[:, 1]]


@dataclass(frozen=True)
class _Seen:
    frame: Framing
    encoded: Encoded
    usable: Bool[Tensor, "H W"]  # on the network's image


class Mast3rMatcher:
    """Descriptors of every pixel from the two-view network."""

    name = "MASt3R"

    def __init__(self, network: Mast3r, settings: LocalizationSettings) -> None:
        self.network, self.settings = network, settings.matching

    def describe(self, image: Float[Tensor, "h w 3"], usable: Bool[Tensor, "h w"]) -> _Seen:
        """The image's encoding."""
        frame = framing(image.shape[1], image.shape[0])
        with torch.no_grad():
            encoded = self.network.encode(to_network(image, frame)[None].to(self.network.device))
        return _Seen(frame, encoded, mask_to_network(usable, frame))

    def index(self, names: Sequence[str], described: Callable[[str], _Seen]) -> Likeness:
        """Cosines of the tokens' summed deviations from the references' mean token."""
        sample = names[:: -(-len(names) // _SAMPLE)]
        mean = torch.stack([_tokens(described(name)).mean(0) for name in sample]).mean(0)
        known = torch.stack([asmk.global_descriptor(_tokens(described(name)) - mean) for name in names])
        return lambda query: known @ asmk.global_descriptor(_tokens(query) - mean)

    def match(self, a: _Seen, b: _Seen) -> tuple[Pixels, Pixels]:
        """Reciprocal nearest descriptors of both passes."""
        with torch.no_grad():
            p = predict_pair(self.network, (0, a.encoded), (1, b.encoded), heads=(False, True))

        def described(view: ViewPrediction, usable: Tensor) -> DescriptorMap:
            assert view.descriptors is not None
            assert view.descriptor_confidence is not None
            return DescriptorMap(view.descriptors, view.descriptor_confidence, usable.to(view.descriptors.device))

        found = match_views(
            described(p.view_ii, a.usable),
            described(p.view_ji, b.usable),
            described(p.view_ij, a.usable),
            described(p.view_jj, b.usable),
            self.settings,
        )
        return (
            pixels_to_image(found.xy1.cpu() + 0.5, a.frame),
            pixels_to_image(found.xy2.cpu() + 0.5, b.frame),
        )


def _tokens(seen: _Seen) -> Float[Tensor, "k c"]:
    return seen.encoded.tokens[0].float().cpu()


def chosen_matcher(settings: LocalizationSettings) -> Literal["mast3r", "sift"]:
    """The matcher that "auto" selects. Raises WeightsError for weights that are named and not there."""
    if settings.matcher != "auto":
        return settings.matcher
    return "sift" if weights.find("mast3r", settings.weights) is None else "mast3r"


def matcher_for(settings: LocalizationSettings) -> Matcher:
    """The matcher that the settings name. Raises WeightsError where MASt3R is asked for and its weights are missing."""
    match chosen_matcher(settings):
        case "mast3r":
            network = Mast3rSettings(weights=settings.weights, device=settings.device, precision=settings.precision)
            return Mast3rMatcher(load_network(network), settings)
        case "sift":
            return SiftMatcher(settings)
