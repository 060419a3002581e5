"""What phones print about their temperatures, as pure functions of the text.

`dumpsys battery` gives tenths of a degree; 0 beside a voltage of 0 means that there is no sensor.
`dumpsys thermalservice` repeats a cache, which may be hours old, before the live section "Current
temperatures from HAL": only that section counts. It lists volts and percents as Temperature too
(types 6 to 8), and 0.0 for a sensor that is not fitted. `/sys/class/thermal` mixes units: 37000,
370 and 37 all mean 37 °C; a zone's unit is guessed once, from its first value, and then kept.
Source: android.hardware.thermal TemperatureType; dumps of eleven phones.
"""

from __future__ import annotations

import re

__all__ = ["TYPES", "battery", "thermal_zones", "thermalservice", "zone_scale"]

TYPES = {
    0: "CPU", 1: "GPU", 2: "BATTERY", 3: "SKIN", 4: "USB_PORT", 5: "POWER_AMPLIFIER",
    6: "BCL_VOLTAGE", 7: "BCL_CURRENT", 8: "BCL_PERCENTAGE", 9: "NPU",
}  # fmt: skip
NOT_TEMPERATURES = {6, 7, 8}
LIVE_SECTION = "Current temperatures from HAL:"

_FIELD = re.compile(r"^[ \t]*(temperature|voltage):[ \t]*(-?\d+)[ \t]*$", re.MULTILINE)
_RECORD = re.compile(
    r"Temperature\{mValue=(?P<value>-?\d+(?:\.\d+)?(?:[eE]-?\d+)?), mType=(?P<type>-?\d+), "
    r"mName=(?P<name>[^,}]*), mStatus=(?P<status>\d+)\}"
)


def battery(text: str) -> float | None:
    """°C of `dumpsys battery`; None where the phone has no sensor or says nothing."""
    fields: dict[str, int] = {}
    for name, value in _FIELD.findall(text):
        fields.setdefault(name, int(value))  # the first is live; log lines may repeat the word
    if "temperature" not in fields:
        return None
    if fields["temperature"] == 0 and fields.get("voltage") == 0:
        return None
    return fields["temperature"] / 10.0


def thermalservice(text: str) -> dict[str, float]:
    """{sensor: °C} of the live section; empty where the phone has not got it."""
    _, found, rest = text.partition(LIVE_SECTION)
    if not found:
        return {}
    values: dict[str, float] = {}
    for line in rest.splitlines()[1:]:
        record = line.strip()
        if record and not record.startswith("Temperature{"):
            break  # the next section
        match = _RECORD.fullmatch(record)
        if match is None or int(match["type"]) in NOT_TEMPERATURES:
            continue
        value = float(match["value"])
        if value != 0.0:  # the HAL's way to say "not fitted"
            values[match["name"]] = value
    return values


def zone_scale(raw: float) -> float:
    """What a zone's value must be multiplied by to be °C, guessed from its size."""
    if abs(raw) >= 1000.0:
        return 0.001
    return 0.1 if abs(raw) >= 150.0 else 1.0


def thermal_zones(text: str) -> dict[str, float]:
    """{zone: raw value} of lines "type value"; zones that could not be read are left out."""
    values: dict[str, float] = {}
    for line in text.splitlines():
        name, _, value = line.strip().rpartition(" ")
        if name and re.fullmatch(r"-?\d+", value):
            values.setdefault(name, float(value))
    return values
