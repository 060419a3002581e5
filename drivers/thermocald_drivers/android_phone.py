"""An Android phone behind an adb server: state, shell, files; its thermometers.

adbutils implements the adb server's protocol (127.0.0.1:5037). The server is Android's own
(`adb start-server`); it serves several phones by their serial numbers. Each fault has its own
error. The thermometers are the battery, the thermal service and the thermal zones:

    thermometers:
      - name: pixel
        driver: android
        serial: 0A1B2C3D4E            # as `adb devices` lists it
        sensors: {temperature: battery, skin: "thermal:skin", soc: "zone:cpu-0-0"}
        units: {soc: thousandths}     # of a battery or zone: degC, tenths, thousandths
        timeout_s: 5
        host: 127.0.0.1               # of the adb server
        port: 5037
        start_server: true            # start a server if none runs

A sensor that the phone does not report, that is frozen, or whose unit is unknown is absent from the
reading; the reason names the option that states the unit. Once a unit is certain, it holds until
the phone is closed; a number that agrees with the last one only in another unit is rejected. A
value that absent sensors report (see `chips`) needs a recent reading within 5 K.

`dumpsys battery` reports tenths of a degree, but whole degrees on boards that also report whole
volts and on some that report millivolts: up to 70 it may be either. It is rejected if the phone has
no battery (`present: false`, or 0 °C at a voltage that no cell has) and if its values are frozen or
forged (`UPDATES STOPPED`, after `dumpsys battery unplug` or `set`).

`dumpsys thermalservice`: only the live section "Current temperatures from HAL" is used; the cache
before it may be hours old. The section also lists volts, currents and percent (types 6 to 8), and
differences or flags in any unit (type −1); 0.0 means that a sensor is not fitted, and `lmh-dcvs` is
a limit of the processor. Thermal zones: see `kernel`.
Source: android.hardware.thermal TemperatureType, AOSP BatteryService; dumps of eleven phones.
"""

from __future__ import annotations

import logging
import math
import re
import socket
import stat
import struct
import time
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceError,
    DeviceGone,
    DeviceNotFound,
    DeviceTimeout,
    WrongDevice,
)
from thermocald.hal import Device, DriverOptions, Found
from thermocald_drivers import chips, kernel, support

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from thermocald.hal import Reading


DENIED = {
    "unauthorized": "unauthorized: unlock the phone and confirm 'Allow USB debugging' (tick "
    "'always'); if no dialog appears: developer options, 'Revoke USB debugging authorizations', "
    "re-plug",
    "permissions": "no permissions; see the udev rules in systemd/",
}
"""What the adb server says of a phone that it must not use, and advice."""

_CLOCK_S, _CLOCK_TRIES = 0.002, 12


class PhoneOptions(DriverOptions):
    """The options of a phone and of its adb server."""

    serial: support.Text
    host: support.Text = "127.0.0.1"
    port: support.Port = 5037
    start_server: bool = True
    timeout_s: support.Seconds


def _devices(client: Any) -> list[tuple[str, str]]:
    """Return (serial, state) by `host:devices`; adbutils' own list cuts both at blanks."""
    with client.make_connection() as line:
        line.send_command("host:devices")
        line.check_okay()
        rows = line.read_string_block().replace("\r", "").split("\n")
    pairs = [row.partition("\t") for row in rows if "\t" in row]
    return [(serial.strip(), state.strip()) for serial, _, state in pairs]


def require_server(host: str, port: int, timeout_s: float, *, seen: bool) -> None:
    """Raise a DeviceError unless an adb server answers; start none."""
    try:
        socket.create_connection((host, port), timeout=timeout_s).close()
    except OSError as error:
        message = f"no adb server at {host}:{port} ({error}); run `adb start-server`"
        raise support.absent(message, seen=seen) from error


class AdbPhone(Device):
    """A phone's connection, shared by its drivers."""

    device_classes = ("char-usb_device",)  # of an adb server that this driver starts
    Options: ClassVar[type[DriverOptions]] = PhoneOptions
    usual: ClassVar[Mapping[str, int] | None] = None
    """Further options of a listed phone's stanza; None: phones are not listed for the driver."""

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """List the phones on a running adb server in any state; [] without a server."""
        if cls.usual is None:
            return []
        adbutils = support.library("adbutils", "android")
        try:
            require_server("127.0.0.1", 5037, 1.0, seen=False)
            pairs = _devices(adbutils.AdbClient(socket_timeout=1.0))
        except (OSError, adbutils.AdbError):
            return []
        return [Found({"serial": one, **cls.usual}, f"{one} {state}") for one, state in pairs]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.where = f"phone {self.options.serial}"
        self._lines: list[Any] = []

    def open(self) -> None:
        """Find the phone among the server's devices; raises a DeviceError if it cannot be used."""
        adbutils = support.library("adbutils", "android")
        logging.getLogger("adbutils").setLevel(logging.ERROR)  # it warns of old ones at each call
        o = self.options
        if not o.start_server:
            require_server(o.host, o.port, o.timeout_s, seen=self.seen)
        client = adbutils.AdbClient(o.host, o.port, socket_timeout=o.timeout_s)
        connect = client.make_connection

        def connect_and_record(timeout: float | None = None) -> Any:
            self._lines.append(connect(timeout))
            return self._lines[-1]

        client.make_connection = connect_and_record
        listed = self._call(lambda: _devices(client))
        states = [state for serial, state in listed if serial == o.serial]
        if len(states) > 1:
            raise WrongDevice(
                f"{self.where}: {len(states)} devices have this serial number "
                f"({', '.join(states)}), as cheap phones may; attach them to different machines"
            )
        if not states:
            others = ", ".join(f"{serial} ({state})" for serial, state in listed) or "none"
            advice = "switch on USB debugging, and use a cable that carries data"
            if any(state == "device" for _, state in listed):
                advice += ", or set `serial` to another phone's"
            raise support.absent(
                f"{self.where}: not attached; adb lists {others}; {advice}", seen=self.seen
            )
        if states != ["device"]:
            raise self._translated(f"its state is {states[0]!r}; let it boot into Android")
        self.handle, self.seen = client.device(serial=o.serial), True

    def shell(self, command: str) -> str:
        """Return the command's output (both streams); its exit status is ignored."""
        device, timeout_s = self.opened(), self.options.timeout_s
        answer = self._call(lambda: device.shell2(command, timeout=timeout_s, v2=True))
        return str(answer.output)

    def listing(self, folder: str) -> dict[str, int]:
        """Return {name: bytes} of the regular files in a folder."""
        device = self.opened()
        entries = self._call(lambda: list(device.sync.iter_directory(folder)))
        return {e.path: e.size for e in entries if stat.S_ISREG(e.mode)}

    def pull(self, path: str) -> bytes:
        """Return a file's bytes; a DeviceError if the transfer breaks off."""
        device = self.opened()
        return bytes(self._call(lambda: device.sync.read_bytes(path)))

    def clock_offset(self) -> tuple[float, str, float]:
        """Return (phone's clock minus this machine's, s; its time zone, +hhmm; uncertainty, s).

        Each round trip bounds the offset from both sides; the result is the middle of the interval
        that satisfies all bounds, as soon as it is known to 2 ms. If the clock is set meanwhile, no
        interval satisfies them, and the shortest round trip is used.
        """
        low, high = -math.inf, math.inf
        found: list[tuple[float, str, float]] = []
        while len(found) < _CLOCK_TRIES and high - low > 2 * _CLOCK_S:
            offset, zone, half = self._call(self._ask_clock)
            found.append((offset, zone, half))
            low, high = max(low, offset - half), min(high, offset + half)
        if low > high:
            return min(found, key=lambda one: one[2])
        return (low + high) / 2.0, found[-1][1], (high - low) / 2.0

    def _ask_clock(self) -> tuple[float, str, float]:
        # the connection is opened beforehand: adbutils sleeps 10 ms while opening and closing one,
        # which would lengthen only one side of the round trip
        line = self.opened().open_transport(timeout=self.options.timeout_s)
        start = time.time()
        line.send_command("shell:date '+%s.%N %z'")
        line.check_okay()
        text = line.read_until_close().split()
        end = time.time()
        second, _, fraction = "".join(text[:1]).partition(".")
        # without a fraction (old versions of Android): the middle of the second
        half_s = 0.0 if fraction.isdecimal() else 0.5
        try:
            phone = half_s + support.parse_number(second if half_s else text[0])
        except ValueError as error:
            raise BadReading(f"{self.where}: `date` prints {' '.join(text)!r}") from error
        return phone - (start + end) / 2.0, "".join(text[1:2]), half_s + (end - start) / 2.0

    def _call(self, action: Callable[[], Any]) -> Any:
        """Run an action; raises adbutils' errors as DeviceErrors by the server's answer."""
        adbutils = support.library("adbutils", "android")
        try:
            return action()
        except (adbutils.AdbTimeout, TimeoutError) as error:
            raise DeviceTimeout(f"{self.where}: no answer in {self.timeout_s:g} s") from error
        except adbutils.AdbError as error:
            raise self._translated(str(error)) from error
        except (EOFError, struct.error, ConnectionError) as error:
            raise DeviceGone(f"{self.where}: the connection broke off ({error})") from error
        except ValueError as error:
            raise BadReading(
                f"{self.where}: the adb server's answer cannot be read ({error})"
            ) from error
        finally:
            for line in self._lines:  # adbutils leaves a refused connection open
                line.close()
            self._lines.clear()

    def _translated(self, message: str) -> DeviceError:
        for word, advice in DENIED.items():
            if word in message:
                return support.denied(f"{self.where}: {advice}", seen=self.seen)
        if "offline" in message:
            return DeviceGone(
                f"{self.where}: offline: re-plug the cable, or `adb reconnect offline`; an "
                "unpowered hub is a common cause"
            )
        if "connect to adb server" in message or "No adb exe" in message:
            server = f"{self.options.host}:{self.options.port}"
            return DeviceNotFound(f"no adb server at {server}: {message}")
        if "chunk missing" in message or "Invalid sync" in message:
            message = f"a transfer broke off ({message})"
        return DeviceGone(f"{self.where}: {' '.join(message.split())}")


ZONES = 'for z in /sys/class/thermal/thermal_zone*; do echo "$(cat $z/type) $(cat $z/temp)"; done'
DUMPS = {"battery": "dumpsys battery", "thermal": "dumpsys thermalservice", "zone": ZONES}
NO_BATTERY = (
    "no battery temperature: no battery, one above 70 °C, frozen values (`dumpsys battery reset` "
    "ends that), or an unknown unit ({state})"
)
# TemperatureType: CPU 0, GPU, BATTERY, SKIN, USB_PORT, POWER_AMPLIFIER; BCL_VOLTAGE 6, BCL_CURRENT
# and BCL_PERCENTAGE are none; NPU 9, TPU, DISPLAY, MODEM, SOC, WIFI, CAMERA, FLASHLIGHT, SPEAKER,
# AMBIENT, POGO
TEMPERATURES = {*range(6), *range(9, 20)}
LIVE_SECTION = "Current temperatures from HAL:"
WHOLE_VOLTS = range(1, 100)
CELL_MV = range(2500, 4600)
COLDEST_BATTERY_C, HOTTEST_BATTERY_C = -30.0, 70.0

_FIELD = re.compile(
    r"^[ \t]*(temperature|voltage|present):[ \t]*(-?[0-9]{1,9}|true|false)[ \t]*$", re.MULTILINE
)
_RECORD = re.compile(
    r"Temperature\{mValue=(?P<value>[^,]*), mType=(?P<type>-?[0-9]+), "
    r"mName=(?P<name>(?:(?!Temperature\{).)*?), mStatus=[0-9]+\}",
    re.DOTALL,
)
_HEADING = re.compile(r"^[^\s,}][^{}\n]*:[ \t]*$", re.MULTILINE)


class AndroidThermometer(AdbPhone, support.CheckedThermometer):
    """A phone's battery, thermal service and thermal zones, read in one shell call each."""

    class Options(PhoneOptions):
        """The options of the thermometer `android`.

        sensors: {channel: battery, thermal:NAME or zone:TYPE}; units: {channel: unit}.
        """

        sensors: dict[str, str] = {"temperature": "battery"}  # noqa: RUF012 - pydantic copies it
        units: dict[str, Literal["degC", "tenths", "thousandths"]] = {}  # noqa: RUF012
        timeout_s: support.Seconds = 5.0

    range_c = (-30.0, 125.0)
    usual: ClassVar = {}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.sensors: dict[str, str] = self.options.sensors
        for channel, source in self.sensors.items():
            kind, _, name = source.partition(":")
            if kind not in DUMPS or (kind != "battery") != bool(name):
                raise ConfigurationError(
                    f"sensors.{channel}: {source!r} is neither battery, thermal:NAME nor zone:TYPE"
                )
        for channel in self.options.units:
            if self.sensors.get(channel, "").partition(":")[0] not in ("battery", "zone"):
                raise ConfigurationError(
                    f"units.{channel}: sensors has no battery or zone of that name"
                )
        self._scales = self._stated()

    def close(self) -> None:
        super().close()
        self._scales = self._stated()

    def named_channels(self) -> list[str]:
        return list(self.sensors)

    def read(self) -> Reading:
        start = self.clock.monotonic()
        kinds = {source.partition(":")[0] for source in self.sensors.values()}
        texts = {kind: self.shell(DUMPS[kind]) for kind in sorted(kinds)}
        service = thermalservice(texts.get("thermal", ""))
        found: dict[str, float | str] = {
            f"thermal:{name}": value for name, value in service.items()
        }
        number = battery(texts.get("battery", ""), self._scales.get("battery"))
        if number is None:
            found["battery"] = NO_BATTERY
        else:
            self._scales["battery"] = number[1]
            found["battery"] = self._in_unit("battery", *number)
        found |= self._zones(texts)
        measures = {
            channel: (source, partial(self._judge, channel, source, found.get(source)))
            for channel, source in self.sensors.items()
        }
        return self.reading(measures, start)

    def _judge(self, channel: str, source: str, value: float | str | None) -> float:
        where = f"{self.where}: {source}"
        if value is None:
            raise BadReading(f"{where}: the phone does not report it")
        if isinstance(value, str):
            state = f"set units: {{{channel}: degC}}, tenths or thousandths"
            raise BadReading(f"{where}: {value.format(state=state)}")
        idle = "what an absent sensor reports" if chips.is_idle("", value) else ""
        return self.judge(source, where, value, idle)

    def _stated(self) -> dict[str, float]:
        """Return {source: factor to °C} for the units in the stanza."""
        return {
            self.sensors[channel]: support.UNITS[unit]
            for channel, unit in self.options.units.items()
        }

    def _in_unit(self, source: str, number: float, scale: float) -> float | str:
        """Return °C, or why the unit is doubtful, in words."""
        if self.switched(source, number, scale):
            return f"{number:g} agrees with the last reading only in another unit: it has switched"
        return round(number * scale, 6)

    def _zones(self, texts: Mapping[str, str]) -> dict[str, float | str]:
        raw = kernel.raw_zones(texts.get("zone", ""))
        known = {s.removeprefix("zone:"): f for s, f in self._scales.items() if s != "battery"}
        scales = kernel.zone_scales(raw, known)
        self._scales |= {f"zone:{name}": scale for name, scale in scales.items()}
        found: dict[str, float | str] = {}
        for name, value in raw.items():
            source = f"zone:{name}"
            if name in scales:
                found[source] = self._in_unit(source, value, scales[name])
            elif not kernel.is_temperature(name):
                found[source] = f"by its name, {value} is not a temperature; if it is, {{state}}"
            elif value == 0:
                found[source] = "0 is what an absent sensor reports; if it is fitted, {state}"
            else:
                found[source] = f"the unit of {value} is unknown; {{state}}"
        return found


def battery(text: str, scale: float | None = None) -> tuple[float, float] | None:
    """Return (number, factor to °C) of `dumpsys battery`; None without a credible temperature.

    scale: the factor, if it is known.
    """
    text = text.replace("\r", "")
    if "UPDATES STOPPED" in text:
        return None
    fields: dict[str, str] = {}
    for name, value in _FIELD.findall(text):
        fields.setdefault(name, value)  # the first is current; log lines may repeat the word
    whole = {name: int(v) for name, v in fields.items() if v not in ("true", "false")}
    raw, volts = whole.get("temperature"), whole.get("voltage")
    if raw is None or fields.get("present") == "false" or (raw == 0 and not volts):
        return None
    if scale is not None:
        return (raw, scale) if abs(raw) * scale <= HOTTEST_BATTERY_C else None
    if raw == 0 and volts not in CELL_MV:  # a board with mains supply
        return None
    degrees = COLDEST_BATTERY_C <= raw <= HOTTEST_BATTERY_C
    if volts in WHOLE_VOLTS and degrees:
        return raw, 1.0
    lowest = 2 * HOTTEST_BATTERY_C if volts in WHOLE_VOLTS else 10 * COLDEST_BATTERY_C
    # up to 70 it may be tenths or whole degrees, which some boards report beside mV
    tenths = not degrees and lowest <= raw <= 10 * HOTTEST_BATTERY_C
    return (raw, 0.1) if tenths else None


def thermalservice(text: str) -> dict[str, float]:
    """Return {sensor: °C} of the live section; empty if the phone prints none."""
    text = text.replace("\r", "")
    _, section, rest = text.partition(LIVE_SECTION)
    if not section or "HAL Ready: false" in text:
        return {}
    heading = _HEADING.search(rest)
    section = rest[: heading.start()] if heading else rest
    found: list[tuple[str, float]] = []
    for record in _RECORD.finditer(section):
        if int(record["type"]) not in TEMPERATURES:
            continue
        try:
            value = support.parse_number(record["value"])
        except ValueError:
            continue  # NaN
        name = " ".join(record["name"].split())
        # 0.0 is the HAL's value for a sensor that is not fitted
        if value != 0.0 and not kernel.is_limit(name):
            found.append((name, value))
    return kernel.unambiguous(found)
