"""A protocol's name says what differs from the run's own, and fits a folder."""

from dataclasses import replace
from pathlib import Path

from swimm3r.pipeline.scores.scoring import Protocol
from swimm3r.splat.settings import PoseRefinementSettings

OWN = Protocol(PoseRefinementSettings(steps=300, long_side=320))


def test_the_runs_own_protocol_has_no_name_beside_it():
    assert Protocol(PoseRefinementSettings(steps=300, long_side=320)).key_beside(OWN) == ""


def test_what_differs_is_named():
    fewer = replace(OWN, test=replace(OWN.test, steps=20))
    assert fewer.key_beside(OWN) == "steps-20"
    assert replace(OWN, test=replace(fewer.test, long_side=80)).key_beside(OWN) == "steps-20_long-side-80"


def test_references_of_one_name_are_told_apart():
    names = {
        Protocol(OWN.test, Path(folder) / "cameras.json").key_beside(OWN) for folder in ("a", "b", "../../c", "/d e")
    }
    assert len(names) == 4
    assert all(name.startswith("reference-cameras-") and "/" not in name for name in names)
    assert OWN.key_beside(Protocol(OWN.test, Path("a/cameras.json"))) == "no-reference"
