"""The focus and exposure that frames report reach the store; what a start is refused for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.daemon.conftest import make_recording, replayed_camera
from thermocald.acquisition.calibrator import CalibratedEpoch
from thermocald.acquisition.pipeline import AcquiredEpoch
from thermocald.acquisition.steady_clock import SteadyClock
from thermocald.acquisition.thermometers import Thermometers
from thermocald.config import parse_config
from thermocald.daemon.live_state import LiveState
from thermocald.daemon.plan import plan_cameras
from thermocald.daemon.series_run import Runtime, SeriesRun
from thermocald.daemon.service import Service
from thermocald.daemon.store_guard import StoreGuard
from thermocald.epoch import Epoch
from thermocald.errors import ConfigurationError
from thermocald.hal import Frame, VirtualClock
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.store.series import EpochResult

CAMERA = {"name": "river", "driver": "v4l2", "device": "/dev/video0", "width": 64, "height": 48}
PHONE = {"name": "phone", "driver": "android", "serial": "X", "width": 96, "height": 64}


def plan_of(camera, **changes):
    document = {"cameras": [{**camera, "series": "M1", **changes}]}
    (plan,) = plan_cameras(parse_config(document, Path("/etc/config.yaml")), VirtualClock())
    return plan


@pytest.fixture
def run(tmp_path):
    """A series that stores epochs of a camera without its frames."""
    guard = StoreGuard(tmp_path / "k.db", durable=False)
    runtime = Runtime(guard, SteadyClock(VirtualClock()), LiveState(tmp_path))
    none = Thermometers(SimpleNamespace(cameras=(), thermometers=()), VirtualClock())
    frames = SimpleNamespace(wanted=lambda *_: False, root=tmp_path)
    yield SeriesRun(plan_of(CAMERA), runtime, none, frames, [], dict)
    guard.close()


def keep(run, number: int, **temperatures: float) -> Epoch:
    """Take an epoch; return it."""
    utc, settings = 1e9 + number, {"focus": 30.0, "gain": 4.0}
    frame = Frame(np.zeros((48, 64), np.uint8), 1.0, utc, settings=settings)
    epoch = Epoch(number, utc, utc, temperatures)
    run.keep(AcquiredEpoch(number, frame, True, epoch))
    return epoch


def test_a_thermometer_that_was_never_there_is_assumed_to_have_a_temperature():
    """Regression: of one that was plugged in later, no analysis had a temperature."""
    config = {"thermometers": [{"name": "air", "driver": "hwmon", "chip": "tmp102"}]}
    thermometers = Thermometers(parse_config(config, Path("c.yaml")), VirtualClock())
    assert thermometers.columns(["air"]) == ["temperature"]


def test_every_epoch_keeps_its_settings_also_when_it_is_calibrated_later(run, caplog):
    run.amend(CalibratedEpoch(Epoch(1, 1e9, 1e9, {}), failed("no_observations", ""), {}))
    assert "the calibration of epoch 1 waits: series M1 has not begun" in caplog.text
    # a temperature that the series began without is told once: no analysis had any
    for number, channel in enumerate(("temperature", "lens", "lens"), 1):
        keep(run, number, **{channel: 20.0})
    assert caplog.text.count("series M1 began without lens: no analysis") == 1
    store = run.runtime.guard.store
    assert [event.kind for event in store.events()] == ["series_begun", "channel_unknown"]
    assert all(event.text.startswith("camera river: series M1 beg") for event in store.events())
    store.amend(run.series, 1, EpochResult("ok"), extra={"blur": 0.7})
    columns = store.series_columns(run.series, ["camera_focus", "camera_gain", "blur"])
    assert columns["camera_focus"].tolist() == [30.0] * 3
    assert columns["camera_gain"].tolist() == [4.0] * 3
    assert columns["blur"][0] == 0.7


AIR, CASE = ({"name": name, "driver": "mock"} for name in ("air", "case"))
UNNAMED = {"name": "u", "driver": "replay"}
GONE = {"faults": [{"kind": "unplugged", "at_s": 0, "for_s": 1e9}]}


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        ([AIR, {**CASE, **GONE}], [CASE, AIR], None),
        ([AIR], [CASE], None),  # of one thermometer, the column is `temperature`
        ([UNNAMED, AIR], [UNNAMED, AIR], None),  # regression: refused at each start but the first
        ([AIR], [AIR, CASE], (r"^camera 'r': choose a new name for its `series`, or configure the "
         r"thermometers \(temperature, not air, case\) with which 'watch' was begun$")),
        ([AIR], [AIR], r"or configure the test field with which 'watch' was begun$"),
    ],
)  # fmt: skip
def test_a_start_is_refused_only_for_other_thermometers_or_targets(tmp_path, before, after, why):
    recording = make_recording(tmp_path / "R", 2)
    for name in ("recording.yaml", "epochs.csv"):
        text = (recording / name).read_text().replace("temperature:", "lens:")
        (recording / name).write_text(text.replace(",temperature,", ",lens,"))

    def start(thermometers):
        devices = [{**one, "recording": str(recording)} if one is UNNAMED else one
                   for one in thermometers]  # fmt: skip
        names = [one["name"] for one in thermometers]
        camera = replayed_camera(recording, name="r", thermometers=names)
        document = {"cameras": [camera, {**camera, "name": "idle", "series": None}],
                    "thermometers": devices, "frames": {"keep": "none"}}  # fmt: skip
        config = parse_config(document, tmp_path / "config.yaml")
        assert Service(config, fast=True, epochs=1, until_finished=True).run()

    start(before)
    if why is None:
        start(after)
        return
    if before == after:
        field = recording / "testfield.csv"
        field.write_text("".join(field.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(ConfigurationError, match=why):
        start(after)


def test_a_long_series_does_not_keep_its_next_epochs_waiting(run, tmp_path, monkeypatch):
    """Regression: after a restart, all epochs were read before the first one was calibrated."""
    guard, read, epoch = run.runtime.guard, [], keep(run, 1, air=20.0)
    (tmp_path / "late.jpg").touch()
    for number in range(2, 1201):
        late = Path("late.jpg") if number == 1100 else None
        guard.store.append(run.series, replace(epoch, number=number, frame=late))
    epochs = guard.epochs
    monkeypatch.setattr(guard, "epochs", lambda *a, **b: read.extend(epochs(*a, **b)) or read[:])
    found = []
    for _ in range(7):
        read.clear()
        found.append(run.backlog(1201))
        assert len(read) <= 200
    assert [one.number for one in found if one is not None] == [1100]


@pytest.mark.parametrize("camera", [CAMERA, PHONE])
def test_a_sensor_of_another_size_than_the_driver_is_refused(camera):
    width, height = camera["width"], camera["height"]
    sensor = {"width_px": width, "height_px": height, "pixel_pitch_mm": 0.003}
    assert plan_of(camera, sensor=sensor).sensor.width == width
    with pytest.raises(ConfigurationError, match=rf"1920×1080 px.* have {width}×{height} px"):
        plan_of(camera, sensor={**sensor, "width_px": 1920, "height_px": 1080})
