"""A camera as a device to simulate: sensor, set-up, heat, thermometers, how well it measures.

The camera file:

    format: thermocald-camera/1
    name: rpi-v2.1
    width: 3280
    height: 2464
    pixel_pitch: 0.00112                         # mm
    exterior: {omega: …, …, Z0: 1000.0}          # rad, mm; default: before the field's middle
    distance: 1300.0                             # mm, for that default
    measuring: {sigma: 0.04, missed: 0.02, gross: 0.002, gross_size: 3.0}   # px, shares, px
    look: {paper: 200, ink: 30, blur: 0.8, noise: 2.0, vignetting: 0.15}    # DN, px, share
    heat:
      bodies: {lens: {capacity: 0.6}, board: {capacity: 15.0}}              # J/K
      links:                                     # W/K; what is not a body is a boundary
      - {between: [lens, board], conductance: 0.01}
      - {between: [board, ambient], conductance: 0.05}
    thermometers:                                # the first is the reference
      temperature: {body: lens, noise: 0.04, resolution: 0.0625}            # K
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field
from typing import TYPE_CHECKING

from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, ExteriorOrientation, Sensor
from thermocald.simulation.effects.parameter import PARAMETER_UNITS
from thermocald.simulation.heat import HeatNetwork, Link, read_network
from thermocald.simulation.model_file import read_sensor
from thermocald.simulation.quantities import QuantityReader
from thermocald.simulation.scene import Look
from thermocald.simulation.thermometer import SimulatedThermometer, read_thermometer
from thermocald.yaml_file import read_yaml

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["CAMERA_FORMAT", "CameraDevice", "Measuring", "read_camera_device"]

CAMERA_FORMAT = "thermocald-camera/1"


@dataclass(frozen=True, slots=True)
class Measuring:
    """How image points are measured: sigma px of a coordinate; share of targets missed; share
    grossly wrong, and by how much (sigma, px) those are.
    """

    sigma: float = 0.04
    missed: float = 0.02
    gross: float = 0.002
    gross_size: float = 3.0


@dataclass(frozen=True)
class CameraDevice:
    """A camera in its set-up, as the camera file describes it."""

    name: str
    sensor: Sensor
    network: HeatNetwork
    thermometers: Mapping[str, SimulatedThermometer]
    exterior: ExteriorOrientation | None = None
    distance: float = 1300.0
    measuring: Measuring = field(default_factory=Measuring)
    look: Look = field(default_factory=Look)

    @property
    def reference(self) -> str:
        """The reference thermometer's name."""
        return next(iter(self.thermometers))


def default_heat() -> tuple[HeatNetwork, dict[str, SimulatedThermometer]]:
    """A camera module on a board in a housing, in front of its test field; two thermometers.

    Capacities and conductances are of the order of a Raspberry Pi in a plastic case: the module
    warms with a time constant of a few minutes.
    """
    network = HeatNetwork(
        {"sensor": 1.0, "lens": 1.5, "board": 40.0, "housing": 60.0, "test_field": 2000.0},
        (
            Link("sensor", "lens", 0.05),
            Link("sensor", "board", 0.05),
            Link("lens", "housing", 0.02),
            Link("board", "housing", 0.25),
            Link("housing", "ambient", 0.4),
            Link("test_field", "ambient", 5.0),
        ),
    )
    thermometers = {
        "temperature": SimulatedThermometer("lens"),
        "board_temperature": SimulatedThermometer("board"),
    }
    return network, thermometers


def read_camera_device(path: Path) -> CameraDevice:
    """Read a camera file; ConfigurationError names file and key."""
    document = read_yaml(path)
    top = QuantityReader(path, document)
    found = top.text("format")
    if found != CAMERA_FORMAT:
        raise top.fail("format", f"is {found[:60]!r}; this program reads {CAMERA_FORMAT!r}")
    top.only(
        ("format", "name", "width", "height", "pixel_pitch", "exterior", "distance", "measuring",
         "look", "heat", "thermometers")
    )  # fmt: skip
    network, thermometers = default_heat()
    if document.get("heat") is not None:
        network = read_network(top.inner("heat"))
    if document.get("thermometers") is not None:
        group = top.inner("thermometers")
        thermometers = {str(n): read_thermometer(group.inner(n)) for n in group.mapping}
    for name, thermometer in thermometers.items():
        if thermometer.body not in (*network.bodies, *network.boundaries):
            raise top.fail(
                f"thermometers.{name}.body",
                f"is {thermometer.body!r}; bodies are {', '.join(network.bodies)}",
            )
    if not thermometers:
        raise top.fail("thermometers", "is empty: one thermometer is needed")
    return CameraDevice(
        top.text("name", "camera"),
        read_sensor(top),
        network,
        thermometers,
        _exterior(top) if document.get("exterior") is not None else None,
        top.number("distance", "mm", 1300.0, above=0.0),
        _measuring(top) if document.get("measuring") is not None else Measuring(),
        _look(top) if document.get("look") is not None else Look(),
    )


def _exterior(top: QuantityReader) -> ExteriorOrientation:
    reader = top.inner("exterior")
    reader.only(EOP_NAMES)
    return ExteriorOrientation(*(reader.number(n, PARAMETER_UNITS[n]) for n in EOP_NAMES))


def _measuring(top: QuantityReader) -> Measuring:
    reader = top.inner("measuring")
    reader.only(("sigma", "missed", "gross", "gross_size"))
    usual = Measuring()
    missed, gross = (
        reader.number(key, "1", getattr(usual, key), low=0.0) for key in ("missed", "gross")
    )
    for key, share in (("missed", missed), ("gross", gross)):
        if share >= 1:
            raise reader.fail(key, f"is {share:g}; it is a share below 1")
    return Measuring(
        reader.number("sigma", "px", usual.sigma, above=0.0),
        missed,
        gross,
        reader.number("gross_size", "px", usual.gross_size, low=0.0),
    )


def _look(top: QuantityReader) -> Look:
    reader = top.inner("look")
    reader.only(("paper", "ink", "blur", "noise", "vignetting"))
    usual = Look()
    look = Look(
        reader.number("paper", "DN", usual.paper_dn, low=0.0),
        reader.number("ink", "DN", usual.ink_dn, low=0.0),
        reader.number("blur", "px", usual.blur_px, low=0.0),
        reader.number("noise", "DN", usual.noise_dn, low=0.0),
        reader.number("vignetting", "1", usual.vignetting, low=0.0),
    )
    limits = {"paper": 255.0, "ink": 255.0, "blur": 30.0, "noise": 60.0, "vignetting": 1.0}
    for (key, high), value in zip(limits.items(), astuple(look), strict=True):
        if value > high:
            raise reader.fail(key, f"is {value:g}; it is at most {high:g}")
    return look
