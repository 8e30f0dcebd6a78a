"""`swimm3r doctor --selftest`: kernels against their references, and what is said of one that is wrong."""

import pytest

from swimm3r import selftest
from swimm3r.cli.main import main
from swimm3r.selftest.checks import Check, check_kernels
from swimm3r.selftest.speed import SIZES, Speed, Times


def speeds() -> list[Speed]:
    return [Speed("cpu", SIZES["S"], Times(1.0, 2.0, 3.0, 6.0), 0.5, 0.61)]


def test_every_kernel_of_this_computer_agrees_with_its_reference():
    found = list(check_kernels())
    assert {"rasterizer, Beta kernels: gradients", "projection with time: gradients", "plane sweep: depth"} <= {
        check.kernel for check in found
    }
    assert [check for check in found if not check.passed] == []
    assert all(check.error > 0 for check in found)  # two different computations


@pytest.mark.parametrize("error", [1.0, float("nan")])
def test_a_wrong_kernel_is_named_and_ends_with_the_code_of_devices(
    error: float, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    checks = [Check("image loss: value", "cpu", 1e-9, 1e-5), Check("projection: primitives", "cuda", error, 1e-5)]
    monkeypatch.setattr(selftest, "check_kernels", lambda: iter(checks))
    monkeypatch.setattr(selftest, "measure_speed", lambda: iter(speeds()))
    with pytest.raises(SystemExit) as stop:
        main(["doctor", "--selftest"])
    shown = capsys.readouterr()
    assert stop.value.code == 5
    assert "projection: primitives (cuda)" in shown.err
    assert "image loss" not in shown.err
    assert shown.out.count("WRONG") == 1
    assert "0.50 of 1e9 FMAs, 0.61 in the documents" in shown.out
