"""What a photograph reports of itself (EXIF), and whether focus and exposure stayed locked.

Source: CIPA DC-008 (Exif 2.32), Android's `dumpsys media.camera`.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

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
    0xA402: "exposure_mode",
    0xA403: "white_balance",
    0xA404: "digital_zoom",
}
EXPOSURE = ("exposure_s", "iso")
LENS = ("f_number", "focal_length_mm", "digital_zoom")
FOCUS = ("subject_distance_m", "focus_distance_dioptres")
SETTINGS = (*EXPOSURE, *LENS, *FOCUS)
"""What a photograph reports of its camera's settings, stored with its epoch."""


def exif(jpeg: bytes) -> dict[str, Any]:
    """Those of TAGS that the photograph has, and `width`, `height`, `make`, `model`."""
    image_module = support.library("PIL.Image", "android")
    try:
        with image_module.open(io.BytesIO(jpeg)) as image:
            base = image.getexif()
            found = {name: _plain(base.get_ifd(EXIF_IFD).get(tag)) for tag, name in TAGS.items()}
            found |= {"make": _plain(base.get(0x010F)), "model": _plain(base.get(0x0110))}
            found |= {"width": image.width, "height": image.height}
    except (OSError, ValueError, SyntaxError) as error:
        raise BadReading(f"these {len(jpeg)} bytes are not a photograph") from error
    return {name: value for name, value in found.items() if value is not None}


def _plain(value: Any) -> Any:
    """Rationals as floats, texts without their padding."""
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, str):
        return value.strip("\0 ") or None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return str(value)
    return number if number == number else None


@dataclass(frozen=True)
class ExposureStart:
    """Start of the exposure, s UTC by the phone's clock, and its resolution (s)."""

    utc: float
    resolution_s: float


def exposure_start(tags: Mapping[str, Any], zone: str) -> ExposureStart | None:
    """The photograph's time; zone: +hhmm, used if the photograph has none."""
    text = tags.get("time")
    if not isinstance(text, str):
        return None
    try:
        naive = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    sign = re.fullmatch(r"([-+])(\d\d):?(\d\d)", str(tags.get("zone", zone)))
    offset = timedelta()
    if sign:
        offset = timedelta(hours=int(sign[2]), minutes=int(sign[3])) * (-1 if sign[1] == "-" else 1)
    seconds = naive.replace(tzinfo=timezone(offset) if sign else UTC).timestamp()
    digits = str(tags.get("subsecond", ""))
    if re.fullmatch(r"\d+", digits):
        return ExposureStart(seconds + int(digits) / 10 ** len(digits), 10.0 ** -len(digits))
    return ExposureStart(seconds, 1.0)


def focus_state(dump: str) -> dict[str, Any]:
    """Lens position and autofocus state from `dumpsys media.camera`, where it reports them."""
    found: dict[str, Any] = {}
    distance = re.search(
        r"android\.lens\.focusDistance \([^)]*\):[^\n]*\n\s*\[\s*([-\d.eE]+)", dump
    )
    if distance:
        found["focus_distance_dioptres"] = float(distance[1])
    state = re.search(r"android\.control\.afState \([^)]*\):[^\n]*\n\s*\[\s*(\w+)", dump)
    if state:
        found["af_state"] = state[1]
    return found


def image_moved(first: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """What moved the image since the first photograph: focus, focal length, zoom; "" if nothing."""
    if "SCAN" in str(now.get("af_state", "")):
        return f"autofocus is at work ({now['af_state']})"
    return _changed((*LENS, *FOCUS), first, now)


def settings(tags: Mapping[str, Any]) -> dict[str, float]:
    """The numbers among SETTINGS that the photograph reports."""
    found = {name: tags[name] for name in SETTINGS if name in tags}
    return {
        name: float(value)
        for name, value in found.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }


def _changed(names: Iterable[str], first: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    for name in names:
        if name in first and now.get(name) != first[name]:
            return f"{name} was {first[name]} and is {now.get(name)}"
    return ""


def lock_verdict(first: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[bool | None, str]:
    """(True, False, or None if unknown; why) of this photograph against the first one."""
    if why := image_moved(first, now) or _changed(EXPOSURE, first, now):
        return False, why
    missing = [name for name in ("exposure_s", "iso") if name not in now]
    if missing:
        return None, f"the photographs do not report {', '.join(missing)}"
    if not any(name in now for name in FOCUS):
        return None, "neither the photographs nor the camera service report the focus"
    return True, ""
