"""Videos tell true times, stand upright, and give what they can when damaged."""

import math
import struct
from fractions import Fraction

import av
import numpy as np
import pytest

from swimm3r.errors import InputError
from swimm3r.io.video import Video

# four flat quarters: red, green / blue, white
QUARTERS = np.zeros((96, 160, 3), np.uint8)
QUARTERS[:48, :80, 0] = QUARTERS[:48, 80:, 1] = QUARTERS[48:, :80, 2] = 230
QUARTERS[48:, 80:] = 230


def scene(n, size=(96, 160), seed=0):
    """A texture that drifts by two pixels a frame."""
    coarse = np.random.default_rng(seed).integers(0, 255, (size[0] // 8, size[1] // 8, 3), dtype=np.uint8)
    texture = coarse.repeat(8, 0).repeat(8, 1)
    return [np.roll(texture, 2 * i, 1) for i in range(n)]


def turn_tag(path, matrix):
    """Write a display matrix into the track header of an mp4, as cameras do."""
    data = bytearray(path.read_bytes())
    identity = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    at = data.index(identity, data.index(b"tkhd"))
    a, b, c, d = (value << 16 for value in matrix)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("codec", "suffix"),
    [("libx264", "mp4"), ("libx265", "mp4"), ("libx264", "mkv"), ("libx264", "ts"), ("mpeg4", "avi"), ("ffv1", "mkv")],
)
def test_usual_codecs_and_containers_give_every_frame_at_its_time(tmp_path, write_video, codec, suffix):
    video = Video(write_video(tmp_path / f"dive.{suffix}", scene(20), codec=codec))
    frames = list(video.frames())
    assert (video.width, video.height) == (160, 96)
    assert video.damaged == 0
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(20) / 30, atol=1e-3)
    assert np.abs(frames[7].rgb().astype(int) - scene(20)[7]).mean() < 16


def test_raw_streams_without_a_clock_count_frames(tmp_path, write_video):
    video = Video(write_video(tmp_path / "dive.h264", scene(10)))
    np.testing.assert_allclose(np.diff([frame.time for frame in video.frames()]), 1 / video.rate)


def test_uneven_frame_rates_keep_their_times(tmp_path, write_video):
    times = np.cumsum([0.0, 0.01, 0.2, 0.03, 0.5, 0.04, 0.04, 1.0])
    video = Video(write_video(tmp_path / "dive.mp4", scene(8), times))
    np.testing.assert_allclose([frame.time for frame in video.frames()], times, atol=1e-3)


@pytest.mark.parametrize(
    ("matrix", "quarter_turns_clockwise"), [((0, 1, -1, 0), 1), ((-1, 0, 0, -1), 2), ((0, -1, 1, 0), 3)]
)
def test_the_rotation_tag_turns_images_upright(tmp_path, write_video, matrix, quarter_turns_clockwise):
    """x' = a x + c y, y' = b x + d y with y down (QuickTime): (0, 1, -1, 0) sends right to down, clockwise."""
    path = write_video(tmp_path / "dive.mp4", [QUARTERS] * 3)
    turn_tag(path, matrix)
    video = Video(path)
    upright = np.rot90(QUARTERS, -quarter_turns_clockwise)
    image = next(video.frames()).rgb()
    assert (video.height, video.width) == image.shape[:2] == upright.shape[:2]
    for v, u in ((0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)):
        at = int(v * upright.shape[0]), int(u * upright.shape[1])
        assert np.abs(image[at].astype(int) - upright[at]).max() < 12


def test_pixels_that_are_not_square_are_made_square(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [QUARTERS] * 3, sample_aspect_ratio=Fraction(4, 3))
    video = Video(path)
    assert (video.width, video.height) == (213, 96)
    assert next(video.frames()).rgb().shape == (96, 213, 3)


@pytest.mark.parametrize(("tag", "lines", "matrix"), [(1, 96, 1), (5, 96, 5), (2, 720, 1), (2, 96, 5)])
def test_colors_follow_the_tag_or_the_size(tmp_path, tag, lines, matrix):
    """BT.709 (1) or BT.601 (5); untagged (2) video is 709 from 720 lines on."""
    color = np.array([40, 160, 200], np.uint8)
    with av.open(str(tmp_path / "dive.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = lines, lines, "yuv420p"
        stream.codec_context.colorspace = tag
        frame = av.VideoFrame.from_ndarray(np.broadcast_to(color, (lines, lines, 3)).copy(), "rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace=matrix)
        frame.colorspace = tag
        file.mux(stream.encode(frame))
        file.mux(stream.encode())
    image = next(Video(tmp_path / "dive.mp4").frames()).rgb()
    assert np.abs(image[lines // 2, lines // 2].astype(int) - color).max() <= 4


def test_a_part_of_a_video_has_the_times_of_the_whole(tmp_path, write_video):
    for suffix in ("mp4", "ts"):
        path = write_video(tmp_path / f"dive.{suffix}", scene(60), gop_size=12)
        times = [frame.time for frame in Video(path).frames(start=1.0, end=1.5)]
        np.testing.assert_allclose(times, np.arange(30, 45) / 30, atol=1e-3)


def test_a_video_cut_off_gives_what_it_has(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mkv", scene(60), gop_size=6)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    video = Video(path)
    times = [frame.time for frame in video.frames()]
    assert 15 < len(times) < 45
    assert video.seconds == pytest.approx(2.0, abs=0.1)


def test_damage_in_the_middle_is_passed_over_and_counted(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", scene(120), gop_size=10)
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat")
    data[start + 20000 : start + 26000] = bytes(6000)
    path.write_bytes(data)
    video = Video(path)
    times = [frame.time for frame in video.frames()]
    assert video.damaged > 0
    assert 60 < len(times) < 120
    assert times[-1] == pytest.approx(119 / 30, abs=0.05)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("letter.txt", b"a letter to a diver\n" * 40),
        ("letter.mp4", b"a letter to a diver\n" * 40),
        ("paper.pdf", b"%PDF-1.7\n" + bytes(range(256)) * 8),
        ("empty.mp4", b""),
    ],
)
def test_what_is_no_video_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        Video(tmp_path / name)


def test_a_video_without_its_index_is_refused(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", scene(60))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])  # a recording that was not closed
    with pytest.raises(InputError, match=r"dive\.mp4"):
        Video(path)


def test_sound_alone_is_no_video(tmp_path):
    with av.open(str(tmp_path / "song.wav"), "w") as file:
        stream = file.add_stream("pcm_s16le", rate=8000, layout="mono")
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        file.mux(stream.encode(sound))
        file.mux(stream.encode())
    with pytest.raises(InputError, match="no moving images"):
        Video(tmp_path / "song.wav")


def test_names_with_colons_and_spaces_open(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", scene(3)).rename(tmp_path / "dive 2: the wreck.mp4")
    assert len(list(Video(path).frames())) == 3


@pytest.mark.parametrize("start", [1e9, 1e300, math.inf])
def test_a_start_beyond_every_clock_gives_no_frames(tmp_path, write_video, start):
    video = Video(write_video(tmp_path / "a.mp4", [np.full((48, 64, 3), 9 * i, np.uint8) for i in range(9)]))
    assert list(video.frames(start)) == []
