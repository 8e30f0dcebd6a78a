"""Navigation files: every format gives the positions it was written with, and every bad one is refused by name."""

from pathlib import Path

import numpy as np
import pytest

from swimm3r.errors import InputError
from swimm3r.io.navigation.clock import seconds_of, seconds_of_date, seconds_of_name
from swimm3r.io.navigation.columns import column
from swimm3r.io.navigation.pressure import depth_of_pressure
from swimm3r.io.navigation.read import read_navigation
from swimm3r.io.navigation.record import vehicle_attitude

T0 = 1_554_350_888.0  # 2019-04-04 04:08:08 UTC


def written(folder: Path, text: str, name: str = "nav.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def refused(folder: Path, text: str, name: str = "nav.csv") -> str:
    with pytest.raises(InputError) as told:
        read_navigation(written(folder, text, name))
    assert name in told.value.what
    return str(told.value)


def test_a_table_with_names_and_units_in_any_order(tmp_path):
    text = (
        "Heading [rad];Depth (cm);Longitude;utc;Latitude;pitch_deg;roll;salinity;std_up\n"
        "1.5707963267948966;185441;-176.566672;2019-04-04T04:08:08Z;-21.98917764;0;0;35;0.1\n"
        "1.5707963267948966;185414;-176.5666627;2019-04-04T06:08:12+02:00;-21.98917722;0;0;35;0.2\n"
    )
    found = read_navigation(written(tmp_path, text))
    np.testing.assert_allclose(found.position[0], [-21.98917764, -176.566672, -1854.41])
    np.testing.assert_allclose(found.time, [T0, T0 + 4])
    assert found.attitude is not None
    assert found.std is not None
    np.testing.assert_allclose(found.attitude[0, :, 0], [1, 0, 0], atol=1e-12)  # bow to the east
    np.testing.assert_allclose(found.std[:, 2], [0.1, 0.2])


def test_rows_come_in_the_order_of_time_and_once(tmp_path):
    found = read_navigation(written(tmp_path, "time,x,y,z\n3,3,0,0\n1,1,0,0\n2,2,0,0\n2,9,0,0\n"))
    np.testing.assert_allclose(found.position[:, 0], [1, 2, 3])
    assert found.clock == "clip"


def test_a_position_without_height_has_no_word_on_it(tmp_path):
    found = read_navigation(written(tmp_path, "time,lat,lon\n1,10,20\n2,10.1,20\n"))
    assert found.std is not None
    assert np.isinf(found.std[:, 2]).all()


def test_the_attitude_of_a_vehicle():
    east, up_bow, starboard_down = (vehicle_attitude(*np.array([[a] for a in angles], float))[0] for angles in (
        (90, 0, 0), (0, 30, 0), (0, 0, 30),
    ))  # fmt: skip
    np.testing.assert_allclose(east @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(up_bow @ [1, 0, 0], [0, np.cos(np.pi / 6), 0.5], atol=1e-12)
    np.testing.assert_allclose(starboard_down @ [0, 1, 0], [np.cos(np.pi / 6), 0, -0.5], atol=1e-12)


def test_depth_of_pressure_is_that_of_the_published_check_value():
    assert depth_of_pressure(np.array([1000.0]), 30.0)[0] == pytest.approx(9712.653, abs=1e-3)
    assert depth_of_pressure(np.array([1.01325]), absolute=True)[0] == 0


def test_pressures_become_heights(tmp_path):
    found = read_navigation(written(tmp_path, "time,lat,lon,pressure_dbar\n1,30,20,10000\n2,30,20.1,0\n"))
    np.testing.assert_allclose(found.position[:, 2], [-9712.653, 0], atol=1e-3)


TRANSFORMS = "ts,source,target,x,y,z,qx,qy,qz,qw\n"
TURNED = "0,0,0.7071067811865476,0.7071067811865476"  # by 90 degrees about z: x to y


def test_transforms_from_the_world_are_read_as_the_places_of_the_camera(tmp_path):
    rows = f"1,world,camera,0,-2,-5,{TURNED}\n2,world,camera,0,-3,-5,{TURNED}\n"
    found = read_navigation(written(tmp_path, TRANSFORMS + rows))
    np.testing.assert_allclose(found.position, [[2, 0, 5], [3, 0, 5]], atol=1e-12)  # R X + t = 0
    assert found.frame == "local"


def test_transforms_to_the_world_hold_the_places_themselves(tmp_path):
    rows = f"1,base_link,odom,2,0,5,{TURNED}\n2,base_link,odom,3,0,5,{TURNED}\n"
    found = read_navigation(written(tmp_path, TRANSFORMS + rows))
    np.testing.assert_allclose(found.position, [[2, 0, 5], [3, 0, 5]])


def test_transforms_that_cannot_be_places_are_refused(tmp_path):
    row = f"1,{{}},{{}},0,-2,-5,{TURNED}\n"
    two = row.format("dvl", "camera") + row.format("dvl", "camera").replace("1,", "2,", 1)
    assert "one end has to be the world" in refused(tmp_path, TRANSFORMS + two)
    both = row.format("world", "left") + row.format("world", "right").replace("1,", "2,", 1)
    assert "world to left, world to right" in refused(tmp_path, TRANSFORMS + both)
    without = "ts,source,target,x,y,z\n1,world,camera,0,0,0\n2,world,camera,1,0,0\n"
    assert "without qx, qy, qz, qw" in refused(tmp_path, without)


def test_a_real_log_of_transforms_is_the_smooth_path_of_a_vehicle(shared):
    found = read_navigation(shared / "data" / "sparus_nav" / "sparus_snippet.csv")
    steps = np.linalg.norm(np.diff(found.position, axis=0), axis=1)
    assert len(found) == 50
    assert steps.sum() < 1.05 * np.linalg.norm(found.position[-1] - found.position[0])  # translations turn: 3.2 times


def test_matisse_files_name_images(shared):
    found = read_navigation(shared / "data" / "rov_vent_a" / "navigation.dim2")
    assert len(found) == 20
    assert found.names is not None
    assert found.names[0] == "20190404T040808.826276Z.jpg"
    np.testing.assert_allclose(found.position[0], [-21.98917764, -176.566672, -1854.41])
    assert seconds_of_name(found.names[0]) == pytest.approx(found.time[0], abs=1e-6)


def sentence(body: str) -> str:
    total = 0
    for character in body.encode():
        total ^= character
    return f"${body}*{total:02X}"


def gga(time: str) -> str:
    return sentence(f"GPGGA,{time},2159.350600,S,17633.99990,W,1,08,0.9,12.0,M,0,M,,")


def rmc(time: str, date: str) -> str:
    return sentence(f"GPRMC,{time},A,2159.350600,S,17633.99990,W,0.1,90,{date},,")


def test_nmea_sentences_with_a_date(tmp_path):
    lines = [
        sentence("GPRMC,040808.00,A,2159.350658,S,17633.99998,W,0.1,90,040419,,"),
        sentence("SDDPT,3.4,0.0"),
        sentence("GPGGA,040809.50,2159.350600,S,17633.99990,W,1,08,0.9,12.0,M,0,M,,"),
        "$GPGGA,040810.50,2159.350600,S,17633.99990,W,1,08,0.9,12.0,M,0,M,,*00",  # damaged on the way
    ]
    found = read_navigation(written(tmp_path, "\r\n".join(lines), "log.nmea"))
    np.testing.assert_allclose(found.time, [T0, T0 + 1.5])
    np.testing.assert_allclose(found.position[0, :2], [-21.9891776, -176.5666663], atol=1e-7)
    assert found.altitude is not None
    assert found.altitude[0] == 3.4


MIDNIGHT = 1767312000.0  # 2026-01-02


@pytest.mark.parametrize(
    ("lines", "seconds"),
    [
        pytest.param(
            [rmc("235959", "010126"), gga("000000"), rmc("000000", "020126"), gga("000001")], [-1, 0, 1], id="behind"
        ),
        pytest.param([rmc("000000", "020126"), gga("235959.90"), gga("000001")], [-0.1, 0, 1], id="late sentence"),
        pytest.param(
            [sentence("GPZDA,235957,01,01,2026,00,00"), gga("235959"), gga("000001"), gga("120000"), gga("000002")],
            [-1, 1, 43200, 86402],
            id="one date for days",
        ),
        pytest.param(
            [rmc("080000", "010126"), rmc("070000", "020126"), gga("070001")], [-57600, 25200, 25201], id="gap"
        ),
    ],
)
def test_nmea_times_go_on_after_midnight(tmp_path, lines, seconds):
    found = read_navigation(written(tmp_path, "\n".join(lines) + "\n", "log.nmea"))
    np.testing.assert_allclose(found.time - MIDNIGHT, seconds, atol=1e-6)


@pytest.mark.parametrize(
    "cut", ["$GPGGA,2359", "$GPGGA,235952,2159.35", "$GPDPT", "$GPRMC,235952,A", "$GPZDA,235952,02,01,20", "$"]
)
def test_a_sentence_that_is_cut_off_is_left_out(tmp_path, cut):
    lines = [rmc("235950", "010126"), gga("235951"), cut]
    assert len(read_navigation(written(tmp_path, "\n".join(lines), "log.nmea"))) == 2


def test_tum_trajectories(tmp_path):
    found = read_navigation(
        written(tmp_path, "# t x y z q\n0 1 2 3 0 0 0 1\n1 2 2 3 0 0 0.7071068 0.7071068\n", "a.txt")
    )
    np.testing.assert_allclose(found.position, [[1, 2, 3], [2, 2, 3]])
    assert found.attitude is not None
    np.testing.assert_allclose(found.attitude[0] @ [0, 0, 1], [0, 0, -1], atol=1e-6)  # level: its z, down, is down
    np.testing.assert_allclose(found.attitude[1] @ [1, 0, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(found.attitude[1] @ [0, 1, 0], [1, 0, 0], atol=1e-6)  # north ahead, east to starboard


@pytest.mark.parametrize(
    "place", ["[latitude: 12.5] [longitude: 44.25] [rel_alt: 1.2 abs_alt: -3.5]", "GPS(44.25,12.5,-3.5) BAROMETER"]
)
def test_subtitles_with_positions(tmp_path, place):
    blocks = [f"{i}\n00:00:0{i},500 --> 00:00:0{i},600\n<font>{place}</font>\n" for i in range(3)]
    blocks.append(
        "4\n00:00:04,500 --> 00:00:04,600\n[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 1.2]\n"
    )  # no fix
    found = read_navigation(written(tmp_path, "\n".join(blocks), "clip.srt"))
    np.testing.assert_allclose(found.time, [0.5, 1.5, 2.5])
    assert found.position[0, :2].tolist() == [12.5, 44.25]


def test_positions_in_the_images_themselves(tmp_path):
    from PIL import Image

    for i in range(2):
        exif = Image.Exif()
        exif.get_ifd(0x8825).update(
            {1: "S", 2: (21.0, 30.0, float(i)), 3: "W", 4: (176.0, 0.0, 0.0), 5: b"\x01", 6: 12.0}
        )
        Image.new("RGB", (16, 16)).save(tmp_path / f"{i}.jpg", exif=exif)
    found = read_navigation(tmp_path)
    np.testing.assert_allclose(found.position, [[-21.5, -176, -12], [-21.5 - 1 / 3600, -176, -12]])
    assert found.names == ("0.jpg", "1.jpg")


@pytest.mark.parametrize("latitude", ["numbers over zero", (0.0, 0.0, 0.0), 21.5, None])
def test_images_that_are_damaged_or_had_no_fix_have_no_position(tmp_path, latitude):
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    place = {1: "N", 2: (21.0, 30.5), 3: "E", 4: (17.0, 0.0)}
    latitude = (IFDRational(0, 0),) * 3 if latitude == "numbers over zero" else latitude
    without_fix = {} if latitude is None else {**place, 2: latitude, 4: (0.0, 0.0, 0.0)}
    for i, gps in enumerate((place, place, without_fix)):
        exif = Image.Exif()
        exif.get_ifd(0x8825).update(gps)
        (tmp_path / "a").mkdir(exist_ok=True)
        Image.new("RGB", (16, 16)).save(tmp_path / "a" / f"{i}.jpg", exif=exif)
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "a" / "0.jpg").read_bytes()[:60])
    (tmp_path / "empty.png").touch()
    found = read_navigation(tmp_path)
    assert found.names == ("a/0.jpg", "a/1.jpg")
    np.testing.assert_allclose(found.position[:, :2], [[21 + 30.5 / 60, 17]] * 2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,lat,lon,depth\n1,-176.5,-21.9,5\n2,-176.5,-21.8,5\n", "swapped"),
        ("time,lat,lon,depth\n1,0.38,-1.2,5\n2,0.381,-1.2,5\n", "radians in columns that should hold degrees"),
        ("time,lat [rad],lon [rad]\n1,38.1,12.2\n2,38.2,12.3\n", "degrees in a column that states radians"),
        ("time,x,y,z,heading,pitch,roll\n1,0,0,0,0.1,0,0\n2,1,0,0,3.1,0,0\n", "radians in columns"),
        ("time,lat,lon,depth\n1,50,8,-12\n2,50,8.1,-13\n", "a depth grows downwards"),
        ("time,heading\n1,5\n2,5\n", "no two give a position"),
        ("lat,lon\n50,8\n51,8\n", "neither times nor names"),
        ("time,lat,lon\n10:00:01,50,8\n10:00:02,51,8\n", "no date"),
        ("time,lat,lon\n1,50,8\n2,fifty,8\n", "line 3: the latitude is 'fifty'"),
        ("timestamp,x,y\n1600000000000,0,0\n1600000001000,1,0\n", "milliseconds since 1970"),
        ("1600000000000000000 0 0 0 0 0 0 1\n1600000001000000000 1 0 0 0 0 0 1\n", "nanoseconds since 1970"),
        ("time,x,y\n20190404120000,0,0\n20190404120001,1,0\n", "a date written as one number"),
        ("time,lat,lon\nnoon,50,8\nlater,50,9\n", "a time cannot be read"),
        ("time,lat,lon,depth [fathom]\n1,50,8,3\n2,50,8,4\n", "the unit of 'depth [fathom]' is fathom"),
        ("time,lat,latitude,lon\n1,50,50,8\n2,51,51,8\n", "two of its columns are the latitude"),
        ("time,lat,lon\n1,50,8\n", "1 position"),
        ("time,lat,lon\n1,50,8\n2,inf,8\n", "not finite"),
        ("time,lat,lon\n", "no rows"),
        ("", "is empty"),
        ("$GPGGA,040809.50,2159.35,S,17633.99,W,1,08,0.9,12.0,M,0,M,,\n" * 3, "no date"),
        ("$GPRMC,1*00\n" * 4, "checksums"),
        ("0;04/04/2019;04:08:08;a;b;c.jpg;1;2\n" * 3, "13 are expected"),
        ("1 2 3 4 0 0 0 0\n2 2 3 4 0 0 0 0\n", "a quaternion is zero"),
        ("1\n00:00:01,000 --> 00:00:02,000\nhello\n", "no block states"),
        ("\0\0\0", "it is no text"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_with_its_fault(tmp_path, text, words):
    assert words in refused(tmp_path, text)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="missing"):
        read_navigation(tmp_path / "none.csv")


def test_images_without_positions_are_counted(tmp_path):
    from PIL import Image

    Image.new("RGB", (16, 16)).save(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="0 of its 1 images"):
        read_navigation(tmp_path)


@pytest.mark.parametrize("title", ["Depth [cm]", "depth_cm", " DEPTH (cm) "])
def test_units_stand_in_brackets_or_after_an_underscore(title):
    found = column(title)
    assert found is not None
    assert (found.kind, found.factor) == ("depth", 0.01)


def test_dates_are_told_with_the_day_first():
    assert seconds_of_date("04/05/2019", "00:00:01.5") - seconds_of_date("2019-05-04", "0:00") == 1.5
    assert seconds_of("2019-04-04 04:08:08") == T0
    assert seconds_of_name("dive 7") is None
