"""Objects around the pixels that surely move, by colors that all frames of a dive share."""

from dataclasses import replace

import cv2
import numpy as np

from swimm3r.sfm.moving.objects import ColorModels, ColorSamples, color_models, color_samples, objects
from swimm3r.sfm.moving.occluders import Evidence

HEIGHT, WIDTH = 60, 80
ARM = (slice(20, 30), slice(0, 60))  # in from the border, before sand and a rock
ROCK = (slice(10, 50), slice(5, 25))
HEAD = (slice(18, 32), slice(45, 60))  # the arm's end, where other frames measured the sand behind it


def frame(arm: bool = True) -> np.ndarray:
    """Sand, a white rock, and a black arm across both."""
    noise = np.random.default_rng(0).normal(0, 0.02, (HEIGHT, WIDTH, 3)).astype(np.float32)
    rgb = np.full((HEIGHT, WIDTH, 3), (0.2, 0.5, 0.45), np.float32)
    rgb[ROCK] = (0.8, 0.9, 0.9)
    if arm:
        rgb[ARM] = rgb[HEAD] = (0.05, 0.1, 0.1)
    return (rgb + noise).clip(0, 1)


def mask(*parts: tuple[slice, slice]) -> np.ndarray:
    found = np.zeros((HEIGHT, WIDTH), bool)
    for part in parts:
        found[part] = True
    return found


def grown(found: np.ndarray) -> np.ndarray:
    """With the pixels beside it."""
    return cv2.dilate(found.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def evidence() -> Evidence:
    """Other frames measured the right half, and nothing of the left one, where the rock lies."""
    right = mask((slice(None), slice(40, None)))
    return Evidence(moving=mask(HEAD), still=right & ~mask(ARM, HEAD))


def models_of(*frames: tuple[np.ndarray, Evidence]) -> ColorModels:
    """The models of some frames, of which there is enough."""
    models = color_models(color_samples(*one) for one in frames)
    assert models is not None
    return models


def of_rock() -> tuple[np.ndarray, Evidence]:
    """A frame without the arm, of which others measured everything."""
    return frame(arm=False), Evidence(moving=mask(), still=mask((slice(None), slice(None))))


def test_an_object_reaches_over_ground_that_nobody_measured():
    models = models_of((frame(), evidence()), of_rock())
    found, truth = objects(frame(), evidence(), models), mask(ARM, HEAD)
    assert (found & truth).sum() > 0.98 * truth.sum()
    assert not (found & ~grown(truth)).any()


def test_other_frames_tell_that_an_unmeasured_rock_beside_an_object_is_still():
    alone, together = models_of((frame(), evidence())), models_of((frame(), evidence()), of_rock())
    rock = mask(ROCK) & ~grown(mask(ARM))
    assert objects(frame(), evidence(), alone)[rock].mean() > 0.9
    assert not objects(frame(), evidence(), together)[rock].any()


def test_colors_of_an_object_alone_make_nothing_move():
    apart = frame()
    apart[45:55, 65:75] = apart[22, 50]
    nothing = Evidence(moving=mask(), still=evidence().still)
    models = models_of((frame(), evidence()), of_rock())
    assert not objects(apart, nothing, models).any()
    still_there = Evidence(evidence().moving, evidence().still & ~mask((slice(45, 55), slice(65, 75))))
    assert not objects(apart, still_there, models)[45:55, 65:75].any()


def test_what_moves_with_the_camera_is_found_where_nobody_measured_the_ground():
    unsure = Evidence(moving=mask(), still=evidence().still)
    models = models_of((frame(), evidence()), of_rock())
    assert not objects(frame(), unsure, models).any()
    found = objects(frame(), unsure, models, neighbors=mask(ARM))
    assert (found & mask(ARM, HEAD)).sum() > 0.98 * mask(ARM, HEAD).sum()
    assert not (found & ~grown(mask(ARM, HEAD))).any()


def test_an_object_of_the_frames_before_and_after_may_have_left_the_place():
    unsure = Evidence(moving=mask(), still=evidence().still)
    models = models_of((frame(), evidence()), of_rock())
    assert not objects(frame(arm=False), unsure, models, neighbors=mask(ARM)).any()
    assert not objects(frame(), unsure, models, neighbors=mask((slice(10, 21), slice(0, 60)))).any()


def test_pixels_that_surely_show_what_others_measured_stay():
    both = Evidence(evidence().moving, mask((slice(None), slice(0, 40))))
    models = models_of((frame(), evidence()), of_rock())
    assert objects(frame(), both, models)[:, :38].mean() < 0.01


def test_where_hardly_anything_moves_colors_have_to_be_clearer():
    noise = np.random.default_rng(1).normal(0, 0.12, (HEIGHT, WIDTH, 3))
    alike = frame(arm=False) + noise.astype(np.float32)
    alike[ARM] = alike[ARM] - (0.12, 0.32, 0.28)
    alike[HEAD] = noise[HEAD] + (0.05, 0.1, 0.1)
    samples = color_samples(alike, evidence())
    moving, still = samples.counts
    often, seldom = (color_models([replace(samples, counts=(moving, k * still))]) for k in (1, 100_000))
    assert often is not None
    assert seldom is not None
    unmeasured = mask((slice(20, 30), slice(25, 38)))
    assert objects(alike, evidence(), often)[unmeasured].all()
    assert not objects(alike, evidence(), seldom)[unmeasured].any()


def test_a_few_sure_pixels_do_not_make_a_large_region_move():
    few = Evidence(moving=mask((slice(22, 25), slice(50, 53))), still=evidence().still)
    models = models_of((frame(), evidence()), of_rock())
    alone = objects(frame(), few, models)
    assert alone[few.moving].all()
    assert not (alone & ~grown(few.moving)).any()
    assert objects(frame(), few, models, neighbors=mask(ARM))[mask(ARM)].mean() > 0.98


def test_pixels_that_mix_an_object_and_the_ground_are_the_objects():
    blurred = cv2.blur(frame(), (3, 3))
    sure = Evidence(evidence().moving, evidence().still & ~mask((slice(17, 33), slice(44, 61))))
    found = objects(blurred, sure, models_of((frame(), evidence()), of_rock()))
    assert found[17:33, 44:61].mean() > 0.95
    assert not found[:16].any()


def test_without_colors_of_both_kinds_only_pixels_beside_sure_ones_move():
    assert color_models([]) is None
    assert color_models([ColorSamples(np.zeros((0, 3), np.uint8), np.zeros((9, 3), np.uint8), (0, 9))]) is None
    assert color_models([ColorSamples(np.zeros((9, 3), np.uint8), np.zeros((0, 3), np.uint8), (9, 0))]) is None
    found = objects(frame(), evidence(), None)
    assert found[evidence().moving].all()
    assert not found[:, :43].any()


def test_a_few_pixels_are_noise_and_few_colors_are_enough():
    speck = Evidence(moving=mask((slice(5, 7), slice(60, 62))), still=evidence().still)
    assert not objects(frame(), speck, None).any()
    few = color_models([ColorSamples(np.full((1, 3), 9, np.uint8), np.full((1, 3), 200, np.uint8), (1, 1))])
    assert few is not None
    assert objects(frame(), evidence(), few)[HEAD].all()


def test_the_number_of_colors_of_a_frame_is_bounded():
    many = Evidence(moving=np.zeros((200, 100), bool), still=np.ones((200, 100), bool))
    samples = color_samples(np.zeros((200, 100, 3), np.float32), many)
    assert (len(samples.moving), len(samples.still)) == (0, 4000)
