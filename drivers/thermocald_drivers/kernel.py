"""Thermometers that the kernel reads: hwmon, iio and thermal zones in sysfs.

    thermometers:
      - {name: lens, driver: hwmon, chip: lm75}                  # or chip: 1-0048 (the bus address)
      - {name: board, driver: hwmon, chip: sht3x, channels: {housing: temp1}}
      - {name: sensor, driver: iio, chip: tmp117}
      - {name: soc, driver: thermal_zone, zone: cpu-thermal, unit: thousandths}   # the default

`channels` maps channel names to the kernel's inputs (`temp1`, `in_temp_ambient`) or their labels;
without it every temperature input is read, a single one as `temperature`. `minimum_c` and
`maximum_c` bound the accepted values (a broken diode reads 127 °C); `sysfs` (/sys) is the folder of
the files. The kernel renumbers its devices whenever one is plugged in: the driver looks them up by
name at each open and checks the name at each reading.

An idle value, which a chip reports without having measured (`chips`: 0, the ends of its scale, all
ones, its power-up value; with iio the raw word before offset and scale; for an unlisted chip any
unlikely temperature), is accepted only if a recent reading is within 5 K. A zone at −40 °C is not
fitted. The hwmon entry of a 1-wire sensor is rejected at its power-on value: use the driver
ds18b20, which sees the CRC.

A zone of a vendor's kernel may be in °C or tenths. Unless `unit` states the unit, a number up to
1250 is rejected until a larger one has shown that the zone is in thousandths, and is then accepted
only within 5 K of a recent reading. A number that agrees with the last reading only in another unit
is rejected: the unit has switched. Within 0.125 °C of zero, only a reading close by distinguishes
thousandths from degrees.

The unit of a phone's zone is that of the zone's family if only one fits, else that of the phone's
other zones, else unknown: 37000, 370 and 37 may all mean 37 °C, a zone may hold percent, mA or mV,
and a wrong temperature is worse than none.
Source: Documentation/hwmon/sysfs-interface, ABI/testing/sysfs-bus-iio, driver-api/thermal; qcom
tsens and qpnp-adc-tm of kernels 3.10 to 4.9, MediaTek mtk_ts_*, power_supply class; zones of eleven
phones.
"""

from __future__ import annotations

import errno
import math
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from thermocald.errors import BadReading, ConfigurationError, DeviceGone, WrongDevice
from thermocald.hal import DriverOptions, Found, channel_fault
from thermocald_drivers import chips, support

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from thermocald.hal import Reading

NOT_FITTED_C = -40.0
LARGEST_OF_TENTHS = 1250  # 125 °C; a larger number can only be thousandths
LARGEST_OF_DEGREES = 125
LOWEST_C, HIGHEST_C = -30.0, 125.0
COOLER_K = 10.0
"""No zone of a phone is colder than the coldest of the others by more than this."""

_OTHER_QUANTITIES = re.compile(
    r"soc|socd|(?:batt?(?:ery)?|bms|maxfg|fg)[-_]?soc"
    r"|(?:.*[-_ ])?(?:ibat|vbat|vph|bcl|icl|ocp|vsys|vbus|ibus|curr|current|volt"
    r"|voltage|power|pwr|percent|pct|capacity|cycle|cycles|level|duty|pwm|fan|minus|smpl|reduce"
    r"|lvl[0-9]*|mv|ma|uv|ua|mw)(?:[-_ ].*)?|batoilo[0-9]*|vdroop[0-9]*|smpl_gm",
    re.IGNORECASE,
)
_LIMIT = re.compile(r"lmh[-_]dcvs.*", re.IGNORECASE)  # always 75 or 95 °C


class KernelOptions(DriverOptions):
    """The inputs to read and the bounds of their temperatures."""

    channels: dict[str, str] = {}  # noqa: RUF012 - pydantic copies it
    minimum_c: support.Celsius = -55.0
    maximum_c: support.Celsius = 125.0
    sysfs: support.Text = "/sys"


class ChipOptions(KernelOptions):
    """A chip, given by its name or bus address."""

    chip: support.Text


class ZoneOptions(KernelOptions):
    """A thermal zone, given by its type; unit None: thousandths, once they are certain."""

    zone: support.Text
    unit: Literal["degC", "tenths", "thousandths"] | None = None


class _KernelThermometer(support.CheckedThermometer):
    """A device folder of a sysfs class, found by its name."""

    Options: ClassVar[type[DriverOptions]] = ChipOptions
    key: ClassVar[str] = "chip"
    folder: ClassVar[str]
    prefix: ClassVar[str]
    name_file: ClassVar[str] = "name"

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.chip = self.where = getattr(self.options, self.key)
        self.sysfs = Path(self.options.sysfs)

    @classmethod
    def devices(cls, sysfs: Path) -> Iterator[tuple[Path, str, str]]:
        """Yield (folder, name, bus address) of each device of the class."""
        for folder in sorted((sysfs / cls.folder).glob(cls.prefix + "*")):
            try:
                name = support.read_line(folder / cls.name_file)
            except OSError:
                continue  # unplugged after the listing
            device = folder / "device"
            yield folder, name, device.resolve().name if device.exists() else folder.name

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:
        """List the devices as stanzas, for `thermocald devices`."""
        found = list(cls.devices(Path(sysfs)))
        names = [name for _, name, _ in found]
        return [
            Found({cls.key: name if name and names.count(name) == 1 else address}, str(folder))
            for folder, name, address in found
            if cls._inputs(folder)
        ]

    def open(self) -> None:
        found = list(self.devices(self.sysfs))
        matches = [folder for folder, name, address in found if self.chip in (name, address)]
        where = f"{self.sysfs / self.folder}: {self.chip!r}"
        if not matches:
            names = ", ".join(sorted({name for _, name, _ in found})) or "nothing"
            raise support.absent(f"{where} is not there; there is {names}", seen=self.seen)
        if len(matches) > 1:
            addresses = ", ".join(a for folder, _, a in found if folder in matches)
            raise WrongDevice(f"{where} is there {len(matches)} times; set chip: {addresses}")
        inputs = self._inputs(matches[0])
        if not inputs:
            raise support.absent(f"{matches[0]}: no temperature input is there", seen=self.seen)
        self._channels = self._select(inputs, matches[0])
        self.handle, self.seen = matches[0], True
        self._name = support.read_line(matches[0] / self.name_file)

    def named_channels(self) -> list[str]:
        return list(self.options.channels)

    def _select(self, inputs: dict[str, str], folder: Path) -> dict[str, str]:
        """Return {channel: kernel's input} by the option `channels`."""
        if not self.options.channels:
            if len(inputs) == 1:
                return {"temperature": next(iter(inputs))}
            # inputs with the same label would be one channel; a label may be no channel name
            given = [*inputs.values(), *inputs]
            return {
                key if channel_fault(label) or given.count(label) > 1 else label: key
                for key, label in inputs.items()
            }
        by_label = {label: key for key, label in inputs.items() if label}
        chosen = {
            channel: key if key in inputs else by_label.get(key, key)
            for channel, key in self.options.channels.items()
        }
        if inputs.keys().isdisjoint(chosen.values()):  # one that is missing is so in each reading
            message = f"{folder}: no input {', '.join(chosen.values())}; there is "
            raise support.absent(message + ", ".join([*inputs, *by_label]), seen=self.seen)
        return chosen

    def read(self) -> Reading:
        folder: Path = self.opened()
        measures = {}
        for channel, key in self._channels.items():
            where = f"{folder.name} ({self.chip}) {key}"
            measures[channel] = where, partial(self._measure, folder, key, where)
        reading = self.reading(measures)
        try:
            name = support.read_line(folder / self.name_file)
        except OSError as error:
            raise DeviceGone(f"{folder}: unplugged ({error.strerror})") from error
        if name != self._name:  # hwmon3 may be another device after a re-plug
            raise DeviceGone(f"{folder} is {name!r} now and was {self._name!r}")
        return reading

    def _measure(self, folder: Path, key: str, where: str) -> float:
        return self.judge(key, where, *self._convert(folder, key))

    @classmethod
    def _inputs(cls, folder: Path) -> dict[str, str]:
        """Return {kernel's input: label or ''}."""
        raise NotImplementedError

    def _convert(self, folder: Path, key: str) -> tuple[float, str]:
        """Return (an input's value in °C, why it may be an idle value or "")."""
        raise NotImplementedError

    def _idle(self, value: float) -> str:
        return UNMEASURED if chips.is_idle(self._name, value) else ""


UNMEASURED = "what such an input reports without a sensor or before a measurement"


def _number(path: Path) -> float:
    return support.parse_number(support.read_line(path))


def _label(folder: Path, key: str) -> str:
    try:
        return support.read_line(folder / f"{key}_label")
    except OSError:
        return ""


class HwmonThermometer(_KernelThermometer):
    """`/sys/class/hwmon`: temp*_input in 1/1000 °C; temp*_fault flags an open diode."""

    folder = "class/hwmon"
    prefix = "hwmon"

    @classmethod
    def _inputs(cls, folder: Path) -> dict[str, str]:
        keys = sorted(path.name.removesuffix("_input") for path in folder.glob("temp*_input"))
        return {key: _label(folder, key) for key in keys}

    def _convert(self, folder: Path, key: str) -> tuple[float, str]:
        fault = folder / f"{key}_fault"
        if fault.exists() and _number(fault) != 0:
            raise BadReading(f"{folder.name} {key}: the chip reports a broken sensor (fault flag)")
        text = support.read_line(folder / f"{key}_input")
        value = support.parse_number(text) / 1000.0
        if not text.lstrip("+-").isdecimal():
            raise BadReading(f"{folder.name} {key}: {text} is not a whole number of 1/1000 °C")
        if self._name.startswith("w1_") and value in chips.idle_celsius("ds18b20"):
            raise BadReading(
                f"{folder.name} {key}: {value:g} °C is a 1-wire power-on value; use driver: "
                "ds18b20, which reads the sensor's bytes"
            )
        return value, self._idle(value)


class IioThermometer(_KernelThermometer):
    """`/sys/bus/iio/devices`: in_temp*_input, or (raw + offset)·scale, in 1/1000 °C."""

    folder = "bus/iio/devices"
    prefix = "iio:device"

    @classmethod
    def _inputs(cls, folder: Path) -> dict[str, str]:
        keys = {
            path.name.rsplit("_", 1)[0]
            for end in ("input", "raw")
            for path in folder.glob(f"in_temp*_{end}")
        }
        return {key: _label(folder, key) for key in sorted(keys)}

    def _convert(self, folder: Path, key: str) -> tuple[float, str]:
        for fault in sorted(folder.glob("fault_*")):  # open wire of a thermocouple or PT100
            if _number(fault) != 0:
                raise BadReading(f"{folder.name} {key}: the chip reports a fault ({fault.name})")
        processed = folder / f"{key}_input"
        if processed.exists():
            value = _number(processed) / 1000.0
            return value, self._idle(value)
        raw = _number(folder / f"{key}_raw")
        offset = self._shared(folder, key, "offset", 0.0)
        value = (raw + offset) * self._shared(folder, key, "scale", None) / 1000.0
        idle = chips.is_idle_word(self._name, raw)
        return value, f"raw {raw:g}, {UNMEASURED}" if idle else ""

    @staticmethod
    def _shared(folder: Path, key: str, what: str, default: float | None) -> float:
        """Return a channel's attribute, else the one shared by all temperature channels."""
        for path in (folder / f"{key}_{what}", folder / f"in_temp_{what}"):
            if path.exists():
                return _number(path)
        if default is None:
            raise BadReading(f"{folder.name} {key}: the kernel reports no {what}")
        return default


class ThermalZoneThermometer(_KernelThermometer):
    """`/sys/class/thermal`: the zone's temp in 1/1000 °C; a disabled zone fails with EAGAIN."""

    Options: ClassVar[type[DriverOptions]] = ZoneOptions
    key = "zone"
    folder = "class/thermal"
    prefix = "thermal_zone"
    name_file = "type"

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.unit = self.options.unit or "thousandths"
        self._certain = False
        if self.options.unit is None and not is_temperature(self.chip):
            raise ConfigurationError(
                f"zone: {self.chip!r} holds percent, mA or mV on known machines; if it is a "
                "temperature on yours, set unit: thousandths (or degC, tenths)"
            )

    def close(self) -> None:
        super().close()
        self._certain = False

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:
        """List the devices as stanzas, for `thermocald devices`."""
        zones = super().attached(sysfs)
        return [found for found in zones if is_temperature(str(found.options["zone"]))]

    @classmethod
    def _inputs(cls, folder: Path) -> dict[str, str]:
        return {"temp": ""} if (folder / "temp").exists() else {}

    def _convert(self, folder: Path, key: str) -> tuple[float, str]:
        try:
            number = _number(folder / key)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.ENODATA, errno.EINVAL):
                raise BadReading(f"{folder.name}: the zone is disabled or asleep") from error
            raise
        scale = support.UNITS[self.unit]
        value = round(number * scale, 6)
        larger = abs(number) > LARGEST_OF_TENTHS
        self._certain |= larger and abs(value) <= LARGEST_OF_TENTHS / 10
        stated = self.options.unit is not None
        if not stated and not self._certain and not larger and number != 0:
            raise BadReading(
                f"{folder.name}: the unit of {number:g} is unknown; set unit: degC, tenths or "
                "thousandths"
            )
        if value == NOT_FITTED_C:
            raise BadReading(f"{folder.name}: {value:g} °C is what an absent sensor reports")
        if self.switched(key, number, scale):
            raise BadReading(
                f"{folder.name}: {number:g} is {value:g} °C in {self.unit} and agrees with the "
                "last reading only in another unit; the kernel has switched the unit"
            )
        if not stated and not larger and not self.supports(key, value):
            return value, f"{number:g} in a unit that is not certain (set unit: {self.unit})"
        if self.unit == "thousandths" and 0 < abs(number) <= LARGEST_OF_DEGREES:
            return value, f"{number:g} in thousandths, or in degrees"
        return value, self._idle(value)


# Families of zones: a pattern of their names (the first match counts); the highest temperature, °C,
# in whole degrees and in tenths, -inf if the family does not use the unit; the smallest |number|
# that may be 1/1000 °C (from 1251 on, it can be nothing else).
_FAMILIES: tuple[tuple[str, float, float, int], ...] = (
    # qcom tsens: tenths on msm8909 … msm8998, whole degrees before
    (r"tsens_tz_sensor\d*", 105.0, HIGHEST_C, 1251),
    # power supply class: tenths; fuel gauges: thousandths; a battery above 70 °C burns
    (r"(?:.*[-_])?(?:batt?|battery|bms|maxfg|fg)(?:[-_].*)?", 70.0, 70.0, 500),
    # MediaTek: thousandths; mtktsAP of some kernels: whole degrees
    (r"mtkts(?:batt).*", 70.0, -math.inf, 126),
    (r"mtkts.*", 105.0, -math.inf, 126),
    # qcom ADC thermistors of kernels 3.x: whole degrees
    (r".*_therm(?:\d|_.*)?", 105.0, -math.inf, 1251),
    (r"(?s:.*)", 105.0, HIGHEST_C, 500),
)


def is_temperature(zone: str) -> bool:
    """Return whether a zone, by its name, holds a temperature: not percent, mA, mV or a limit."""
    return _OTHER_QUANTITIES.fullmatch(zone) is None and not is_limit(zone)


def is_limit(name: str) -> bool:
    """Return whether a zone or sensor, by its name, holds a hardware limit."""
    return _LIMIT.fullmatch(name) is not None


def raw_zones(text: str) -> dict[str, float]:
    """Parse lines "type number" to {zone: number}; omit a name that has several numbers."""
    lines = (line.strip().rpartition(" ") for line in text.replace("\r", "").split("\n"))
    return unambiguous(
        (name.strip(), int(number))
        for name, _, number in lines
        if name.strip() and re.fullmatch(r"-?[0-9]{1,9}", number)
    )


def unambiguous(pairs: Iterable[tuple[str, float]]) -> dict[str, float]:
    """Return {name: number}; omit a name that has several numbers."""
    values: dict[str, float] = {}
    several = {name for name, number in pairs if values.setdefault(name, number) != number}
    return {name: value for name, value in values.items() if name not in several}


def zone_scales(raw: Mapping[str, float], known: Mapping[str, float]) -> dict[str, float]:
    """Return {zone: factor to °C} for the zones whose unit is certain.

    raw: all zones of the phone at one time; known: factors that were stated or determined before.
    """
    found = {name: known[name] for name in raw if name in known}
    temperatures = {n: v for n, v in raw.items() if v != 0 and n not in known and is_temperature(n)}
    choices = {name: _candidates(name, value) for name, value in temperatures.items()}
    found |= {name: fits[0] for name, fits in choices.items() if len(fits) == 1}
    others = [raw[name] * scale for name, scale in found.items()]
    others = [celsius for celsius in others if LOWEST_C <= celsius <= HIGHEST_C]
    whole = any(scale == 1.0 for scale in found.values())
    for name, fits in choices.items():
        if len(fits) > 1 and (scale := _among(raw[name], fits, others, whole)) is not None:
            found[name] = scale
    return found


def _candidates(name: str, value: float) -> list[float]:
    """Return the factors with which a zone's number is a possible temperature, by its name."""
    family = next(row for row in _FAMILIES if re.fullmatch(row[0], name, re.IGNORECASE))
    _, whole_c, tenths_c, thousandths_from = family
    thousandths_c = HIGHEST_C if abs(value) >= thousandths_from else -math.inf
    highest = {1.0: whole_c, 0.1: tenths_c, 0.001: thousandths_c}
    return [scale for scale, high_c in highest.items() if LOWEST_C <= value * scale <= high_c]


def _among(value: float, fits: list[float], others: Iterable[float], whole: bool) -> float | None:
    """Return the factor that agrees with the phone's other zones; None if they do not decide."""
    coldest = min(others, default=None)
    if coldest is None:
        return None
    near = [scale for scale in fits if value * scale >= coldest - COOLER_K]
    if len(near) == 1:
        return near[0]
    # colder than all other zones in any unit: the unit of its neighbours
    return 1.0 if not near and whole and 1.0 in fits else None
