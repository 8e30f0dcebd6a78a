"""Arrays of an archive, as they were written or not at all."""

import gc
import io
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from swimm3r.errors import InputError
from swimm3r.io.files.array_file import Layout, read_arrays, read_npy, read_npz, write_arrays
from swimm3r.io.files.damage import remake

LAYOUTS = {"i": Layout("m", "int"), "xy": Layout("m 2"), "seen": Layout("m", finite=False)}
GOOD = {"i": np.arange(3), "xy": np.ones((3, 2), np.float32), "seen": np.array([1.0, np.nan, np.inf])}


def claiming(shape: tuple[int, ...]) -> bytes:
    """An .npy whose header claims more than follows."""
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return out.getvalue() + b"\0" * 24


@pytest.mark.parametrize("write", [np.savez_compressed, write_arrays])
def test_what_was_written_is_read(write, tmp_path: Path):
    write(tmp_path / "a.npz", **GOOD, more=np.zeros(1))
    found = read_arrays(tmp_path / "a.npz", LAYOUTS, remake(tmp_path))
    assert found.keys() == GOOD.keys()
    for name, values in GOOD.items():
        np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"i": None}, "no array i"),
        ({"i": np.arange(3.0)}, "i holds float64, and int is expected"),
        ({"xy": np.ones((3, 2), int)}, "xy holds int64, and float is expected"),
        ({"xy": np.array([["a", "b"]] * 3)}, "xy holds <U1"),
        ({"xy": np.ones((2, 2))}, "3 is expected for m"),
        ({"xy": np.ones((3, 3))}, "2 is expected for 2"),
        ({"xy": np.ones(3)}, "xy has 1 axes, and 2"),
        ({"xy": np.full((3, 2), np.nan)}, "xy has values that are not finite"),
        ({"xy": np.array([[{"a": 1}] * 2] * 3, object)}, "pickled objects"),
    ],
)
def test_other_arrays_are_refused(tmp_path: Path, change: dict, said: str):
    np.savez(tmp_path / "a.npz", **{k: v for k, v in {**GOOD, **change}.items() if v is not None})
    with pytest.raises(InputError, match=said) as raised:
        read_arrays(tmp_path / "a.npz", LAYOUTS, remake(tmp_path))
    assert "a.npz is damaged (" in raised.value.what


def test_an_array_that_claims_a_terabyte_is_refused_without_asking_for_it(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("xy.npy", claiming((1 << 38, 2)))
    with pytest.raises(InputError, match="xy is cut off"):
        read_arrays(tmp_path / "a.npz", {"xy": LAYOUTS["xy"]}, remake(tmp_path))


@pytest.mark.parametrize("share", [0, 0.3, 0.9])
def test_a_cut_archive_is_refused(tmp_path: Path, share: float):
    np.savez_compressed(tmp_path / "a.npz", **GOOD)
    data = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match="is damaged"):
        read_arrays(tmp_path / "a.npz", LAYOUTS, remake(tmp_path))


def test_any_flipped_byte_gives_the_arrays_or_an_error(tmp_path: Path):
    np.savez_compressed(tmp_path / "a.npz", **GOOD)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    for at in range(0, len(data), 3):
        flipped = bytes(data[:at]) + bytes([data[at] ^ 0xFF]) + bytes(data[at + 1 :])
        (tmp_path / "a.npz").write_bytes(flipped)
        try:
            found = read_arrays(tmp_path / "a.npz", LAYOUTS, remake(tmp_path))
        except InputError:
            continue
        np.testing.assert_array_equal(found["i"], GOOD["i"])  # a byte that nothing depends on


def test_arrays_of_any_shape_keep_order_and_kind(tmp_path: Path):
    columns = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    arrays = {"columns": columns, "none": np.ones((0, 3)), "text": np.array("a")}
    np.savez(tmp_path / "a.npz", **arrays)
    np.save(tmp_path / "a.npy", columns)
    for found in (read_npz(tmp_path / "a.npz"), read_npz(tmp_path / "a.npz", *arrays)):
        assert found.keys() == arrays.keys()
        for name, values in arrays.items():
            np.testing.assert_array_equal(found[name], values)
            assert found[name].dtype == values.dtype
            assert found[name].flags.writeable
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), columns)
    with pytest.raises(ValueError, match="it has no array depth"):
        read_npz(tmp_path / "a.npz", "depth")


class Garbage:
    """Lets other threads run while it is collected, as tensors do."""

    def __init__(self) -> None:
        self.cycle = self

    def __del__(self) -> None:
        time.sleep(1e-5)


@pytest.fixture
def frequent_collection():
    before = gc.get_threshold()
    gc.set_threshold(20, 5, 5)
    yield
    gc.set_threshold(*before)


@pytest.mark.usefixtures("frequent_collection")
def test_threads_read_at_once(tmp_path: Path):
    write_arrays(tmp_path / "a.npz", **GOOD)
    np.save(tmp_path / "a.npy", GOOD["xy"])

    def read(_: int) -> int:
        Garbage()
        read_npy(tmp_path / "a.npy")
        return len(read_arrays(tmp_path / "a.npz", LAYOUTS, remake(tmp_path)))

    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(read, range(400))) == {3}
