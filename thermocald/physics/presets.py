"""Presets: the cameras of the reference study, with the drift that it reports.

Elias, Eltner, Liebold, Maas (2020): Assessing the Influence of Temperature Changes on the Geometric
Stability of Smartphone- and Raspberry Pi Cameras, Sensors 20, 643, sections 4.1 and 4.2. Taken from
the text: size and direction of the drift of principal point and principal distance between the
first and the last of 150 epochs (the RPi: at the highest temperature), the growth of σ0 to 3.5
times, and the RPi's incomplete return. The rates per kelvin follow from these and from the course
of the temperature. Assumed, with usual sizes: temperatures, distortion (its drift is small,
according to the text), image noise, and the ratio of x to y in the drift.

Sensor and lens data:

* RPi camera v2.1: Raspberry Pi documentation, camera, hardware specification: IMX219,
  3280 × 2464 px of 1.12 µm, focal length 3.04 mm, f/2.0.
* LG Google Nexus 5: sensor Sony IMX179 (1/3.2 inch, 3264 × 2448 px of 1.4 µm), f/2.4; focal length
  3.97 mm according to the phone's EXIF.
* Samsung Galaxy S8: sensor Sony IMX333 or Samsung S5K2L2 (1/2.55 inch, 4032 × 3024 px of 1.4 µm),
  f/1.7; focal length 4.2 mm according to the phone's EXIF.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError, UsageError
from thermocald.photogrammetry.camera.camera_model import (
    RASPBERRY_PI_V2,
    InteriorOrientation,
    Sensor,
)
from thermocald.physics import catalogue
from thermocald.physics.device import (
    CameraDevice,
    Programme,
    read_camera_device,
    read_programme,
)
from thermocald.physics.heat import Course, HeatNetwork
from thermocald.physics.model import ModelEffect, ThermalModel
from thermocald.physics.model_file import read_model
from thermocald.physics.simulation import Simulation
from thermocald.physics.testfields import RPI_INTERIOR, corner_field, corner_view, load_field
from thermocald.result import Result

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.physics.effect import Effect

_EPOCHS = 150
_INTERVAL_S = 10.0
_HEATED_S = 750.0  # the RPi's lamp is on for the first half


@dataclass(frozen=True)
class Preset:
    """A camera in one state, as reported by the reference study.

    interior: at T0; drift_px, drift_c_mm: of principal point and principal distance over the whole
    warming; direction_deg: of the principal point's drift in the image (x right, y up); begin_degc,
    end_degc: temperature at power-on and in equilibrium; noise_ratio: σ0 at the highest temperature
    over σ0 at the start; set_share: share of the principal point's drift that remains; lamp:
    whether it is heated from outside and then left to cool; distortion_drift: of A1, B1, B2 over
    the warming.
    """

    name: str
    about: str
    camera: str
    sensor: Sensor
    interior: InteriorOrientation
    f_number: float
    distance_mm: float
    drift_px: float
    direction_deg: float
    drift_c_mm: float
    begin_degc: float
    end_degc: float
    noise_ratio: float = 1.0
    set_share: float = 0.0
    lamp: bool = False
    distortion_drift: tuple[float, float, float] = (0.0, 0.0, 0.0)


_NEXUS = Sensor(3264, 2448, 0.0014)
_NEXUS_INTERIOR = InteriorOrientation(
    c=3.97, x0=0.021, y0=-0.034, A1=0.0051, A2=-4.0e-4, B1=1.2e-4, B2=-0.9e-4
)
_S8 = Sensor(4032, 3024, 0.0014)
_S8_INTERIOR = InteriorOrientation(
    c=4.2, x0=-0.017, y0=0.042, A1=0.0062, A2=-3.6e-4, B1=-0.7e-4, B2=1.1e-4
)

PRESETS: Mapping[str, Preset] = {
    p.name: p
    for p in (
        Preset(
            "nexus5-cold", "LG Google Nexus 5, switched on cold, warms itself",
            "nexus5", _NEXUS, _NEXUS_INTERIOR, 2.4, 900.0,
            drift_px=16.0, direction_deg=-28.0, drift_c_mm=0.007, begin_degc=23.0, end_degc=40.0,
            distortion_drift=(2e-5, -2e-5, 1e-5),
        ),
        Preset(
            "nexus5-warm", "LG Google Nexus 5, warm already",
            "nexus5", _NEXUS, _NEXUS_INTERIOR, 2.4, 900.0,
            drift_px=8.0, direction_deg=-28.0, drift_c_mm=0.003, begin_degc=32.0, end_degc=40.0,
            distortion_drift=(1e-5, -1e-5, 0.5e-5),
        ),
        Preset(
            "galaxy-s8-cold", "Samsung Galaxy S8, switched on cold, warms itself",
            "galaxy-s8", _S8, _S8_INTERIOR, 1.7, 900.0,
            drift_px=40.0, direction_deg=152.0, drift_c_mm=0.007, begin_degc=23.0, end_degc=45.0,
            noise_ratio=1.8, distortion_drift=(3e-5, 0.0, 0.0),
        ),
        Preset(
            "galaxy-s8-warm", "Samsung Galaxy S8, warm already",
            "galaxy-s8", _S8, _S8_INTERIOR, 1.7, 900.0,
            drift_px=11.0, direction_deg=152.0, drift_c_mm=0.003, begin_degc=37.0, end_degc=43.0,
            noise_ratio=1.2, distortion_drift=(1e-5, 0.0, 0.0),
        ),
        Preset(
            "rpi-v2.1-heating", "Raspberry Pi camera v2.1, heated by a lamp, then left to cool",
            "rpi-v2.1", RASPBERRY_PI_V2.sensor, RPI_INTERIOR, 2.0, 900.0,
            drift_px=10.5, direction_deg=-150.0, drift_c_mm=0.005, begin_degc=25.0, end_degc=52.0,
            noise_ratio=3.5, set_share=0.06, lamp=True, distortion_drift=(2e-5, -2e-5, -2e-5),
        ),
    )
}  # fmt: skip
"""The presets, by name."""


_LOSS = 0.2375  # W/K
_HOUSED = HeatNetwork(
    {"board": 15.0, "housing": 52.0, "lens": 0.8, "sensor": 0.4},
    (
        ("board", "housing", 6.0),
        ("lens", "housing", 0.4),
        ("sensor", "lens", 0.2),
        ("housing", "ambient", _LOSS),
    ),
)
"""A camera module in a housing that cools in air: 63 % of the change in 300 s."""


def preset_simulation(
    name: str, seed: int = 0, series: str = "M1", field: TestField | None = None
) -> Simulation:
    """Return a preset's simulation, by default of a corner field of 147 circles.

    Raises ConfigurationError for an unknown name.
    """
    if name not in PRESETS:
        raise ConfigurationError(f"unknown preset {name!r}; known are: {', '.join(PRESETS)}")
    preset = PRESETS[name]
    device = CameraDevice(preset.camera, preset.sensor, _HOUSED, distance=preset.distance_mm)
    ambient = preset.begin_degc if preset.lamp else 23.0
    power = _LOSS * (preset.end_degc - ambient)
    lamp = Course.steps([0.0, _HEATED_S, _EPOCHS * _INTERVAL_S + 50.0], [power, 0.0])
    programme = Programme(
        preset.name,
        _EPOCHS,
        _INTERVAL_S,
        {"ambient": Course.constant(ambient)},
        {"housing": lamp} if preset.lamp else {"board": Course.constant(power)},
        series,
        initial=preset.begin_degc,
    )
    test_field = corner_field() if field is None else field
    bare = ThermalModel(
        preset.camera,
        preset.sensor,
        preset.begin_degc,
        preset.interior,
        exterior=corner_view(test_field, preset.distance_mm),
        image_sigma=device.measuring.sigma,
        name=preset.name,
    )
    still = Simulation(bare, device, test_field, programme, seed)
    # without jitter, the temperature at the frames depends neither on the seed nor on the drift
    course = still.true_history.temperature()
    return replace(still, model=_add_drift(bare, preset, float(np.max(np.abs(course - course[0])))))


def _add_drift(bare: ThermalModel, preset: Preset, warming: float) -> ThermalModel:
    """Return the model with the preset's drift over a warming by some K."""
    angle = np.deg2rad(preset.direction_deg)
    way = preset.drift_px * preset.sensor.pixel_pitch * np.array([np.cos(angle), np.sin(angle)])
    x0, y0 = (way / warming).tolist()
    stays, returns = preset.set_share, 1.0 - preset.set_share
    a1, b1, b2 = (change / warming for change in preset.distortion_drift)
    wanted: list[tuple[Callable[[Effect], bool], dict[str, float]]] = [
        (lambda e: e.irreversible, {"x0": stays * x0, "y0": stays * y0}),
        (lambda e: e.usual == ("A1",), {"A1": a1}),
        (lambda e: e.usual == ("B1", "B2"), {"B1": b1, "B2": b2}),
        (lambda e: e.seen_in == "noise", {"factor": (preset.noise_ratio - 1.0) / warming}),
    ]
    return replace(
        bare,
        rates={"c": preset.drift_c_mm / warming, "x0": returns * x0, "y0": returns * y0},
        effects=tuple(
            ModelEffect(catalogue.find(one).name, sizes)
            for one, sizes in wanted
            if any(sizes.values())
        ),
    )


def given_simulation(
    preset: str | None,
    model: Path | None,
    camera: Path | None,
    field: TestField | None,
    programme: Path | None,
    seed: int = 0,
    series: str = "M1",
) -> Simulation:
    """Return the simulation described by a preset, by files, or by both.

    Raises UsageError if neither a preset nor model and programme are given.
    """
    if preset is not None:
        usual = preset_simulation(preset, seed, series, field)
        return replace(  # both at once: a given model and camera need not fit the preset's
            usual,
            device=usual.device if camera is None else read_camera_device(camera),
            programme=usual.programme if programme is None else read_programme(programme),
            model=usual.model if model is None else read_model(model),
        )
    if model is None or programme is None:
        raise UsageError(
            f"give --preset ({', '.join(PRESETS)}), or --model and --programme "
            "(and --camera and --testfield where the defaults do not fit)"
        )
    thermal = read_model(model)
    plain = CameraDevice(thermal.camera, thermal.sensor)
    device = plain if camera is None else read_camera_device(camera)
    chosen = load_field("circles") if field is None else field
    return Simulation(thermal, device, chosen, read_programme(programme), seed)


class Catalogue(Result):
    """The list of the presets, and of the effects for model files."""

    def as_dict(self) -> dict[str, Any]:
        """Return the document that `simulate --list --json` writes."""
        return {
            "format": "thermocald-catalogue/1",
            "presets": [{"preset": one.name, "about": one.about} for one in PRESETS.values()],
            "effects": [
                {"effect": name, "kind": effect.kind, "parameters": effect.units()}
                for name in catalogue.names()
                if (effect := catalogue.get(name))
            ],
        }

    def lines(self) -> list[str]:
        """Return what `simulate --list` prints."""
        lines = ["presets", *(f"  {p.name:<18} {p.about}" for p in PRESETS.values())]
        lines.append("effects (for model files)")
        for name in catalogue.names():
            effect = catalogue.get(name)
            searched = ", ".join(f"{k} [{p.unit}]" for k, p in effect.nonlinear.items())
            linear = ", ".join(f"{k} [{effect.linear[k]}]" for k in effect.usual)
            lines.append(f"  {name:<24} {'; '.join(t for t in (searched, linear) if t)}")
        return lines
