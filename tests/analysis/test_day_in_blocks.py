"""A day studied and fitted in blocks gives the numbers of a single block."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

import thermocald as tc
from benchmarks.adjustment import INTERIOR
from benchmarks.long_recording import write_long_recording
from tests.blocks import InBlocks
from thermocald.analysis.series import adjusted, recorded
from thermocald.analysis.study.measured import StudySettings
from thermocald.analysis.study.study import study
from thermocald.photogrammetry.series import long_series
from thermocald.photogrammetry.series.normals import gathered
from thermocald.series import Series
from thermocald.store.recording.reader import Recording, open_recording

DAY = 8640
SAME = 1e-9  # of the principal distance, or of a rate
TOGETHER = 2000  # epochs of the sample, rows of the fit


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """Return the recording of a day, and all its observations in one grid."""
    pytest.importorskip("pyarrow")
    path = tmp_path_factory.mktemp("day") / "day"
    write_long_recording(path, DAY, 21)
    recording = open_recording(path)
    return recording, gathered(recording, [slice(0, DAY)])


@pytest.fixture
def samples(monkeypatch):
    """Limit the epochs that are adjusted together."""
    for module in (adjusted, recorded, long_series):
        monkeypatch.setattr(module, "together_at_most", lambda _: TOGETHER)


@pytest.mark.slow
def test_the_study(day, samples, monkeypatch):
    (recording, grid), found = day, []
    for size in (DAY, 500):
        blocks = InBlocks(grid, size)
        monkeypatch.setattr(
            Recording, "blocks", lambda _, windows=None, b=blocks: b.blocks(windows)
        )
        measured = Series(recording).measured()
        (camera,) = study([measured], StudySettings(sets=1000)).cameras
        found.append(camera)
    one, many = found
    np.testing.assert_allclose(many.iop[:3], one.iop[:3], rtol=0, atol=SAME * INTERIOR.c)
    np.testing.assert_allclose(many.sds, one.sds, rtol=1e-5)
    a, b = (camera.series[0] for camera in found)
    for name in ("c", "x0", "y0"):
        assert abs(b.deviations[name].change - a.deviations[name].change) < SAME * INTERIOR.c
        assert b.significance[name].success_ratio == a.significance[name].success_ratio
        slopes = [x.channels[0].dependences[name].slope for x in (a, b)]
        assert abs(slopes[1] - slopes[0]) < SAME * INTERIOR.c  # for a change of 1 K


@pytest.mark.slow
def test_a_wrong_coordinate(day, samples, tmp_path):
    """A target with an error of 30 mm is left out and named; it once changed c by 98 µm."""
    path, means = tmp_path / "day", []
    shutil.copytree(day[0].path, path)
    field = (path / "testfield.csv").read_text().splitlines()
    sure = [line.rsplit(",", 3)[0] + ",0.3,0.3,0.3" for line in field[1:]]
    name, x, rest = sure[7].split(",", 2)
    wrong = [*sure[:7], f"{name},{float(x) + 30.0},{rest}", *sure[8:]]
    for lines in (sure, wrong):
        (path / "testfield.csv").write_text("\n".join([field[0], *lines]) + "\n")
        series = tc.open(path)
        table = series.calibrate()
        assert table.ok.all()
        means.append(table.values[:, :3].mean(axis=0))
        named = any(f": {name} " in doubt for doubt in series.doubts(table))
        assert named == (lines is wrong)
    assert (np.abs(means[1] - means[0]) < 3 * table.level_sd[:3]).all()
