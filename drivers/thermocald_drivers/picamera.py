"""Raspberry Pi cameras through libcamera and picamera2 (Camera Module v2.1 and newer).

    cameras:
      - name: rpi
        driver: picamera2
        camera: 0                     # as `rpicam-hello --list-cameras` counts
        model: imx219                 # refuses any other sensor
        width: 3280                   # the whole sensor, no scaling
        height: 2464
        exposure_s: 0.02              # or `auto`
        gain: 1.0                     # analogue; or `auto`
        focus_dioptres: 2.0           # lens position in 1/m, `auto`, or left out: locked as it is
        colour_gains: [1.8, 1.5]      # red, blue; `auto`, or left out: locked as they are
        tolerance: 0.05               # by which exposure, gain and focus may differ
        timeout_s: 10

The frame is the luminance plane of the sensor's YUV output, without a JPEG in between. Automatic
exposure, gain, white balance and focus are off; lens position and colour gains are locked at the
values of the first frame after opening, and at the same ones when the camera is opened again. What
the sensor really did is read back with each frame, stored with the epoch, and must agree with what
was set (`tolerance`: exposures are whole numbers of lines). `auto` is accepted only by name, with a
warning in the status. A frame that began before the call is discarded. A capture that hangs is
given up after `timeout_s` and the camera closed, so that the next `open` starts again. picamera2
comes from Raspberry Pi OS (`apt install python3-picamera2`; the environment needs
`--system-site-packages`).

libcamera's SensorTimestamp is on CLOCK_BOOTTIME, when the first line began to be read out: half an
exposure later than the middle of that line's exposure. SensorTemperature is kept only where it is
plausible: the IMX219 gives none; others give their lower limit (−20) or 0.0 until it is measured.
Source: libcamera control_ids_core.yaml, Picamera2 manual (Raspberry Pi Ltd), appendix C.
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
    ConfigurationError,
    DeviceDenied,
    DeviceGone,
    DeviceTimeout,
    WrongDevice,
)
from thermocald.hal import Camera, Found, Frame
from thermocald_drivers import support
from thermocald_drivers.picamera_metadata import (
    agrees,
    frame_settings,
    jsonable,
    sensor_temperature,
)
from thermocald_drivers.support import AUTO

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock

__all__ = ["Picamera2Camera", "sensor_temperature"]

log = logging.getLogger(__name__)

CLOSE_S = 3.0
MANUAL_FOCUS, CONTINUOUS_FOCUS = 0, 2
"""libcamera's AfModeManual and AfModeContinuous."""


def _colour_gains(value: object) -> tuple[float, float] | str | None:
    """Red and blue gain, AUTO, or None; ConfigurationError for anything else."""
    if value is None or value == AUTO:
        return None if value is None else AUTO
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ConfigurationError(f"colour_gains: {value!r} is neither [red, blue] nor {AUTO}")
    red, blue = (support.number("colour_gains", gain, 0, 32) for gain in value)
    return red, blue


def _current_settings(library: Any, number: int) -> dict[str, Any]:
    """Size and lens position of a camera that nobody uses; {} otherwise."""
    try:
        camera = library.Picamera2(number)
    except RuntimeError:
        return {}
    try:
        width, height = camera.sensor_resolution
        found: dict[str, Any] = {"width": int(width), "height": int(height)}
        limits = camera.camera_controls.get("LensPosition")
        if isinstance(limits, tuple) and len(limits) == 3 and limits[2] is not None:
            found["focus_dioptres"] = float(limits[2])
        return found
    finally:
        camera.close()


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
        exposure_s: float | str = 0.02,
        gain: float | str = 1.0,
        focus_dioptres: float | str | None = None,
        colour_gains: Sequence[float] | str | None = None,
        tolerance: float = 0.05,
        timeout_s: float = 10.0,
    ) -> None:
        self.clock = clock
        self.number = int(support.number("camera", camera, 0, 9, whole=True))
        self.model = model
        self.width = int(support.number("width", width, 64, 20000, "px", whole=True))
        self.height = int(support.number("height", height, 64, 20000, "px", whole=True))
        self.exposure_s = support.number_or_auto("exposure_s", exposure_s, 1e-5, 200, "s")
        self.gain = support.number_or_auto("gain", gain, 1, 64)
        self.focus_dioptres = (
            None
            if focus_dioptres is None
            else support.number_or_auto("focus_dioptres", focus_dioptres, 0, 32, "1/m")
        )
        self.colour_gains = _colour_gains(colour_gains)
        self.tolerance = support.number("tolerance", tolerance, 0, 1)
        self.timeout_s = support.number("timeout_s", timeout_s, 0.05, 600, "s")
        self._camera: Any = None
        self._seen = False
        self._held: dict[str, Any] = {}

    @property
    def where(self) -> str:
        """The device as the user knows it."""
        return f"libcamera camera {self.number}"

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """Cameras that libcamera lists."""
        library = support.library("picamera2")
        found = []
        for k, info in enumerate(library.Picamera2.global_camera_info()):
            options = {"camera": k, "model": str(info.get("Model", ""))}
            options |= _current_settings(library, k) | {"exposure_s": 0.02, "gain": 1.0}
            found.append(Found(options, str(info.get("Id", ""))))
        return found

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
            raise DeviceDenied(
                f"{self.where}: cannot be opened ({error}); does another program have it?"
            ) from error
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
        if self.focus_dioptres is not None and "LensPosition" not in camera.camera_controls:
            raise WrongDevice(
                f"{self.where}: this lens cannot be focused; leave focus_dioptres out"
            )
        size = (self.width, self.height)
        camera.configure(
            camera.create_still_configuration(
                main={"size": size, "format": "YUV420"},
                controls=self._controls("LensPosition" in camera.camera_controls),
                buffer_count=2,
            )
        )
        camera.start()
        self._lock(camera)

    def _controls(self, focuses: bool) -> dict[str, Any]:
        """The controls of the configuration; what is left out is locked by `_lock`."""
        automatic = AUTO in (self.exposure_s, self.gain)
        controls: dict[str, Any] = {"AeEnable": automatic, "AwbEnable": self.colour_gains == AUTO}
        if not isinstance(self.exposure_s, str):
            microseconds = round(self.exposure_s * 1e6)
            controls["ExposureTime"] = microseconds
            controls["FrameDurationLimits"] = (max(microseconds, 100_000),) * 2
        if not isinstance(self.gain, str):
            controls["AnalogueGain"] = self.gain
        if isinstance(self.colour_gains, tuple):
            controls["ColourGains"] = self.colour_gains
        if focuses:
            controls["AfMode"] = CONTINUOUS_FOCUS if self.focus_dioptres == AUTO else MANUAL_FOCUS
            if isinstance(self.focus_dioptres, int | float):
                controls["LensPosition"] = self.focus_dioptres
        return controls

    def _lock(self, camera: Any) -> None:
        """Hold lens position and colour gains where the stanza leaves them out."""
        wanted = {"LensPosition": self.focus_dioptres, "ColourGains": self.colour_gains}
        open_ones = [name for name, value in wanted.items() if value is None]
        if any(name not in self._held for name in open_ones):
            first = camera.capture_metadata()
            self._held = {n: first[n] for n in open_ones if first.get(n) is not None} | self._held
        held = {name: self._held[name] for name in open_ones if name in self._held}
        if held:
            camera.set_controls(held)

    def close(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            try:
                self._in_time(camera.close, "closing", CLOSE_S)
            except (DeviceTimeout, RuntimeError) as error:
                log.warning("%s", error)

    def warnings(self) -> list[str]:
        options = ("exposure_s", "gain", "focus_dioptres", "colour_gains")
        return [
            f"{name}: auto lets the camera change it; every change is another camera"
            for name in options
            if getattr(self, name) == AUTO
        ]

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
        kept = jsonable(dict(metadata))
        kept["sensor_temperature_c"] = sensor_temperature(metadata)
        return Frame(
            image=plane,
            monotonic=monotonic,
            utc=utc,
            exposure=exposure,
            metadata=kept,
            settings=frame_settings(metadata) | self._modes(metadata),
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
        """Libcamera delivers what it can, not what was asked: BadReading where they differ."""
        asked: dict[str, Any] = dict(self._held)
        if not isinstance(self.exposure_s, str):
            asked["ExposureTime"] = self.exposure_s * 1e6
        if not isinstance(self.gain, str):
            asked["AnalogueGain"] = self.gain
        if isinstance(self.focus_dioptres, int | float):
            asked["LensPosition"] = self.focus_dioptres
        if isinstance(self.colour_gains, tuple):
            asked["ColourGains"] = self.colour_gains
        for name, value in asked.items():
            got = metadata.get(name)
            if not agrees(value, got, self.tolerance):
                shown = f"{value:g}" if isinstance(value, int | float) else f"{value}"
                raise BadReading(f"{self.where}: {name} was set to {shown} and is {got}")

    def _modes(self, metadata: Mapping[str, Any]) -> dict[str, float]:
        """Which settings are left to the camera, as 1.0 and 0.0."""
        found = {
            "exposure_auto": float(AUTO in (self.exposure_s, self.gain)),
            "white_balance_auto": float(self.colour_gains == AUTO),
        }
        if "LensPosition" in metadata:
            found["focus_auto"] = float(self.focus_dioptres == AUTO)
        return found

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
