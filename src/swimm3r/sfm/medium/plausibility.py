"""Plausibility of the fitted water: whether images may be restored with it, and the warnings for the user.

Coefficients trade against each other where the depths span a short range, while T_D and B within that range may still
be right. So images are judged by the standard deviation of the optical depth (beta_D z at the middle z of the fit),
and true colors by whether any coefficient is identifiable at all. Where none is, the water acts on all channels alike
as far as nothing tells them apart (`with_like_channels`), and images change their hue toward gray at most
(`restore.milder_gains`).
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.medium import MediumFit
from swimm3r.scene.reconstruction import QualityWarning

_GUESS = 0.5  # standard deviation of the optical depth, in every channel, from which T_D is a guess: a factor of 1.6
_DARKEST = 1e-3  # mean of a channel of the frames: shares of less light say nothing


def optical_depth(fit: MediumFit) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """-ln T_D at the middle of the depths the fit has seen, and its standard deviation."""
    middle = _middle_depth(fit)
    return fit.beta_D * middle, fit.std.beta_D * middle


def _middle_depth(fit: MediumFit) -> float:
    near, far = fit.z_range
    return (near * far) ** 0.5


def attenuation_is_a_guess(fit: MediumFit) -> bool:
    """Return whether no channel's T_D is known: dividing by it would invent colors."""
    return bool((optical_depth(fit)[1] > _GUESS).all())


def any_determined(fit: MediumFit) -> bool:
    """Return whether the frames determine a single coefficient; where not, no restored color is a surface's true
    one."""
    return any(bool(flags.any()) for flags in fit.identifiable.values())


def with_like_channels(fit: MediumFit, mean_color: Float[Tensor, "3"]) -> MediumFit:
    """The fit with its channels drawn together where the frames determine no coefficient.

    Of the optical depth tau at the middle depth, of the backscatter there as a share of the frames' mean color, and of
    ln beta_B, which gives Binf to that backscatter:

        x_c' = m + v / (v + s^2) (x_c - m)     m, v: mean and variance over the channels,   s^2: mean of their variances

    which is the mean of x_c given all three where channels differ by chance (empirical Bayes). Differences between
    undetermined channels are mostly errors, which restored images would show as a cast. Standard deviations stay, and
    so does a fit of which any coefficient is determined.
    """
    if any_determined(fit):
        return fit
    tau, tau_std = optical_depth(fit)
    thinner = _drawn_together(tau, tau_std) / tau
    z, color = _middle_depth(fit), mean_color.clamp(min=_DARKEST)
    built_up = -torch.expm1(-fit.beta_B * z)
    share = fit.Binf * built_up / color
    share_std = torch.hypot(fit.std.Binf * built_up, fit.Binf * (1 - built_up) * z * fit.std.beta_B) / color
    beta_B = _drawn_together(fit.beta_B.log(), fit.std.beta_B / fit.beta_B).exp()
    Binf = _drawn_together(share, share_std) * color / -torch.expm1(-beta_B * z)
    curve = replace(fit.curve, a=fit.curve.a * thinner, c=fit.curve.c * thinner)
    return replace(fit, Binf=Binf.clamp(max=1), beta_D=fit.beta_D * thinner, beta_B=beta_B, curve=curve)


def _drawn_together(x: Float[Tensor, "3"], std: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    spread, noise = x.var(), std.square().mean()
    return x.mean() + spread / (spread + noise).clamp(min=1e-12) * (x - x.mean())


def water_warnings(
    fit: MediumFit, *, gray: bool, predicted: bool = False, linear: MediumFit | None = None
) -> tuple[QualityWarning, ...]:
    """Everything that speaks against the water that restores a dive's images, or limits what it means.

    `predicted` by a physics head instead of fitted to the frames. `linear` is the fit that tables and the report's
    verdict are taken from.
    """
    found = (_gray(gray), _undetermined(fit, predicted, linear), _red_lost_least(fit, gray))
    return tuple(warning for warning in found if warning is not None)


def _gray(gray: bool) -> QualityWarning | None:
    if not gray:
        return None
    return QualityWarning(
        "The frames are gray: the water was fitted to their one channel, which stands for red, green and blue.",
        "Its coefficients are those of the whole band the camera sees, and restored images stay gray; for colors, "
        "give the footage in color.",
    )


def _undetermined(fit: MediumFit, predicted: bool, linear: MediumFit | None) -> QualityWarning | None:
    advice = (
        "Train the adapter with held-out pairs, so that its head's error is known, or restore without one."
        if predicted
        else "Film the same ground from near and from far in one dive (1 to 4 m), with open water in view; coefficients"
        " in brackets are not for a table."
    )
    factor = optical_depth(fit)[1].max().exp().item()
    if attenuation_is_a_guess(fit):
        kept = "the colors as filmed" if fit.lamp is None else "the hue as filmed and are evenly lit"
        return QualityWarning(
            "The water is not determined: the light lost on the way is uncertain by a factor of up to"
            f" {factor:.1f}, so the restored frames keep {kept}.",
            advice,
        )
    if any_determined(fit):
        if linear is None or bool(linear.identifiable["beta_D"].any()):
            return None
        return QualityWarning(
            "The attenuation is not determined in any color channel: these frames do not tell over which distance the"
            " water takes half of the light.",
            advice,
        )
    return QualityWarning(
        f"None of the water's coefficients is determined: restored colors (some {factor - 1:.0%} uncertain at the"
        " middle distance) are not the true ones. The restored frames have more contrast, and less of the water's hue"
        " as far as that brings them nearer to gray; they are not balanced to gray.",
        advice,
    )


def _red_lost_least(fit: MediumFit, gray: bool) -> QualityWarning | None:
    """Of Jerlov's types only the most turbid of the coast, 7C and 9C, attenuate red the least."""
    depth = optical_depth(fit)[0]
    if gray or not bool(depth[0] < depth[1:].min()):
        return None
    return QualityWarning(
        "The water found attenuates red least, as only the most turbid coastal waters do: its colors are implausible.",
        "The footage may be color-corrected, lit by lamps, or too hazy to tell; give the uncorrected original, and do"
        " not read colors or coefficients off this result.",
    )
