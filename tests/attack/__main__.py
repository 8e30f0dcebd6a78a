"""Runs the attack: `python -m tests.attack [FAMILY ...] [--only TEXT]`; exit 1 where a case falls short."""

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from tests.attack import foreign, outputs, runs, sources, values
from tests.attack.harness import build_fixture, run_case

FAMILIES = {"runs": runs, "foreign": foreign, "outputs": outputs, "sources": sources, "values": values}


def main() -> None:
    """Run every case of the chosen families and print those that fall short."""
    parser = argparse.ArgumentParser(prog="python -m tests.attack", description=__doc__)
    parser.add_argument("families", nargs="*", help=f"{', '.join(FAMILIES)}; all by default")
    parser.add_argument("--only", default="", help="run the cases whose name holds this text")
    parser.add_argument("--fixture", type=Path, default=Path(tempfile.gettempdir()) / "swimm3r-attack")
    options = parser.parse_args()
    _warm_up()
    options.fixture.mkdir(parents=True, exist_ok=True)
    options.fixture.chmod(0o777)
    fixture = build_fixture(options.fixture)
    short = total = 0
    for family in options.families or FAMILIES:
        for case in FAMILIES[family].cases(fixture):
            if options.only not in f"{family}/{case.name}":
                continue
            ended = run_case(case, options.fixture)
            total += 1
            if ended.faults:
                short += 1
                print(f"- {family}/{case.name}: {'; '.join(ended.faults)}\n    swimm3r {' '.join(case.arguments)}")
                print("    " + "\n    ".join(ended.output.strip().splitlines()[-4:]), flush=True)
    print(f"{total} cases, {short} fell short")
    sys.exit(bool(short))


def _warm_up() -> None:
    """Import once what every case would import again."""
    import numba
    import pycolmap
    import torch

    import swimm3r.cli.main  # noqa: F401

    torch.set_num_threads(1)
    del numba, pycolmap


if __name__ == "__main__":
    main()
