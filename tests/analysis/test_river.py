"""Rendered rivers from cold starts to knocks: the water line's sds, and flagged scenes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.analysis.river_scenes import EXAMPLE, KINDS, play, write_example


@pytest.mark.slow
def test_the_water_line_has_true_sds_and_doubtful_scenes_are_flagged(tmp_path):
    """Two scenes of each kind; `python -m benchmarks.river` has more."""
    scenes = [play(300 + seed, KINDS[seed % len(KINDS)], tmp_path) for seed in range(14)]
    posed = np.array([s.chi2 for s in scenes]) / 6
    still = np.array([s.chi2_first for s in scenes if not s.flagged]) / 6
    # the six coordinates of a scene correlate, so these few scenes give a ratio to a tenth
    assert np.sqrt(posed.mean()) == pytest.approx(1.0, abs=0.3)
    assert np.sqrt(still.mean()) == pytest.approx(1.0, abs=0.3)
    before, after = np.array([(s.before, s.after) for s in scenes]).T
    assert np.mean(before**2) > 100 * np.mean(after**2)
    assert {s.kind for s in scenes if s.moved} == {"knocked"}
    assert all(s.moved for s in scenes if s.kind == "knocked")
    assert {s.kind for s in scenes if s.flagged} == {"knocked", "night"}
    assert all(s.flagged for s in scenes if s.kind in ("knocked", "night"))
    assert all(s.statuses[1:] == ("last_pose",) * 2 for s in scenes if s.kind == "night")


@pytest.mark.slow
def test_the_shipped_example_is_up_to_date(tmp_path):
    """Texts are identical, photographs differ at most by the JPEG encoder."""
    write_example(tmp_path)
    for path in sorted(p for p in tmp_path.rglob("*") if p.is_file()):
        shipped = EXAMPLE / path.relative_to(tmp_path)
        if path.suffix == ".jpg":
            a, b = (cv2.imread(str(p), cv2.IMREAD_GRAYSCALE).astype(float) for p in (path, shipped))
            assert np.abs(a - b).mean() < 2.0
        else:
            assert path.read_text() == shipped.read_text(), path.name
