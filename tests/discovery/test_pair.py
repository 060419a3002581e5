"""The recordings that a discovery is made and proved on."""

from __future__ import annotations

from pathlib import Path

import pytest

from thermocald.discovery.evidence.pair import load_together
from thermocald.errors import UsageError


@pytest.mark.parametrize(
    ("others", "said"),
    [(["M2", "M1"], "recording to explain itself"), (["M2", "M3", "M2"], "twice")],
)
def test_a_recording_counts_once(others, said):
    with pytest.raises(UsageError, match=said):
        load_together(Path("M1"), [Path(o) for o in others], lambda _: None)
