"""GPMF payloads that the tests write, and those of real cameras, are read with their scale, axes and times."""

import csv
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from swimm3r.cli.main import main
from swimm3r.errors import InputError
from swimm3r.io.telemetry.klv import numbers, parse, text, texts
from swimm3r.io.telemetry.read import read_telemetry, write_csv
from swimm3r.io.telemetry.streams import Payload, streams_of


def element(key: str, kind: str, rows: list, size: int | None = None) -> bytes:
    """An element with one sample per row; a row is bytes or what struct packs with the format before it."""
    samples = [row if isinstance(row, bytes) else struct.pack(">" + row[0], *row[1:]) for row in rows]
    size = len(samples[0]) if size is None else size
    data = b"".join(samples)
    head = key.encode() + (b"\0" if not kind else kind.encode()) + struct.pack(">BH", size, len(samples))
    return head + data + b"\0" * (-len(data) % 4)


def nest(key: str, *children: bytes) -> bytes:
    data = b"".join(children)
    return key.encode() + b"\0" + struct.pack(">BH", 1, len(data)) + data


def device(*streams: bytes, name: bytes = b"HERO") -> bytes:
    return nest("DEVC", element("DVID", "L", [("L", 1)]), element("DVNM", "c", [name], len(name)), *streams)


def shorts(*rows: tuple[int, ...]) -> list:
    return [(f"{len(row)}h", *row) for row in rows]


def one(*about: bytes):
    """The stream of a single payload."""
    (stream,), _, damaged = streams_of([Payload(0.0, 1.0, device(nest("STRM", *about)))])
    assert damaged == 0
    return stream


@pytest.mark.parametrize(
    ("kind", "form", "values"),
    [
        ("b", "b", (-128, 127)),
        ("B", "B", (0, 255)),
        ("s", "h", (-32768, 32767)),
        ("S", "H", (0, 65535)),
        ("l", "i", (-(2**31), 2**31 - 1)),
        ("L", "I", (0, 2**32 - 1)),
        ("f", "f", (-0.5, 1.25)),
        ("d", "d", (-1e-300, 3.141592653589793)),
        ("J", "Q", (0, 2**53)),
        ("j", "q", (-(2**53), 5)),
    ],
)
def test_numbers_of_every_type_come_back(kind: str, form: str, values: tuple):
    (found,) = parse(element("DATA", kind, [(form, value) for value in values]))
    assert numbers(found).tolist() == [[value] for value in values]


def test_fixed_point_numbers_are_divided():
    whole = parse(element("ONEQ", "q", [("i", 3 << 15)]) + element("TWOQ", "Q", [("q", -(1 << 31))]))
    assert [numbers(found).tolist() for found in whole] == [[[1.5]], [[-0.5]]]


def test_elements_are_aligned_to_four_bytes_and_characters_are_text():
    first, second = parse(element("STNM", "c", [b"gyro "], 5) + element("UNIT", "c", [b"deg", b"m\0\0"]))
    assert (text(first), texts(second)) == ("gyro", ("deg", "m"))
    assert numbers(first) is None


def test_samples_of_several_types_follow_their_list():
    rows = [("iiHB", -7, 8, 9, 10), ("iiHB", 1, 2, 3, 4)]
    (found,) = parse(element("GPS9", "?", rows))
    expected = [[-7, 8, 9, 10], [1, 2, 3, 4]]
    assert numbers(found, "llSB").tolist() == expected
    assert numbers(found, "l[2]SB").tolist() == expected
    assert numbers(found, "lFB") is None
    with pytest.raises(ValueError, match="GPS9"):
        numbers(found, "ll")


def test_every_cut_of_a_payload_is_refused_or_shorter():
    whole = device(nest("STRM", element("SHUT", "f", [("f", 0.5)] * 3)))
    for end in range(1, len(whole)):
        with pytest.raises(ValueError, match=r"needs|header|begins"):
            parse(whole[:end])
    assert len(parse(whole)) == 1


def test_bytes_that_are_no_elements_and_bottomless_nests_are_refused():
    with pytest.raises(ValueError, match="begins no element"):
        parse(b"\x01\x02\x03\x04" + bytes(8))
    deep = b""
    for _ in range(100):
        deep = nest("DEVC", deep)
    with pytest.raises(ValueError, match="deep"):
        parse(deep)


def test_a_scale_divides_all_channels_or_each_its_own():
    data = element("DATA", "s", shorts((100, 200), (300, 400)))
    np.testing.assert_allclose(one(element("SCAL", "s", shorts((10,))), data).values, [[10, 20], [30, 40]])
    both = element("SCAL", "s", shorts((10,), (100,)))
    np.testing.assert_allclose(one(both, data).values, [[10, 2], [30, 4]])


def test_axes_are_put_in_order_and_turned_by_letters():
    data = element("ACCL", "s", shorts((1, 2, 3)))
    assert one(data).values.tolist() == [[2, 3, 1]]  # HERO5 to HERO7 do not state Z, X, Y
    assert one(element("ORIN", "c", [b"YxZ"], 3), data).values.tolist() == [[-2, 1, 3]]
    assert one(element("ORIN", "c", [b"YxZ"], 3), data).channels == ("X", "Y", "Z")


def test_a_matrix_gives_the_axes_of_the_output():
    about = (element("ORIN", "c", [b"YxZ"], 3), element("ORIO", "c", [b"ZXY"], 3))
    matrix = element("MTRX", "f", [("9f", 0, 0, 1, 0, -1, 0, 1, 0, 0)])
    assert one(*about, matrix, element("GYRO", "s", shorts((1, 2, 3)))).values.tolist() == [[-2, 1, 3]]


def test_samples_are_spread_between_the_payloads_and_over_the_last_at_the_same_rate():
    packets = [
        Payload(float(k), 1.0, device(nest("STRM", element("ISOE", "S", [("H", 100 + k)] * count))))
        for k, count in enumerate((4, 4, 2))
    ]
    (stream,), _, _ = streams_of(packets)
    np.testing.assert_allclose(stream.time, np.arange(10) / 4)
    assert stream.rate == pytest.approx(4.0)


def test_the_camera_clock_sets_apart_payloads_that_were_late_in_the_track():
    packets = [
        Payload(begin, 1.0, device(nest("STRM", element("STMP", "J", [("Q", clock)]), *[
            element("SHUT", "f", [("f", 0.01)] * 2)
        ])))
        for begin, clock in ((0.0, 50_000_000), (1.3, 51_000_000), (2.0, 52_000_000))
    ]  # fmt: skip
    (stream,), _, _ = streams_of(packets)
    np.testing.assert_allclose(stream.time, np.arange(6) / 2, atol=1e-9)


def test_devices_of_one_file_keep_their_own_streams_and_temperatures(tmp_path: Path):
    accelerometer = nest("STRM", element("TMPC", "f", [("f", 21.5)]), element("ACCL", "s", shorts((1, 2, 3))))
    payload = device(accelerometer) + device(nest("STRM", element("ACCL", "s", shorts((4, 5, 6)))), name=b"DRON")
    packets = [Payload(0.0, 1.0, payload)]
    streams, _, _ = streams_of(packets)
    assert [(s.device, s.key) for s in streams] == [("HERO", "ACCL.TMPC"), ("HERO", "ACCL"), ("DRON", "ACCL")]
    path = write_clip(tmp_path / "two.mp4", [payload])
    names = [file.name for file in write_csv(tmp_path, read_telemetry(path))]
    assert names == ["ACCL.TMPC.csv", "ACCL.csv", "ACCL-2.csv"]


def write_clip(path: Path, payloads: list[bytes], **options: str) -> Path:
    """A video of a second per payload with a telemetry track."""
    with av.open(str(path), "w", options=options) as file:
        video = file.add_stream("mpeg4", rate=10)
        video.width = video.height = 64
        video.pix_fmt = "yuv420p"
        track = file.add_data_stream("bin_data") if payloads else None
        for k in range(10 * max(len(payloads), 1)):
            frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 5 * (k % 40) + 20, np.uint8), format="rgb24")
            frame.pts = k
            file.mux(video.encode(frame))
        file.mux(video.encode())
        for k, payload in enumerate(payloads):
            packet = av.Packet(payload)
            assert track is not None
            packet.stream, packet.time_base = track, Fraction(1, 1000)
            packet.pts = packet.dts = 1000 * k
            packet.duration = 1000
            file.mux(packet)
    return path


def gravity(k: int) -> bytes:
    values = element("GRAV", "s", shorts(*[(0, 32767, i) for i in range(k, k + 10)]))
    return device(nest("STRM", element("SCAL", "s", shorts((32767,))), values))


def test_a_video_gives_the_samples_that_were_written_and_csv_files_hold_them(tmp_path: Path, capsys):
    path = write_clip(tmp_path / "clip.mp4", [gravity(0), gravity(10), gravity(20)])
    (stream,) = read_telemetry(path).streams
    np.testing.assert_allclose(stream.values[:, 2] * 32767, np.arange(30))
    np.testing.assert_allclose(stream.time, np.arange(30) / 10, atol=1e-9)
    main(["telemetry", str(path), "--csv", str(tmp_path / "tables")])
    assert "GRAV    1     30       10" in capsys.readouterr().out
    with (tmp_path / "tables" / "GRAV.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time [s]", "X [1]", "Z [1]", "Y [1]"]
    np.testing.assert_allclose(np.array(rows[1:], float)[:, 1:], stream.values, rtol=1e-11)


def test_a_damaged_payload_is_passed_over_with_a_warning(tmp_path: Path):
    path = write_clip(tmp_path / "clip.mp4", [gravity(0), gravity(10)[:-9], gravity(20)])
    found = read_telemetry(path)
    assert len(found.streams[0]) == 20
    np.testing.assert_allclose(found.streams[0].time[10], 2.0)
    assert "1 of 3 payloads" in found.warnings[0]


def test_a_file_that_was_cut_off_gives_what_is_there_and_says_so(tmp_path: Path):
    path = write_clip(tmp_path / "clip.mp4", [gravity(10 * k) for k in range(8)], movflags="faststart")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = read_telemetry(path)
    assert 10 <= len(found.streams[0]) < 80
    assert "should hold 8 payloads" in found.warnings[-1]
    assert found.streams[0].rate == pytest.approx(10.0)


def test_what_holds_no_telemetry_is_refused_with_advice(tmp_path: Path, capsys):
    plain = write_clip(tmp_path / "plain.mp4", [])
    write_clip(tmp_path / "broken.mp4", [gravity(0)[:-9]])
    (tmp_path / "cut.mp4").write_bytes(plain.read_bytes()[:300])
    (tmp_path / "text.mp4").write_text("no video\n" * 50)
    (tmp_path / "empty.mp4").touch()
    for name, why in (
        ("plain.mp4", "holds no telemetry"),
        ("broken.mp4", "1 of 1 payloads are damaged"),
        ("cut.mp4", "cannot be read as a video"),
        ("text.mp4", "cannot be read as a video"),
        ("empty.mp4", "cannot be read as a video"),
        ("missing.mp4", "missing.mp4"),
        (".", "folder"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["telemetry", str(tmp_path / name)])
        told = capsys.readouterr().err
        assert stop.value.code == InputError.exit_code, name
        assert why in told, told
        assert "Try:" in told, told


@pytest.mark.shared
def test_a_hero10_clip_has_the_counts_rates_and_values_that_other_readers_find(shared: Path):
    found = read_telemetry(shared / "data" / "gopro_reef" / "reef.mp4")
    counts = {stream.key: len(stream) for stream in found.streams}
    expected = dict.fromkeys(("GRAV", "CORI", "IORI", "SHUT", "ISOE"), 210)
    expected |= {"ACCL": 1397, "GYRO": 1397, "ACCL.TMPC": 7, "GYRO.TMPC": 7, "GPS5": 127, "WBAL": 70, "WRGB": 70}
    assert {key: counts[key] for key in expected} == expected
    rates = {stream.key: stream.rate for stream in found.streams}
    assert rates["ACCL"] == pytest.approx(199.4, abs=0.5)
    assert rates["GRAV"] == pytest.approx(30000 / 1001, abs=0.01)
    accelerometer, up = found.stream("ACCL"), found.stream("GRAV")
    np.testing.assert_allclose(accelerometer.values[0], np.array([201, 1487, 3943]) / 417)
    assert accelerometer.units == ("m/s²",) * 3
    np.testing.assert_allclose(up.values[0], np.array([1826, 30634, 11483]) / 32767)
    at_rest = np.median(accelerometer.values, 0)[[0, 2, 1]]  # the order of GRAV
    np.testing.assert_allclose(at_rest / np.linalg.norm(at_rest), np.median(up.values, 0), atol=0.04)
    assert found.stream("SHUT").values[0, 0] == pytest.approx(1 / 239.9, rel=1e-3)
    assert found.warnings == ()


@pytest.mark.shared
def test_a_karma_clip_keeps_camera_and_drone_apart(shared: Path):
    found = read_telemetry(shared / "data" / "gopro_telemetry" / "karma.mp4")
    camera = {s.key: (len(s), round(s.rate, 1)) for s in found.streams if s.device == "Camera"}
    assert camera["ACCL"] == (2397, 198.4)
    assert camera["GYRO"] == (4795, 396.9)
    assert camera["SHUT"] == camera["ISOG"] == (361, 29.9)
    np.testing.assert_allclose(found.stream("ACCL").values[0], np.array([-356, -1547, 4246]) / 418)
    drone = found.stream("GPRI")  # of several types with a scale of each channel
    assert drone.device == "GoPro Karma v1.0"
    np.testing.assert_allclose(drone.values[0, 1:3], [33.1253680, -117.3310641], atol=1e-6)
