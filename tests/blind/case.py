"""The effects, camera and errors of a blind recording."""

from __future__ import annotations

from dataclasses import dataclass

SINGLE = (
    "thermal_lag", "time_offset", "nonlinear_expansion", "softening", "thermal_gradient",
    "permanent_set", "hysteresis", "self_heating", "creep", "slip", "cyclic_interference",
    "second_heat_source", "defocus", "housing_tilt", "radial_distortion_drift",
    "decentering_drift", "affinity_drift", "test_field_expansion", "target_displacement",
)  # fmt: skip
OUTSIDE = "outside"
PROGRAMMES = ("lamp", "lamp2", "selfwarming", "steps", "ramp")

# name: (width, height, pitch mm, c mm, A1)
CAMERAS = {
    "rpi-v2.1": (3280, 2464, 0.00112, 3.04, -2.5e-3),
    "nexus5": (3264, 2448, 0.0014, 3.97, 1.2e-3),
    "galaxy-s8": (4032, 3024, 0.0014, 4.25, 8.0e-4),
}


@dataclass(frozen=True)
class Case:
    """A recording to generate."""

    effects: tuple[str, ...] = ()
    strength_px: float = 0.3
    seed: int = 0
    hard: bool = False
    noise_px: float = 0.04
    thermometer_k: float = 0.04
    epochs: int = 180
    interval: float = 10.0
    camera: str | None = None
    programmes: tuple[str, str] | None = None
    with_m2: bool = True
    influence: str = ""  # of the module `outside`, if the effect is OUTSIDE
    record_humidity: bool = False
    field_motion: str = ""  # motion of the test field in M1: knock, creep, wander
