"""A stand-in for picamera2, since libcamera delivers no frames without a Raspberry Pi."""

from __future__ import annotations

import time
from types import ModuleType
from typing import ClassVar

import numpy as np


class Request:
    def __init__(self, camera: StandIn, metadata: dict, array: np.ndarray) -> None:
        self.camera, self.metadata, self.array = camera, metadata, array
        camera.requests_out += 1

    def get_metadata(self) -> dict:
        return self.metadata

    def make_array(self, name: str) -> np.ndarray:
        assert name == "main"
        return self.array

    def release(self) -> None:
        self.camera.requests_out -= 1


class StandIn:
    """A camera with a focusing lens, such as the Camera Module 3; tests set its attributes."""

    cameras = ({"Model": "imx219", "Id": "/base/soc/i2c0mux/i2c@1/imx219@10"},)
    sensor_resolution = (96, 64)
    camera_controls: ClassVar[dict] = {"LensPosition": (0.0, 32.0, 1.0)}
    extra: ClassVar[dict] = {}
    standing: ClassVar[dict] = {"LensPosition": 1.5, "ColourGains": (1.75, 1.5)}
    stale = 0
    hang_s = 0.0
    busy = False
    cut = False
    instances: ClassVar[list] = []

    @classmethod
    def global_camera_info(cls):
        return list(cls.cameras)

    def __init__(self, number: int) -> None:
        if type(self).busy:
            raise RuntimeError("Camera __init__ sequence did not complete.")
        self.requests_out, self.closed = 0, False
        self._stale = type(self).stale
        type(self).instances.append(self)

    def create_still_configuration(self, *, main, controls, buffer_count):
        assert main["format"] == "YUV420"
        return {"main": main, "controls": controls}

    def configure(self, camera_config) -> None:
        self.configuration = camera_config

    def start(self) -> None:
        pass

    def capture_metadata(self) -> dict:
        """Return the next frame's metadata by libcamera's current state."""
        return {**type(self).standing, **type(self).extra}

    def set_controls(self, controls: dict) -> None:
        unknown = set(controls) - {*type(self).camera_controls, "ColourGains", "AfMode"}
        assert not unknown, f"libcamera has no control {unknown}"
        self.configuration["controls"] |= controls

    def capture_request(self) -> Request:
        if type(self).hang_s:
            time.sleep(type(self).hang_s)
            raise RuntimeError("closed while waiting")
        controls = {"ExposureTime": 8000, "AnalogueGain": 2.0, **type(self).standing}
        controls |= self.configuration["controls"]
        exposure = controls["ExposureTime"]
        now = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        if self._stale:
            self._stale -= 1
            stamp = now - 50_000_000
        else:
            time.sleep(exposure * 1e-6 + 0.002)
            stamp = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        metadata = {
            "SensorTimestamp": stamp,
            "ExposureTime": exposure,
            "AnalogueGain": controls["AnalogueGain"],
            **{n: controls[n] for n in ("LensPosition", "ColourGains") if n in controls},
            "ScalerCrop": (0, 0, 96, 64),
            **type(self).extra,
        }
        self.given = metadata
        width, height = self.configuration["main"]["size"]
        array = np.full((height * 3 // 2, width + 32), 128, np.uint8)  # rows padded to the stride
        array[:height, :width] = np.add.outer(np.arange(height), np.arange(width)) % 251
        return Request(self, metadata, array[: height // 2] if type(self).cut else array)

    def close(self) -> None:
        self.closed = True


def module(camera: type[StandIn]) -> ModuleType:
    stand_in = ModuleType("picamera2")
    stand_in.Picamera2 = camera
    return stand_in
