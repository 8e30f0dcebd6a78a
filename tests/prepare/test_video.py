"""Videos are sampled by time, the sharpest frame of each bin, in bounded memory."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from swimm3r.errors import InputError
from swimm3r.prepare import read_frames

TEXTURE = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)


def numbered(i, blur=0.0):
    """A texture that carries its number as eight black or white bars."""
    image = cv2.GaussianBlur(TEXTURE, (0, 0), blur) if blur else TEXTURE.copy()
    for bit in range(8):
        image[:48, bit * 32 : bit * 32 + 32] = 255 * (i >> bit & 1)
    return image


def number_of(image):
    return sum(1 << bit for bit in range(8) if image[8:40, bit * 32 + 8 : bit * 32 + 24].mean() > 0.5)


def numbers(frames):
    return [number_of(frames.image(i).numpy()) for i in range(len(frames))]


def test_uniform_takes_every_sixth_frame_of_thirty_a_second(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(60)])
    frames = read_frames(path, folder=tmp_path / "prepare", pick="uniform")
    assert numbers(frames) == list(range(0, 60, 6))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(0, 60, 6) / 30, atol=1e-3)
    assert frames.ordered
    assert frames.names[3] == "frame_000003.png"
    assert frames.warnings == ()


def dated(source: Path, stated: str) -> Path:
    """A copy of a video whose container states a date."""
    path = source.with_name(f"dated_{source.name}")
    with av.open(str(source)) as before, av.open(str(path), "w") as after:
        after.metadata["creation_time"] = stated
        stream = after.add_stream_from_template(before.streams.video[0])
        for packet in before.demux(before.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                after.mux(packet)
    return path


@pytest.mark.parametrize(
    ("stated", "kept"), [("2023-08-19T09:30:05.000000Z", "2023-08-19T09:30:05"), ("1970-01-01T00:00:00Z", None)]
)
def test_the_date_of_the_container_is_kept_unless_its_clock_was_never_set(tmp_path, write_video, stated, kept):
    path = dated(write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(30)]), stated)
    assert read_frames(path, folder=tmp_path / "prepare").recorded == kept


def test_the_sharpest_frame_of_each_bin_is_taken(tmp_path, write_video):
    sharp = [2, 9, 12, 23, 29]
    path = write_video(tmp_path / "dive.mp4", [numbered(i, 0 if i in sharp else 3) for i in range(30)])
    frames = read_frames(path, folder=tmp_path / "prepare")
    assert numbers(frames) == sharp


def test_bins_are_of_time_and_not_of_count(tmp_path, write_video):
    """Ten frames in the first second, two in the next, none in the third."""
    times = [*np.arange(10) / 10, 1.0, 1.5, 3.0]
    path = write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(13)], times)
    assert numbers(read_frames(path, folder=tmp_path / "prepare", pick="uniform", fps=1.0)) == [0, 10, 12]


def test_zero_frames_a_second_takes_all(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(12)])
    assert numbers(read_frames(path, folder=tmp_path / "prepare", fps=0.0)) == list(range(12))


def test_a_limit_lowers_the_rate(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(60)])
    frames = read_frames(path, folder=tmp_path / "prepare", pick="uniform", max_frames=4)
    assert numbers(frames) == [0, 15, 30, 45]


def test_a_part_of_the_video_keeps_its_times(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(90)])
    frames = read_frames(path, folder=tmp_path / "prepare", pick="uniform", start=1.0, end=2.0)
    assert numbers(frames) == [30, 36, 42, 48, 54]
    assert frames.frames[0].time == pytest.approx(1.0, abs=1e-3)
    with pytest.raises(InputError, match="no frames from second 50"):
        read_frames(path, folder=tmp_path / "other", start=50.0)


def test_large_videos_are_scaled_to_the_long_side(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(30)], codec="libx265")
    frames = read_frames(path, folder=tmp_path / "prepare", long_side=128)
    assert (frames.width, frames.height) == (128, 96)
    assert frames.image(0).shape == (96, 128, 3)


def test_black_bins_are_left_out_and_said(tmp_path, write_video):
    black = np.zeros_like(TEXTURE)
    path = write_video(tmp_path / "dive.mp4", [black if 12 <= i < 24 else numbered(i) for i in range(60)])
    frames = read_frames(path, folder=tmp_path / "prepare", pick="uniform")
    assert numbers(frames) == [0, 6, *range(24, 60, 6)]
    assert "2 times of the video show nothing" in frames.warnings[0]


def test_a_black_video_is_refused(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [np.full_like(TEXTURE, 16)] * 30)
    with pytest.raises(InputError, match="0 usable frames") as caught:
        read_frames(path, folder=tmp_path / "run" / "prepare")
    assert "5 times of the video show nothing" in caught.value.cause
    assert not (tmp_path / "run").exists()


def test_one_frame_is_refused(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [numbered(0)])
    with pytest.raises(InputError, match="1 usable frame"):
        read_frames(path, folder=tmp_path / "run" / "prepare")


def test_a_video_cut_off_is_used_as_far_as_it_goes(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mkv", [numbered(i) for i in range(180)], gop_size=10)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = read_frames(path, folder=tmp_path / "prepare", fps=2.0)
    assert 4 <= len(frames) <= 8
    assert any("should last 6.0 s, but ends at" in warning for warning in frames.warnings)


def test_an_unreadable_video_leaves_nothing(tmp_path):
    (tmp_path / "dive.mp4").write_bytes(b"a letter to a diver\n" * 40)
    with pytest.raises(InputError, match=r"dive\.mp4"):
        read_frames(tmp_path / "dive.mp4", folder=tmp_path / "run" / "prepare")
    assert [path.name for path in tmp_path.iterdir()] == ["dive.mp4"]


def test_interruption_leaves_nothing(tmp_path, write_video):
    path = write_video(tmp_path / "dive.mp4", [numbered(i) for i in range(60)])

    def impatient(what, done, total, /):
        assert done <= total == 60
        if done == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        read_frames(path, folder=tmp_path / "run" / "prepare", progress=impatient)
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_memory_does_not_grow_with_the_length_of_a_video(tmp_path, write_video):
    """2,400 frames of 320x240 would take 550 MB as RGB and 275 MB as decoded."""
    texture = cv2.resize(TEXTURE, (320, 240))
    path = write_video(tmp_path / "dive.mp4", (np.roll(texture, i, 1) for i in range(2400)))
    resident = []

    def watch(what, done, total, /):
        if done % 50 == 0:
            resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6)

    frames = read_frames(path, folder=tmp_path / "prepare", fps=1.0, progress=watch)
    assert len(frames) == 80
    assert max(resident) - resident[4] < 60  # after 200 frames the decoder has what it needs
