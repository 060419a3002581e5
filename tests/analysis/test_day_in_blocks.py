"""A day studied and fitted in blocks: the numbers of one block that holds all of it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

import numpy as np
import pytest

import thermocald as tc
from benchmarks.adjustment import INTERIOR
from benchmarks.long_recording import write_long_recording
from tests.blocks import InBlocks
from thermocald.analysis.series import adjusted, recorded
from thermocald.analysis.study.study import StudySettings, study
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.photogrammetry.series.normals import gathered
from thermocald.series import Series
from thermocald.store.recording.reader import Recording, open_recording
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import condensed

DAY = 8640
SAME = 1e-9  # of the principal distance, or of a rate
TOGETHER = 2000  # epochs of the sample, rows of the fit


@dataclass(frozen=True)
class Day:
    """A recording of a day, and all its observations in one grid."""

    recording: Recording
    grid: object

    def blocks(self, size):
        """The observations, `size` epochs at a time."""
        return InBlocks(self.grid, size)


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    pytest.importorskip("pyarrow")
    path = tmp_path_factory.mktemp("day") / "day"
    write_long_recording(path, DAY, 21)
    recording = open_recording(path)
    return Day(recording, gathered(recording, [slice(0, DAY)]))


@pytest.mark.slow
def test_the_study(day, monkeypatch):
    for module in (adjusted, recorded):
        monkeypatch.setattr(module, "together_at_most", lambda _: TOGETHER)
    found = []
    for size in (DAY, 500):
        blocks = day.blocks(size)
        monkeypatch.setattr(
            Recording, "blocks", lambda _, windows=None, b=blocks: b.blocks(windows)
        )
        measured = Series(day.recording).measured()
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
        assert abs(slopes[1] - slopes[0]) < SAME * INTERIOR.c  # over a kelvin


@pytest.mark.slow
def test_the_fit(day):
    series = tc.open(day.recording.path).observed()
    rates = []
    for size in (DAY, 500):
        short = condensed(series, day.blocks(size), TOGETHER)
        assert len(short.frame_times) < DAY / 2
        fitted = fit_thermal_model([reduce_series(short, strict=False)], [])
        rates.append([fitted.model.rates[name] for name in ("c", "x0", "y0")])
    np.testing.assert_allclose(rates[1], rates[0], rtol=SAME)


@pytest.mark.slow
def test_a_coordinate_that_is_wrong(day, monkeypatch, tmp_path):
    """30 mm of one target moved c by 98 µm: it is left out, and named, as in a short series."""
    for module in (adjusted, recorded):
        monkeypatch.setattr(module, "together_at_most", lambda _: TOGETHER)
    path, means = tmp_path / "day", []
    shutil.copytree(day.recording.path, path)
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
        said = any(f": {name} " in doubt for doubt in series.doubts(table))
        assert said == (lines is wrong)
    assert (np.abs(means[1] - means[0]) < 3 * table.level_sd[:3]).all()
