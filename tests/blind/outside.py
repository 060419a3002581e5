"""Influences outside the catalogue, on an axis of one second; shares no code with thermocald.

Most are functions of recorded quantities; "smooth" and "random_walk" have an unrecorded cause.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.blind.world import backlash, lagged, smooth_unknown, stepped

Climate = dict[str, np.ndarray]


def _leaking(x: np.ndarray, tau: float) -> np.ndarray:
    left = np.exp(-1.0 / tau)
    return stepped(x, x[0], lambda state, v: v if v > state else v + (state - v) * left)


def _humidity(rng: np.random.Generator, seconds: int) -> np.ndarray:
    """Draw a room's humidity, %, which wanders with a time constant of a quarter of an hour."""
    wander = np.cumsum(rng.normal(size=seconds))
    slow = lagged(wander - np.linspace(0, wander[-1], seconds), 200.0)
    return 50.0 + 8.0 * slow / np.std(slow)


def _recorded(rng: np.random.Generator, ranges: list[tuple[float, float]]) -> dict[str, Callable]:
    low, high = max(r[0] for r in ranges), min(r[1] for r in ranges)
    k = low + rng.uniform(0.35, 0.65) * (high - low)
    w = rng.uniform(0.12, 0.3) * (high - low)
    tau, second, r = rng.uniform(50, 120), rng.uniform(80, 250), rng.uniform(0.6, 2.0)
    return {
        "tanh": lambda T, B, t: np.tanh((T - k) / w),
        "sign_rate_square": lambda T, B, t: np.sign(np.gradient(T)) * np.gradient(T) ** 2,
        "integral_above": lambda T, B, t: np.cumsum(np.clip(T - k, 0, None)),
        "abs_rate": lambda T, B, t: np.abs(np.gradient(T)),
        "two_lags": lambda T, B, t: lagged(lagged(T, tau), second),
        "product": lambda T, B, t: T * B,
        "switch": lambda T, B, t: (k < T).astype(float),
        "play_of_lag": lambda T, B, t: backlash(lagged(T, tau), r),
        "fading_peak": lambda T, B, t: _leaking(T, 2 * second),
        "time_times_T": lambda T, B, t: t * T,
    }


HUMID = ("lag_of_humidity",)


def trajectories(
    rng: np.random.Generator, kind: str, climates: list[Climate], seconds: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the influence (seconds,) and the recorded humidity in each series."""
    ranges = [(float(c["temperature"].min()), float(c["temperature"].max())) for c in climates]
    known = _recorded(rng, ranges)
    humid = [_humidity(rng, seconds) for _ in climates]
    t = np.arange(seconds, dtype=float)
    out = []
    for c, h in zip(climates, humid, strict=True):
        T, B = c["temperature"], c["board_temperature"]
        if kind in known:
            out.append(known[kind](T, B, t))
        elif kind == "lag_of_humidity":
            out.append(lagged(h, 120.0))
        elif kind == "smooth":
            out.append(smooth_unknown(rng, seconds))
        elif kind == "random_walk":
            out.append(lagged(np.cumsum(rng.normal(size=seconds)), 20.0))
        else:
            raise SystemExit(f"no such influence: {kind}")
    return out, humid
