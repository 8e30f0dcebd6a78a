"""Wall-clock and processor time of the parts of a run, on one thread and on several.

    python benchmarks/threads.py SOURCE --out DIR [--threads 1 2] [--preset fast] [--last-stage eval]

SOURCE is a clip or a dive that `swimm3r demo` made (DIR-dive). It is run once for each number of threads, in a process
of its own, after a run of 20 training steps that compiles the kernels. A part lasts from one name that the progress
shows to the next; parts below half a second are summed up as the rest. The gain is the wall time on the fewest threads
divided by that on the most: parts where it stays near 1 do not scale.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from swimm3r.pipeline.presets import PRESETS, Preset
from swimm3r.pipeline.run import run_pipeline
from swimm3r.tasks.threads import thread_variables

LEAST = 0.5  # seconds on the fewest threads


class Parts:
    """Times by the names of a progress: a part lasts until another one is shown."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {}
        self._part, self._since = "start", self._now()

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()

    def __call__(self, what: str, done: int, total: int, /) -> None:
        part = what.split(",")[0]  # without the number of a round
        if part != self._part:
            self.end(part)

    def end(self, following: str = "end") -> None:
        """Add the time since the last change to the current part."""
        wall, cpu = self._now()
        spent = self.seconds.setdefault(self._part, [0.0, 0.0])
        spent[0] += wall - self._since[0]
        spent[1] += cpu - self._since[1]
        self._part, self._since = following, (wall, cpu)


def measured(source: Path, out: Path, preset: Preset, last_stage: str, iterations: int | None) -> dict:
    """Seconds (wall, processor) of the parts of one run in this process."""
    settings = PRESETS[preset]
    if iterations is not None:
        settings = replace(settings, splat=replace(settings.splat, iterations=iterations))
    parts = Parts()
    run_pipeline(source, out, settings, last_stage=last_stage, progress=parts)
    parts.end()
    return parts.seconds


def in_a_process(arguments: argparse.Namespace, out: Path, threads: int, iterations: int | None) -> dict:
    """The same in a process with so many threads."""
    command = [sys.executable, __file__, str(arguments.source), "--out", str(out), "--preset", arguments.preset]
    command += ["--last-stage", arguments.last_stage, "--measure"]
    if iterations is not None:
        command += ["--iterations", str(iterations)]
    environment = os.environ | thread_variables(threads)
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def table(times: dict[int, dict[str, list[float]]]) -> str:
    """The parts of all runs, in the order of the work."""
    fewest, most = min(times), max(times)
    counts = sorted(times)
    heads = ["part", *(f"{n} thread{'s' * (n > 1)}: wall, CPU s" for n in counts), "gain"]
    rows, rest = [], {n: [0.0, 0.0] for n in counts}
    for part, (wall, _) in times[fewest].items():
        spent = {n: times[n].get(part, [0.0, 0.0]) for n in counts}
        if wall < LEAST:
            rest = {n: [a + b for a, b in zip(rest[n], spent[n], strict=True)] for n in counts}
            continue
        rows.append((part, spent))
    total = {n: [sum(values) for values in zip(*times[n].values(), strict=True)] for n in counts}
    lines = [heads, ["---"] * len(heads)]
    for part, spent in [*rows, ("rest", rest), ("all", total)]:
        gain = spent[fewest][0] / max(spent[most][0], 1e-9)
        lines.append([part, *(f"{spent[n][0]:.1f}, {spent[n][1]:.1f}" for n in counts), f"{gain:.2f}"])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder that receives the runs")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--preset", choices=["fast", "default", "best", "paper"], default="fast")
    parser.add_argument("--last-stage", choices=["prepare", "sfm", "splat", "eval"], default="eval")
    parser.add_argument("--iterations", type=int, help="training steps instead of the preset's")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        seconds = measured(
            arguments.source, arguments.out, arguments.preset, arguments.last_stage, arguments.iterations
        )
        print(json.dumps(seconds))
        return
    in_a_process(arguments, arguments.out / "compiled", max(arguments.threads), 20)
    print(
        table({n: in_a_process(arguments, arguments.out / str(n), n, arguments.iterations) for n in arguments.threads})
    )


if __name__ == "__main__":
    main()
