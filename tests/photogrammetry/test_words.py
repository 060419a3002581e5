"""Words of epochs that take two bytes each and read as a sequence of strings."""

import numpy as np

from thermocald.photogrammetry.series.spool import Words


def test_they_read_as_the_sequence_they_are():
    said = ["ok", "no_frame", "ok", "too_few_targets"] * 3
    words = Words.of(said)
    assert list(words) == said
    assert words == tuple(said)
    assert tuple(said) == words
    assert words != said[:-1]
    assert words[1] == words[-11] == "no_frame"
    assert words[1:4] == said[1:4]
    assert "no_frame" in words
    assert "no_frame" not in words[2:4]
    assert words.counts() == {"ok": 6, "no_frame": 3, "too_few_targets": 3}
    np.testing.assert_array_equal(words.are("ok"), [one == "ok" for one in said])
    assert not words.are("blurred").any()


def test_one_word_for_all_takes_no_memory():
    words = Words.repeated("ok", 10_000_000)
    assert len(words) == words.count("ok") == 10_000_000
    assert words[9_999_999] == "ok"
