"""Cost of the full-size MASt3R network: CPU seconds per encoding, pair and head, and memory; weights are random.

    python benchmarks/mast3r.py [--device cpu|cuda|mps] [--dtypes float32 bfloat16] [--height 384 --width 512]

A symmetric pair is two decoder passes and four heads. `per pair` encodes both images of every pair anew, `per image`
once and keeps them; the ratio is for a sequence in which every image is in `--degree` pairs.
"""

import argparse
import resource
import time
from collections.abc import Callable

import torch

from swimm3r.sfm.mast3r.network import Architecture, Mast3r


def random_network(device: torch.device) -> Mast3r:
    """The published sizes with weights of a sane scale, so that nothing overflows or turns denormal."""
    with torch.device("meta"):
        model = Mast3r(Architecture())
    model.to_empty(device=device)
    generator = torch.Generator(device).manual_seed(0)
    with torch.no_grad():
        for p in model.parameters():
            if p.ndim > 1:
                p.normal_(0, p[0].numel() ** -0.5, generator=generator)
            else:
                p.fill_(0)
        for module in model.modules():
            if isinstance(module, torch.nn.LayerNorm):
                module.weight.fill_(1)
    return model.eval().requires_grad_(False)


def seconds(work: Callable[[], object], device: torch.device, repeats: int) -> float:
    """CPU seconds on the CPU, wall seconds elsewhere."""

    def now() -> float:
        if device.type == "cpu":
            return time.process_time()
        torch.cuda.synchronize() if device.type == "cuda" else torch.mps.synchronize()
        return time.perf_counter()

    if device.type != "cpu":
        work()  # kernels are chosen at the first call
    start = now()
    for _ in range(repeats):
        work()
    return (now() - start) / repeats


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtypes", nargs="+", default=["float32", "bfloat16"])
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--degree", type=int, default=8, help="pairs each image is in")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    device = torch.device(args.device)
    model = random_network(device)
    generator = torch.Generator().manual_seed(1)
    images = torch.rand(2, 1, 3, args.height, args.width, generator=generator).to(device) * 2 - 1
    print(f"{args.height} x {args.width}, {device}, {args.threads} threads, torch {torch.__version__}")
    for name in args.dtypes:
        model.set_precision(getattr(torch, name))
        one, two = (model.encode(image) for image in images)
        view, _ = model.decode(one, two)
        cost = {
            "encode": seconds(lambda: model.encode(images[0]), device, args.repeats),
            "decode": seconds(lambda one=one, two=two: model.decode(one, two), device, args.repeats),
            "pointmap head": seconds(lambda view=view: model.pointmap(view, 1), device, args.repeats),
            "descriptor head": seconds(lambda view=view: model.descriptors(view, 1), device, args.repeats),
        }
        pair = 2 * cost["decode"] + 4 * (cost["pointmap head"] + cost["descriptor head"])
        per_pair = pair + 2 * cost["encode"]
        per_image = pair + 2 * cost["encode"] / args.degree
        print(name, *(f"{what} {value:.2f} s" for what, value in cost.items()), sep="  ")
        print(
            f"  symmetric pair {pair:.2f} s; with encoding per pair {per_pair:.2f} s, per image {per_image:.2f} s: ",
            end="",
        )
        print(f"{per_pair / per_image:.2f} times")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of the process {peak:.0f} MB", end="")
    print(f", of the device {torch.cuda.max_memory_allocated() / 2**20:.0f} MB" if device.type == "cuda" else "")


if __name__ == "__main__":
    main()
