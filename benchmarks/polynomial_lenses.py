"""Lenses of COLMAP's models against polynomials: errors of observations that were left out of the adjustment.

    python benchmarks/polynomial_lenses.py RUN...

RUN are folders with finished structure from motion of frames as filmed (`--rectify keep`).
"""

import argparse
from pathlib import Path

import pycolmap

from swimm3r.io.colmap.model import silence_log
from swimm3r.sfm.colmap.calibration.polynomial import errors_left_out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    runs = parser.parse_args().runs
    silence_log()
    print("| run | frames | own lens | third degree | fifth degree |\n| --- | --- | --- | --- | --- |")
    for run in runs:
        model = pycolmap.Reconstruction(run / "sfm" / "sparse")
        errors = errors_left_out(model)
        told = " | ".join(["fisheye"] * 3 if errors is None else [f"{error:.3f} px" for error in errors.values()])
        print(f"| {run.name} | {model.num_reg_images()} | {told} |", flush=True)


if __name__ == "__main__":
    main()
