"""Names of channels from outside never replace or shift one of the program's columns."""

from __future__ import annotations

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

import thermocald as tc
from tests.commands import call
from tests.drivers.fakes.sysfs import Sysfs
from tests.store.small import write_recording
from thermocald.acquisition.thermometers import Thermometers
from thermocald.config import parse_config
from thermocald.daemon.series_run import result_row
from thermocald.epoch import Epoch
from thermocald.errors import RecordingError, StoreError, UsageError, WrongDevice
from thermocald.hal import Reading, VirtualClock, open_device
from thermocald.names import channel_fault, tell_apart
from thermocald.output.dashboard.view import View
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES, Sensor
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head, read_head
from thermocald.store.recording.reader import read_recording
from thermocald.store.schema import COLUMN_NAMES

BAD = [
    "A1", "c", "skew_s", "frame", "sd_c", "status", "epoch", "blur_px", "lost", "online_c",
    "drift_c_px", "temperature_time", "event", "series_x0", "level_sd_y0", "mount_px",
    "series_epochs", "series_restarted",
    "Diode, left", "a;b", "bell\x07", " lead", "x=1", 'say "t"', "", "é" * 65, "two\nlines",
]  # fmt: skip
GOOD = ["temperature", "camera", "Core 0", "Gehäuse (innen)", "probe1", "C", "28-00000a1b", "µm"]
FIELD = TestField.build(["a"], np.zeros((1, 3)))


def head_of(*channels: str) -> Head:
    camera = CameraSpec("cam", Sensor(640, 480, 0.001))
    return Head("a", "M1", 10.0, camera, dict.fromkeys(channels, Channel()))


def test_a_name_that_cannot_be_a_channel_is_refused(tmp_path):
    with Store.open(tmp_path / "t.db", "append", durable=False) as store:
        for name in BAD:
            with pytest.raises(WrongDevice, match="cannot be called"):
                Reading({name: 20.0}, 0.0, 0.0)
            with pytest.raises(StoreError, match="cannot be called") as told:
                store.create_series(head_of(name), FIELD)
            assert "\n" not in str(told.value)
            with pytest.raises(RecordingError, match="cannot be called"):
                write_recording(tmp_path / "M1", head_of(name), FIELD, [])
        assert not store.all_series()
    assert not (tmp_path / "M1").exists()


def test_natural_names_are_read_back_unchanged_from_store_page_and_recording(tmp_path):
    values = {name: 20.5 + i for i, name in enumerate(GOOD)}
    assert Reading(values, 0.0, 0.0).values == values
    seen = Observations(np.array([0]), np.ones((1, 2)), np.ones((1, 2)))
    epoch = Epoch(1, 1e9, 1e9, values, observations=seen)
    with Store.open(tmp_path / "t.db", "append", durable=False) as store:
        store.append(store.create_series(head_of(*GOOD), FIELD), epoch)
    page = "".join(View(tmp_path / "t.db", Path).csv("cam", "M1")).splitlines()
    row = dict(zip(*csv.reader(page), strict=True))
    assert {name: float(row[name]) for name in GOOD} == values
    write_recording(tmp_path / "M1", head_of(*GOOD), FIELD, [epoch])
    assert read_recording(tmp_path / "M1").epochs[0].temperatures == values


def test_every_column_that_an_epoch_can_have_is_ours(tmp_path):
    """Read from where columns are made, so that a new one is refused as a channel too."""
    row = result_row(SimpleNamespace(name="cam", series="M1"), Epoch(1, 0.0, 0.0, {}), None, {})
    recording, store = tmp_path / "M1", tmp_path / "s.db"
    tc.simulate("rpi-v2.1-heating", seed=1, epochs=12, out=recording)
    call("replay", recording, "--store", store)
    page = next(View(store, Path).csv("rpi-v2.1", "M1")).splitlines()[0]
    exported = call("export", recording).stdout.splitlines()[0]
    known = {*row, *COLUMN_NAMES, *page.split(","), *exported.split(",")}
    known -= {"temperature", *read_head(recording).channels}
    assert set(PARAMETER_NAMES) < known
    assert not [name for name in known if not channel_fault(name)]


def mocks(**thermometers: list[str]) -> dict:
    """Return a configuration of mock thermometers with channels, and of their camera."""
    sections = [
        {"name": name, "driver": "mock", "options": {"channels": {c: {} for c in channels}}}
        for name, channels in thermometers.items()
    ]
    camera = {"name": "cam", "driver": "mock", "thermometers": list(thermometers)}
    return {"cameras": [camera], "thermometers": sections}


def one(**stanza) -> dict:
    return {"thermometers": [{"name": "board", **stanza}]}


@pytest.mark.parametrize(("document", "said"), [
    (one(driver="ds18b20", sensors={"A1": "28-000000000001"}), "cannot be called 'A1'"),
    (one(driver="hwmon", chip="k10temp", channels={"frame": "t"}), "cannot be called 'frame'"),
    (one(driver="mock", channels={"sd_x0": {}}), "cannot be called 'sd_x0'"),
    (one(driver="serial", port="/dev/null", pattern="(?P<c>[0-9.]+)"), "cannot be called 'c'"),
    # a thermometer's own name is the column, and `temperature` is the reference's name
    (mocks(c=["temperature"], air=["temperature"]), "thermometers"),
    (mocks(board=["inner", "temperature"]), "thermometers"),
    (mocks(skew=["s"], air=["temperature"]), "thermometers"),
    (mocks(sd=["board"], air=["temperature"]), "thermometers"),
    (mocks(a=["b_d"], a_b=["d"]), "thermometers"), (mocks(drift=["px_per_min"], x=["y"]), "drift"),
])  # fmt: skip
def test_a_configuration_with_columns_of_ours_or_two_of_one_name_is_refused(
    tmp_path, document, said
):
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    for command in (["check"], ["run", "--config"]):
        done = call(*command, tmp_path / "config.yaml")
        assert done.returncode == 2
        assert said in done.stderr


def test_a_label_of_the_kernel_that_is_no_name_gives_way_to_the_input(tmp_path):
    labels = {"temp1_label": "c", "temp2_label": "Tctl", "temp3_label": "Diode, left"}
    inputs = {f"temp{i}_input": f"3{i}000" for i in (1, 2, 3)}
    sysfs = Sysfs(tmp_path)
    sysfs.hwmon(0, "k10temp", **labels, **inputs)
    options = {"chip": "k10temp", "sysfs": str(sysfs.root)}
    with open_device("thermometer", "hwmon", options, VirtualClock()) as device:
        assert device.read().values == {"temp1": 31.0, "Tctl": 32.0, "temp3": 33.0}


def test_a_recording_with_a_column_of_ours_is_refused_when_it_is_opened(tmp_path):
    tc.simulate("rpi-v2.1-heating", seed=1, epochs=6, out=tmp_path / "M1")
    path = tmp_path / "M1/recording.yaml"
    path.write_text(path.read_text().replace("temperature:", "sigma0:", 1))
    for command in ("check", "replay", "study", "fit --output m.yaml", "discover"):
        done = call(*command.split(), tmp_path / "M1", folder=tmp_path)
        assert "'sigma0': it is the name of a column" in done.stderr


def test_the_reference_keeps_its_place_when_it_is_not_read():
    document = {"thermometers": [{"name": n, "driver": "mock"} for n in ("housing", "air")]}
    thermometers = Thermometers(parse_config(document, Path("config.yaml")), VirtualClock())
    thermometers.add("air", Reading({"temperature": 12.0}, 0.0, 0.0))
    _, temperatures, _ = thermometers.around(["housing", "air"], 0.0, patience_s=0.0)
    assert list(temperatures) == ["housing", "air"]
    epoch = Epoch(1, 0.0, 0.0, temperatures)
    row = result_row(SimpleNamespace(name="cam", series="M1"), epoch, None, {})
    np.testing.assert_array_equal([row["temperature"], temperatures["air"]], [np.nan, 12.0])


def test_series_of_one_name_are_told_apart():
    for names, sources, told in (
        (["M1", "M2"], ["day1/M1", "day1/M2"], ["M1", "M2"]),
        (["M1", "M1", "M2"], ["day1/M1", "day2/M1", "M2"], ["M1 in day1", "M1 in day2", "M2"]),
        (["M1"] * 3, ["a/x/M1", "a/y/M1", "b/x/M1"],
         ["M1 in a/x/M1", "M1 in a/y/M1", "M1 in b/x/M1"]),
        (["M1", "M1"], ["day/M1", "day/N1"], ["M1", "M1 in N1"]),
        (["M1"] * 3, ["M1", "a/M1", "x/b/M1"], ["M1", "M1 in a", "M1 in b"]),
    ):  # fmt: skip
        assert tell_apart(names, sources) == told


@pytest.mark.parametrize(("path", "says"), [
    ("", "a path is empty"), ("nowhere/M1", "nowhere/M1: does not exist"),
    ("x" * 5000, "^x{200}…x{200}: cannot be read: File name too long"),
])  # fmt: skip
def test_a_path_that_leads_nowhere_is_one_error(path, says):
    for read in (tc.open, tc.open_all):
        with pytest.raises((StoreError, UsageError), match=says):
            read(path)
