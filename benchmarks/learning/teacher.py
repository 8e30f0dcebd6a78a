"""A small network of MASt3R's kind, trained from scratch on clear images: the teacher of the small experiment.

    python benchmarks/learning/teacher.py DIVES/train OUT/teacher.safetensors [--steps 3000]

Pairs are seen from either side, mirrored at random and with jittered colors. The same command goes on after an
interruption, from OUT/teacher.state.
"""

import argparse
import json
import time
from pathlib import Path

import torch
from torch import Tensor, nn
from views import Shots, draw_matches, read_shots, stacked

from swimm3r.io.files.atomic import atomic_path
from swimm3r.sfm.distillation.two_view_losses import (
    MATCHING_WEIGHT,
    TrueMatches,
    TruePoints,
    matching_loss,
    pointmap_loss,
)
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Architecture, Encoded, Mast3r

SMALL = Architecture(
    encoder_dim=128,
    encoder_depth=6,
    encoder_heads=2,
    decoder_dim=128,
    decoder_depth=4,
    decoder_heads=2,
    dpt_layer_dims=(16, 32, 64, 128),
    dpt_feature_dim=24,
    dpt_last_dims=(12, 12),
    local_hidden_dim=256,
    descriptor_dim=12,
)
_MATCHES, _WRONG = 512, 0.3  # rows per pair, and the share of them that only stand among the wrong answers
_WARM_UP = 100
_COOL_DOWN = 0.3  # share of the steps in which the rate falls to 0; until then --steps may still be changed
_JITTER = 0.5  # of brightness and contrast and saturation, as MASt3R's
_STATE_EVERY = 50


def new_network(architecture: Architecture, seed: int) -> Mast3r:
    """Weights as the reference starts: Xavier, no bias."""
    torch.manual_seed(seed)
    network = Mast3r(architecture)
    for module in network.modules():
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.zeros_(module.bias)
    projection = network.patch_embed.proj
    nn.init.xavier_uniform_(projection.weight.view(len(projection.weight), -1))
    return network


def batch(shots: list[Shots], size: int, generator: torch.Generator) -> tuple[Tensor, tuple, TrueMatches]:
    """Images [2, size, 3, h, w], the true points of both views, and their matches."""
    number = int(torch.multinomial(torch.tensor([float(len(s.pairs)) for s in shots]), 1, generator=generator))
    shape = shots[number].clean.shape[1:]
    alike = [s for s in shots if s.clean.shape[1:] == shape]
    images, points, valid, sky, rows = [], [], [], [], []
    for _ in range(size):
        s = alike[int(torch.randint(len(alike), (1,), generator=generator))]
        i, j = s.pairs[int(torch.randint(len(s.pairs), (1,), generator=generator))]
        if torch.rand(1, generator=generator) < 0.5:
            i, j = j, i
        pose = s.second_from_first(j, i).float()
        one, two = s.points(i), s.points(j) @ pose[:3, :3].mT + pose[:3, 3]
        index1, index2, ok = draw_matches(s, i, j, _MATCHES, _WRONG, generator)
        seen = [_jittered(s.clean[[i, j]], generator), torch.stack([one, two]), s.z_depth[[i, j]] > 0]
        if torch.rand(1, generator=generator) < 0.5:  # in a mirror
            seen = [seen[0].flip(-1), seen[1].flip(2) * torch.tensor([-1.0, 1, 1]), seen[2].flip(-1)]
            width = shape[-1]
            index1, index2 = (k - 2 * (k % width) + width - 1 for k in (index1, index2))
        images.append(seen[0])
        points.append(seen[1])
        valid.append(seen[2])
        sky.append(~seen[2] & (s.raw is not None))  # depth of a rendered dive misses nothing but open water
        rows.append((index1, index2, ok))
    truth = tuple(
        TruePoints(
            torch.stack([p[v] for p in points]), torch.stack([k[v] for k in valid]), torch.stack([o[v] for o in sky])
        )
        for v in (0, 1)
    )
    return torch.stack(images, 1), truth, stacked(rows)


def _jittered(images: Tensor, generator: torch.Generator) -> Tensor:
    """Brightness, contrast and saturation of each image, -1..1."""
    brightness, contrast, saturation = 1 + _JITTER * (2 * torch.rand(3, len(images), 1, 1, 1, generator=generator) - 1)
    x = (images + 1) / 2 * brightness
    x = (x - x.mean((1, 2, 3), keepdim=True)) * contrast + x.mean((1, 2, 3), keepdim=True)
    x = (x - x.mean(1, keepdim=True)) * saturation + x.mean(1, keepdim=True)
    return x.clamp(0, 1) * 2 - 1


def losses(
    network: Mast3r, images: Tensor, truth: tuple, matches: TrueMatches, least_share: float
) -> tuple[Tensor, Tensor]:
    """L_conf and L_match of a batch."""
    both = network.encode(images.flatten(0, 1))
    half = len(images[0])
    one, two = (
        Encoded(both.tokens[k], both.positions[k], both.height, both.width) for k in (slice(half), slice(half, None))
    )
    views = network.decode(one, two)
    maps = network.pointmap(views[0], 1), network.pointmap(views[1], 2)
    described = network.descriptors(views[0], 1), network.descriptors(views[1], 2)
    metric = torch.ones(half, dtype=torch.bool)
    return pointmap_loss(maps, truth, metric), matching_loss(described, matches, least_share)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dives", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--size", type=int, default=96, help="long side, pixels")
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--least-share",
        type=float,
        default=0.0,
        help="bound of the matching loss; the reference has 1e-8, beyond which a new network learns nothing",
    )
    args = parser.parse_args()
    shots = read_shots(args.dives, args.size)
    network = new_network(SMALL, args.seed)
    optimizer = torch.optim.AdamW(network.parameters(), lr=args.rate, betas=(0.9, 0.95), weight_decay=0.05)
    state, done, spent = args.out.with_suffix(".state"), 0, 0.0
    if state.is_file():
        stored = torch.load(state, weights_only=True)
        network.load_state_dict(stored["network"])
        optimizer.load_state_dict(stored["optimizer"])
        done, spent = stored["step"], stored["cpu_seconds"]
    count = sum(p.numel() for p in network.parameters())
    print(f"{count:,} parameters, {sum(len(s.pairs) for s in shots)} pairs of {len(shots)} sequences", flush=True)
    spent -= time.process_time()
    sums = torch.zeros(3)
    for step in range(done + 1, args.steps + 1):
        generator = torch.Generator().manual_seed(args.seed * 1_000_003 + step)
        for group in optimizer.param_groups:
            group["lr"] = args.rate * min(1.0, step / _WARM_UP, (args.steps + 1 - step) / (_COOL_DOWN * args.steps))
        points, matching = losses(network, *batch(shots, args.batch, generator), args.least_share)
        (points + MATCHING_WEIGHT * matching).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        sums += torch.stack([points.detach(), matching.detach(), torch.ones(())])
        if step % _STATE_EVERY == 0 or step == args.steps:
            now = spent + time.process_time()
            points, matching, _ = (sums / sums[2]).tolist()
            print(json.dumps({"step": step, "points": points, "matching": matching, "cpu_s": now}), flush=True)
            sums.zero_()
            with atomic_path(state) as draft:
                kept = {"network": network.state_dict(), "optimizer": optimizer.state_dict()}
                torch.save({**kept, "step": step, "cpu_seconds": now}, draft)
            checkpoint.save(network, args.out)


if __name__ == "__main__":
    main()
