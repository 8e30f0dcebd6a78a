"""Scores of a run, as the terminal says them."""

import pytest

from swimm3r.cli.terminal.summary import print_summary

TEST = {"views": 2, "psnr": 12.62, "blur4_psnr": 34.7, "ssim": 0.703, "sharpness": 0.588}


def printed(capsys, **scores) -> str:
    print_summary({"test": TEST | scores})
    return " ".join("".join(capsys.readouterr()).split())


@pytest.mark.parametrize(("views", "said"), [(1, "1 test frame: PSNR 12.6 dB"), (2, "2 test frames: PSNR 12.6 dB")])
def test_frames_are_counted(views, said, capsys):
    assert said in printed(capsys, views=views)


def test_scores_of_what_training_frames_saw_stand_beside_those_of_all_pixels(capsys):
    observed = {"observed": 0.706, "psnr_observed": 26.56, "sharpness_observed": 0.626}
    said = "Of the test frames, training frames saw 71 %: PSNR 26.6 dB, sharpness 0.63"
    assert said in printed(capsys, **observed)
    for nothing_else in ({}, observed | {"observed": 0.999}, {"observed": 0.0, "psnr_observed": None}):
        assert "training frames saw" not in printed(capsys, **nothing_else)


def test_frames_that_could_not_be_placed_are_named_and_others_scored(capsys):
    some = printed(capsys, unplaced=["far.png"])
    assert "Not scored, as no frame near them is registered: far.png" in some
    assert "PSNR 12.6 dB" in some
    none = printed(capsys, views=0, psnr=None, ssim=None, unplaced=["far.png"])
    assert "far.png" in none
    assert "PSNR" not in none
