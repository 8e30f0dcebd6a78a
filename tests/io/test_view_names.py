"""Names of rendered views are short and never shared."""

from swimm3r.io.view_names import view_stems


def test_a_view_bears_its_frames_name_without_the_suffix():
    assert view_stems(["0000.png", "day_2/0001.jpg"]) == {"0000.png": "0000", "day_2/0001.jpg": "day_2/0001"}


def test_frames_that_differ_in_their_suffix_alone_keep_it():
    stems = view_stems(["a.jpg", "a.png", "b.png"])
    assert stems == {"a.jpg": "a.jpg", "a.png": "a.png", "b.png": "b"}


def test_no_two_frames_share_their_views():
    for names in (["a.jpg", "a.png", "a.jpg.png"], ["A.jpg", "a.png"], ["a.b.png", "a.b.jpg", "a.png"], ["a", "a.png"]):
        stems = view_stems(names)
        assert list(stems) == names
        assert len({stem.casefold() for stem in stems.values()}) == len(names)
