"""Audit of the study's statistics: false alarms, and standard deviations of slopes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.audit_rows import Row, ratio, share
from thermocald.analysis.statistics.dependence import dependence, holm, slope_p_value
from thermocald.analysis.statistics.noise_models import drift_test

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def _noise(rng: np.random.Generator, coloured: float, phi: float, n: int = 150) -> Array:
    from scipy.signal import lfilter

    white = rng.standard_normal(n)
    slow = np.asarray(lfilter([1], [1, -phi], rng.standard_normal(n + 600)))[600:]
    return np.sqrt(coloured * (1 - phi**2)) * slow + np.sqrt(1 - coloured) * white


def significance(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit the false alarms of the study's tests at 5 %, and the standard deviations it states."""
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
    for what, coloured, phi, missing in (
        ("AR 0.97, 40 % missing in one piece", 1.0, 0.97, 60),
        ("AR 0.9, 17 % missing in one piece", 1.0, 0.9, 25),
    ):
        drift, r = [], []
        for _ in range(draws):
            first = int(rng.integers(10, 140 - missing))
            t = 10.0 * np.delete(np.arange(150), slice(first, first + missing))
            y = _noise(rng, coloured, phi)[(t / 10).astype(int)]
            found = drift_test(y, ones[: len(t)], redundancy[: len(t)], times=t)
            assert found is not None
            drift.append(found.p_value <= 0.05)
            r.append(slope_p_value(y, course[(t / 10).astype(int)], t) <= 0.05)
        rows.append(share("`study`, `replay`: p, no drift", what, "the gap's length", drift))
        rows.append(share("`study`, `replay`: p of r", what, "the gap's length", r))
    family = []
    for _ in range(max(draws // 4, 1)):
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
