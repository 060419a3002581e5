"""What phones print about their temperatures, as pure functions of the text.

`dumpsys battery`: tenths of a degree, but whole degrees on boards that also give whole volts. It is
refused where the phone has no battery (`present: false`, or 0 °C at a voltage that no cell has) and
where its values are frozen or forged (`UPDATES STOPPED`, after `dumpsys battery unplug` or `set`).

`dumpsys thermalservice`: only the live section "Current temperatures from HAL" is used; the cache
before it may be hours old. The section also lists volts, currents and percent (types 6 to 8), and
differences or flags in any unit (type −1); 0.0 is a sensor that is not fitted, and `lmh-dcvs` is a
limit of the processor.
Source: android.hardware.thermal TemperatureType, AOSP BatteryService; dumps of eleven phones.
"""

from __future__ import annotations

import re

from thermocald_drivers import support
from thermocald_drivers.android_zones import UNITS, is_limit

__all__ = ["TYPES", "battery", "thermalservice"]

TYPES = {
    0: "CPU", 1: "GPU", 2: "BATTERY", 3: "SKIN", 4: "USB_PORT", 5: "POWER_AMPLIFIER",
    6: "BCL_VOLTAGE", 7: "BCL_CURRENT", 8: "BCL_PERCENTAGE", 9: "NPU", 10: "TPU", 11: "DISPLAY",
    12: "MODEM", 13: "SOC", 14: "WIFI", 15: "CAMERA", 16: "FLASHLIGHT", 17: "SPEAKER",
    18: "AMBIENT", 19: "POGO",
}  # fmt: skip
NOT_TEMPERATURES = {6, 7, 8}
LIVE_SECTION = "Current temperatures from HAL:"
WHOLE_VOLTS = range(1, 100)
CELL_MV = range(2500, 4600)
HOTTEST_BATTERY_C = 70.0

_FIELD = re.compile(
    r"^[ \t]*(temperature|voltage|present):[ \t]*(-?[0-9]{1,9}|true|false)[ \t]*$", re.MULTILINE
)
_RECORD = re.compile(
    r"Temperature\{mValue=(?P<value>[^,]*), mType=(?P<type>-?[0-9]+), "
    r"mName=(?P<name>(?:(?!Temperature\{).)*?), mStatus=[0-9]+\}",
    re.DOTALL,
)
_HEADING = re.compile(r"^[^\s,}][^{}\n]*:[ \t]*$", re.MULTILINE)


def battery(text: str, unit: str = "") -> float | None:
    """°C of `dumpsys battery`; None where there is none to be believed.

    unit: a word of UNITS, where it is known.
    """
    text = text.replace("\r", "")
    if "UPDATES STOPPED" in text:
        return None
    fields: dict[str, str] = {}
    for name, value in _FIELD.findall(text):
        fields.setdefault(name, value)  # the first is current; log lines may repeat the word
    raw, volts = _whole(fields.get("temperature")), _whole(fields.get("voltage"))
    if raw is None or fields.get("present") == "false" or (raw == 0 and not volts):
        return None
    if unit:
        return raw * UNITS[unit]
    if raw == 0 and volts not in CELL_MV:  # a board that runs from the mains
        return None
    if volts in WHOLE_VOLTS:
        return _of_whole_volts(raw)
    return raw / 10.0 if abs(raw) <= HOTTEST_BATTERY_C * 10 else None


def _whole(text: str | None) -> int | None:
    return int(text) if text is not None and text not in ("true", "false") else None


def _of_whole_volts(raw: int) -> float | None:
    """°C where the voltage is in whole volts, and the temperature probably in whole degrees."""
    if abs(raw) <= HOTTEST_BATTERY_C:
        return float(raw)
    return raw / 10.0 if 2 * HOTTEST_BATTERY_C <= raw <= HOTTEST_BATTERY_C * 10 else None


def thermalservice(text: str) -> dict[str, float]:
    """{sensor: °C} of the live section; empty where the phone does not print one."""
    text = text.replace("\r", "")
    _, found, rest = text.partition(LIVE_SECTION)
    if not found or "HAL Ready: false" in text:
        return {}
    heading = _HEADING.search(rest)
    section = rest[: heading.start()] if heading else rest
    values: dict[str, float] = {}
    ambiguous = set()
    for record in _RECORD.finditer(section):
        kind = int(record["type"])
        if kind not in TYPES or kind in NOT_TEMPERATURES:
            continue
        try:
            value = support.parse_number(record["value"])
        except ValueError:
            continue  # NaN
        name = " ".join(record["name"].split())
        # 0.0 is the HAL's way to say "not fitted"
        if value == 0.0 or is_limit(name):
            continue
        if values.setdefault(name, value) != value:
            ambiguous.add(name)
    return {name: value for name, value in values.items() if name not in ambiguous}
