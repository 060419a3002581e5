"""Rendered rivers from cold starts to knocks: the water line's places, and what is said of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.analysis.river_scenes import EXAMPLE, KINDS, play, write_example


@pytest.mark.slow
def test_the_water_line_has_true_sds_and_what_is_not_sure_is_flagged(tmp_path):
    """Two scenes of each kind; `python -m benchmarks.river` has more of them."""
    scenes = [play(300 + seed, KINDS[seed % len(KINDS)], tmp_path) for seed in range(14)]
    posed = np.array([s.chi2 for s in scenes]) / 6
    still = np.array([s.chi2_first for s in scenes if not s.flagged]) / 6
    # six coordinates of a scene hang together: of so few scenes a ratio is known to a tenth
    assert np.sqrt(posed.mean()) == pytest.approx(1.0, abs=0.3)
    assert np.sqrt(still.mean()) == pytest.approx(1.0, abs=0.3)
    before, after = (np.sqrt(np.mean([getattr(s, n) ** 2 for s in scenes])) for n in
                     ("before", "after"))  # fmt: skip
    assert before > 10 * after
    assert {s.kind for s in scenes if s.moved} == {"knocked"}
    assert all(s.moved for s in scenes if s.kind == "knocked")
    assert {s.kind for s in scenes if s.flagged} == {"knocked", "night"}
    assert all(s.flagged for s in scenes if s.kind in ("knocked", "night"))
    assert all(s.statuses[1:] == ("last_pose",) * 2 for s in scenes if s.kind == "night")


@pytest.mark.slow
def test_the_example_is_what_its_writer_writes(tmp_path):
    """Texts to the letter; photographs but for what another JPEG encoder makes of them."""
    write_example(tmp_path)
    for path in sorted(p for p in tmp_path.rglob("*") if p.is_file()):
        shipped = EXAMPLE / path.relative_to(tmp_path)
        if path.suffix == ".jpg":
            a, b = (cv2.imread(str(p), cv2.IMREAD_GRAYSCALE).astype(float) for p in (path, shipped))
            assert np.abs(a - b).mean() < 2.0
        else:
            assert path.read_text() == shipped.read_text(), path.name
