"""The driver with libcamera and picamera2 themselves: `.ci/picamera2` has those of Debian 13.

There the camera is libcamera's own virtual one: it is listed and identified like a real one, but
gives picamera2 no raw mode, so opening it ends with picamera2's error. Frames need a Pi.
"""

from __future__ import annotations

import ast
import inspect
import json
from pathlib import Path

import pytest
from thermocald_drivers import picamera

from thermocald.errors import DeviceDenied, DeviceGone, ThermocaldError, WrongDevice
from thermocald.hal import SystemClock

controls = pytest.importorskip("libcamera", reason="libcamera is not here").controls
picamera2 = pytest.importorskip("picamera2", reason="picamera2 is not here")

API = json.loads(Path(__file__).with_name("picamera2_api.json").read_text())["classes"]
NO_CONTROLS = {"Picamera2Camera", "YUV420", "Model", "Id"}


def names_in(module) -> set[str]:
    """Words of the driver's source that are written as libcamera writes names."""
    tree = ast.parse(inspect.getsource(module))
    texts = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)}
    return {t for t in texts if isinstance(t, str) and t.isidentifier() and t[:1].isupper()}


def test_every_control_that_the_driver_names_exists():
    named = names_in(picamera)
    assert {"ExposureTime", "AnalogueGain", "LensPosition", "SensorTimestamp"} <= named
    assert [name for name in named - NO_CONTROLS if not hasattr(controls, name)] == []
    assert int(controls.AfModeEnum.Manual) == picamera.MANUAL_FOCUS
    assert int(controls.AfModeEnum.Continuous) == picamera.CONTINUOUS_FOCUS


@pytest.mark.parametrize("kind", ["Picamera2", "CompletedRequest"])
def test_the_recorded_signatures_are_those_of_the_installed_picamera2(kind):
    source = picamera2.Picamera2 if kind == "Picamera2" else picamera2.request.CompletedRequest
    for name, recorded in API[kind].items():
        if recorded is None or name.startswith("_") or not hasattr(source, name):
            continue
        own = list(inspect.signature(getattr(source, name)).parameters)
        wanted = [part.split("=")[0].strip("*") for part in recorded.split(", ") if part]
        assert [p for p in own if p != "self"][: len(wanted)] == wanted, name


def camera(**options):
    return picamera.Picamera2Camera(clock=SystemClock(), timeout_s=20, **options)


def test_a_camera_is_listed_and_another_one_refused():
    (found,) = picamera.Picamera2Camera.attached()
    assert found.options["camera"] == 0
    assert found.options["model"] == "Virtual Video Device"
    with pytest.raises(WrongDevice, match=r"this is 'Virtual Video Device', not 'imx219'"):
        camera(model="imx219").open()
    with pytest.raises(ThermocaldError, match=r"libcamera lists 1 \(Virtual Video Device\)"):
        camera(camera=3).open()


def test_a_camera_that_picamera2_cannot_start_is_an_error_in_words():
    device = camera()
    with pytest.raises(DeviceDenied, match=r"cannot be opened.*another program"):
        device.open()
    device.close()
    with pytest.raises(DeviceGone):
        device.capture()
