"""The camera of an Android phone, over adb.

    cameras:
      - name: pixel
        driver: android
        serial: 0A1B2C3D4E            # as `adb devices` lists it
        trigger: camera               # camera (key 27), volume (key 24), tap (tap: [540, 2000])
        folder: /sdcard/DCIM/Camera
        width: 4032
        height: 3024
        delete: true                  # delete each photograph on the phone after its transfer
        refuse_unlocked: null         # null: focus, focal length, zoom; true: exposure too; false
        minimum_free_mb: 200          # less free storage is an error
        timeout_s: 15
        host: 127.0.0.1               # of the adb server
        port: 5037
        start_server: true            # start a server if none runs

A phone's camera settings cannot be set through adb: switch the camera app to its manual (pro) mode
and fix focus, ISO and exposure time before the first frame. The driver compares each photograph
with the first by EXIF and the camera service, and stores the reported settings with the epoch. A
photograph whose focus, focal length or zoom has changed is rejected (`refuse_unlocked`); if a phone
does not report its focus, the status warns that it cannot be checked.

The driver wakes and unlocks the phone (but enters no PIN), opens the camera app once and leaves it
open, since a restart would focus again. A photograph is the single new JPEG in the folder; it is
accepted when its size no longer changes, all bytes were received and it is complete (a vendor's
data or a video may follow it). Its time is the EXIF time, corrected by the phone's clock offset as
measured after each photograph; without one, or with one that is later than the complete file, the
time of the trigger. A photograph that was taken more than 5 s before the trigger is rejected.
Source: CIPA DC-008 (Exif 2.32), Android's `dumpsys media.camera`.
"""

from __future__ import annotations

import io
import math
import re
import time
from datetime import datetime
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceDenied,
    DeviceError,
    DeviceGone,
    DeviceTimeout,
    PermanentDeviceError,
    WrongDevice,
)
from thermocald.hal import Camera, Frame
from thermocald_drivers import support
from thermocald_drivers.android_phone import AdbPhone, PhoneOptions

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

KEYS = {"camera": 27, "volume": 24, "wake": 224}
OPEN_APP = "am start -a android.media.action.STILL_IMAGE_CAMERA"
STATE = (
    "dumpsys power | grep -m1 mWakefulness=; "
    "dumpsys window | grep -m1 -E 'mShowingLockscreen=|mDreamingLockscreen=|isKeyguardShowing='"
)
POLL_S = 0.1
CLOCKS_DIFFER_S, LATEST_S, COARSE_S = 5.0, 600.0, 0.2
EXIF_IFD = 0x8769
TAGS = {
    0x829A: "exposure_s",
    0x829D: "f_number",
    0x8827: "iso",
    0x9003: "time",
    0x9011: "zone",
    0x9206: "subject_distance_m",
    0x920A: "focal_length_mm",
    0x9291: "subsecond",
    0xA404: "digital_zoom",
}
EXPOSURE = ("exposure_s", "iso")
LENS = ("f_number", "focal_length_mm", "digital_zoom")
FOCUS = ("subject_distance_m", "focus_distance_dioptres")
SETTINGS = (*EXPOSURE, *LENS, *FOCUS)
"""The camera settings that a photograph reports; they are stored with its epoch."""
Point = Annotated[list[Annotated[int, Field(ge=0, le=20_000)]], Field(min_length=2, max_length=2)]


class AndroidCamera(AdbPhone, Camera):
    """A phone's camera app, triggered through adb."""

    class Options(PhoneOptions):
        """The options of the camera `android`."""

        width: Annotated[int, Field(ge=64, le=20_000)]
        height: Annotated[int, Field(ge=64, le=20_000)]
        trigger: Literal["camera", "volume", "tap"] = "camera"
        tap: Point | None = None
        folder: support.Text = "/sdcard/DCIM/Camera"
        delete: bool = False
        refuse_unlocked: bool | None = None
        minimum_free_mb: Annotated[float, Field(ge=0.0, le=1e6)] = 200.0
        timeout_s: Annotated[float, Field(ge=0.1, le=600.0)] = 15.0

    usual: ClassVar = {"width": 4032, "height": 3024}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        if o.trigger != "tap":
            self.command = f"input keyevent {KEYS[o.trigger]}"
        elif o.tap is None:
            raise ConfigurationError("trigger: tap needs tap: [x, y], the shutter button in px")
        else:
            self.command = f"input tap {o.tap[0]} {o.tap[1]}"
        self.folder = o.folder.rstrip("/")
        self._unchecked = ""
        self._first: dict[str, Any] | None = None

    def open(self) -> None:
        super().open()
        self._wake()
        self._require_space()
        self.shell(OPEN_APP)

    def warnings(self) -> list[str]:
        found = []
        if self.options.refuse_unlocked is False:
            found.append("refuse_unlocked: false accepts a phone that focuses between frames")
        if self._unchecked:
            found.append(f"{self._unchecked}: whether they change cannot be checked")
        return found

    def capture(self) -> Frame:
        if "Awake" not in self.shell(STATE):
            self._wake()
            self.shell(OPEN_APP)
        before = self.listing(self.folder)
        triggered = time.time()
        self.shell(self.command)
        triggered = (triggered + time.time()) / 2.0
        path, jpeg, image = self._new_photograph(set(before))
        stored = time.time()
        if self.options.delete:
            self.shell(f"rm -f {quote(path)}")
        self._require_size(image)
        tags = exif(jpeg) | focus_state(self.shell("dumpsys media.camera"))
        self._require_lock(tags)
        start = self._exposure_start(tags, triggered, stored)
        middle = start + tags.get("exposure_s", 0.0) / 2.0
        monotonic, utc = support.on_clock(self.clock, middle - time.time() + time.monotonic())
        numbers = {name: support.number_or_nan(tags.get(name)) for name in SETTINGS}
        return Frame(
            image=image,
            encoded=jpeg,
            monotonic=monotonic,
            utc=utc,
            exposure=tags.get("exposure_s"),
            settings={name: n for name, n in numbers.items() if math.isfinite(n)},
        )

    def _wake(self) -> None:
        """Switch on the screen and dismiss a lock without PIN; DeviceDenied if it has a PIN."""
        self.shell(f"input keyevent {KEYS['wake']}; wm dismiss-keyguard")
        state = self.shell(STATE)
        if "Lockscreen=true" in state or "isKeyguardShowing=true" in state:
            raise DeviceDenied(
                f"{self.where}: the screen is locked; unlock it and set the screen lock to "
                "'None' (and 'Stay awake' in the developer options)"
            )
        if "mWakefulness=" in state and "Awake" not in state:
            raise DeviceGone(f"{self.where}: the screen does not switch on")

    def _require_space(self) -> None:
        """Raise PermanentDeviceError if the storage is full; unknown free space passes."""
        text = self.shell(f"df -k {quote(self.folder)} 2>/dev/null || df -k /sdcard")
        found = re.search(r"\s([0-9]+)\s+[0-9]+%\s", text)
        free_mb = int(found[1]) / 1024.0 if found else math.inf
        if free_mb < self.options.minimum_free_mb:
            raise PermanentDeviceError(
                f"{self.where}: its storage is full ({free_mb:.0f} MB free, minimum "
                f"{self.options.minimum_free_mb:g}); delete photographs, or set delete: true"
            )

    def _new_photograph(self, before: set[str]) -> tuple[str, bytes, support.Grey]:
        """Wait for the one new photograph to be complete; return its (path, bytes, image)."""
        o, deadline = self.options, time.monotonic() + self.options.timeout_s
        problem: DeviceError | None = None
        found: tuple[str, bytes, support.Grey] | None = None
        last_size = -1
        while time.monotonic() < deadline:
            # an app hides a file until it is complete
            visible = {
                name: size
                for name, size in self.listing(self.folder).items()
                if name not in before and not name.startswith(".")
            }
            new = {n: size for n, size in visible.items() if n.lower().endswith((".jpg", ".jpeg"))}
            if len(new) > 1:
                raise BadReading(
                    f"{self.where}: {len(new)} new photographs ({', '.join(sorted(new))}); "
                    "switch off burst, HDR and RAW+JPEG copies, and do not touch the phone"
                )
            for name, size in new.items():
                problem = problem or BadReading(f"{self.where}: partial photograph, {name}")
                complete, last_size = size == last_size > 0, size
                if not complete:
                    continue
                jpeg = self.pull(f"{self.folder}/{name}")
                try:
                    image = support.decode_jpeg(jpeg)
                except BadReading as error:
                    found = None
                    problem = BadReading(f"{self.where}: partial photograph, {name}: {error}")
                    continue
                found = f"{self.folder}/{name}", jpeg, image
                if image.shape == (o.height, o.width):
                    return found
            time.sleep(POLL_S)
        if found:  # of another size: an app may replace its preview until the end
            return found
        if problem:
            raise problem
        if visible:
            raise BadReading(
                f"{self.where}: it stored {', '.join(sorted(visible))} but no JPEG; set the camera "
                "app to JPEG (not HEIF, not RAW alone)"
            )
        self._require_space()
        self._wake()
        raise DeviceTimeout(
            f"{self.where}: no new photograph in {self.folder} {self.options.timeout_s:g} s "
            "after the trigger; check that the camera app is open, and trigger: camera, volume, tap"
        )

    def _require_size(self, image: support.Grey) -> None:
        o, (height, width) = self.options, image.shape
        if (width, height) != (o.width, o.height):
            # after a good photograph, the size may be set back
            raise (BadReading if self._first else WrongDevice)(
                f"{self.where}: the photograph has {width}×{height} px, not {o.width}×{o.height}; "
                "set the camera app to its full size, and do not turn the phone"
            )

    def _require_lock(self, tags: dict[str, Any]) -> None:
        """Compare a photograph with the first; BadReading for a change that is refused."""
        first = self._first or tags
        # a photograph taken while focusing is no reference
        self._first = None if "SCAN" in str(first.get("af_state", "")) else first
        refuse = self.options.refuse_unlocked
        moved = _changed((*LENS, *FOCUS), first, tags)
        if "SCAN" in str(tags.get("af_state", "")):
            moved = f"autofocus is at work ({tags['af_state']})"
        changed = _changed(EXPOSURE, first, tags)
        self._unchecked = "" if moved or changed else unreported(tags)
        why = {None: moved, True: moved or changed, False: ""}[refuse]
        if why:
            raise BadReading(
                f"{self.where}: focus or exposure changed, {why}; set the camera app to manual "
                "(refuse_unlocked: false accepts the change)"
            )

    def _exposure_start(self, tags: Mapping[str, Any], triggered: float, stored: float) -> float:
        """Return the start of the exposure, s UTC on this machine's clock.

        stored: when the photograph was complete; a later mark is not that of its exposure.
        """
        offset, zone, uncertainty_s = self.clock_offset()  # the phone may set its clock at any time
        stated = exposure_start(tags, zone)
        if stated is None:
            return triggered
        utc, resolution_s = stated
        start = utc - offset
        if CLOCKS_DIFFER_S < triggered - start < LATEST_S:
            raise BadReading(
                f"{self.where}: the photograph was taken {triggered - start:.0f} s before the "
                "trigger, and is that of an earlier one; the phone is slower than timeout_s"
            )
        if abs(start - triggered) > CLOCKS_DIFFER_S or start - uncertainty_s > stored:
            return triggered  # its zone or date is not the phone's, or it is the file's
        spread_s = resolution_s + uncertainty_s
        if spread_s > COARSE_S:  # whole seconds: the trigger's time within them
            return min(max(triggered, start - uncertainty_s), start + spread_s)
        return start


def exif(jpeg: bytes) -> dict[str, Any]:
    """Return the TAGS of a photograph."""
    image_module = support.library("PIL.Image", "android")
    try:
        with image_module.open(io.BytesIO(jpeg)) as image:
            base = image.getexif()
            found = {name: _plain(base.get_ifd(EXIF_IFD).get(tag)) for tag, name in TAGS.items()}
    except (OSError, ValueError, SyntaxError) as error:
        raise BadReading(f"these {len(jpeg)} bytes are not a photograph") from error
    exposure_s = found["exposure_s"]
    if not (isinstance(exposure_s, float) and 0.0 < exposure_s < LATEST_S):  # damaged
        found["exposure_s"] = None
    return {name: value for name, value in found.items() if value is not None}


def _plain(value: Any) -> Any:
    """Convert an EXIF value: rationals to floats, texts without padding; None for NaN."""
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, str):
        return value.strip("\0 ") or None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return str(value)
    return number if number == number else None


def exposure_start(tags: Mapping[str, Any], zone: str) -> tuple[float, float] | None:
    """Return the start of the exposure (s UTC on the phone's clock) and its resolution (s).

    zone: the time zone, +hhmm, of a photograph that states none. None without a valid time.
    """
    zone = str(tags.get("zone", zone))
    zone = zone if re.fullmatch(r"[-+]\d\d:?\d\d", zone) else "+0000"
    try:
        moment = datetime.strptime(f"{tags.get('time')} {zone}", "%Y:%m:%d %H:%M:%S %z")
    except ValueError:
        return None
    seconds = moment.timestamp()
    digits = str(tags.get("subsecond", ""))
    if re.fullmatch(r"\d+", digits):
        return seconds + int(digits) / 10 ** len(digits), 10.0 ** -len(digits)
    return seconds, 1.0


def focus_state(dump: str) -> dict[str, Any]:
    """Return the lens position and autofocus state that `dumpsys media.camera` reports, if any."""
    found: dict[str, Any] = {}
    for name, tag, value in (
        ("focus_distance_dioptres", r"lens\.focusDistance", r"\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"),
        ("af_state", r"control\.afState", r"\w+"),
    ):
        if match := re.search(rf"android\.{tag} \([^)]*\):[^\n]*\n\s*\[\s*({value})", dump):
            found[name] = float(match[1]) if name in FOCUS else match[1]
    return found


def _changed(names: Iterable[str], first: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the first difference from the first photograph in words, or ""."""
    for name in names:
        was, found = first.get(name), now.get(name)
        if name == "digital_zoom":  # phones omit it, or report 0, until it is used
            was, found = was or 1.0, found or 1.0
        if was is not None and found != was:
            return f"{name} was {was} and is {found}"
    return ""


def unreported(now: Mapping[str, Any]) -> str:
    """Return in words which settings are not reported, so cannot be checked, or ""."""
    missing = [name for name in EXPOSURE if name not in now]
    if missing:
        return f"the photographs do not report {', '.join(missing)}"
    if not any(name in now for name in FOCUS):
        return "neither the photographs nor the camera service report the focus"
    return ""
