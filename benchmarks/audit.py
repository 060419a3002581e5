"""Every printed standard deviation against the scatter of what it belongs to, and every level.

Run: python -m benchmarks.audit [SECTION …] [--draws N] [--seed S]
Prints the rows of docs/reference/standard-deviations.md: error over stated standard deviation (root
mean square over the draws; 1 where the statement is true) or the fraction of false alarms. Exit
status 1 where a ratio lies outside 0.9 to 1.1 by more than three of its own sds, or a level is
exceeded by as much; rows that are known to be cautious have a lower bound of their own.
Seeded and array-level: the same seed prints the same rows.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from thermocald.analysis.camera.photographs import calibrate_observations
from thermocald.analysis.online.equilibrium import slope
from thermocald.analysis.online.field_errors import FieldErrors
from thermocald.analysis.online.filter import OnlineFilter
from thermocald.analysis.statistics.dependence import dependence, holm, slope_p_value
from thermocald.analysis.statistics.drift_test import drift_test
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.discovery.verdict.result import discover_series
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings, adjust
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.adjustment import SeriesSettings, adjust_series
from thermocald.reduction.reduce import reduce_series
from thermocald.reduction.source import epochs_input
from thermocald.simulation.demonstration import demonstration_model
from thermocald.simulation.model import ModelEffect
from thermocald.simulation.presets import preset_simulation
from thermocald.simulation.testfields import corner_field

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

NOISE_PX = 0.04
NAMES = ("c", "x0", "y0")


@dataclass(frozen=True)
class Row:
    """One line of the page: a ratio of error to sd, or a share of false alarms at 5 %."""

    printed_by: str
    what: str
    holds: str
    value: float
    sd: float
    draws: int
    is_share: bool = False
    low: float = 0.9

    @property
    def met(self) -> bool:
        if self.is_share:
            return self.value <= 0.05 + 3 * self.sd
        return self.low - 3 * self.sd <= self.value <= 1.1 + 3 * self.sd

    def text(self, seed: int) -> str:
        shown = (
            f"{100 * self.value:.1f} %" if self.is_share else f"{self.value:.2f} ± {self.sd:.2f}"
        )
        return (
            f"| {self.printed_by} | {self.what} | {self.holds} | {shown} | {self.draws} | {seed} |"
        )


def ratio(printed_by: str, what: str, holds: str, standardised: Array, low: float = 0.9) -> Row:
    """A row from errors over sds (draws,) or (draws, k), whose k are taken together."""
    off = np.asarray(standardised, dtype=float)
    draws = len(off)
    value = float(np.sqrt(np.mean(off**2)))
    return Row(printed_by, what, holds, value, value / np.sqrt(2 * draws), draws, low=low)


def share(printed_by: str, what: str, holds: str, alarms: list[bool]) -> Row:
    n = len(alarms)
    return Row(
        printed_by, what, holds, float(np.mean(alarms)), np.sqrt(0.05 * 0.95 / n), n, is_share=True
    )


class Scene:
    """A camera before a corner of 48 targets whose coordinates err as stated."""

    def __init__(self, rng: np.random.Generator, sigma_mm: float, noise_px: float = NOISE_PX):
        self.rng, self.noise = rng, noise_px
        plain = corner_field("plain", per_side=4, pitch_mm=150.0)
        model = demonstration_model(plain)
        self.sensor = model.sensor
        self.iop, self.eop = model.interior.as_array(), model.exterior.as_array()
        self.field = TestField.build(plain.names, plain.points, sigma_mm)
        self.points = plain.points + sigma_mm * rng.standard_normal(plain.points.shape)

    def observe(self, iop: Array, eop: Array, gross: float = 0.0) -> Observations:
        seen = project(self.sensor, iop, eop, self.points)
        seen = seen + self.rng.normal(0, self.noise, seen.shape)
        wrong = self.rng.random(len(seen)) < gross
        seen[wrong] += self.rng.normal(0, 5.0, (int(wrong.sum()), 2))
        return Observations(np.arange(len(seen)), seen, np.full(seen.shape, NOISE_PX))

    def adjust(self, observations: Observations):
        return adjust(
            self.sensor, self.field, observations, InteriorOrientation.from_array(self.iop),
            ExteriorOrientation.from_array(self.eop),
        )  # fmt: skip


def epoch(draws: int, rng: np.random.Generator) -> list[Row]:
    """One epoch's adjustment."""
    rows = []
    cases = (
        ("field 0.01 mm", 0.01, 0.0, 1.0),
        ("field 0.01 mm, 3 % gross errors", 0.01, 0.03, 1.0),
        ("noise twice the stated", 0.0, 0.0, 2.0),
    )
    for what, sigma, gross, factor in cases:
        off, sigma0 = [], []
        for _ in range(draws):
            scene = Scene(rng, sigma, factor * NOISE_PX)
            result = scene.adjust(scene.observe(scene.iop, scene.eop, gross))
            if result.ok:
                truth = np.concatenate([scene.iop, scene.eop])
                off.append(((result.values - truth) / result.sd)[[0, 1, 2, 13, 14, 15]])
                sigma0.append(result.sigma0)
        rows.append(ratio("`replay`, daemon: an epoch", f"sd of c, x0, y0, X0, Y0, Z0; {what}",
                          "noise, the field's coordinates", np.array(off)))  # fmt: skip
        if factor != 1.0:
            print(f"(σ₀: {np.mean(sigma0):.2f}, against the stated sigmas)", file=sys.stderr)
    return rows


def _series(
    scene: Scene, epochs: int, tremble_px: float, exterior: str, drift: float = 1.0, tau: float = 10
):
    truth = np.tile(np.concatenate([scene.iop, scene.eop]), (epochs, 1))
    warm = drift * (1 - np.exp(-np.arange(epochs) / tau))
    truth[:, :3] += warm[:, None] * np.array([2e-3, -4.5e-3, 3e-3])
    per_px = scene.sensor.pixel_pitch / scene.iop[0]
    truth[:, 10:13] += tremble_px * per_px * scene.rng.standard_normal((epochs, 3))
    seen = [scene.observe(one[:10], one[10:]) for one in truth]
    result = adjust_series(
        scene.sensor, scene.field, seen, InteriorOrientation.from_array(scene.iop),
        ExteriorOrientation.from_array(scene.eop), SeriesSettings(exterior=exterior),  # type: ignore[arg-type]
    )  # fmt: skip
    return result, truth


def series(draws: int, rng: np.random.Generator) -> list[Row]:
    """A series that stands still: differences between epochs, and what all have in common."""
    change, level = [], []
    for _ in range(draws):
        scene = Scene(rng, 0.01)
        found, truth = _series(scene, 24, 0.0, "series")
        error = (found.values - truth)[:, :3]
        sd = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3])
        change.append((error[-1] - error[0]) / np.hypot(sd[0], sd[-1]))
        level.append(error.mean(axis=0) / np.sqrt(np.diag(found.level_covariance)[:3]))
    strong = []
    for _ in range(max(draws // 10, 4)):
        scene = Scene(rng, 0.0, 0.5 * NOISE_PX)
        found, truth = _series(scene, 150, 0.0, "series", drift=4.0, tau=15.0)
        error = (found.values - truth)[:, :3]
        sd = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3])
        strong.append((error[-1] - error[0]) / np.hypot(sd[0], sd[-1]))
    return [
        ratio("`replay`, `study`: a series", "the same, warm-up by 16 px in 150 epochs",
              "noise of both epochs", np.array(strong)),
        ratio("`replay`, `study`: a series", "sd of last − first; c, x0, y0",
              "noise of both epochs", np.array(change)),
        ratio("`replay`, `study`: a series", "sd of the level; c, x0, y0",
              "EOP and field, common to all epochs", np.array(level)),
    ]  # fmt: skip


def mount(draws: int, rng: np.random.Generator) -> list[Row]:
    """A mount that trembles."""
    rows = []
    for tremble in (0.02, 0.1):
        off = []
        for _ in range(draws):
            scene = Scene(rng, 0.0)
            found, truth = _series(scene, 40, tremble, "mount")
            error = (found.values - truth)[:, :3]
            sd = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3])
            off.append((error[30] - error[10]) / np.hypot(sd[10], sd[30]))
        rows.append(ratio("`--exterior mount`", f"sd of a difference; c, x0, y0; {tremble} px",
                          "noise and movements of the mount", np.array(off)))  # fmt: skip
    return rows


def calibrate(draws: int, rng: np.random.Generator) -> list[Row]:
    """Four photographs before one field."""
    rows = []
    for sigma in (0.0, 0.05):
        off, failed = [], 0
        for _ in range(draws):
            scene = Scene(rng, sigma)
            seen = []
            for turn in (0.0, 0.05, -0.05, 0.1):
                eop = scene.eop + np.array([0, turn, 20 * turn, 400 * turn, 0, 0])
                seen.append(scene.observe(scene.iop, eop))
            found = calibrate_observations(
                ["a", "b", "c", "d"], seen, {}, scene.field, scene.sensor, AdjustmentSettings(),
                None, InteriorOrientation.from_array(scene.iop),
            )  # fmt: skip
            if found.interior is None or not found.estimated:
                failed += 1
                continue
            sd = np.sqrt(np.diag(found.covariance)[:3])
            off.append((found.interior.as_array()[:3] - scene.iop[:3]) / sd)
        if failed:
            print(f"({failed} of {draws} not calibrated)", file=sys.stderr)
        rows.append(ratio("`calibrate`", f"sd of c, x0, y0; 4 photographs, field {sigma} mm",
                          "noise, the field's coordinates", np.array(off)))  # fmt: skip
    return rows


def online(draws: int, rng: np.random.Generator) -> list[Row]:
    """The filter in the daemon: its estimate, its innovations, its drift."""
    rows = []
    for sigma in (0.01, 0.05):
        off, chi2 = [], []
        for _ in range(draws):
            scene = Scene(rng, sigma)
            errors = FieldErrors(scene.sensor, scene.field)
            found = OnlineFilter(scene.sensor, common_variances=errors.variances)
            for k in range(4):
                seen = scene.observe(scene.iop, scene.eop)
                result = scene.adjust(seen)
                one = found.update(result, 25.0, errors.split(result, seen))
                if k and one is not None:
                    chi2.append(one.chi2 / one.dof)
            sd = np.sqrt(np.diag(found.covariance()))[:3]
            off.append((found.values() - np.concatenate([scene.iop, scene.eop]))[:3] / sd)
        rows.append(ratio("daemon, `status`: online", f"sd of c, x0, y0; field {sigma} mm",
                          "noise, the field's coordinates", np.array(off)))  # fmt: skip
        rows.append(ratio("daemon: innovation", f"√(χ²/dof); field {sigma} mm", "noise alone",
                          np.sqrt(chi2)))  # fmt: skip
    t = np.arange(20) * 10.0
    drift = []
    for _ in range(draws):
        found_slope, sd_slope = slope(t, (0.01 * t + rng.normal(0, 0.05, 20))[:, None],
                                      np.full((20, 1), 0.05))  # fmt: skip
        drift.append((found_slope[0] - 0.01) / sd_slope[0])
    rows.append(ratio("daemon, `status`: drift", "sd of px/min", "noise, more where no line fits",
                      np.array(drift), low=0.85))  # fmt: skip
    return rows


def _noise(rng: np.random.Generator, coloured: float, phi: float, n: int = 150) -> Array:
    from scipy.signal import lfilter

    white = rng.standard_normal(n)
    slow = np.asarray(lfilter([1], [1, -phi], rng.standard_normal(n + 600)))[600:]
    return np.sqrt(coloured * (1 - phi**2)) * slow + np.sqrt(1 - coloured) * white


def significance(draws: int, rng: np.random.Generator) -> list[Row]:
    """False alarms of the study's tests at 5 %, and the standard deviations beside them."""
    rows = []
    ones, redundancy = np.ones(150), np.full(150, 280.0)
    course = 1 - np.exp(-np.arange(150) / 30)
    for what, coloured, phi, size in (
        ("white", 0.0, 0.0, 1.0), ("AR 0.97", 1.0, 0.97, 1.0),
        ("AR 0.97 on white", 0.5, 0.97, 1.0), ("white, twice the sds", 0.0, 0.0, 2.0),
    ):  # fmt: skip
        drift, excess, r = [], [], []
        for _ in range(draws):
            y = size * _noise(rng, coloured, phi)
            found = drift_test(y, ones, redundancy)
            assert found is not None
            drift.append(found.p_value <= 0.05)
            excess.append(found.p_excess <= 0.05)
            r.append(slope_p_value(y, course) <= 0.05)
        rows.append(share("`study`: p, no drift", what, "noise of any size and memory", drift))
        if size == 1.0:
            rows.append(share("`study`: p, within sds", what, "noise of the stated sds", excess))
        rows.append(share("`study`: p of r", what, "noise of any size and memory", r))
    family = []
    for _ in range(draws // 4):
        tests = [drift_test(_noise(rng, 0.5, 0.97), ones, redundancy) for _ in range(8)]
        family.append(min(holm([one.p_value for one in tests if one])) <= 0.05)
    rows.append(share("`study`: p, no drift", "any of 8 parameters, AR 0.97 on white", "", family))
    for what, coloured, phi in (
        ("white noise", 0.0, 0.0), ("AR 0.9", 1.0, 0.9), ("AR 0.97 on white", 0.5, 0.97),
    ):  # fmt: skip
        slopes = []
        for _ in range(2 * draws):
            temperature = 25 + 12 * course + 0.05 * rng.standard_normal(150)
            found_line = dependence(4.8 * course + 0.3 * _noise(rng, coloured, phi), 0.3 * ones,
                                    temperature, 0.05)  # fmt: skip
            slopes.append((found_line.slope - 0.4) / found_line.sd_slope)
        rows.append(ratio("`study`: slope", f"sd per kelvin; {what}", "both noises, memory",
                          np.array(slopes)))  # fmt: skip
    noise = []
    for _ in range(draws):
        found = drift_test(100 * course + _noise(rng, 0, 0), ones, redundancy)
        assert found is not None
        noise.append((found.noise_ratio - 1) / found.sd_noise_ratio)
    rows.append(ratio("`study`: noise / stated", "its sd", "noise", np.array(noise)))
    return rows


def thermal(draws: int, rng: np.random.Generator) -> list[Row]:
    """`fit`: rates and the time of a lag."""
    rates, tau = [], []
    for seed in rng.integers(0, 2**31, max(4, draws // 10)):
        s = preset_simulation("rpi-v2.1-heating", seed=int(seed))
        lag = ModelEffect("thermal_lag", {"tau": 70.0})
        s = _shortened(s, lag)
        source = epochs_input(s.head, s.field, list(s.epochs()), "M1")
        model = fit_thermal_model(
            [reduce_series(source, affinity=False, strict=False)],
            [ModelEffect("thermal_lag", {"tau": 10.0})],
        )
        tau.append((model.model.effects[0].values["tau"] - 70.0) / model.sd("thermal_lag.tau"))
        rates.append(
            [(model.model.rates[n] - s.model.rates[n]) / model.sd(f"rates.{n}") for n in NAMES]
        )
    return [
        ratio("`fit`", "sd of the rates of c, x0, y0", "image and thermometer noise",
              np.array(rates)),
        ratio("`fit`", "sd of the lag τ", "image and thermometer noise", np.array(tau)),
    ]  # fmt: skip


def discovery(draws: int, rng: np.random.Generator) -> list[Row]:
    """`discover`: the estimate of what was found (false names: discovery-confusion.md)."""
    tau = []
    for seed in rng.integers(0, 2**31, max(4, draws // 10)):
        s = preset_simulation("rpi-v2.1-heating", seed=int(seed))
        s = _shortened(s, ModelEffect("thermal_lag", {"tau": 70.0}))
        source = epochs_input(s.head, s.field, list(s.epochs()), "M1")
        for entry in discover_series([reduce_series(source)]).effects:
            if entry.effect == "thermal_lag":
                estimate = entry.estimates["tau"]
                tau.append((estimate["value"] - 70.0) / estimate["sd"])
    return [ratio("`discover`", "sd of the lag τ", "image and thermometer noise", np.array(tau))]


def _shortened(s, *effects: ModelEffect):
    from dataclasses import replace

    programme = replace(s.programme, epochs=120)
    return replace(s, model=replace(s.model, effects=effects), programme=programme)


SECTIONS: dict[str, Callable[[int, np.random.Generator], list[Row]]] = {
    "epoch": epoch,
    "series": series,
    "mount": mount,
    "calibrate": calibrate,
    "online": online,
    "significance": significance,
    "thermal": thermal,
    "discovery": discovery,
}


@cache
def _header() -> str:
    return (
        "| printed by | what | holds | error / sd, or false alarms at 5 % | draws | seed |\n"
        "|---|---|---|---|---|---|"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    unknown = set(given.sections) - set(SECTIONS)
    if unknown:
        parser.error(f"{min(unknown)}: there are {', '.join(SECTIONS)}")
    missed = 0
    print(_header())
    for name in given.sections or SECTIONS:
        begin = time.process_time()
        for row in SECTIONS[name](given.draws, np.random.default_rng(given.seed)):
            print(row.text(given.seed) + ("" if row.met else "  <- outside"), flush=True)
            missed += not row.met
        print(f"{name}: {time.process_time() - begin:.0f} s of processor", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
