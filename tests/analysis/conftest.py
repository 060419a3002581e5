"""Measured series of a warm-up, computed from formulas with known numbers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from thermocald.analysis.study.measured import MeasuredSeries, Thermometer
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor

NEXUS = Sensor(3264, 2448, 0.0014)
INTERIOR = np.array([3.97, 0.01, -0.02, -2e-3, 3e-4, 0.0, 2e-4, -1e-4, 0.0, 0.0])
SDS = np.array([2e-5, 7e-6, 7e-6, 2e-6, 2e-7, np.nan, 3e-6, 3e-6, np.nan, np.nan])


@dataclass
class WarmUp:
    """A camera that warms up with a time constant of 300 s; a call returns a series."""

    drift: dict[str, float] = field(
        default_factory=lambda: {"c": 0.007, "x0": 0.0194, "y0": -0.0112}
    )
    epochs: int = 150
    kelvin: float = 12.0
    thermometer_sd: float = 0.05
    seed: int = 0
    sds: np.ndarray = field(default_factory=SDS.copy)

    def __call__(
        self, name: str = "M1", label: str = "camera", **changes: object
    ) -> MeasuredSeries:
        rng = np.random.default_rng(self.seed)
        n = self.epochs
        time_s = np.arange(n) * 10.0
        course = 1 - np.exp(-time_s / 300.0)
        values = np.tile(INTERIOR, (n, 1))
        for parameter, amount in self.drift.items():
            values[:, IOP_NAMES.index(parameter)] += amount * course
        values += np.nan_to_num(self.sds) * rng.standard_normal((n, 10))
        sds = np.tile(self.sds, (n, 1))
        temperature = 25 + self.kelvin * course + self.thermometer_sd * rng.standard_normal(n)
        correlation = np.eye(10)
        correlation[3, 4] = correlation[4, 3] = -0.9
        correlation[1, 6] = correlation[6, 1] = correlation[2, 7] = correlation[7, 2] = 0.6
        made = MeasuredSeries(
            label=label, name=name, camera="nexus5", sensor=NEXUS, source="formula", time_s=time_s,
            thermometers=(Thermometer("temperature", temperature, self.thermometer_sd),),
            values=values, sds=sds, sigma0=1 + 0.04 * rng.standard_normal(n),
            redundancy=np.full(n, 284.0), correlations=np.tile(correlation, (n, 1, 1)),
            exterior="series", without_result={},
        )  # fmt: skip
        return replace(made, **changes)


@pytest.fixture
def warm_up() -> type[WarmUp]:
    """Return the class whose instances build series of a camera that warms up."""
    return WarmUp
