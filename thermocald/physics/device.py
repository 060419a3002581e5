"""A simulated camera (sensor, set-up, heat, thermometers, accuracy), and its programme.

The camera file:

    format: thermocald-camera/1
    name: rpi-v2.1
    width: 3280
    height: 2464
    pixel_pitch: 0.00112                         # mm
    exterior: {omega: …, …, Z0: 1000.0}          # rad, mm; default: facing the field's centre
    distance: 1300.0                             # mm, of that default
    measuring: {sigma: 0.04, missed: 0.02, gross: 0.002, gross_size: 3.0}   # px, shares, px
    look: {paper: 200, ink: 30, blur: 0.8, noise: 2.0, vignetting: 0.15}    # DN, px, share
    heat:
      bodies: {lens: {capacity: 0.6}, board: {capacity: 15.0}}              # J/K
      links:                                     # W/K; any other name is a boundary
      - {between: [lens, board], conductance: 0.01}
      - {between: [board, ambient], conductance: 0.05}
    thermometers:                                # the first is the reference
      temperature: {body: lens, noise: 0.04, resolution: 0.0625}            # K

The programme file, with the frames' times and the heat that acts on the camera:

    format: thermocald-programme/1
    name: lamp cycles
    series: M1
    epochs: 150
    interval: 10.0                               # s
    jitter: 0.0                                  # s, of the frames' times (sigma)
    reading: {offset: 0.0, spread: 1.0}          # s: readings at frame time + offset ± spread
    begin: 1600000000.0                          # s UTC
    initial: 22.0                                # °C, of all bodies; default: ambient at the start
    ambient: 22.0                                # °C: a number, pieces, or a log (see `heat`)
    sources:                                     # W into bodies of the camera file
      housing: [{from: 0, to: 60, value: 0}, {from: 60, to: 900, value: 6.0},
                {from: 900, to: 1500, value: 0}]

Boundaries other than `ambient` are listed under `boundaries: {chamber: …}`.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field
from typing import TYPE_CHECKING

from thermocald.files import QuantityReader, read_yaml
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, ExteriorOrientation, Sensor
from thermocald.physics.effect import PARAMETER_UNITS
from thermocald.physics.heat import (
    Course,
    HeatNetwork,
    SimulatedThermometer,
    read_course,
    read_network,
    read_thermometer,
)
from thermocald.physics.scene import Look

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path


PROGRAMME_FORMAT = "thermocald-programme/1"


@dataclass(frozen=True)
class Programme:
    """The epochs of a simulation, with the boundaries and heat sources during them.

    epochs: their number; interval s, jitter s, reading_offset, reading_spread s, begin s UTC;
    initial °C, None for the ambient temperature at the start; boundaries {name: Course °C}, sources
    {body: Course W}.
    """

    name: str
    epochs: int
    interval: float
    boundaries: Mapping[str, Course]
    sources: Mapping[str, Course] = field(default_factory=dict)
    series: str = "M1"
    jitter: float = 0.0
    reading_offset: float = 0.0
    reading_spread: float = 1.0
    begin: float = 1_600_000_000.0
    initial: float | None = None


def read_programme(path: Path) -> Programme:
    """Read a programme file; ConfigurationError names the file, the key, and any gap."""
    document = read_yaml(path)
    top = QuantityReader(path, document)
    top.require_format(PROGRAMME_FORMAT)
    top.only(
        ("format", "name", "series", "epochs", "interval", "jitter", "reading", "begin", "initial",
         "ambient", "boundaries", "sources")
    )  # fmt: skip
    epochs = top.whole("epochs", "1")
    interval = top.number("interval", "s", above=0.0)
    duration = (epochs - 1) * interval
    boundaries = {"ambient": read_course(top, "ambient", "degC", duration, path.parent)}
    boundaries |= _read_courses(top, "boundaries", "degC", duration, path.parent)
    reading = _group(top, "reading", ("offset", "spread"))
    return Programme(
        top.text("name", path.stem),
        epochs,
        interval,
        boundaries,
        _read_courses(top, "sources", "W", duration, path.parent),
        top.text("series", "M1"),
        top.number("jitter", "s", 0.0, low=0.0),
        reading.number("offset", "s", 0.0),
        reading.number("spread", "s", 1.0, low=0.0),
        top.number("begin", "s", 1_600_000_000.0),
        top.number("initial", "degC") if document.get("initial") is not None else None,
    )


def _group(top: QuantityReader, key: str, known: Iterable[str] | None = None) -> QuantityReader:
    """Return a reader of the mapping at a key, empty if absent; `known`: the keys allowed."""
    group = top.inner(key) if top.mapping.get(key) is not None else QuantityReader(key, {})
    group.only(group.mapping if known is None else known)
    return group


def _read_courses(
    top: QuantityReader, key: str, unit: str, duration: float, folder: Path
) -> dict[str, Course]:
    group = _group(top, key)
    return {str(name): read_course(group, name, unit, duration, folder) for name in group.mapping}


CAMERA_FORMAT = "thermocald-camera/1"
# unit and highest value, in the order of `Look`
_LOOK = {"paper": ("DN", 255.0), "ink": ("DN", 255.0), "blur": ("px", 30.0), "noise": ("DN", 60.0),
         "vignetting": ("1", 1.0)}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Measuring:
    """The quality of image measurement.

    sigma px, of a coordinate; missed, gross: shares of the targets that are missed or grossly
    wrong; gross_size px: sigma of gross errors.
    """

    sigma: float = 0.04
    missed: float = 0.02
    gross: float = 0.002
    gross_size: float = 3.0


USUAL_NETWORK = HeatNetwork(
    {"sensor": 1.0, "lens": 1.5, "board": 40.0, "housing": 60.0, "test_field": 2000.0},
    (
        ("sensor", "lens", 0.05),
        ("sensor", "board", 0.05),
        ("lens", "housing", 0.02),
        ("board", "housing", 0.25),
        ("housing", "ambient", 0.4),
        ("test_field", "ambient", 5.0),
    ),
)
"""A camera module on a board in a housing before a test field.

The values are of the order of those of a Raspberry Pi in a plastic case, whose module warms with a
time constant of a few minutes.
"""
USUAL_THERMOMETERS: Mapping[str, SimulatedThermometer] = {
    "temperature": SimulatedThermometer("lens"),
    "board_temperature": SimulatedThermometer("board"),
}


@dataclass(frozen=True)
class CameraDevice:
    """A camera in its set-up, as described by the camera file."""

    name: str
    sensor: Sensor
    network: HeatNetwork = USUAL_NETWORK
    thermometers: Mapping[str, SimulatedThermometer] = field(
        default_factory=lambda: USUAL_THERMOMETERS
    )
    exterior: ExteriorOrientation | None = None
    distance: float = 1300.0
    measuring: Measuring = field(default_factory=Measuring)
    look: Look = field(default_factory=Look)

    @property
    def reference(self) -> str:
        """The reference thermometer's name."""
        return next(iter(self.thermometers))


def read_camera_device(path: Path) -> CameraDevice:
    """Read a camera file; ConfigurationError names the file and the key."""
    document = read_yaml(path)
    top = QuantityReader(path, document)
    top.require_format(CAMERA_FORMAT)
    if "interior" in document:
        raise top.fail(
            "interior", "is a calibrated camera's; give a file that describes how a camera warms"
        )
    top.only(
        ("format", "name", "width", "height", "pixel_pitch", "exterior", "distance", "measuring",
         "look", "heat", "thermometers")
    )  # fmt: skip
    network, thermometers = USUAL_NETWORK, USUAL_THERMOMETERS
    if document.get("heat") is not None:
        network = read_network(top.inner("heat"))
    if document.get("thermometers") is not None:
        group = top.inner("thermometers")
        thermometers = {str(n): read_thermometer(group.inner(n)) for n in group.mapping}
    for name, thermometer in thermometers.items():
        if thermometer.body not in (*network.capacities, *network.boundaries):
            raise top.fail(
                f"thermometers.{name}.body",
                f"is {thermometer.body!r}; bodies are {', '.join(network.capacities)}",
            )
    if not thermometers:
        raise top.fail("thermometers", "is empty; give at least one thermometer")
    where = _group(top, "exterior", EOP_NAMES)
    measuring = _group(top, "measuring", ("sigma", "missed", "gross", "gross_size"))
    usual, look = Measuring(), _group(top, "look", _LOOK)
    return CameraDevice(
        top.text("name", "camera"),
        Sensor.read(top),
        network,
        thermometers,
        ExteriorOrientation(*(where.number(n, PARAMETER_UNITS[n]) for n in EOP_NAMES))
        if where.mapping
        else None,
        top.number("distance", "mm", 1300.0, above=0.0),
        Measuring(
            measuring.number("sigma", "px", usual.sigma, above=0.0),
            measuring.share("missed", usual.missed),
            measuring.share("gross", usual.gross),
            measuring.number("gross_size", "px", usual.gross_size, low=0.0),
        ),
        Look(
            *(
                look.number(name, unit, seen, low=0.0, high=most)
                for (name, (unit, most)), seen in zip(_LOOK.items(), astuple(Look()), strict=True)
            )
        ),
    )
