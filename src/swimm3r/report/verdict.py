"""The water of a dive in one sentence: which attenuation the frames determine, and where half of the light is lost.

T_D(z) = exp(-beta_D z) = 1 / 2    at z = ln 2 / beta_D
"""

import math
from dataclasses import dataclass

from swimm3r.medium import MediumFit

CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class HalfDistance:
    """The ray depth at which half of a channel's light is lost, with one standard deviation."""

    channel: str
    distance: float
    std: float

    def text(self, unit: str) -> str:
        """The number with its deviation and unit, rounded to what the deviation leaves."""
        places = max(0, 1 - math.floor(math.log10(self.std))) if self.std > 0 else 2
        places = min(places, max(0, 2 - math.floor(math.log10(self.distance))))
        return f"{self.distance:.{places}f} \u00b1 {self.std:.{places}f} {unit}"


def half_distances(fit: MediumFit) -> tuple[HalfDistance, ...]:
    """Those of the channels whose attenuation the frames determine."""
    found = zip(
        CHANNELS, fit.beta_D.tolist(), fit.std.beta_D.tolist(), fit.identifiable["beta_D"].tolist(), strict=True
    )
    return tuple(
        HalfDistance(channel, math.log(2) / beta, math.log(2) * std / beta**2)
        for channel, beta, std, known in found
        if known and beta > 0
    )


def water_verdict(fit: MediumFit | None, *, metric: bool, gray: bool = False) -> str:
    """One sentence on the attenuation that `fit` found, preferably the fit in linear light.

    Of gray frames the three channels are one, and the sentence is about light as such.
    """
    if fit is None:
        return "The water was not estimated."
    known, unit = half_distances(fit), "m" if metric else "scene units"
    light = "light" if fit.encoding == "linear" else "brightness"
    if gray:
        if not known:
            return "Attenuation is not determined: these frames do not tell how fast the water takes light."
        whole = "Attenuation is determined for the camera's whole band"
        return f"{whole}; half of the {light} is lost in {known[0].text(unit)}."
    if not known:
        return (
            "Attenuation is not determined in any color channel: these frames do not tell how fast the water takes"
            " light."
        )
    names = _listed([each.channel for each in known])
    first, *others = (each.text(unit) for each in known)
    lost = f"{known[0].channel} loses half of its {light} in {first}" + "".join(
        f", {each.channel} in {text}" for each, text in zip(known[1:], others, strict=True)
    )
    return f"Attenuation is determined in {names}{' only' * (len(known) < 3)}; {lost}."


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
