"""Where simulation and measurement disagree: the misfit of the base model, resolved.

By parameter, by time, temperature, its rate and other channels, by image region, by target, in
level and in noise; each with its significance against the noise of image and thermometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.series import COLUMNS

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.discovery.search.examination import Examination
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Misfit", "resolve"]


@dataclass(frozen=True)
class Misfit:
    """A misfit resolved.

    rows: (against what, size in px RMS, significance in sigma); targets: those that jumped;
    regions {(row, column) of a 3 × 3 grid over the image: what a free camera leaves, in units of
    the noise}.
    """

    rows: tuple[tuple[str, float, float], ...]
    targets: tuple[str, ...]
    regions: dict[tuple[int, int], float]

    def as_json(self) -> dict[str, Any]:
        """As it stands in an effect's evidence."""
        return {
            "against": [
                {"what": what, "rms_px": size, "significance_sigmas": sigmas}
                for what, size, sigmas in self.rows
            ],
            "targets": list(self.targets),
            "image_regions": [
                {"row": i, "column": j, "noise_ratio": ratio}
                for (i, j), ratio in self.regions.items()
            ],
        }


def resolve(x: Examination, series: int = 0) -> Misfit:
    """The base model's misfit in one series."""
    e = x.fitter.series[series]
    fit = x.base.fit
    weighting = fit.weightings[series]
    C, V, index = fit.designs[series]
    coefficients = fit.coefficients[index]
    sigma = e.sigma_px
    coordinates = 2.0 * float(e.n.sum())

    def against(trajectories: Array, directions: Array) -> tuple[float, float]:
        A, c, B = weighting.scan(trajectories[None], directions, (C, V))
        rest = c[0] - B[0] @ coefficients
        scale = np.sqrt(np.maximum(np.diag(A[0]), 1e-300))
        own = A[0] / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
        gain = float(rest / scale @ np.linalg.solve(own, rest / scale))
        free = len(scale)
        excess = max(gain - free, 0.0)
        return sigma * float(np.sqrt(excess / coordinates)), (gain - free) / np.sqrt(2.0 * free)

    every = x.base_adequacy[series].directions
    T = e.history.temperature()  # on all epochs; the rows may be blocks of them
    trajectories: dict[str, Array] = {
        "time": e.times - e.times.mean(),
        "temperature, bent": e.averaged((T - T.mean()) ** 2),
        "rate of temperature": e.averaged(np.gradient(T, e.history.times)),
    }
    for name in e.history.readings:
        if name != e.history.reference:
            trajectories[f"channel {name}"] = e.averaged(e.history.temperature(name))
    rows: list[tuple[str, float, float]] = []
    for name, trajectory in trajectories.items():
        rows.append((name, *against((trajectory - trajectory.mean())[:, None], every)))
    smooth = x.base_adequacy[series].trajectories.T
    for j, column in enumerate(COLUMNS):
        one = np.zeros((len(COLUMNS), 1))
        one[j] = 1.0
        rows.append((f"{column}, slow trajectories", *against(smooth, one)))
    total = x.base_adequacy[series]
    rows.insert(0, ("all slow trajectories in all parameters", total.misfit_px, total.significance))
    rows.append(("noise level (sigma0)", *_noise(e.sigma0, e.n.astype(float), e.N.shape[1])))
    rows = [(what, float(size), float(sigmas)) for what, size, sigmas in rows]
    return Misfit(tuple(rows), tuple(_targets(x, series)), _regions(e, sigma))


def _noise(sigma0: Array, n: Array, columns: int) -> tuple[float, float]:
    """Spread of sigma0 over the series, and how unlikely it is for a constant noise."""
    ok = n > 0
    free = 2.0 * n[ok] - columns
    z = float(np.sum(free * (sigma0[ok] - np.average(sigma0[ok], weights=free)) ** 2)) * 2
    count = float(ok.sum() - 1)
    return float(np.std(sigma0[ok])), (z - count) / np.sqrt(2 * count)


def _targets(x: Examination, series: int) -> list[str]:
    names = x.fitter.series[series].source.field.names
    return [names[r] for g in x.displaced[series] for r in g.rows]


def _regions(e: ReducedSeries, sigma: float) -> dict[tuple[int, int], float]:
    """RMS of what a free camera leaves, on a grid of 3 × 3, in units of the noise."""
    place = e.at.predicted
    row = np.clip((3 * place[:, 1] / e.source.sensor.height).astype(float), 0, 2.99)
    column = np.clip((3 * place[:, 0] / e.source.sensor.width).astype(float), 0, 2.99)
    out = {}
    for i in range(3):
        for j in range(3):
            inside = (np.floor(row) == i) & (np.floor(column) == j)
            v = e.residuals[:, inside]
            v = v[np.isfinite(v)]
            if len(v):
                out[(i, j)] = float(np.sqrt(np.mean(v**2)) / sigma)
    return out
