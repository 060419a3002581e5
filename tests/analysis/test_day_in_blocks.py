"""A day that is calibrated in blocks: a wrong coordinate of a target."""

from __future__ import annotations

import numpy as np
import pytest

import thermocald as tc
from benchmarks.long_recording import write_long_recording
from thermocald.analysis.series import adjusted, recorded
from thermocald.photogrammetry.series import long_series


@pytest.mark.slow
def test_a_wrong_coordinate(monkeypatch, tmp_path):
    """A target with an error of 30 mm is left out and named; it once changed c by 98 µm."""
    pytest.importorskip("pyarrow")
    for module in (adjusted, recorded, long_series):
        monkeypatch.setattr(module, "together_at_most", lambda _: 2000)
    write_long_recording(tmp_path / "day", 8640, 21)
    file, means = tmp_path / "day" / "testfield.csv", []
    head, *rows = file.read_text().splitlines()
    sure = [line.rsplit(",", 3)[0] + ",0.3,0.3,0.3" for line in rows]
    name, x, rest = sure[7].split(",", 2)
    wrong = [*sure[:7], f"{name},{float(x) + 30.0},{rest}", *sure[8:]]
    for lines in (sure, wrong):
        file.write_text("\n".join([head, *lines]) + "\n")
        series = tc.open(tmp_path / "day")
        table = series.calibrate()
        assert table.ok.all()
        means.append(table.values[:, :3].mean(axis=0))
        named = any(f": {name} " in doubt for doubt in series.doubts(table))
        assert named == (lines is wrong)
    assert (np.abs(means[1] - means[0]) < 3 * table.level_sd[:3]).all()
