"""Every numeric setting of every command, just outside its range: refused before any work, with the range named.

The settings are found by walking the dataclasses that the command line is made from, so a new one is attacked, too.
"""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import partial

from tests.attack.harness import Case, Fixture
from tests.attack.outputs import _with_copy

BAD = {float: ("nan", "inf", "-1e30"), int: ("-1000000", "1e300", "nan")}


def cases(fixture: Fixture) -> Iterator[Case]:
    """The settings of `run`, then the arguments of single commands."""
    from swimm3r.pipeline.presets import PRESETS

    fast = PRESETS["fast"]
    groups = {"": fast.frames, "splat": fast.splat, "test": fast.test}
    for prefix, settings in (*groups.items(), ("", fast.sfm)):
        for name, value in _numbers(settings):
            option = f"--{prefix}.{name}" if prefix else f"--{name}"
            for bad in BAD[type(value)]:
                arguments = (
                    "run",
                    str(fixture.dive),
                    "--out",
                    "out",
                    "--preset",
                    "fast",
                    option.replace("_", "-"),
                    bad,
                )
                yield Case(f"run{option}={bad}", arguments, (2,), seconds=60)
    copied = partial(_with_copy, fixture, lambda d: None, True)
    frame = next(p for p in sorted((fixture.run / "prepare").rglob("*")) if p.suffix in (".png", ".jpg"))
    for arguments in (
        ("render", "copy", "--long-side", "{}"),
        ("render", "copy", "--count", "{}"),
        ("render", "copy", "--time", "{}"),
        ("export", "copy", "--time", "{}"),
        ("eval", "copy", "--steps", "{}"),
        ("localize", "copy", str(frame), "--max-error", "{}"),
        ("localize", "copy", str(frame), "--rounds", "{}"),
        ("localize", "copy", str(frame), "--border", "{}"),
        ("localize", "copy", str(frame), "--min-alpha", "{}"),
    ):
        for bad in ("-1", "nan", "inf", "x", "99999999999999999999999999"):
            name = f"{arguments[0]}{arguments[-2]}={bad}"
            legal = arguments[0] in ("render", "export") and arguments[-2] == "--time"
            yield Case(name, tuple(word.format(bad) for word in arguments), (0, 2, 3) if legal else (2, 3), copied)
    demo = ("demo", "--out", "run")
    for option in ("--frames", "--width", "--height", "--seed", "--noise", "--caustics"):
        for bad in ("-1", "nan", "inf", "99999999999999999999999999"):
            yield Case(f"demo{option}={bad}", (*demo, option, bad), (2,), lambda folder: None, seconds=60)


def _numbers(settings: object, prefix: str = "") -> Iterator[tuple[str, int | float]]:
    for field in fields(settings):  # pyright: ignore[reportArgumentType]
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from _numbers(value, f"{prefix}{field.name}.")
        elif type(value) in (int, float):
            yield f"{prefix}{field.name}", value
