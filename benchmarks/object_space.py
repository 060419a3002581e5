"""Measure the errors that correction leaves in object space, for the reference study's presets.

Run: python -m benchmarks.object_space   (exit status 1 if the bound is missed)
Bound: mean error after correction ≤ 1/10 of the mean error without it.

A thermal model is fitted to M1 and applied to the *thermometer's readings* of M2, another series
with other noise. Nine image points are projected onto a plane at 10 m with the true interior
orientation of each epoch, and with another one: that of the start (uncorrected: a camera calibrated
once), the mean of the series (the reference study's way), and the model's, whose level is that of a
calibration at the start. "Base" is the model with rates only; "with effects" also contains the
preset's effects, which discovery would name; their parameters are estimated.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np

from thermocald.analysis.study.reference import QUOTED
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.physics import catalogue
from thermocald.physics.model import ModelEffect
from thermocald.physics.presets import PRESETS, preset_simulation
from thermocald.physics.simulation import Simulation
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.series import ReducedSeries
from thermocald.thermal.source import epochs_input

DISTANCE_MM = 10_000.0
BOUND = 0.1
EVERY = 5  # epochs

HEADER = """\
| preset | reference | about the mean | uncorrected | corrected: base | with effects | ratio |
|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Row:
    """A preset's mean distances, mm: from the mean, uncorrected, base model, with effects."""

    preset: str
    about_mean: float
    uncorrected: float
    base: float
    corrected: float

    @property
    def ratio(self) -> float:
        return self.corrected / self.uncorrected

    def markdown(self) -> str:
        quoted = QUOTED[self.preset].mean_cm
        return (
            f"| `{self.preset}` | {quoted:.1f} cm | {self.about_mean / 10:.2f} cm | "
            f"{self.uncorrected / 10:.2f} cm | {self.base / 10:.3f} cm | "
            f"{self.corrected / 10:.3f} cm | 1/{1 / self.ratio:.0f} |"
        )


def measure(preset: str, seed: int = 1) -> Row:
    """Simulate both series of a preset; fit the model to the first and apply it to the second."""
    first = preset_simulation(preset, seed, "M1")
    second = preset_simulation(preset, seed + 1, "M2")
    listed = [
        replace(e, values=dict.fromkeys(catalogue.get(e.name).usual, 0.0))
        for e in first.model.effects
        if e.name != "defocus"  # moves no point
    ]
    series = reduce_series(
        epochs_input(first.head, first.field, list(first.epochs()), "M1"),
        strict=False,
    )
    about_mean, uncorrected, base = _errors(series, [], second)
    *_, corrected = _errors(series, listed, second)
    return Row(preset, about_mean, uncorrected, base, corrected)


def _errors(
    series: ReducedSeries, listed: list[ModelEffect], second: Simulation
) -> tuple[float, float, float]:
    """Return M2's mean distances, mm: from its mean, from its start, and with the model."""
    model = fit_thermal_model([series], listed).model
    camera = ThermalCamera(model)
    along = camera.along(
        second.reading_times, second.readings, second.frame_times, extrapolate=True
    )
    state = ThermalCamera(replace(model, validity={})).at(model.T0)
    true = second.truth.iop
    begin, mean = replace(state, values=true[0]), replace(state, values=true.mean(axis=0))
    found = []
    for i in range(0, len(along), EVERY):
        now = replace(state, values=true[i])
        predicted = replace(state, values=along.values[i] - along.values[0] + true[0])
        found.append([s.object_distance(now, DISTANCE_MM).mean() for s in (mean, begin, predicted)])
    about_mean, uncorrected, left = np.mean(found, axis=0).tolist()
    return about_mean, uncorrected, left


def main() -> int:
    print(HEADER)
    rows = []
    for preset in PRESETS:
        rows.append(measure(preset))
        print(rows[-1].markdown(), flush=True)
    worst = max(row.ratio for row in rows)
    print(f"\nlargest ratio {worst:.3f} (bound {BOUND:g})")
    return 0 if worst <= BOUND else 1


if __name__ == "__main__":
    sys.exit(main())
