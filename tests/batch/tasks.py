"""A task of a batch that processes elsewhere can import: it is killed, fails or leaves a file."""

import os
import signal
from pathlib import Path

from swimm3r.batch.dive import Dive
from swimm3r.errors import InputError


def finish_or_fail(dive: Dive, *, out: Path, **_: object) -> None:
    """The task of a dive, by the dive's name; the first attempt at `killed` is killed."""
    (out / dive.name).mkdir(exist_ok=True)
    if dive.name == "killed" and len(list((out / dive.name).iterdir())) == 0:
        (out / dive.name / "tried").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if dive.name == "gone":
        raise InputError("there is no nowhere", cause="a slip", hint="another name")
    (out / dive.name / "done").touch()
