"""Is `MediumFit.identifiable` true? Synthetic dives of known water, at the level of pixels, in all four water families.

    python benchmarks/seathru_calibration.py --draws 60

Each draw takes a water family, a scene depth (0.5-8 m), a range of viewing distances, reflectances and how many frames
saw it, adds depth errors (1-2 %), noise and 8-bit rounding, fits, and compares. Printed per family: the share of
coefficients called identifiable, the share of those within 15 % of the truth, and the errors of T_D and B.
"""

import argparse
from dataclasses import dataclass

import numpy as np
import torch

from swimm3r.medium import Medium, add_water, backscatter, transmittances
from swimm3r.sfm.medium.samples import WaterSamples
from swimm3r.sfm.medium.seathru import fit_medium
from swimm3r.sfm.medium.settings import SeathruSettings

FAMILIES = {  # the paper's intervals of Binf
    "cyan": ((0.02, 0.08), (0.30, 0.50), (0.30, 0.45)),
    "teal": ((0.05, 0.15), (0.45, 0.70), (0.30, 0.55)),
    "green": ((0.10, 0.25), (0.30, 0.50), (0.10, 0.30)),
    "warm": ((0.20, 0.40), (0.15, 0.30), (0.10, 0.25)),
}
TOLERANCE = 0.15
NOISE = 0.002  # of a sample: a camera's 0.008, averaged over a patch or a few pixels


@dataclass(frozen=True)
class Draw:
    """Samples of one synthetic dive and its water."""

    samples: WaterSamples
    medium: Medium


def draw_dive(family: str, generator: np.random.Generator, points: int = 4000) -> Draw:
    """One dive: surface points seen once to eight times from a moving camera."""
    u = generator.uniform
    Binf = np.array([u(*interval) for interval in FAMILIES[family]])
    beta_D = np.array([u(0.7, 1.6) if family == "cyan" else u(0.3, 2.0), u(0.04, 0.85), u(0.04, 0.85)])
    medium = Medium(*(torch.tensor(v, dtype=torch.float32) for v in (Binf, beta_D, u(0.05, 1.0, 3) * beta_D)))

    frames = int(generator.integers(15, 50))
    middle, depth_spread, track_spread = u(0.8, 5.0), u(0.1, 0.5), u(0.03, 0.4)
    seen = generator.integers(1, 8, points)
    track = np.repeat(np.arange(points), seen)
    frame = (generator.integers(0, frames, points)[track] + np.arange(len(track))) % frames
    position = generator.normal(0, 1, frames)
    z = middle * np.exp(generator.normal(0, depth_spread, points)[track] + track_spread * position[frame]).clip(0.2, 4)
    shared_error = generator.normal(0, 0.01, points)[track] + generator.normal(0, 0.005, frames)[frame]
    measured = z * (1 + u(0.5, 1.5) * shared_error + generator.normal(0, 0.003, len(z)))

    albedo = np.clip(u(0.2, 0.5) * np.exp(generator.normal(0, u(0.25, 0.6), points)), 0.01, 0.95)
    tint = np.exp(generator.normal(0, 0.15, 3) + generator.normal(0, 0.1, (points, 3)))
    shade = np.where(generator.random(points) < 0.02, u(0.02, 0.3), 1.0)
    J = torch.from_numpy(((albedo * shade)[:, None] * tint).clip(0, 1).astype(np.float32))[track]
    I = add_water(J, torch.from_numpy(z.astype(np.float32)), medium).numpy()
    exposure = np.exp(generator.normal(0, 0.005, frames))[frame][:, None]
    I = (I * exposure + generator.normal(0, NOISE, I.shape)).clip(0, 1)
    open_water = np.empty((0, 3))
    if u() < 0.5:
        open_water = Binf + u(-0.01, 0.01, 3) + generator.normal(0, NOISE, (2000, 3))
    samples = WaterSamples(
        torch.from_numpy((np.round(I * 255) / 255).astype(np.float32)),
        torch.from_numpy(measured.astype(np.float32)),
        torch.from_numpy(frame),
        torch.from_numpy(np.where(seen[track] > 1, track, -1)),
        torch.from_numpy(np.round(open_water.clip(0, 1) * 255).astype(np.float32) / 255),
    )
    return Draw(samples, medium)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=60, help="per family")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(
        "family  coefficient  identifiable  within 15 %   |  T_D error  B error (mean; 90th percentile), worst channel"
    )
    for number, family in enumerate(FAMILIES):
        generator = np.random.default_rng([arguments.seed, number])
        errors: dict[str, list[np.ndarray]] = {"Binf": [], "beta_D": [], "beta_B": []}
        flags: dict[str, list[np.ndarray]] = {"Binf": [], "beta_D": [], "beta_B": []}
        T_D_error, B_error = [], []
        for _ in range(arguments.draws):
            draw = draw_dive(family, generator)
            fit = fit_medium(draw.samples, SeathruSettings(), "srgb")
            z = draw.samples.ray_depth
            found = fit.at(z)
            T_D_error.append((transmittances(z, found)[0] - transmittances(z, draw.medium)[0]).abs().mean(0).max())
            B_error.append((backscatter(z, found) - backscatter(z, draw.medium)).abs().mean(0).max())
            for name in errors:
                truth = getattr(draw.medium, name)
                errors[name].append(((getattr(fit, name) - truth).abs() / truth).numpy())
                flags[name].append(fit.identifiable[name].numpy())
        for name in errors:
            flag, error = np.stack(flags[name]), np.stack(errors[name])
            within = (error[flag] < TOLERANCE).mean() if flag.any() else float("nan")
            line = f"{family:7} {name:12} {flag.mean():12.0%} {within:12.1%}"
            if name == "Binf":
                line += "   |  " + "  ".join(
                    f"{np.mean(e):.3f}; {np.quantile(e, 0.9):.3f}" for e in (T_D_error, B_error)
                )
            print(line, flush=True)


if __name__ == "__main__":
    main()
