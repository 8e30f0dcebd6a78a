"""Memory and time of the MASt3R back end against the number of frames, with a tiny network on tiny images.

    python benchmarks/mast3r_scale.py [--frames 50 100 200 400 800] [--memory-mb 16] [--max-matches 40000]

Every size runs in a process of its own, so that its peak is its own; the peak before the first frame (PyTorch, network)
is told beside it. The frames are crops along a line over one noise image; weights are random, so poses mean nothing:
what is measured is the machinery. `held at once` is what the running sums of all frames would take in memory.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HEIGHT, WIDTH = 48, 64


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run_one(count: int, memory_mb: int, max_matches: int) -> dict[str, float]:
    import torch

    from swimm3r.io import images
    from swimm3r.scene.frames import Frame, Frames
    from swimm3r.sfm.backends import mast3r as mast3r_backend
    from swimm3r.sfm.features.pair_graph import parse_graph
    from swimm3r.sfm.mast3r.network import Architecture, Mast3r
    from swimm3r.sfm.mast3r.settings import MatchingSettings
    from swimm3r.sfm.mast3r_sfm.network_frames import network_images
    from swimm3r.sfm.mast3r_sfm.run_pairs import run_pairs
    from swimm3r.sfm.settings import Mast3rSettings

    torch.manual_seed(0)
    torch.set_num_threads(1)
    network = Mast3r(
        Architecture(
            encoder_dim=32,
            encoder_depth=1,
            encoder_heads=1,
            decoder_dim=32,
            decoder_depth=4,
            decoder_heads=1,
            dpt_layer_dims=(4, 4, 4, 4),
            dpt_feature_dim=4,
            dpt_last_dims=(4, 4),
            local_hidden_dim=32,
            descriptor_dim=6,
        )
    )
    network.eval().requires_grad_(False)
    settings = Mast3rSettings(
        size=WIDTH,
        memory_mb=memory_mb,
        max_matches=max_matches,
        min_matches=1,
        max_error=1e9,
        min_confidence=0,
        matching=MatchingSettings(subsample=4),
    )
    rng = np.random.default_rng(0)
    texture = rng.random((HEIGHT, WIDTH + 4 * count, 3), np.float32)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = []
        for i in range(count):
            path = folder / "frames" / f"{i:05d}.png"
            images.write_rgb(path, texture[:, 4 * i : 4 * i + WIDTH])
            found.append(Frame(path.name, path, float(i), 1.0, "train"))
        seen = network_images(Frames(tuple(found), WIDTH, HEIGHT, True), settings)
        before, began = peak_mb(), time.process_time()
        said = run_pairs(network, seen, parse_graph("video"), settings, folder / "cache")
        looked, looked_peak = time.process_time(), peak_mb()
        rec = mast3r_backend._place(said, seen, settings, folder, lambda *_: None)
        done = time.process_time()
        return {
            "frames": count,
            "pairs": len(said.pairs),
            "matches": len(rec.matches.i),
            "before_mb": before,
            "pairs_mb": looked_peak,
            "peak_mb": peak_mb(),
            "held_at_once_mb": count * 7 * 8 * HEIGHT * WIDTH / 2**20,
            "pairs_s": looked - began,
            "placing_s": done - looked,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[50, 100, 200, 400, 800])
    parser.add_argument("--memory-mb", type=int, default=16)
    parser.add_argument("--max-matches", type=int, default=40_000)
    parser.add_argument("--one", type=int, default=0, help="for the processes this one starts")
    args = parser.parse_args()
    if args.one:
        print(json.dumps(run_one(args.one, args.memory_mb, args.max_matches)))
        return
    columns = ("frames", "pairs", "matches", "MB before", "MB after pairs", "MB at the end", "sums held at once, MB")
    print("| " + " | ".join((*columns, "ms per pair", "placing s")) + " |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for count in args.frames:
        command = [sys.executable, __file__, "--one", str(count), "--memory-mb", str(args.memory_mb)]
        command += ["--max-matches", str(args.max_matches)]
        told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
        r = json.loads(told)
        print(
            f"| {r['frames']} | {r['pairs']} | {r['matches']} | {r['before_mb']:.0f} | {r['pairs_mb']:.0f} | "
            f"{r['peak_mb']:.0f} | {r['held_at_once_mb']:.0f} | {1000 * r['pairs_s'] / r['pairs']:.0f} | "
            f"{r['placing_s']:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
