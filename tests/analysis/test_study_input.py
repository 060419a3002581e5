"""Series from recordings and stores: epochs read, and epochs left out with a reason."""

from dataclasses import replace

import numpy as np
import pytest

import thermocald as tc
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.physics.presets import preset_simulation
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import open_recording
from thermocald.store.series import EpochResult

FREE = ("c", "x0", "y0", "A1", "A2", "B1", "B2")


@pytest.fixture
def recording(tmp_path):
    """Write ten epochs of a warm phone, of which two have too few or no observations."""
    simulation = preset_simulation("nexus5-warm", 1)
    simulation = replace(simulation, programme=replace(simulation.programme, epochs=10))
    simulation.write(tmp_path / "rec")
    lines = (tmp_path / "rec" / "observations.csv").read_text().splitlines(keepends=True)
    kept = [line for line in lines if not line.startswith("3,")]
    few = [line for line in kept if line.startswith("7,")][3:]
    text = "".join(line for line in kept if line not in few)
    (tmp_path / "rec" / "observations.csv").write_text(text)
    return tmp_path / "rec"


def test_epochs_without_a_result_are_counted(recording):
    series = tc.open(recording).measured(free=FREE, exterior="series")
    interval = tc.open(recording).head.interval
    assert np.rint(series.time_s / interval).tolist() == [0, 1, 3, 4, 5, 7, 8, 9]
    assert sum(series.without_result.values()) == 2
    assert series.free == FREE
    assert series.exterior == "series"
    # DESIGN idea 3: thousandths of a pixel with one exterior orientation
    assert series.sds[0, 1] / series.sensor.pixel_pitch < 0.01
    assert series.correlations.shape == (8, 10, 10)
    assert [t.name for t in series.thermometers] == ["temperature", "board_temperature"]
    assert 0.02 < series.thermometers[0].sd < 0.12
    given = tc.open(recording).measured(thermometer_sd=0.25, free=FREE)
    assert [t.sd for t in given.thermometers] == [0.25, 0.25]


def test_a_store_is_read_in_columns_without_broken_epochs(recording, tmp_path):
    opened = open_recording(recording)
    covariance = np.diag(np.append(np.full(8, 1e-8), np.zeros(8)))
    broken = covariance.copy()
    broken[1, 1] = -1e-12
    values = np.arange(16.0)
    with Store.open(tmp_path / "s.db", "append", durable=False) as store:
        stored = store.create_series(opened.head, opened.testfield, start="warm")
        for epoch in opened.epochs:
            result = EpochResult("ok", "", values + epoch.number, covariance, 1.0, 200, 100)
            if epoch.number == 5:
                result = replace(result, covariance=broken)
            if epoch.number == 6:
                result = EpochResult("too_few_targets", "3 targets")
            store.append(stored, epoch, result)
        columns = store.series_columns(stored, ["c", "sd_c"])
    series = tc.open(tmp_path / "s.db").measured(exterior="per_epoch")
    assert series.label == "nexus5-warm"
    assert series.without_result == {"too few targets": 1, "no standard deviation": 1}
    numbers = [1, 2, 3, 4, 7, 8, 9, 10]
    np.testing.assert_array_equal(series.values, values[:10] + np.array(numbers)[:, None])
    assert series.free == IOP_NAMES[:8]
    assert len(series.correlations) == 8
    assert series.redundancy.tolist() == [200] * 8
    # the numbers in a store are exported without a new adjustment
    table = tc.open(tmp_path / "s.db").calibrate(exterior="stored")
    np.testing.assert_array_equal(table.values[:, 0], columns["c"])
    np.testing.assert_array_equal(table.sd[:, 0], columns["sd_c"])
    assert (table.sd[table.ok, 0] == 1e-4).all()


def test_a_store_without_any_result_is_refused(recording, tmp_path):
    opened = open_recording(recording)
    with Store.open(tmp_path / "s.db", "append", durable=False) as store:
        stored = store.create_series(opened.head, opened.testfield)
        store.append(stored, opened.epochs[0], EpochResult("weak_geometry", "one plane"))
    with pytest.raises(DataError, match=r"no epoch has a result \(1 × weak geometry\)"):
        tc.open(tmp_path / "s.db").measured(exterior="per_epoch")


def test_an_empty_store_is_refused_with_one_line(tmp_path):
    with Store.open(tmp_path / "s.db", "append", durable=False):
        pass
    with pytest.raises(DataError, match="holds no series") as caught:
        tc.open_all(tmp_path / "s.db")
    assert "\n" not in str(caught.value)
