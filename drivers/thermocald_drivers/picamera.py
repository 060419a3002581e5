"""Raspberry Pi cameras through libcamera and picamera2 (Camera Module v2.1 and newer).

    cameras:
      - name: rpi
        driver: picamera2
        camera: 0                     # its number in `rpicam-hello --list-cameras`
        model: imx219                 # any other sensor is rejected
        width: 3280                   # the whole sensor, unscaled
        height: 2464
        exposure_s: 0.02              # or `auto`
        gain: 1.0                     # analogue; or `auto`
        focus_dioptres: 2.0           # lens position in 1/m, `auto`, or omitted: locked as it is
        colour_gains: [1.8, 1.5]      # red, blue; `auto`, or omitted: locked as they are
        tolerance: 0.05               # relative; for exposure, gain and focus as read back
        timeout_s: 10

The frame is the luminance plane of the sensor's YUV output; no JPEG is involved. Automatic
exposure, gain, white balance and focus are off. An omitted lens position or colour gain is locked
at its value in the first frame after opening, also when the camera is opened again. The sensor's
actual settings are read back with each frame, stored with the epoch, and must agree with the
options (`tolerance`: exposures are whole numbers of lines). `auto` has to be written explicitly and
is shown as a warning in the status. A frame that began before the call is discarded. A capture that
hangs is abandoned after `timeout_s` and the camera closed, so that the next `open` starts afresh.
picamera2 comes with Raspberry Pi OS (`apt install python3-picamera2`; the environment needs
`--system-site-packages`).

libcamera's SensorTimestamp, on CLOCK_BOOTTIME, is the start of the first line's readout: half an
exposure after the middle of that line's exposure. SensorTemperature is stored with an epoch if it
is plausible: the IMX219 reports none; others report their lower limit (−20) or 0.0 until they have
measured it.
Source: libcamera control_ids_core.yaml, Picamera2 manual (Raspberry Pi Ltd), appendix C.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceDenied,
    DeviceTimeout,
    WrongDevice,
)
from thermocald.hal import Camera, DriverOptions, Found, Frame
from thermocald_drivers import chips, support
from thermocald_drivers.support import AUTO

if TYPE_CHECKING:
    from collections.abc import Mapping

log = logging.getLogger(__name__)

_NUMBERS = (
    # setting, libcamera's name, unit
    ("exposure_s", "ExposureTime", 1e-6),
    ("gain", "AnalogueGain", 1.0),
    ("digital_gain", "DigitalGain", 1.0),
    ("focus_dioptres", "LensPosition", 1.0),
)
CLOSE_S = 3.0
MANUAL_FOCUS, CONTINUOUS_FOCUS = 0, 2
"""libcamera's AfModeManual and AfModeContinuous."""


def _gains(value: list[float] | str | None) -> tuple[float, float] | str | None:
    if value in (None, AUTO):
        return value
    if isinstance(value, str) or len(value) != 2 or not all(0 <= gain <= 32 for gain in value):
        raise ConfigurationError(f"{value!r} is neither [red, blue] within 0 … 32 nor {AUTO}")
    return value[0], value[1]


def _current_settings(library: Any, number: int) -> dict[str, Any]:
    """Return a camera's size and lens position; {} if another program uses it."""
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
    """A libcamera camera, configured for stills and streaming while it is open."""

    device_classes = ("char-video4linux", "char-media", "char-dma_heap")

    class Options(DriverOptions):
        """The options of `picamera2`; focus_dioptres, colour_gains None: locked as they are."""

        camera: Annotated[int, Field(ge=0, le=9)] = 0
        model: support.Text | None = None
        width: support.Pixels = 3280
        height: support.Pixels = 2464
        exposure_s: Annotated[float | str, support.or_auto(1e-5, 200)] = 0.02
        gain: Annotated[float | str, support.or_auto(1, 64)] = 1.0
        focus_dioptres: Annotated[float | str | None, support.or_auto(0, 32)] = None
        colour_gains: Annotated[list[float] | str | None, AfterValidator(_gains)] = None
        tolerance: Annotated[float, Field(ge=0.0, le=1.0)] = 0.05
        timeout_s: Annotated[float, Field(ge=0.05, le=600.0)] = 10.0

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.where = f"libcamera camera {self.options.camera}"
        self._held: dict[str, Any] = {}
        o = self.options
        stated = {
            "ExposureTime": o.exposure_s if o.exposure_s == AUTO else round(o.exposure_s * 1e6),
            "AnalogueGain": o.gain,
            "LensPosition": o.focus_dioptres,
            "ColourGains": o.colour_gains,
        }
        self._stated = {name: v for name, v in stated.items() if v not in (None, AUTO)}

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """List libcamera's cameras."""
        library = support.library("picamera2")
        found = []
        for k, info in enumerate(library.Picamera2.global_camera_info()):
            options = {"camera": k, "model": str(info.get("Model", ""))}
            options |= _current_settings(library, k) | {"exposure_s": 0.02, "gain": 1.0}
            found.append(Found(options, str(info.get("Id", ""))))
        return found

    def open(self) -> None:
        self._in_time(self._open, "opening")
        self.seen = True

    def _open(self) -> None:
        library = support.library("picamera2")
        cameras = library.Picamera2.global_camera_info()
        if self.options.camera >= len(cameras):
            names = ", ".join(str(info.get("Model")) for info in cameras) or "none"
            raise support.absent(
                f"{self.where}: libcamera lists {len(cameras)} ({names}); "
                "check the ribbon cable and camera_auto_detect=1",
                seen=self.seen,
            )
        found = str(cameras[self.options.camera].get("Model", ""))
        if self.options.model is not None and self.options.model != found:
            raise WrongDevice(f"{self.where}: this is {found!r}, not {self.options.model!r}")
        try:
            camera = library.Picamera2(self.options.camera)
        except RuntimeError as error:
            raise DeviceDenied(
                f"{self.where}: cannot be opened ({error}); another program may be using it"
            ) from error
        try:
            self._configure(camera)
        except BaseException:
            camera.close()
            raise
        self.handle = camera

    def _configure(self, camera: Any) -> None:
        o, focuses = self.options, "LensPosition" in camera.camera_controls
        if tuple(camera.sensor_resolution) != (o.width, o.height):
            have = "×".join(str(n) for n in camera.sensor_resolution)
            raise WrongDevice(
                f"{self.where}: the sensor has {have} px, not {o.width}×{o.height}; a scaled image "
                "has another interior orientation"
            )
        if o.focus_dioptres is not None and not focuses:
            raise WrongDevice(f"{self.where}: this lens cannot be focused; omit focus_dioptres")
        controls: dict[str, Any] = {
            "AeEnable": AUTO in (o.exposure_s, o.gain),
            "AwbEnable": o.colour_gains == AUTO,
            **self._stated,
        }
        if exposure := controls.get("ExposureTime"):
            controls["FrameDurationLimits"] = (max(exposure, 100_000),) * 2
        if focuses:
            automatic = o.focus_dioptres == AUTO
            controls["AfMode"] = CONTINUOUS_FOCUS if automatic else MANUAL_FOCUS
        main = {"size": (o.width, o.height), "format": "YUV420"}
        still = camera.create_still_configuration(main=main, controls=controls, buffer_count=2)
        camera.configure(still)
        camera.start()
        # what the stanza omits is locked as it is
        wanted = {"LensPosition": o.focus_dioptres, "ColourGains": o.colour_gains}
        open_ones = [name for name, value in wanted.items() if value is None]
        if any(name not in self._held for name in open_ones):
            first = camera.capture_metadata()
            self._held = {n: first[n] for n in open_ones if first.get(n) is not None} | self._held
        if self._held:
            camera.set_controls(self._held)

    def close(self) -> None:
        camera, self.handle = self.handle, None
        if camera is not None:
            try:
                self._in_time(camera.close, "closing", CLOSE_S)
            except (DeviceTimeout, RuntimeError) as error:
                log.warning("%s", error)

    def warnings(self) -> list[str]:
        return support.automatic_warnings(dict(self.options))

    def identity(self) -> Mapping[str, str]:
        return {"camera": str(self.options.camera), "model": str(self.options.model or "")}

    def capture(self) -> Frame:
        camera = self.opened()
        called_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        try:
            plane, metadata = self._in_time(lambda: self._fresh(camera, called_ns), "a capture")
        except DeviceTimeout:
            self.close()  # a hung pipeline does not come back by itself
            raise
        for name, value in (self._held | self._stated).items():
            # libcamera applies the nearest possible setting
            if not agrees(value, got := metadata.get(name), self.options.tolerance):
                shown = f"{value:g}" if isinstance(value, int | float) else f"{value}"
                raise BadReading(f"{self.where}: {name} was set to {shown} and is {got}")
        exposure = metadata["ExposureTime"] * 1e-6
        sleep_s = time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()  # suspended, s
        middle = metadata["SensorTimestamp"] * 1e-9 - sleep_s - exposure / 2.0
        monotonic, utc = support.on_clock(self.clock, middle)
        o = self.options
        settings = frame_settings(metadata) | {
            "exposure_auto": float(AUTO in (o.exposure_s, o.gain)),
            "white_balance_auto": float(o.colour_gains == AUTO),
        }
        if "LensPosition" in metadata:
            settings["focus_auto"] = float(o.focus_dioptres == AUTO)
        return Frame(plane, monotonic, utc, exposure=exposure, settings=settings)

    def _fresh(self, camera: Any, called_ns: int) -> tuple[Any, Mapping[str, Any]]:
        """Return (grey plane, metadata) of the first frame that began after the call."""
        o = self.options
        deadline = time.monotonic() + o.timeout_s
        while time.monotonic() < deadline and self.handle is camera:
            request = camera.capture_request()
            try:
                metadata = request.get_metadata()
                if "SensorTimestamp" not in metadata or "ExposureTime" not in metadata:
                    raise BadReading(f"{self.where}: a frame without time stamp or exposure")
                if metadata["SensorTimestamp"] - metadata["ExposureTime"] * 1000 < called_ns:
                    continue
                array = request.make_array("main")
                rows, stride = array.shape
                if rows < o.height * 3 // 2 or stride < o.width:
                    raise BadReading(f"{self.where}: partial frame, {stride}×{rows} bytes")
                # the luminance of YUV420 is its top rows
                return np.array(array[: o.height, : o.width], np.uint8), metadata
            finally:
                request.release()
        raise BadReading(f"{self.where}: no frame that began after the call")

    def _in_time(self, work: Any, what: str, timeout_s: float | None = None) -> Any:
        """Run work in a new thread, which is abandoned if it hangs; raises DeviceTimeout."""
        limit = self.options.timeout_s if timeout_s is None else timeout_s
        late = f"{self.where}: {what} hangs, given up after {limit:g} s"
        return support.result_in_time(support.in_thread(work, f"picamera2-{what}"), limit, late)


def agrees(asked: Any, got: Any, tolerance: float) -> bool:
    """Return whether a value, or each of several, was read back within a relative tolerance."""
    if isinstance(asked, tuple | list):
        same = isinstance(got, tuple | list) and len(got) == len(asked)
        return same and all(agrees(a, g, tolerance) for a, g in zip(asked, got, strict=True))
    if isinstance(got, bool) or not isinstance(got, int | float):
        return False
    return bool(abs(got - asked) <= tolerance * max(abs(asked), 1e-9))


def frame_settings(metadata: Mapping[str, Any]) -> dict[str, float]:
    """Return the settings that affect the image, as the sensor reports them, by option name."""
    found = {
        name: round(float(metadata[key]) * unit, 9)
        for name, key, unit in _NUMBERS
        if isinstance(metadata.get(key), int | float)
    }
    gains = metadata.get("ColourGains")
    if isinstance(gains, tuple | list) and len(gains) == 2:
        found["colour_gain_red"], found["colour_gain_blue"] = map(float, gains)
    celsius = support.number_or_nan(metadata.get("SensorTemperature"))
    idle = chips.idle_celsius("imx708")  # its lower and upper limit, and 0
    if min(idle) < celsius < max(idle) and celsius not in idle:
        found["sensor_temperature_c"] = celsius
    return found
