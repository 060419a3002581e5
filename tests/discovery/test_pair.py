"""The recordings that a discovery is made and proved on."""

from __future__ import annotations

from pathlib import Path

import pytest

from thermocald.discovery.evidence import load_together
from thermocald.errors import DataError, UsageError
from thermocald.physics.presets import preset_simulation


@pytest.mark.parametrize(
    ("others", "said"),
    [(["M2", "M1"], "recording to explain itself"), (["M2", "M3", "M2"], "twice")],
)
def test_a_recording_counts_once(others, said):
    with pytest.raises(UsageError, match=said):
        load_together(Path("M1"), [Path(o) for o in others], lambda _: None)


def test_a_copy_under_another_name_proves_nothing(tmp_path):
    for name, seed in (("M1", 1), ("M2", 1), ("M3", 2)):
        preset_simulation("nexus5-cold", seed, name).write(tmp_path / name)
    m1, m2, m3 = (tmp_path / name for name in ("M1", "M2", "M3"))

    assert len(load_together(m1, [m3], lambda _: None)) == 2
    with pytest.raises(DataError, match=r"M2 holds the same observations as .*M1"):
        load_together(m1, [m3, m2], lambda _: None)
