"""Records in a notebook: short text, and HTML that is well-formed, self-contained, small and safe for any name."""

import time
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

import swimm3r
from swimm3r import notebook
from swimm3r.io.images import write_rgb
from swimm3r.medium import AttenuationCurve
from swimm3r.scene.frames import Frame
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps, Matches, Points, QualityWarning, Tracks
from swimm3r.splat.medium.field import initial_field
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.settings import MediumFieldSettings

HOSTILE = "<script>alert(\"1\")</script> & 'b'"
MOST_BYTES = 300_000
FLAGS = {name: torch.tensor([True, True, False]) for name in ("Binf", "beta_D", "beta_B")}
WATER = swimm3r.Medium(torch.tensor([0.1, 0.4, 0.5]), torch.tensor([0.4, 0.15, 0.1]), torch.tensor([0.3, 0.2, 0.2]))


class Page(HTMLParser):
    """Checks that tags are closed in order and nothing is loaded from elsewhere; collects the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            assert name in ("style", "src", "alt"), name
            assert name != "src" or (value or "").startswith("data:image/jpeg;base64,")
        if tag != "img":
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += f"{data}\n"


def page_of(record: object) -> Page:
    """The record's HTML, which takes less than a second of processor time."""
    began = time.process_time()
    html = record._repr_html_()  # type: ignore[attr-defined]
    assert time.process_time() - began < 1
    assert len(html.encode()) < MOST_BYTES
    page = Page(html)
    assert "script" not in page.tags
    return page


def is_short(record: object) -> bool:
    text = repr(record)
    return len(text.splitlines()) <= 2 and max(map(len, text.splitlines())) <= 140 and "tensor(" not in text


@pytest.fixture
def frames(tmp_path: Path) -> swimm3r.Frames:
    """Twenty noisy images, which compress badly, of 1600x1000."""
    noise = np.random.default_rng(0).integers(0, 255, (1000, 1600, 3)).astype(np.uint8)
    write_rgb(tmp_path / "0.png", noise)
    listed = [
        Frame(f"{i} {HOSTILE}", tmp_path / "0.png", i / 5, 1.0, "test" if i % 8 == 0 else "train") for i in range(20)
    ]
    return swimm3r.Frames(tuple(listed), 1600, 1000, ordered=True)


@pytest.fixture
def fit() -> swimm3r.MediumFit:
    zero = torch.zeros(3)
    curve = AttenuationCurve(WATER.beta_D, zero, zero, zero)
    std = swimm3r.Medium(zero + 0.01, zero + 0.02, zero + 0.03)
    return swimm3r.MediumFit(
        **vars(WATER), curve=curve, std=std, identifiable=FLAGS, z_range=(0.5, 4.0), encoding="srgb"
    )


@pytest.fixture
def rec(tmp_path: Path, fit: swimm3r.MediumFit) -> swimm3r.Reconstruction:
    names = tuple(f"{i} {HOSTILE}" for i in range(500))
    none = torch.zeros(0, dtype=torch.long)
    depth = DepthMaps(tmp_path / "z_depth")
    depth.write("only.png", DepthMap(torch.ones(4, 4), torch.ones(4, 4)))
    return swimm3r.Reconstruction(
        names=names,
        cameras=camera(500),
        points=Points(torch.zeros(9, 3), torch.zeros(9, 3), torch.zeros(9)),
        tracks=Tracks(none, none, torch.zeros(0, 2)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=depth,
        backend=HOSTILE,
        medium=fit,
        cloud=DenseCloud(torch.zeros(12_345, 3), torch.zeros(12_345, 3), torch.zeros(12_345, 3)),
        warnings=(QualityWarning(HOSTILE, HOSTILE),) * 1000,
    )


def camera(count: int = 1) -> swimm3r.Cameras:
    K = torch.tensor([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]], dtype=torch.float64).repeat(count, 1, 1)
    return swimm3r.Cameras(
        K, torch.zeros(count, 0, dtype=torch.float64), torch.eye(4, dtype=torch.float64).repeat(count, 1, 1), 640, 480
    )


@pytest.fixture
def scene() -> swimm3r.SplatMap:
    """Five thousand colored primitives in front of the camera."""
    rng = torch.Generator().manual_seed(0)
    xyz = torch.rand(5000, 3, generator=rng) * torch.tensor([4.0, 3.0, 0.5]) - torch.tensor([2.0, 1.5, -3.0])
    p = BetaPrimitives(
        xyz,
        torch.nn.functional.normalize(xyz, dim=-1),
        torch.rand(5000, 3, generator=rng),
        torch.full((5000,), 3.0),
        torch.zeros(5000, 4),
        torch.cat([torch.full((5000, 3), -3.0), torch.ones(5000, 3)], -1),
        torch.zeros(5000, 15),
        torch.zeros(5000),
    )
    field = initial_field(WATER, MediumFieldSettings(), rng).requires_grad_(False)
    scene = swimm3r.SplatMap(p, field, swimm3r.UwbsSettings(), True, viewpoint=camera())
    scene.render(camera())  # kernels are compiled in the first view
    return scene


def test_frames_are_a_strip_of_a_few(frames: swimm3r.Frames):
    page = page_of(frames)
    assert page.tags.count("img") == 6
    assert "20 frames of 1600x1000: 17 for training, 3 for testing" in page.text
    assert f"0 {HOSTILE}, 0.0 s, test" in page.text
    assert page_of(frames.select([3])).tags.count("img") == 1
    assert page_of(frames.select([])).tags.count("img") == 0


def test_of_large_frames_fewer_are_decoded(frames: swimm3r.Frames, tmp_path: Path):
    write_rgb(tmp_path / "large.png", np.zeros((3000, 4000, 3), np.uint8))
    large = tuple(replace(frame, path=tmp_path / "large.png") for frame in frames)
    assert page_of(replace(frames, frames=large, width=4000, height=3000)).tags.count("img") == 2


def test_the_water_is_a_table_that_brackets_what_is_not_determined(fit: swimm3r.MediumFit):
    page = page_of(fit)
    assert "attenuation beta_D, per unit of ray depth" in page.text
    assert "\n0.400 \u00b1 0.020\n" in page.text
    assert "\n(0.100 \u00b1 0.020)\n" in page.text
    assert "not determined" in page.text
    sure = replace(fit, identifiable={name: torch.ones(3, dtype=torch.bool) for name in FLAGS})
    assert "not determined" not in page_of(sure).text
    assert "\n0.100\n0.400\n0.500\n" in page_of(WATER).text
    assert "[480, 640]: means" in page_of(fit.at(torch.ones(480, 640))).text


def test_a_reconstruction_is_a_summary(rec: swimm3r.Reconstruction):
    page = page_of(rec)
    assert "12,345" in page.text
    assert "1000 warnings" in page.text
    assert page.text.count(HOSTILE) == 1 + 2 * 10  # the back end, and the first warnings
    assert "per scene unit" in page.text
    assert "1/m" in page_of(replace(rec, metric=True)).text
    assert "attenuation" not in page_of(replace(rec, medium=None, cloud=None)).text


def test_a_map_is_a_view_with_its_water_and_without(scene: swimm3r.SplatMap):
    page = page_of(scene)
    assert page.tags.count("img") == 2
    assert "with the water" in page.text
    assert "uwbs-static, 5,000 primitives, metres" in page.text
    assert page_of(replace(scene, viewpoint=None)).tags.count("img") == 0


def test_a_view_of_a_map_is_two_images(scene: swimm3r.SplatMap):
    assert page_of(scene.render(camera())).tags.count("img") == 2


def test_text_is_short(
    frames: swimm3r.Frames, fit: swimm3r.MediumFit, rec: swimm3r.Reconstruction, scene: swimm3r.SplatMap
):
    parts = (rec.points, rec.tracks, rec.matches, rec.cloud, rec.depth["only.png"], fit.curve, fit.at(torch.ones(9)))
    view = scene.render(camera())
    records = (fit, WATER, rec, rec.cameras, rec.cameras[[]], scene, view, *parts)
    assert [type(record) for record in records if not is_short(record)] == []
    renamed = replace(frames, frames=tuple(replace(f, name=f"{f.time}.png") for f in frames))
    assert is_short(renamed)
    assert is_short(frames.select([]))


@pytest.mark.parametrize(
    ("record", "text"),
    [
        (lambda: WATER, "Medium(Binf=[0.1, 0.4, 0.5], beta_D=[0.4, 0.15, 0.1], beta_B=[0.3, 0.2, 0.2])"),
        (lambda: camera(3), "Cameras(3 of 640x480, PINHOLE, focal length 400.0 px, 77x62 degrees)"),
        (lambda: DepthMap(torch.ones(4, 5), torch.ones(4, 5)), "DepthMap(z_depth=[4, 5], confidence=[4, 5])"),
    ],
)
def test_text_says_the_numbers(record: Callable[[], object], text: str):
    assert repr(record()) == text


def test_a_table_escapes_its_title_header_and_cells():
    page = Page(notebook.table(HOSTILE, [[HOSTILE]], [HOSTILE]))
    assert page.tags.count("script") == 0
    assert page.text.count(HOSTILE) == 3
