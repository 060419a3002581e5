"""Audit of false alarms: series and recordings without an effect, in unusual kinds of noise."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.audit_rows import Row, share
from benchmarks.audit_thermal import seen, simulated
from thermocald.analysis.statistics.dependence import holm, slope_p_value
from thermocald.analysis.statistics.noise_models import drift_test
from thermocald.discovery.result import discover_series
from thermocald.physics import catalogue
from thermocald.thermal.reduce import reduce_series

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Noise = Callable[[np.random.Generator, int, int], Array]

LEVEL = 0.01
EPOCHS = (30, 60, 150, 400)
NOISE_PX = 0.04


def _coloured(phi: float, part: float = 1.0) -> Noise:
    """Return noise that is autoregressive (first order) in a part of its variance, else white."""

    def draw(rng: np.random.Generator, n: int, columns: int) -> Array:
        from scipy.signal import lfilter  # half a second, of one worker of the tests

        slow = lfilter([1], [1, -phi], rng.standard_normal((n + 2000, columns)), axis=0)[2000:]
        white = rng.standard_normal((n, columns))
        return np.sqrt(part * (1 - phi**2)) * np.asarray(slow) + np.sqrt(1 - part) * white

    return draw


def _flicker(exponent: float, part: float = 1.0) -> Noise:
    """Return noise of spectrum 1/f^exponent in a part of its variance, else white.

    Each draw is the first eighth of a longer series.
    """

    def draw(rng: np.random.Generator, n: int, columns: int) -> Array:
        shape = np.zeros((4 * n + 1, 1))
        shape[1:, 0] = np.arange(1, 4 * n + 1) ** (-exponent / 2)
        waves = rng.standard_normal((len(shape), columns, 2)) @ np.array([1.0, 1.0j])
        slow = np.fft.irfft(shape * waves, 8 * n, axis=0)[:n]
        white = rng.standard_normal((n, columns))
        return np.sqrt(part) * slow / slow.std(axis=0) + np.sqrt(1 - part) * white

    return draw


def _white(rng: np.random.Generator, n: int, columns: int) -> Array:
    return rng.standard_normal((n, columns))


def _growing(rng: np.random.Generator, n: int, columns: int) -> Array:
    return _white(rng, n, columns) * np.exp(np.linspace(-1.0, 1.0, n))[:, None]


def _bursts(rng: np.random.Generator, n: int, columns: int) -> Array:
    return _white(rng, n, columns) * np.where(rng.random((n // 10 + 1, 1)) < 0.3, 3.0, 1.0).repeat(
        10, axis=0
    )[:n]  # fmt: skip


def _rounded(rng: np.random.Generator, n: int, columns: int) -> Array:
    return np.round(_white(rng, n, columns) / 2.0) * 2.0 + 1e-3 * _white(rng, n, columns)


def _telegraph(rng: np.random.Generator, n: int, columns: int) -> Array:
    flips = rng.random((n, columns)) < 0.1
    return np.where(np.cumsum(flips, axis=0) % 2, 1.0, -1.0) + 0.5 * _white(rng, n, columns)


def _cycle(rng: np.random.Generator, n: int, columns: int) -> Array:
    t = np.arange(n)[:, None] + 12.0 * rng.random(columns)
    return np.sin(2 * np.pi * t / 12.0) + 0.5 * _white(rng, n, columns)


def _averaged(rng: np.random.Generator, n: int, columns: int) -> Array:
    return np.lib.stride_tricks.sliding_window_view(_white(rng, n + 4, columns), 5, axis=0).mean(-1)


def _walk(rng: np.random.Generator, n: int, columns: int) -> Array:
    return np.cumsum(0.1 * _white(rng, n, columns), axis=0) + _white(rng, n, columns)


KINDS: dict[str, Noise] = {
    "white": _white,
    "Student's t, 3 degrees": lambda rng, n, columns: rng.standard_t(3, (n, columns)),
    "AR 0.5": _coloured(0.5),
    "AR 0.9": _coloured(0.9),
    "AR 0.97": _coloured(0.97),
    "AR 0.97 on white": _coloured(0.97, 0.5),
    "1/f": _flicker(1.0),
    "1/f on white": _flicker(1.0, 0.5),
    "1/f^1.5": _flicker(1.5),
    "a random walk on white": _walk,
    "white, growing sevenfold": _growing,
    "white, in bursts": _bursts,
    "rounded to 2 sd": _rounded,
    "a telegraph on white": _telegraph,
    "a cycle of 12 epochs on white": _cycle,
    "means of five neighbours": _averaged,
}


def null(draws: int, rng: np.random.Generator) -> list[Row]:
    """Count drifts and dependences found at 1 % in three stable parameters, by kind of noise."""
    rows = []
    for kind, noise in KINDS.items():
        drifting, dependent = [], []
        for k in range(draws):
            n = EPOCHS[k % len(EPOCHS)]
            y, times = noise(rng, n, 3), 10.0 * np.arange(n)
            warm = 1.0 - np.exp(-np.arange(n) / 30.0)
            tests = [drift_test(one, np.ones(n), np.full(n, 280.0), times=times) for one in y.T]
            drifting.append(min(holm([t.p_value for t in tests if t])) <= LEVEL)
            dependent.append(min(holm([slope_p_value(one, warm, times) for one in y.T])) <= LEVEL)
        holds = "30 to 400 epochs, noise of any size and memory"
        rows.append(share("`study`, `replay`: drift at 1 %", kind, holds, drifting, LEVEL))
        rows.append(share("`study`, `replay`: r at 1 %", kind, holds, dependent, LEVEL))
    return rows


def named(draws: int, rng: np.random.Generator) -> list[Row]:
    """Count the effects that `discover` finds where a camera only follows its temperature."""
    found, others = [], Counter[str]()
    for k in range(max(draws // 2, 2)):
        kind = list(KINDS)[k % len(KINDS)]
        source = seen(simulated(int(rng.integers(2**31)), (), epochs=60))
        epochs, targets, _ = source.grid.points.shape
        odd = KINDS[kind](rng, epochs, 2 * targets).reshape(epochs, targets, 2)
        grid = replace(source.grid, points=source.grid.points + NOISE_PX * odd)
        result = discover_series([reduce_series(replace(source, grid=grid))])
        names = [e.effect for e in result.effects]
        found.append(bool(set(names) & set(catalogue.names())))
        others.update(f"{name} ({kind})" for name in names)
    for what, count in sorted(others.items()):
        print(f"({count} × {what})", file=sys.stderr)
    return [
        share("`discover`: a false name", f"{len(KINDS)} kinds of noise of every image point",
              "no effect of the catalogue", found, LEVEL)
    ]  # fmt: skip
