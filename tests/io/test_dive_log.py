"""Depths over time of dive computers."""

from pathlib import Path

import numpy as np
import pytest

from swimm3r.errors import InputError
from swimm3r.io.navigation.read import read_navigation

SUBSURFACE = """<divelog program='subsurface' version='3'>
<settings></settings>
<dives>
<dive number='12' date='2023-07-04' time='11:02:30' duration='40:10 min'>
  <depth max='14.2 m' mean='8.1 m' />
  <divecomputer model='Suunto Vyper'>
  <sample time='0:10 min' depth='1.6 m' temp='24.0 C' />
  <sample time='0:20 min' depth='3.2 m' />
  <sample time='12:40 min' temp='22.0 C' />
  <sample time='12:50 min' depth='12.5 m' />
  </divecomputer>
</dive>
<dive number='13' date='2023-07-04' time='15:00:00'>
  <divecomputer model='other'>
  <sample time='0:30 min' depth='20 ft' />
  </divecomputer>
</dive>
<dive number='14' date='2023-07-05' time='09:00:00'><notes>by hand</notes></dive>
</dives>
</divelog>
"""
NOON = 1_688_468_550.0  # 2023-07-04 11:02:30 UTC


def written(folder: Path, text: str, name: str = "log.ssrf") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_all_dives_of_subsurface_are_read_in_metres_and_seconds(tmp_path: Path):
    found = read_navigation(written(tmp_path, SUBSURFACE))
    np.testing.assert_allclose(found.time - NOON, [10, 20, 770, 14_280])
    np.testing.assert_allclose(found.position[:, 2], [-1.6, -3.2, -12.5, -20 * 0.3048])
    assert found.clock == "utc"
    assert found.std is not None
    assert np.isinf(found.std[:, :2]).all()
    np.testing.assert_allclose(found.std[:, 2], 0.1)


def test_a_table_of_times_and_depths_says_nothing_of_east_and_north(tmp_path: Path):
    found = read_navigation(written(tmp_path, "time [s],depth [ft]\n0,10\n2,\n4,20\n", "log.csv"))
    np.testing.assert_allclose(found.time, [0, 4])
    np.testing.assert_allclose(found.position[:, 2], [-3.048, -6.096])
    assert found.clock == "clip"
    assert found.std is not None
    assert np.isinf(found.std[:, :2]).all()


def test_a_table_of_pressures_is_in_depths_of_the_sea(tmp_path: Path):
    found = read_navigation(written(tmp_path, "time,pressure [dbar]\n0,0\n1,100\n", "log.csv"))
    assert found.position[1, 2] == pytest.approx(-99.2, abs=0.3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<divelog><dives><dive number='1'></dive></dives></divelog>", "no dive with a date and a depth profile"),
        (SUBSURFACE[:600], "its XML ends or breaks"),
        (SUBSURFACE.replace("3.2 m", "3.2 fathoms"), "is no depth in metres or feet"),
        (SUBSURFACE.replace("0:20 min", "soon"), "is no time of a sample"),
        ('<!DOCTYPE x [<!ENTITY a "b">]>' + SUBSURFACE, "it defines entities"),
    ],
)
def test_a_log_that_cannot_be_used_is_refused_with_its_fault(tmp_path: Path, text: str, words: str):
    with pytest.raises(InputError, match=words):
        read_navigation(written(tmp_path, text))


def test_depths_without_times_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no times"):
        read_navigation(written(tmp_path, "depth\n1\n2\n", "log.csv"))
