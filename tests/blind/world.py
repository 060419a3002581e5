"""The generator's corner of targets, projection, temperatures, lags and delays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def corner_field() -> np.ndarray:
    """Return 147 targets, 49 on each of three planes that meet in a corner."""
    g = 60.0 + 80.0 * np.arange(7)
    a, b = (v.ravel() for v in np.meshgrid(g, g))
    o = np.full(49, 4.0)
    return np.vstack([np.stack([a, b, o], 1), np.stack([a, o, b], 1), np.stack([o, a, b], 1)])


def turn(omega: np.ndarray, phi: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    """Return R = Rx Ry Rz, camera to object, stacked (..., 3, 3)."""
    one, nil = np.ones_like(omega), np.zeros_like(omega)

    def stack(rows: list[list[np.ndarray]]) -> np.ndarray:
        return np.stack([np.stack(r, -1) for r in rows], -2)

    co, so, cp, sp, ck, sk = (f(v) for v in (omega, phi, kappa) for f in (np.cos, np.sin))
    rx = stack([[one, nil, nil], [nil, co, -so], [nil, so, co]])
    ry = stack([[cp, nil, sp], [nil, one, nil], [-sp, nil, cp]])
    rz = stack([[ck, -sk, nil], [sk, ck, nil], [nil, nil, one]])
    return rx @ ry @ rz


def image(points: np.ndarray, p: np.ndarray, sensor: tuple[int, int, float]) -> np.ndarray:
    """Project object points (E, n, 3) with parameters (E, 16), px (E, n, 2)."""
    width, height, pitch = sensor
    v = p[..., None, :]
    d = points - p[:, None, 13:16]
    cam = np.einsum("eji,enj->eni", turn(p[:, 10], p[:, 11], p[:, 12]), d)
    x = -v[..., 0] * cam[..., 0] / cam[..., 2]
    y = -v[..., 0] * cam[..., 1] / cam[..., 2]
    rr = x**2 + y**2
    rad = v[..., 3] * rr + v[..., 4] * rr**2 + v[..., 5] * rr**3
    dx = x * rad + v[..., 6] * (rr + 2 * x**2) + 2 * v[..., 7] * x * y
    dx = dx + v[..., 8] * x + v[..., 9] * y
    dy = y * rad + v[..., 7] * (rr + 2 * y**2) + 2 * v[..., 6] * x * y
    u = (width - 1) / 2 + (v[..., 1] + x + dx) / pitch
    w = (height - 1) / 2 - (v[..., 2] + y + dy) / pitch
    return np.stack([u, w], -1)


def stepped(x: np.ndarray, state: float, rule: Callable[[float, float], float]) -> np.ndarray:
    """Return the state after each second, which a rule computes from the one before and x."""
    return np.array([state := rule(state, v) for v in x])


def _warmed(power: np.ndarray, tau: float, start: float) -> np.ndarray:
    """Return the temperature of a body with one time constant, in steps of one second."""
    decay = 1.0 - np.exp(-1.0 / tau)
    return stepped(power, start, lambda state, q: state + (q - state) * decay)


def climate(rng: np.random.Generator, programme: str, seconds: int) -> dict[str, np.ndarray]:
    """Draw the true reference and board temperatures, one value per second."""
    t = np.arange(seconds, dtype=float)
    ambient = rng.uniform(16, 26) + rng.uniform(-1.5, 1.5) * np.sin(
        2 * np.pi * t / rng.uniform(2500, 6000) + rng.uniform(0, 6.3)
    )
    load, lamp = np.zeros(seconds), np.zeros(seconds)
    scale = seconds / 1800.0
    if programme in ("lamp", "lamp2"):
        at = rng.uniform(60, 180) * scale
        cycles, shorter = (1, 1) if programme == "lamp" else (2, 1.5)
        for _ in range(cycles):
            on = rng.uniform(400, 620) * scale / shorter
            off = rng.uniform(400, 700) * scale / shorter
            lamp[(t >= at) & (t < at + on)] = rng.uniform(14, 28)
            at += on + off
    elif programme == "steps":
        at, level = 0.0, 0.0
        while at < seconds:
            hold = rng.uniform(200, 420) * scale
            level = rng.choice([v for v in (0.0, 8.0, 16.0, 24.0) if abs(v - level) > 1])
            lamp[(t >= at) & (t < at + hold)] = level
            at += hold
    elif programme == "ramp":
        top = rng.uniform(0.45, 0.65) * seconds
        lamp = rng.uniform(15, 28) * np.clip(
            np.minimum(t / top, (seconds - t) / (seconds - top)), 0, 1
        )
    load_on = rng.uniform(0, 0.15) * seconds
    load_off = seconds if programme != "selfwarming" else rng.uniform(0.6, 0.75) * seconds
    strong = rng.uniform(12, 22) if programme == "selfwarming" else 0.0
    load[(t >= load_on) & (t < load_off)] = strong
    tau = rng.uniform(140, 330)
    reference = _warmed(ambient + lamp + load, tau, ambient[0])
    # the board has bursts of processor load, and follows ambient and reference partly
    work, at = np.zeros(seconds), 0.0
    while at < seconds:
        hold = rng.uniform(120, 500) * scale
        work[(t >= at) & (t < at + hold)] = rng.uniform(0, 16)
        at += hold
    board = 8.0 + _warmed(
        0.35 * (reference - ambient) + ambient + work, rng.uniform(60, 160), ambient[0]
    )
    return {"temperature": reference, "board_temperature": board}


def smooth_unknown(rng: np.random.Generator, seconds: int) -> np.ndarray:
    """Draw an unrecorded influence: filtered noise with a correlation of several minutes."""
    width = rng.uniform(90, 260) * seconds / 1800
    n = int(5 * width)
    kernel = np.exp(-0.5 * (np.arange(-n, n + 1) / width) ** 2)
    raw = rng.normal(size=seconds + 2 * n)
    course = np.convolve(raw, kernel, mode="valid")
    return (course - course.mean()) / course.std()


def lagged(x: np.ndarray, tau: float) -> np.ndarray:
    """Solve tau y' = x - y in closed form; x is linear within each second."""
    a = np.exp(-1.0 / tau)
    out, state = np.empty_like(x), x[0]
    out[0] = state
    for i in range(1, len(x)):
        slope = x[i] - x[i - 1]
        state = a * state + (1 - a) * (x[i - 1] - tau * slope) + slope
        out[i] = state
    return out


def backlash(x: np.ndarray, half: float) -> np.ndarray:
    return stepped(x, x[0], lambda state, v: max(min(state, v + half), v - half))


def delayed(x: np.ndarray, d: float) -> np.ndarray:
    t = np.arange(len(x), dtype=float)
    return np.interp(t - d, t, x)
