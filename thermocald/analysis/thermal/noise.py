"""The noise in the fit of a thermal model, beside that of the image points.

The thermometer's own noise, a measuring noise that grows with the temperature, and what the
readings' instants leave open of an effect: a quantity of each epoch with a prior, eliminated.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.system import weights_of
from thermocald.simulation import effects
from thermocald.simulation.model import ModelEffect, ThermalModel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.analysis.thermal.series import ModelSeries

    Array = NDArray[np.float64]

__all__ = ["defocus_law", "open_courses", "thermometer_noise", "without_open_courses"]

_NOISE_K = 0.05  # of a thermometer with hardly any reading
_REWEIGHTED = 5


def thermometer_noise(series: ModelSeries) -> float:
    """Standard deviation K of a reading: of its distance from the line between its neighbours.

    Robust, so that bends of the temperature do not count; not below what quantisation makes.
    """
    history = series.history
    values = history.readings[history.reference]
    good = np.isfinite(values)
    t, T = history.reading_times[good], values[good]
    step = series.resolution.get(history.reference, 0.0) / np.sqrt(12.0)
    if len(t) < 5:
        return float(max(step, _NOISE_K))
    share = (t[1:-1] - t[:-2]) / np.maximum(t[2:] - t[:-2], 1e-9)
    rest = T[1:-1] - (1.0 - share) * T[:-2] - share * T[2:]
    rest /= np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
    return float(max(1.4826 * np.median(np.abs(rest)), step, 1e-3))


def open_courses(series: ModelSeries, model: ThermalModel) -> list[tuple[Array, Array]]:
    """What the readings' instants leave open: directions (22,) and standard deviations (E,)."""
    found = []
    for effect in model.effects:
        kind = effects.get(effect.name)
        nonlinear, coefficients = kind.split(effect.values)
        if kind.kind == "image":
            continue
        open_ = kind.unresolved(series.history, **nonlinear)
        if not np.any(open_):
            continue
        weights = weights_of(coefficients)
        if kind.kind == "drive":
            weights[:10] = model.rate_vector
        if np.any(weights):
            found.append((weights, open_))
    return found


def without_open_courses(
    series: ModelSeries, model: ThermalModel, variance: float, noise: Array | None = None
) -> tuple[ModelSeries, float]:
    """The series with what is open eliminated, and how many observations that costs.

    variance: of unit weight; noise (E,): factors of the image noise. An unknown of the epoch along
    one direction, its prior the open course's standard deviation, is eliminated from the epoch's
    normal equations.
    """
    cost = 0.0
    unit = variance if noise is None else variance * noise**2
    for c, open_ in open_courses(series, model):
        Nc = series.N @ c
        prior = unit / np.maximum(open_, 1e-12) ** 2
        pivot = (Nc @ c) + prior
        share = Nc / pivot[:, None]
        along = series.b @ c
        series = replace(
            series,
            N=series.N - share[:, :, None] * Nc[:, None, :],
            b=series.b - share * along[:, None],
            lPl=series.lPl - along**2 / pivot,
        )
        cost += float(np.sum((Nc @ c) / pivot))
    return series, cost


def defocus_law(
    series: Sequence[ModelSeries],
    models: Sequence[ThermalModel],
    noise: Sequence[Array | None],
    variance: float,
) -> tuple[ModelEffect, list[Array]]:
    """The noise factor per kelvin from each epoch's own misfit, by weighted least squares.

    models: one per series; noise: factors (E,) of the epochs so far. Returns the effect with its
    standard deviation, and the factors of each series' epochs.
    """
    rise, spread, count = [], [], []
    for s, model, known in zip(series, models, noise, strict=True):
        rise.append(s.history.temperature() - model.T0)
        delta = s.corrections(model.predict(s.history, s.field))
        # each epoch's own parameters take up what the temperature's error does
        rest = s.b - np.einsum("eij,ej->ei", s.N, delta)
        N, own = s.N[:, :3, :3], rest[:, :3]
        cost = s.lPl - 2 * np.sum(s.b * delta, 1) + np.einsum("ei,eij,ej->e", delta, s.N, delta)
        cost -= np.einsum("ei,ei->e", own, np.linalg.solve(N, own[..., None])[..., 0])
        factors = np.ones(len(s)) if known is None else known
        # the targets' offsets, an average over the epochs, took this much of each
        taken = variance / np.sum(factors**-2.0)
        spread.append(np.sqrt(np.maximum(cost, 0.0) / (2.0 * s.count - 3.0) + taken))
        count.append(2.0 * s.count - 3.0)
    x, y, n = np.concatenate(rise), np.concatenate(spread), np.concatenate(count)
    A = np.stack([np.ones_like(x), x], axis=1)
    factor = np.ones_like(x)
    for _ in range(_REWEIGHTED):
        w = 2.0 * n / (y.mean() * factor) ** 2
        cofactor = np.linalg.inv(A.T @ (w[:, None] * A))
        level, slope = cofactor @ (A.T @ (w * y))
        factor = np.maximum(1.0 + slope / level * x, 0.1)
        w = 2.0 * n / (level * factor) ** 2
    cofactor = np.linalg.inv(A.T @ (w[:, None] * A))
    lever = np.array([-slope / level**2, 1.0 / level])
    sd = float(np.sqrt(lever @ cofactor @ lever))
    kind = effects.seen_in("noise")
    (key,) = kind.linear
    found = ModelEffect(kind.name, {key: float(slope / level)}, {key: sd})
    ends = np.cumsum([len(s) for s in series])
    return found, list(np.split(factor, ends[:-1]))
