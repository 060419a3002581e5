"""The thermometers of an Android phone: battery, thermal service, thermal zones.

    thermometers:
      - name: pixel
        driver: android
        serial: 0A1B2C3D4E            # as `adb devices` lists it
        sensors: {temperature: battery, skin: "thermal:skin", soc: "zone:cpu-0-0"}
        units: {soc: thousandths}     # of a battery or zone: degC, tenths, thousandths
        timeout_s: 5
        host: 127.0.0.1               # of the adb server
        port: 5037
        start_server: true            # if none runs

The phone's numbers are read by `android_temperatures` and `android_zones`. A sensor that the phone
does not report, that is frozen, or whose unit is not known is absent from the reading; the reason
names the option that states the unit. A unit that was certain once is kept until the phone is
closed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermocald.errors import BadReading, ConfigurationError
from thermocald.hal import Found, Thermometer
from thermocald_drivers import android_temperatures, android_zones, support
from thermocald_drivers.android_phone import ADB_CLASSES, list_devices, make_phone

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.hal import Clock, Reading

__all__ = ["AndroidThermometer"]

ZONES = 'for z in /sys/class/thermal/thermal_zone*; do echo "$(cat $z/type) $(cat $z/temp)"; done'
DUMPS = {"battery": "dumpsys battery", "thermal": "dumpsys thermalservice", "zone": ZONES}
PHONE_RANGE_C = (-30.0, 125.0)
NO_BATTERY = (
    "no battery temperature: not fitted, frozen (`dumpsys battery reset` ends that), or in an "
    "unknown unit (write units: {{{channel}: degC}}, tenths or thousandths)"
)
STATE_UNIT = "write units: {{{channel}: degC}}, tenths or thousandths"


class AndroidThermometer(Thermometer):
    """Battery, thermal service and thermal zones of a phone, in one shell call each."""

    device_classes = ADB_CLASSES

    def __init__(
        self,
        *,
        clock: Clock,
        serial: str,
        sensors: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        timeout_s: float = 5.0,
        host: str = "127.0.0.1",
        port: int = 5037,
        start_server: bool = True,
    ) -> None:
        self.clock = clock
        self.phone = make_phone(serial, host, port, timeout_s, start_server)
        self.sensors = dict(sensors or {"temperature": "battery"})
        for channel, source in self.sensors.items():
            kind, _, name = str(source).partition(":")
            if kind not in ("battery", "thermal", "zone") or (kind != "battery") != bool(name):
                raise ConfigurationError(
                    f"sensors.{channel}: {source!r} is neither battery, thermal:NAME nor zone:TYPE"
                )
        self.units = dict(units or {})
        for channel, unit in self.units.items():
            kind = str(self.sensors.get(channel, "")).partition(":")[0]
            if kind not in ("battery", "zone"):
                raise ConfigurationError(
                    f"units.{channel}: there is no battery or zone of that name in sensors"
                )
            support.choice(f"units.{channel}", unit, list(android_zones.UNITS))
        self._scales = self._stated()

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """Phones that the adb server lists."""
        return [Found({"serial": serial}, f"{serial} {state}") for serial, state in list_devices()]

    def open(self) -> None:
        self.phone.connect()

    def close(self) -> None:
        self.phone.disconnect()
        self._scales = self._stated()

    def identity(self) -> Mapping[str, str]:
        return {"serial": self.phone.serial}

    def read(self) -> Reading:
        start = self.clock.monotonic()
        kinds = {source.partition(":")[0] for source in self.sensors.values()}
        texts = {kind: self.phone.shell(DUMPS[kind]) for kind in sorted(kinds)}
        found = self._battery_and_service(texts) | self._zones(texts)
        values, missing = {}, {}
        for channel, source in self.sensors.items():
            value = found.get(source, "the phone does not report it")
            try:
                if isinstance(value, str):
                    raise BadReading(f"{source}: {value.format(channel=channel)}")
                values[channel] = support.believable(value, *PHONE_RANGE_C, source)
            except BadReading as error:
                missing[channel] = str(error)
        if not values:
            raise BadReading(f"{self.phone.where}: {'; '.join(missing.values())}")
        about = {"missing": missing} if missing else {}
        return support.middle_reading(self.clock, values, start, about)

    def _stated(self) -> dict[str, float]:
        """{zone: factor to °C} of the units in the stanza."""
        return {
            self.sensors[channel].partition(":")[2]: android_zones.UNITS[unit]
            for channel, unit in self.units.items()
            if self.sensors[channel].startswith("zone:")
        }

    def _battery_and_service(self, texts: Mapping[str, str]) -> dict[str, float | str]:
        """{source: °C, or why there is none}."""
        found: dict[str, float | str] = {}
        if "battery" in texts:
            stated = [u for c, u in self.units.items() if self.sensors[c] == "battery"]
            celsius = android_temperatures.battery(texts["battery"], *stated[:1])
            found["battery"] = NO_BATTERY if celsius is None else celsius
        for name, value in android_temperatures.thermalservice(texts.get("thermal", "")).items():
            found[f"thermal:{name}"] = value
        return found

    def _zones(self, texts: Mapping[str, str]) -> dict[str, float | str]:
        """{source: °C, or why there is none}; units that are certain are kept until `close`."""
        raw = android_zones.raw_zones(texts.get("zone", ""))
        self._scales |= android_zones.zone_scales(raw, self._scales)
        found: dict[str, float | str] = {}
        for name, value in raw.items():
            if name in self._scales:
                found[f"zone:{name}"] = round(value * self._scales[name], 6)
            elif not android_zones.is_temperature(name):
                found[f"zone:{name}"] = f"{value} is not a temperature; if it is, {STATE_UNIT}"
            elif value == 0:
                found[f"zone:{name}"] = f"0, as of a sensor not fitted; if not, {STATE_UNIT}"
            else:
                found[f"zone:{name}"] = f"the unit of {value} is not known; {STATE_UNIT}"
        return found
