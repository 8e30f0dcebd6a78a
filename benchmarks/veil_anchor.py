"""The effect of the physics losses on the water: L_sat's anchor and the floor under T_D, on exact images.

    python benchmarks/veil_anchor.py [--waters N] [--steps N]

Nothing is learned here. Frames of synthetic dives are seen through water of each family; Binf, beta_B and a constant
beta_D minimize L_for + L_inv + L_sat by Adam from the head's start: as printed, without the anchor, and with a floor
eps_inv that is never reached.
"""

from dataclasses import replace

import torch
from tyro import cli

from swimm3r import water_types
from swimm3r.medium import Medium, add_water, backscatter, transmittances
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.student.losses import physics_terms
from swimm3r.synthetic import DiveSettings, make_dive

Frames = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def fit(I: torch.Tensor, scene: Frames, settings: ObjectiveSettings, steps: int) -> Medium:
    """The water that minimizes the physics losses of frames of one dive: fields of shape [3]."""
    J, z, valid = scene
    start = torch.tensor([[-0.6] * 3, [-1.2] * 3, [-1.6] * 3])  # logit Binf, ln beta_D, ln beta_B
    x = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([x], lr=0.05)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    def water() -> Medium:
        return Medium(torch.sigmoid(x[0]), x[1].exp(), x[2].exp())

    for _ in range(steps):
        m = water()
        maps = Medium(*(v.expand_as(I) for v in (m.Binf, m.beta_D, m.beta_B)))
        terms = physics_terms(I, J, z, valid, maps, settings)
        loss = (terms.forward + terms.inverse + terms.overshoot + settings.anchor * terms.anchor).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return water()


def scene(seed: int, farther: float) -> Frames:
    """Two frames of a dive, their depths stretched: clear images, ray depths, where they are known."""
    dive = make_dive(DiveSettings(frames=8, width=60, height=40, seed=seed))
    frames = [dive.frame(i) for i in (1, 5)]
    z = torch.stack([f.ray_depth for f in frames]) * farther
    return torch.stack([f.clear for f in frames]), z, z > 0


def main(waters: int = 2, steps: int = 600) -> None:
    """Print the table."""
    print("family  median z  anchor  eps_inv   Binf - truth (R G B)    |T_D|   |B(z)|")
    for family in water_types.FAMILIES:
        for farther in (1.0, 3.0):
            for anchor, floor in ((0.5, 0.05), (0.0, 0.05), (0.0, 0.001)):
                settings = replace(ObjectiveSettings(), anchor=anchor, min_transmittance=floor)
                bias, T_error, B_error, depth = [], [], [], []
                for k in range(waters):
                    frames = scene(k, farther)
                    J, z, valid = frames
                    truth = water_types.sample(family, torch.Generator().manual_seed(k))
                    found = fit(add_water(J, z, truth), frames, settings, steps)
                    bias.append(found.Binf - truth.Binf)
                    at = z[valid]
                    T_error.append((transmittances(at, found)[0] - transmittances(at, truth)[0]).abs().mean())
                    B_error.append((backscatter(at, found) - backscatter(at, truth)).abs().mean())
                    depth.append(at.median())
                numbers = " ".join(f"{v:+.3f}" for v in torch.stack(bias).mean(0))
                errors = "   ".join(f"{torch.stack(e).mean():.4f}" for e in (T_error, B_error))
                median = torch.stack(depth).mean()
                print(f"{family:<7} {median:5.1f} m   {anchor:<6}  {floor:<7}   {numbers}    {errors}", flush=True)


if __name__ == "__main__":
    cli(main)
