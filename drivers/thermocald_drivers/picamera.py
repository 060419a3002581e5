"""Raspberry Pi cameras through libcamera and picamera2 (Camera Module v2.1 and newer).

    cameras:
      - name: rpi
        driver: picamera2
        camera: 0                     # as `rpicam-hello --list-cameras` counts
        model: imx219                 # refuses any other sensor
        width: 3280                   # the whole sensor, no scaling
        height: 2464
        exposure_s: 0.02
        gain: 1.0
        focus_dioptres: null          # lens position in 1/m; null where there is none
        timeout_s: 10

The frame is the luminance plane of the sensor's YUV output, without a JPEG in between. Automatic
exposure, gain and white balance are off; what the sensor really did stands in the metadata and
must agree with what was asked (to `tolerance`, 5 %: exposures are whole numbers of lines). A frame
that began before the call is thrown away. A capture that hangs is given up after `timeout_s` and
the camera closed, so that the next `open` begins anew. picamera2 comes from Raspberry Pi OS
(`apt install python3-picamera2`; the environment needs `--system-site-packages`).

libcamera's SensorTimestamp is on CLOCK_BOOTTIME, when the first line began to be read out: half an
exposure later than the middle of that line's exposure. SensorTemperature is kept only where it is
believable: the IMX219 gives none; others give their lower clamp (−20) or 0.0 until it is measured.
"""

from __future__ import annotations

import concurrent.futures
import logging
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import (
    BadReading,
    DeviceDenied,
    DeviceGone,
    DeviceTimeout,
    WrongDevice,
)
from thermocald.hal import Camera, Found, Frame
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.hal import Clock

__all__ = ["Picamera2Camera", "sensor_temperature"]

log = logging.getLogger(__name__)

CLAMP_LOW_C, CLAMP_HIGH_C = -20.0, 80.0
CLOSE_S = 3.0


def sensor_temperature(metadata: Mapping[str, Any]) -> float | None:
    """°C of the sensor; None where it is absent or a value that means "unknown"."""
    value = metadata.get("SensorTemperature")
    if isinstance(value, bool) or not isinstance(value, int | float) or value == 0.0:
        return None
    return float(value) if CLAMP_LOW_C < value < CLAMP_HIGH_C else None


def _jsonable(value: Any) -> Any:
    """Libcamera's rectangles and tuples as lists."""
    if isinstance(value, dict):
        return {str(key): _jsonable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(entry) for entry in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


class Picamera2Camera(Camera):
    """One libcamera camera, configured for stills and kept running."""

    device_classes = ("char-video4linux", "char-media", "char-dma_heap")

    def __init__(
        self,
        *,
        clock: Clock,
        camera: int = 0,
        model: str | None = None,
        width: int = 3280,
        height: int = 2464,
        exposure_s: float = 0.02,
        gain: float = 1.0,
        focus_dioptres: float | None = None,
        tolerance: float = 0.05,
        timeout_s: float = 10.0,
    ) -> None:
        self.clock = clock
        self.number = int(support.number("camera", camera, 0, 9, whole=True))
        self.model = model
        self.width = int(support.number("width", width, 64, 20000, "px", whole=True))
        self.height = int(support.number("height", height, 64, 20000, "px", whole=True))
        self.exposure_s = support.number("exposure_s", exposure_s, 1e-5, 200, "s")
        self.gain = support.number("gain", gain, 1, 64)
        self.focus_dioptres = (
            None
            if focus_dioptres is None
            else support.number("focus_dioptres", focus_dioptres, 0, 32, "1/m")
        )
        self.tolerance = support.number("tolerance", tolerance, 0, 1)
        self.timeout_s = support.number("timeout_s", timeout_s, 0.05, 600, "s")
        self._camera: Any = None
        self._seen = False

    @property
    def where(self) -> str:
        """The device as the user knows it."""
        return f"libcamera camera {self.number}"

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """Cameras that libcamera lists."""
        library = support.library("picamera2")
        return [
            Found({"camera": k, "model": str(info.get("Model", ""))}, str(info.get("Id", "")))
            for k, info in enumerate(library.Picamera2.global_camera_info())
        ]

    def open(self) -> None:
        self._in_time(self._open, "opening")
        self._seen = True

    def _open(self) -> None:
        library = support.library("picamera2")
        cameras = library.Picamera2.global_camera_info()
        if self.number >= len(cameras):
            names = ", ".join(str(info.get("Model")) for info in cameras) or "none"
            raise support.absent(
                f"{self.where}: libcamera lists {len(cameras)} ({names}); "
                "is the ribbon cable seated, camera_auto_detect=1 set?",
                seen=self._seen,
            )
        found = str(cameras[self.number].get("Model", ""))
        if self.model is not None and self.model != found:
            raise WrongDevice(f"{self.where}: this is a {found}, not a {self.model}")
        try:
            camera = library.Picamera2(self.number)
        except RuntimeError as error:
            raise DeviceDenied(f"{self.where}: another program has it ({error})") from error
        try:
            self._configure(camera)
        except BaseException:
            camera.close()
            raise
        self._camera = camera

    def _configure(self, camera: Any) -> None:
        if tuple(camera.sensor_resolution) != (self.width, self.height):
            have = "×".join(str(n) for n in camera.sensor_resolution)
            raise WrongDevice(
                f"{self.where}: the sensor has {have} px, not {self.width}×{self.height}; "
                "a scaled image has another interior orientation"
            )
        microseconds = round(self.exposure_s * 1e6)
        controls: dict[str, Any] = {
            "AeEnable": False,
            "AwbEnable": False,
            "ExposureTime": microseconds,
            "AnalogueGain": self.gain,
            "FrameDurationLimits": (max(microseconds, 100_000),) * 2,
        }
        if self.focus_dioptres is not None:
            if "LensPosition" not in camera.camera_controls:
                raise WrongDevice(
                    f"{self.where}: this lens cannot be focused; focus_dioptres: null"
                )
            controls |= {"AfMode": 0, "LensPosition": self.focus_dioptres}
        size = (self.width, self.height)
        camera.configure(
            camera.create_still_configuration(
                main={"size": size, "format": "YUV420"}, controls=controls, buffer_count=2
            )
        )
        camera.start()

    def close(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            try:
                self._in_time(camera.close, "closing", CLOSE_S)
            except (DeviceTimeout, RuntimeError) as error:
                log.warning("%s", error)

    def identity(self) -> Mapping[str, str]:
        return {"camera": str(self.number), "model": str(self.model or "")}

    def frame_size(self) -> tuple[int, int]:
        return self.width, self.height

    def capture(self) -> Frame:
        camera = self._camera
        if camera is None:
            raise DeviceGone(f"{self.where}: not open")
        called_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        try:
            plane, metadata = self._in_time(lambda: self._fresh(camera, called_ns), "a capture")
        except DeviceTimeout:
            self.close()  # a hung pipeline does not come back by itself
            raise
        if plane is None:
            raise BadReading(f"{self.where}: no frame that began after the call")
        self._verify(metadata)
        exposure = metadata["ExposureTime"] * 1e-6
        sleep_s = time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()  # since booting
        middle = metadata["SensorTimestamp"] * 1e-9 - sleep_s - exposure / 2.0
        monotonic, utc = support.on_clock(self.clock, middle)
        kept = _jsonable(dict(metadata))
        kept["sensor_temperature_c"] = sensor_temperature(metadata)
        return Frame(
            image=plane,
            monotonic=monotonic,
            utc=utc,
            exposure=exposure,
            metadata=kept,
        )

    def _fresh(self, camera: Any, called_ns: int) -> tuple[Any, Mapping[str, Any]]:
        """(grey plane, metadata) of the first frame whose exposure began after the call."""
        deadline = time.monotonic() + self.timeout_s
        while time.monotonic() < deadline and self._camera is camera:
            request = camera.capture_request()
            try:
                metadata = request.get_metadata()
                if "SensorTimestamp" not in metadata or "ExposureTime" not in metadata:
                    raise BadReading(f"{self.where}: a frame without time stamp or exposure")
                if metadata["SensorTimestamp"] - metadata["ExposureTime"] * 1000 < called_ns:
                    continue
                return self._plane(request.make_array("main")), metadata
            finally:
                request.release()
        return None, {}

    def _plane(self, array: Any) -> Any:
        """The luminance of a YUV420 array: the top H rows, whose stride may exceed the width."""
        rows, stride = array.shape
        if rows < self.height * 3 // 2 or stride < self.width:
            raise BadReading(f"{self.where}: partial frame, {stride}×{rows} bytes")
        return np.array(array[: self.height, : self.width], np.uint8)

    def _verify(self, metadata: Mapping[str, Any]) -> None:
        """The camera did what it was told; libcamera delivers what it can, not what was asked."""
        asked = {"ExposureTime": self.exposure_s * 1e6, "AnalogueGain": self.gain}
        if self.focus_dioptres is not None:
            asked["LensPosition"] = self.focus_dioptres
        for name, value in asked.items():
            got = metadata.get(name)
            if got is None or abs(got - value) > self.tolerance * max(value, 1e-9):
                raise BadReading(f"{self.where}: {name} was set to {value:g} and is {got}")

    def _in_time(self, work: Any, what: str, timeout_s: float | None = None) -> Any:
        """Run in a thread of its own, which is left behind if it hangs."""
        limit = self.timeout_s if timeout_s is None else timeout_s
        task: concurrent.futures.Future[Any] = concurrent.futures.Future()

        def run() -> None:
            try:
                task.set_result(work())
            except BaseException as error:  # noqa: BLE001 - handed over to the caller
                task.set_exception(error)

        threading.Thread(target=run, daemon=True, name=f"picamera2-{what}").start()
        try:
            return task.result(limit)
        except concurrent.futures.TimeoutError as error:
            if task.done():
                raise
            raise DeviceTimeout(
                f"{self.where}: {what} hangs, given up after {limit:g} s"
            ) from error
