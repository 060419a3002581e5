"""A camera's year, drawn as the means to which three million epochs are condensed."""

from __future__ import annotations

import corner_camera as scene
import numpy as np

from thermocald.thermal.reduce import reduce_together
from thermocald.thermal.series import SeriesInput

DAY = 86_400.0
RATES = {0: 2e-4, 1: 4e-4, 2: -3e-4}  # mm/K
HOUR = 360  # epochs


def rows(afternoons=(200,)):
    """Return middles (s), lengths and starts (epochs) of rows: hours, on some days five minutes."""
    first, count = [], []
    for day in range(365):
        n = 30 if day in afternoons else HOUR
        begin = np.arange(0, 8640, n) + 8640 * day
        first.append(begin)
        count.append(np.full(len(begin), n))
    start, length = np.concatenate(first), np.concatenate(count)
    return 10.0 * (start + 0.5 * (length - 1)), length, start


def year(temperature, moved, seed, afternoons=(200,), noise_K=0.02, targets=24):
    """Return the reduced series.

    temperature(t s) °C; moved(t, T) °C: the temperature that c, x0, y0 really follow.
    """
    rng = np.random.default_rng(seed)
    t, count, start = rows(afternoons)
    whole = scene.corner_field(0.02)
    field = whole.subset(np.linspace(0, len(whole) - 1, targets).astype(int))
    # a row's mean is taken over eight instants
    inside = (np.arange(8) - 3.5) / 8.0
    at = t[:, None] + 10.0 * count[:, None] * inside
    T = temperature(at)
    values = np.tile(scene.TRUTH, (len(t), 1))
    drive = moved(at, T).mean(axis=1)
    for column, rate in RATES.items():
        values[:, column] += rate * (drive - 15.0)
    size = np.sqrt(count)[:, None, None]
    grid = scene.observe_series(field, values, rng, noise=1 / size)
    grid.weights[:] *= size**2
    noise = noise_K / np.sqrt(count)
    read = T.mean(axis=1) + rng.normal(0, 1, len(t)) * noise
    return reduce_together([
        SeriesInput(
            "year", "camera", scene.SENSOR, field, scene.INTERIOR.c, t, t, {"temperature": read},
            {"temperature": None}, grid, start, series="year",
            interior=scene.INTERIOR, counts=count, noises={"temperature": noise},
        )
    ])  # fmt: skip
