"""The dives that the small experiment learns from and is tested on: OUT/train, OUT/test.

    python benchmarks/learning/dives.py OUT [--train 48] [--test 8] [--frames 24] [--air FOLDER]

Every dive has a seafloor of its own and water drawn from one of the paper's four families in turn; `--air` adds
images taken in air with depth and poses, which get their water in training.
"""

import argparse
import shutil
from pathlib import Path

from swimm3r.synthetic import DiveSettings, write_dive
from swimm3r.water_types import FAMILIES

_TEST_SEEDS = 1000  # no test dive shares a seafloor with a training dive
_NOISE = 0.004


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--train", type=int, default=48)
    parser.add_argument("--test", type=int, default=8)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--height", type=int, default=96)
    parser.add_argument("--air", type=Path)
    args = parser.parse_args()
    families = list(FAMILIES)
    for part, count, first in (("test", args.test, _TEST_SEEDS), ("train", args.train, 1)):
        for k in range(count):
            family = families[k % len(families)]
            settings = DiveSettings(args.frames, args.width, args.height, seed=first + k, family=family, noise=_NOISE)
            write_dive(settings, args.out / part / f"{k:03d}_{family}")
            print(f"{part} {k + 1} of {count}", flush=True)
    if args.air:
        triple = args.out / "train" / args.air.name
        shutil.copytree(args.air / "images", triple / "clean", dirs_exist_ok=True)
        shutil.copytree(args.air / "depth_mm", triple / "depth_mm", dirs_exist_ok=True)
        shutil.copy(args.air / "cameras.json", triple / "cameras.json")


if __name__ == "__main__":
    main()
