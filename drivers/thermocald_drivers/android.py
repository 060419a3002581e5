"""The camera of an Android phone, over adb.

    cameras:
      - name: pixel
        driver: android
        serial: 0A1B2C3D4E            # as `adb devices` lists it
        trigger: camera               # camera (key 27), volume (key 24), tap (tap: [540, 2000])
        folder: /sdcard/DCIM/Camera
        width: 4032
        height: 3024
        delete: true                  # delete the photograph on the phone once it is here
        refuse_unlocked: null         # null: focus, focal length, zoom; true: exposure too; false
        minimum_free_mb: 200          # less free storage is an error
        timeout_s: 15
        host: 127.0.0.1               # of the adb server
        port: 5037
        start_server: true            # if none runs

Nothing of a phone's camera can be set through adb: set the camera app to its manual (pro) mode and
fix focus, ISO and exposure time before the first frame. Each photograph is compared with the first
one, by EXIF and the camera service, and what they report is stored with the epoch. A photograph
whose focus, focal length or zoom changed is refused (`refuse_unlocked`); where a phone does not
report its focus, the status says that it cannot be checked.

The driver wakes and unlocks the phone (not through a PIN), opens the camera app once and keeps it
open, since a restart would focus again. A photograph is the one new file of the folder; it is taken
when its size no longer changes, all bytes were received and the JPEG is complete. Its time is that
of EXIF, with the phone's clock compared to this machine's at each open, or the trigger's if EXIF
has none.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceDenied,
    DeviceGone,
    DeviceTimeout,
    PermanentDeviceError,
    WrongDevice,
)
from thermocald.hal import Camera, Found, Frame
from thermocald_drivers import photograph, pixel_formats, support
from thermocald_drivers.android_phone import ADB_CLASSES, AdbPhone, PhoneOptions, list_devices

if TYPE_CHECKING:
    from collections.abc import Mapping

KEYS = {"camera": 27, "volume": 24}
WAKE_KEY = 224
OPEN_APP = "am start -a android.media.action.STILL_IMAGE_CAMERA"
STATE = (
    "dumpsys power | grep -m1 mWakefulness=; "
    "dumpsys window | grep -m1 -E 'mShowingLockscreen=|mDreamingLockscreen=|isKeyguardShowing='; "
    "dumpsys window | grep -m1 mCurrentFocus="
)
POLL_S = 0.1
CLOCKS_DIFFER_S = 5.0


class CameraOptions(PhoneOptions):
    """As above."""

    width: Annotated[int, Field(ge=64, le=20_000)]
    height: Annotated[int, Field(ge=64, le=20_000)]
    trigger: Literal["camera", "volume", "tap"] = "camera"
    tap: (
        Annotated[list[Annotated[int, Field(ge=0, le=20_000)]], Field(min_length=2, max_length=2)]
        | None
    ) = None
    folder: support.Text = "/sdcard/DCIM/Camera"
    delete: bool = False
    refuse_unlocked: bool | None = None
    minimum_free_mb: Annotated[float, Field(ge=0.0, le=1e6)] = 200.0
    timeout_s: Annotated[float, Field(ge=0.1, le=600.0)] = 15.0


class AndroidCamera(Camera):
    """The camera app of a phone, triggered through adb."""

    device_classes = ADB_CLASSES
    Options = CameraOptions

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        self.timeout_s: float = o.timeout_s
        self.phone = AdbPhone(o)
        if o.trigger != "tap":
            self.command = f"input keyevent {KEYS[o.trigger]}"
        elif o.tap is None:
            raise ConfigurationError("trigger: tap needs tap: [x, y] of the shutter button, px")
        else:
            self.command = f"input tap {o.tap[0]} {o.tap[1]}"
        self.folder = o.folder.rstrip("/")
        self._unchecked = ""
        self._first: dict[str, Any] | None = None
        self._offset, self._zone, self._offset_half = 0.0, "", 0.0

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """Phones that the adb server lists, whatever their state."""
        return [
            Found({"serial": serial, "width": 4032, "height": 3024}, f"{serial} {state}")
            for serial, state in list_devices()
        ]

    def open(self) -> None:
        self.phone.connect()
        self._wake()
        self._require_space()
        self._offset, self._zone, self._offset_half = self.phone.clock_offset()
        self.phone.shell(OPEN_APP)

    def close(self) -> None:
        self.phone.disconnect()

    def identity(self) -> Mapping[str, str]:
        return {"serial": self.phone.serial}

    def warnings(self) -> list[str]:
        found = []
        if self.options.refuse_unlocked is False:
            found.append("refuse_unlocked: false accepts a phone that focuses between frames")
        if self._unchecked:
            found.append(f"{self._unchecked}: whether they stay as they are cannot be checked")
        return found

    def frame_size(self) -> tuple[int, int]:
        return self.options.width, self.options.height

    def capture(self) -> Frame:
        if "Awake" not in self.phone.shell(STATE):
            self._wake()
            self.phone.shell(OPEN_APP)
        before = self.phone.listing(self.folder)
        triggered = time.time()
        self.phone.shell(self.command)
        triggered = (triggered + time.time()) / 2.0
        path, jpeg = self._new_photograph(set(before))
        tags = photograph.exif(jpeg)
        if (tags["width"], tags["height"]) != (self.options.width, self.options.height):
            raise WrongDevice(
                f"{self.phone.where}: the photograph has {tags['width']}×{tags['height']} px, not "
                f"{self.options.width}×{self.options.height}; set the camera app to its full size"
            )
        tags |= photograph.focus_state(self.phone.shell("dumpsys media.camera"))
        locked, why = self._lock(tags)
        start, source = self._exposure_start(tags, triggered)
        image, _ = pixel_formats.decode(
            memoryview(jpeg), "JPEG", self.options.width, self.options.height
        )
        if self.options.delete:
            self.phone.shell(f"rm -f '{path}'")
        middle = start + float(tags.get("exposure_s", 0.0)) / 2.0
        monotonic, utc = support.on_clock(self.clock, middle - time.time() + time.monotonic())
        metadata = {**tags, "file": path, "locked": locked, "locked_why": why, "time_from": source}
        metadata["phone_clock_offset_s"] = self._offset
        metadata["phone_clock_uncertainty_s"] = self._offset_half
        return Frame(
            image=image,
            encoded=jpeg,
            monotonic=monotonic,
            utc=utc,
            exposure=tags.get("exposure_s"),
            metadata=metadata,
            settings=photograph.settings(tags),
        )

    def _wake(self) -> None:
        """Switch the screen on and dismiss a lock without PIN; DeviceDenied if it has one."""
        self.phone.shell(f"input keyevent {WAKE_KEY}; wm dismiss-keyguard")
        state = self.phone.shell(STATE)
        if "Lockscreen=true" in state or "isKeyguardShowing=true" in state:
            raise DeviceDenied(
                f"{self.phone.where}: the screen is locked; unlock it and set the screen lock to "
                "'None' (and 'Stay awake' in the developer options)"
            )
        if "mWakefulness=" in state and "Awake" not in state:
            raise DeviceGone(f"{self.phone.where}: the screen does not come on")

    def _require_space(self) -> None:
        """PermanentDeviceError if the storage is full; unknown free space is accepted."""
        lines = self.phone.shell(f"df -k '{self.folder}' 2>/dev/null || df -k /sdcard").split("\n")
        fields = lines[-1 if lines[-1].strip() else -2].split() if len(lines) > 1 else []
        if len(fields) >= 4 and fields[3].isdigit():
            free_mb = int(fields[3]) / 1024.0
            if free_mb < self.options.minimum_free_mb:
                raise PermanentDeviceError(
                    f"{self.phone.where}: its storage is full ({free_mb:.0f} MB left, "
                    f"{self.options.minimum_free_mb:g} wanted); delete photographs, or delete: true"
                )

    def _new_photograph(self, before: set[str]) -> tuple[str, bytes]:
        """(path, bytes) of the one new photograph, once it is complete."""
        deadline = time.monotonic() + self.timeout_s
        last_size, name, short = -1, "", ""
        while time.monotonic() < deadline:
            new = {
                n: entry
                for n, entry in self.phone.listing(self.folder).items()
                if n not in before
                and n.lower().endswith((".jpg", ".jpeg"))
                and not n.startswith((".pending", ".trashed"))
            }
            if len(new) > 1:
                raise BadReading(
                    f"{self.phone.where}: {len(new)} new photographs ({', '.join(sorted(new))}); "
                    "switch off burst, HDR and RAW+JPEG copies, and touch nothing"
                )
            for name, entry in new.items():
                if entry.size > 0 and entry.size == last_size:
                    jpeg = self.phone.pull(f"{self.folder}/{name}")
                    if len(jpeg) == entry.size and pixel_formats.jpeg_end(jpeg):
                        return f"{self.folder}/{name}", jpeg
                    short = f"{name} has {len(jpeg)} of {entry.size} bytes and no end"
                last_size = entry.size
            time.sleep(POLL_S)
        if short or name:
            raise BadReading(f"{self.phone.where}: partial photograph, {short or name}")
        self._require_space()
        self._wake()
        raise DeviceTimeout(
            f"{self.phone.where}: no new photograph in {self.folder} {self.timeout_s:g} s after "
            "the trigger; is the camera app open, is the trigger right (camera, volume, tap)?"
        )

    def _lock(self, tags: dict[str, Any]) -> tuple[bool | None, str]:
        if self._first is None:
            self._first = dict(tags)
        locked, why = photograph.lock_verdict(self._first, tags)
        self._unchecked = why if locked is None else ""
        moved = photograph.image_moved(self._first, tags)
        if "SCAN" in str(self._first.get("af_state", "")):
            self._first = None  # nothing to compare with: it was still focusing
        if (locked is False and self.options.refuse_unlocked) or (
            moved and self.options.refuse_unlocked is None
        ):
            raise BadReading(
                f"{self.phone.where}: focus or exposure moved, {why}; set the camera app to manual "
                "(refuse_unlocked: false accepts it)"
            )
        return locked, why

    def _exposure_start(self, tags: Mapping[str, Any], triggered: float) -> tuple[float, str]:
        """(start of the exposure, s UTC on this machine's clock; where that comes from)."""
        exif = photograph.exposure_start(tags, self._zone)
        if exif is None:
            return triggered, "trigger"
        start = exif.utc - self._offset
        if abs(start - triggered) > CLOCKS_DIFFER_S:
            return triggered, f"trigger (EXIF is {start - triggered:+.1f} s off)"
        if exif.resolution_s >= 1.0:  # whole seconds: the trigger, within that second
            return min(max(triggered, start), start + 1.0), "trigger within EXIF's second"
        return start, "exif"
