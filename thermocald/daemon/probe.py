"""What is attached to a machine, as configuration; and what configured devices give now.

A device that is not certain (a serial port, an I2C bus: nobody knows what is on it) is shown as a
comment.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import DeviceError, ThermocaldError
from thermocald.hal import SystemClock, driver_names, load_driver, open_device

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from thermocald.config import Config, DeviceConfig
    from thermocald.hal import Frame, Kind, Reading

KINDS: tuple[Kind, ...] = ("camera", "thermometer", "output")


@dataclass(frozen=True)
class Attached:
    """A device that a driver found; certain: whether it is known to be one for this driver."""

    kind: Kind
    driver: str
    options: Mapping[str, Any]
    about: str
    certain: bool

    def as_dict(self) -> dict[str, Any]:
        """As the document of `devices` has it."""
        return {
            "kind": self.kind,
            "driver": self.driver,
            "options": dict(self.options),
            "about": self.about,
            "certain": self.certain,
        }


@dataclass(frozen=True)
class Probe:
    """What one frame or reading of a configured device gave; error: why there is none."""

    kind: Kind
    name: str
    driver: str
    took_s: float
    shows: str
    values: Mapping[str, Any]
    error: str = ""


def attached() -> tuple[list[Attached], list[str]]:
    """(devices found, notes on drivers that could not look)."""
    found: list[Attached] = []
    notes: list[str] = []
    for kind in KINDS:
        for name in driver_names(kind):
            try:
                found += [
                    Attached(kind, name, one.options, one.about, one.certain)
                    for one in load_driver(kind, name).attached()
                ]
            except DeviceError as error:
                notes.append(f"{kind} driver {name}: {error}")
    return found, notes


def probe(config: Config) -> list[Probe]:
    """Take one frame of each camera and one reading of each thermometer; nothing is stored."""
    return [
        *(_probe("camera", device) for device in config.cameras),
        *(_probe("thermometer", device) for device in config.thermometers),
    ]


def probe_lines(probes: Sequence[Probe]) -> Iterator[str]:
    """The probes for people, one line each."""
    for p in probes:
        what = f"FAILED: {p.error}" if p.error else p.shows
        yield f"{p.kind} {p.name} ({p.driver}), {p.took_s * 1e3:.0f} ms: {what}"


def probe_document(probes: Sequence[Probe]) -> dict[str, Any]:
    """The probes as JSON."""
    return {
        "format": "thermocald-probe/1",
        "devices": [
            {
                "kind": p.kind,
                "name": p.name,
                "driver": p.driver,
                "took_s": p.took_s,
                "values": dict(p.values),
                "error": p.error or None,
            }
            for p in probes
        ],
    }


def _probe(kind: Kind, device: DeviceConfig) -> Probe:
    begin = time.monotonic()
    try:
        with open_device(kind, device.driver, device.options, SystemClock()) as driver:
            begin = time.monotonic()
            result = driver.capture() if kind == "camera" else driver.read()
            took_s = time.monotonic() - begin
    except Exception as error:  # noqa: BLE001
        # a driver's own mistake is told like a fault, so that the other devices are tried too
        took_s = time.monotonic() - begin
        known = isinstance(error, ThermocaldError)
        why = str(error) if known else f"its driver failed: {type(error).__name__}: {error}"
        return Probe(kind, device.name, device.driver, took_s, "", {}, why)
    values = _frame_values(result) if kind == "camera" else _reading_values(result)
    shows = ", ".join(f"{key} {value}" for key, value in values.items() if value is not None)
    return Probe(kind, device.name, device.driver, took_s, shows, values)


def _frame_values(frame: Frame) -> dict[str, Any]:
    values: dict[str, Any] = {"age_s": round(time.time() - frame.utc, 3)}
    if frame.image is not None:
        height, width = frame.image.shape
        values |= {
            "width_px": width,
            "height_px": height,
            "grey_mean": round(float(frame.image.mean()), 1),
            "grey_max": int(frame.image.max()),
        }
    values |= {"exposure_s": frame.exposure, "sequence": frame.sequence}
    return values


def _reading_values(reading: Reading) -> dict[str, Any]:
    values: dict[str, Any] = {f"{k}_c": round(v, 4) for k, v in reading.values.items()}
    for channel, why in dict(reading.metadata.get("missing", {})).items():
        values[f"{channel}_missing"] = why
    return values


def stanzas(found: Sequence[Attached]) -> Iterator[str]:
    """Yield lines of YAML; what is uncertain as comments."""
    if not found:
        yield "# nothing found"
    for kind in KINDS:
        mine = [one for one in found if one.kind == kind]
        certain = [one for one in mine if one.certain]
        if mine:
            yield f"{kind}s:" if certain else f"# {kind}s:"
        for number, one in enumerate(sorted(mine, key=lambda one: not one.certain), 1):
            mark = "" if one.certain else "# "
            yield f"  # {one.about}"
            stanza = {"name": f"{one.driver}-{number}", "driver": one.driver, **one.options}
            yield f"  {mark}- {_flow(stanza)}"


def _flow(mapping: Mapping[str, Any]) -> str:
    """A mapping in one line of YAML."""
    import yaml

    text: str = yaml.safe_dump(
        dict(mapping), default_flow_style=True, sort_keys=False, width=10_000
    )
    return text.strip()
