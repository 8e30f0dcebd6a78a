"""The stages of structure from motion at both ends of every range: what a setting allows must work, or say why not.

Where a range declares no upper end it is the largest number that any setting takes.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from swimm3r.errors import InputError
from swimm3r.imaging.undistortion import frame_rays
from swimm3r.medium import MediumFit
from swimm3r.scene.reconstruction import DepthMaps, Reconstruction
from swimm3r.settings import Range, Settings, declarations, ranges_of
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import extract_features
from swimm3r.sfm.medium.dense_cloud import dense_cloud
from swimm3r.sfm.medium.dense_tracks import DenseTracks, fuse_depth
from swimm3r.sfm.medium.light import judge_light
from swimm3r.sfm.medium.restore import restore_image
from swimm3r.sfm.medium.samples import WaterSamples, collect_samples
from swimm3r.sfm.medium.seathru import estimate_medium, fit_medium
from swimm3r.sfm.medium.settings import RestoreSettings, SeathruSettings, TrackSettings
from swimm3r.sfm.plane_sweep.estimate import estimate_depth
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings

FEW = SeathruSettings(max_pixels=2000, max_observations=2000, start_observations=300, reweightings=1, min_samples=100)
SMALL = PlaneSweepSettings(long_side=48, sources=2, planes=32, rounds=1, threads=1)


def ends(kind: type[Settings]) -> list[Any]:
    """A test per end of every range: the name of the field and the number there."""
    return [
        pytest.param(name, number, id=f"{name}={number:g}")
        for name, hint in declarations(kind).items()
        for rule in ranges_of(hint)
        for number in _ends(rule)
    ]


def _ends(rule: Range) -> list[float]:
    low = rule.least if rule.least is not None else 1e-9 if rule.above == 0 else None
    high = rule.most if rule.most is not None else 1 - 1e-9 if rule.below == 1 else 1_000_000_000
    assert low is not None
    return [low, high, *([0] if rule.or_zero else [])]


LAMP = [end for end in ends(SeathruSettings) if "lamp" in str(end.id)]
"""Of the settings that only a lamp's light asks for."""


def changed(settings: Settings, name: str, number: float) -> Any:
    kind = int if type(getattr(settings, name)) is int else float
    return replace(settings, **{name: kind(number)})  # pyright: ignore[reportArgumentType]


def finite(fit: MediumFit) -> bool:
    values = [*vars(fit.constant()).values(), *vars(fit.curve).values(), *vars(fit.std).values()]
    return all(bool(value.isfinite().all()) for value in values)


@pytest.fixture
def posed(dive, tmp_path: Path) -> Reconstruction:
    """The flat dive with points that its frames track, and no depth yet."""
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings(max_tracks=400))
    width = dive.frames.width
    xy = torch.stack([tracks.pixel % width + 0.5, tracks.pixel // width + 0.5], -1).to(dive.rec.tracks.xy)
    colors = torch.full((len(tracks.xyz), 3), 0.5)
    return replace(
        dive.rec,
        points=replace(dive.rec.points, xyz=tracks.xyz, rgb=colors, error=torch.zeros(len(tracks.xyz))),
        tracks=replace(dive.rec.tracks, point=tracks.track, frame=tracks.frame, xy=xy),
        depth=DepthMaps(tmp_path),
    )


@pytest.fixture(scope="module")
def tracks(dive) -> DenseTracks:
    return fuse_depth(dive.rec, dive.frames, FEW.tracks)


@pytest.fixture(scope="module")
def samples(dive, tracks: DenseTracks) -> WaterSamples:
    return collect_samples(dive.rec, dive.frames, tracks, FEW)


@pytest.fixture(scope="module")
def sampling(dive, tracks: DenseTracks) -> set[str]:
    """Names of the settings that the collection of samples reads."""
    read: set[str] = set()

    class Recording(SeathruSettings):
        def __getattribute__(self, name: str) -> Any:
            read.add(name)
            return super().__getattribute__(name)

    collect_samples(dive.rec, dive.frames, tracks, Recording(**vars(FEW)))
    return read & {*declarations(SeathruSettings)}


@pytest.mark.parametrize(("name", "number"), [end for end in ends(SeathruSettings) if end not in LAMP])
def test_the_water_is_fitted_or_the_pixels_are_too_few(
    name: str, number: float, dive, tracks: DenseTracks, samples: WaterSamples, sampling: set[str]
):
    settings = changed(FEW, name, number)
    if name in sampling:
        samples = collect_samples(dive.rec, dive.frames, tracks, settings)
    try:
        assert finite(fit_medium(samples, settings, "srgb"))
    except InputError:
        assert name == "min_samples"


@pytest.mark.long
@pytest.mark.parametrize(("name", "number"), [end for end in LAMP if "slope" in str(end.id)])
def test_the_water_is_fitted_under_a_lamp(name: str, number: float, samples: WaterSamples):
    assert finite(fit_medium(samples, changed(FEW, name, number), "srgb", "lamp"))


@pytest.mark.parametrize(("name", "number"), [end for end in LAMP if "slope" not in str(end.id)])
def test_the_light_is_a_lamps_unless_a_threshold_is_out_of_reach(
    name: str, number: float, samples: WaterSamples, known_water: MediumFit
):
    within_reach = replace(FEW, lamp_explained=0.0, lamp_fall_off=0.0, lamp_alone=0.0, lamp_change=0.0)
    evidence = judge_light(samples, known_water, changed(within_reach, name, number))
    assert evidence is not None
    assert evidence.fall_off is not None  # so that `lamp_alone` is not asked
    assert evidence.light == ("lamp" if number == 0 or name == "lamp_alone" else "sun")


@pytest.mark.parametrize(("name", "number"), ends(TrackSettings))
def test_tracks_are_found_and_the_water_from_them(name: str, number: float, dive):
    settings = replace(FEW, tracks=changed(TrackSettings(max_tracks=500), name, number))
    assert finite(estimate_medium(dive.rec, dive.frames, settings, "srgb"))


@pytest.mark.parametrize(("name", "number"), ends(RestoreSettings))
def test_images_and_points_are_restored(name: str, number: float, dive, known_water: MediumFit):
    settings = changed(RestoreSettings(), name, number)
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings(max_tracks=500))
    cloud = dense_cloud(dive.rec, dive.frames, tracks, known_water, settings, TrackSettings(max_tracks=500))
    assert 0 < len(cloud.xyz) <= settings.max_points
    depth, rays = dive.rec.depth[dive.rec.names[3]], frame_rays(dive.rec.cameras[3])
    done = restore_image(dive.frames.image(3), depth, rays, known_water, settings)
    assert bool(done.clear.isfinite().all())


@pytest.mark.parametrize(("name", "number"), ends(FeatureSettings))
def test_features_are_found_where_there_are_any(name: str, number: float, dive):
    settings = changed(FeatureSettings(), name, number)
    for image in (dive.frames.image(0), dive.frames.image(0)[:18], torch.zeros(72, 96, 3)):
        found = extract_features(image.contiguous(), torch.ones(image.shape[:2], dtype=torch.bool), settings)
        assert len(found.keypoints) == len(found.descriptors)


@pytest.mark.parametrize(("name", "number"), ends(PlaneSweepSettings))
def test_depth_is_positive_where_there_is_any(name: str, number: float, dive, posed: Reconstruction):
    frames = dive.frames
    if name == "planes" and number > 32:  # as many as there are pixels of motion anyway
        number = 64
    depth = estimate_depth(posed, frames, changed(SMALL, name, number))
    for each in posed.names:
        z_depth = depth[each].z_depth
        assert bool((z_depth.isfinite() & (z_depth >= 0)).all())
        assert z_depth.shape == (frames.height, frames.width)
