"""The recordings for discovery and for verification."""

from __future__ import annotations

import pytest

import thermocald as tc
from thermocald.errors import DataError, UsageError


@pytest.fixture
def series(tmp_path):
    return [
        tc.simulate("nexus5-cold", seed=seed, series=name, out=tmp_path / name)
        for name, seed in (("M1", 1), ("M2", 1), ("M3", 2))
    ]


def test_a_recording_counts_once(series):
    m1, m2, m3 = series
    for others in ([m2, m1], [m2, m3, tc.open(m2.source)]):
        with pytest.raises(UsageError, match="is the same series as"):
            tc.discover(m1, verify=others)


def test_a_copy_under_another_name_proves_nothing(series):
    m1, m2, m3 = series
    with pytest.raises(DataError, match=r"M2 holds the same observations as .*M1"):
        tc.discover(m1, verify=[m3, m2])
