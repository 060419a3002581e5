"""The daemon on a virtual clock, as the demo runs it: rendered devices go away and come back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermocald.acquisition.calibrator import Calibrator
from thermocald.config import parse_config
from thermocald.daemon.plan import demo_config
from thermocald.daemon.service import Service
from thermocald.epoch import Epoch
from thermocald.hal import VirtualClock, open_device
from thermocald.names import channel_fault
from thermocald.store.database.store import Store


@pytest.fixture
def run(tmp_path, small_camera, small_field, monkeypatch):
    """A count, faults of the camera → the store and columns of that many epochs.

    step_s: what the clock is set forward by, after a minute.
    """
    monkeypatch.setattr("thermocald.daemon.service._TURN_S", 0.01)  # several in an epoch
    opened = []

    def ran(epochs, faults=(), statuses=None, step_s=0.0):
        document = demo_config(tmp_path, 1).model_dump(mode="json", by_alias=True)
        document["cameras"][0]["options"] |= {
            "testfield": str(small_field), "model": str(small_camera), "faults": list(faults)
        }  # fmt: skip
        config = parse_config(document, Path("config.yaml"))
        clock = VirtualClock(1_600_000_000.0)
        steps = [step_s]

        def set_clock(_):
            if clock.monotonic() >= 60.0:
                clock.offset += steps.pop() if steps else 0.0

        Service(config, epochs=epochs, until_finished=True, clock=clock, on_turn=set_clock).run()
        opened.append(store := Store.open(config.store.path))
        names = ["status", "frame_time", "temperature_time", "sd_c", "drift_px_per_min"]
        found = store.series_columns(store.find_series(), names)
        assert found["status"].tolist() == (statuses or ["ok"] * epochs)
        return store, found

    yield ran
    for store in opened:
        store.close()


def test_every_tick_is_an_epoch_and_nothing_is_told_that_nobody_put_in(run):
    """However long calibration takes; a channel with a column's name would lose it."""
    store, found = run(8)
    assert [event.kind for event in store.events()] == ["started", "series_begun", "stopped"]
    columns = set().union(*(epoch.extra for epoch in store.epochs(store.find_series())))
    assert np.diff(found["frame_time"]) == pytest.approx([10.0] * 7, abs=1e-3)
    # a reading of a neighbouring tick would be further away
    assert found["temperature_time"] - found["frame_time"] == pytest.approx([0.5] * 8, abs=0.5)
    assert np.isfinite(found["sd_c"]).all()
    assert {"series_c", "level_sd_c", "series_epochs", "skew_s"} < columns
    ours = {name for name in columns if not name.startswith("camera_")}  # those give way
    assert not [name for name in ours if not channel_fault(name)]


def test_a_clock_that_is_set_back_is_no_drift_that_ends(run):
    """For an hour all epochs counted as one of before: 0.02 px/min, where the drift was 0.3."""
    _, found = run(24, step_s=-3600.0)
    (back,) = np.flatnonzero(np.diff(found["frame_time"]) < 0)
    before, after = found["drift_px_per_min"][back], found["drift_px_per_min"][back + 1 :]
    assert np.isnan(after[0])
    assert after[-1] == pytest.approx(before, rel=0.2)


def test_a_camera_that_repeats_its_frame_is_reported_once(run):
    """Its epochs are no independent measurements; standard deviations would be too small."""
    statuses = [*["ok"] * 2, *["repeated_frame"] * 3, *["ok"] * 3]
    store, _ = run(8, [{"kind": "stuck", "at": 3, "count": 3}], statuses=statuses)
    stored = store.epochs(store.find_series())
    seen = [one.epoch.observations is not None for one in stored]
    assert seen == [status == "ok" for status in statuses]
    (frozen,) = [event for event in store.events() if event.kind == "frozen"]
    assert "its last 3 frames are identical" in frozen.text


def test_a_camera_that_is_still_frozen_after_a_restart_gives_no_new_observation(run):
    """On its clock, which starts again, the rendered camera delivers its first frame again."""
    for restarts in range(3):
        store, _ = run(1, statuses=["ok", *["repeated_frame"] * restarts])
    *_, last = store.epochs(store.find_series())
    assert last.result.reason.startswith("it repeats the frame of epoch 2")


def test_a_uniform_area_shows_no_target(small_camera, small_field):
    """As below the damage of a JPEG. Regression: a grey frame was `ok`, with sigmas of 0."""
    options = {"testfield": str(small_field), "model": str(small_camera)}
    with open_device("camera", "mock", options, VirtualClock()) as camera:
        frames = [np.array(camera.capture().image) for _ in range(4)]
        calibrator = Calibrator(*camera.known_scene(), nominal_c=3.04)
    middle = frames[1].shape[1] // 2
    frames[1][:, :middle] = frames[2][:] = 128
    epochs = [calibrator.calibrate(Epoch(k, 0.0, 0.0), frame) for k, frame in enumerate(frames)]
    seen = [epoch.epoch.observations for epoch in epochs]
    assert seen[1].points[:, 0].min() > middle - 2
    assert [epoch.adjustment.status for epoch in epochs[2:]] == ["flat", "ok"]
    assert len(seen[3]) > 0.9 * len(seen[0])
