"""A generator of recordings in which an effect is hidden; shares no code with thermocald.

Own projection, own heat, own noise, everything on a time axis of one second, written from
CONVENTIONS and EFFECTS alone. Used in memory by the scoring, or written as a recording
(CONVENTIONS §3) with the truth in another place.

    python -m tests.blind.generator --effect thermal_lag --px 0.1 --seed 3 --out DIR --truth FILE
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

SINGLE = (
    "thermal_lag", "time_offset", "nonlinear_expansion", "softening", "thermal_gradient",
    "permanent_set", "hysteresis", "self_heating", "creep", "slip", "cyclic_interference",
    "second_heat_source", "defocus", "housing_tilt", "radial_distortion_drift",
    "decentering_drift", "affinity_drift", "test_field_expansion", "target_displacement",
)  # fmt: skip
OUTSIDE = "outside"
PROGRAMMES = ("lamp", "lamp2", "selfwarming", "steps", "ramp")

# name: (width, height, pitch mm, c mm, A1)
CAMERAS = {
    "rpi-v2.1": (3280, 2464, 0.00112, 3.04, -2.5e-3),
    "nexus5": (3264, 2448, 0.0014, 3.97, 1.2e-3),
    "galaxy-s8": (4032, 3024, 0.0014, 4.25, 8.0e-4),
}
_PARAMETERS = (
    "c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2",
    "omega", "phi", "kappa", "X0", "Y0", "Z0",
)  # fmt: skip


@dataclass
class Case:
    """What is asked for."""

    effects: tuple[str, ...] = ()
    strength_px: float = 0.3
    seed: int = 0
    hard: bool = False
    noise_px: float = 0.04
    thermometer_k: float = 0.04
    epochs: int = 180
    interval: float = 10.0
    camera: str | None = None
    programmes: tuple[str, str] | None = None
    with_m2: bool = True


@dataclass
class Series:
    """One recording in memory: rows of observations and of epochs."""

    name: str
    camera: str
    epoch: np.ndarray
    frame_time: np.ndarray
    temperature_time: np.ndarray
    temperatures: dict[str, np.ndarray]
    row_epoch: np.ndarray  # index into `epoch`
    row_target: np.ndarray
    xy: np.ndarray
    sigma: float
    field_nominal: np.ndarray
    interval: float
    missed: np.ndarray = field(default_factory=lambda: np.zeros(0))


def corner_field() -> np.ndarray:
    """147 targets, 49 on each of three planes that meet in a corner, with some relief."""
    g = 60.0 + 80.0 * np.arange(7)
    a, b = (v.ravel() for v in np.meshgrid(g, g))
    o = np.full(49, 4.0)
    return np.vstack([np.stack([a, b, o], 1), np.stack([a, o, b], 1), np.stack([o, a, b], 1)])


def turn(omega: np.ndarray, phi: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    """R = Rx Ry Rz, camera to object, stacked (..., 3, 3), by multiplying the three out."""
    one, nil = np.ones_like(omega), np.zeros_like(omega)

    def stack(rows: list[list[np.ndarray]]) -> np.ndarray:
        return np.stack([np.stack(r, -1) for r in rows], -2)

    co, so, cp, sp, ck, sk = (f(v) for v in (omega, phi, kappa) for f in (np.cos, np.sin))
    rx = stack([[one, nil, nil], [nil, co, -so], [nil, so, co]])
    ry = stack([[cp, nil, sp], [nil, one, nil], [-sp, nil, cp]])
    rz = stack([[ck, -sk, nil], [sk, ck, nil], [nil, nil, one]])
    return rx @ ry @ rz


def image(points: np.ndarray, p: np.ndarray, sensor: tuple[int, int, float]) -> np.ndarray:
    """Object points (E, n, 3) and parameters (E, 16) → px (E, n, 2), collinearity and Brown."""
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


def _warmed(power: np.ndarray, tau: float, start: float) -> np.ndarray:
    """A body with one time constant, Euler steps of one second."""
    out = np.empty_like(power)
    state = start
    decay = 1.0 - np.exp(-1.0 / tau)
    for i, q in enumerate(power):
        state += (q - state) * decay
        out[i] = state
    return out


def climate(rng: np.random.Generator, programme: str, seconds: int) -> dict[str, np.ndarray]:
    """True courses of the reference and of the board temperature, one value per second."""
    t = np.arange(seconds, dtype=float)
    ambient = rng.uniform(16, 26) + rng.uniform(-1.5, 1.5) * np.sin(
        2 * np.pi * t / rng.uniform(2500, 6000) + rng.uniform(0, 6.3)
    )
    load = np.zeros(seconds)
    lamp = np.zeros(seconds)
    scale = seconds / 1800.0
    if programme in ("lamp", "lamp2"):
        at = rng.uniform(60, 180) * scale
        cycles = 1 if programme == "lamp" else 2
        for _ in range(cycles):
            on = rng.uniform(400, 620) * scale / (1 if cycles == 1 else 1.5)
            off = rng.uniform(400, 700) * scale / (1 if cycles == 1 else 1.5)
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
    # the board has its own work: bursts of processor load, and a little of everything else
    work, at = np.zeros(seconds), 0.0
    while at < seconds:
        hold = rng.uniform(120, 500) * scale
        work[(t >= at) & (t < at + hold)] = rng.uniform(0, 16)
        at += hold
    board = 8.0 + _warmed(
        0.35 * (reference - ambient) + ambient + work, rng.uniform(60, 160), ambient[0]
    )
    return {"temperature": reference, "board_temperature": board}


def _smooth_unknown(rng: np.random.Generator, seconds: int) -> np.ndarray:
    """An influence nobody recorded: filtered noise with a correlation of some minutes."""
    width = rng.uniform(90, 260) * seconds / 1800
    n = int(5 * width)
    kernel = np.exp(-0.5 * (np.arange(-n, n + 1) / width) ** 2)
    raw = rng.normal(size=seconds + 2 * n)
    course = np.convolve(raw, kernel, mode="valid")
    return (course - course.mean()) / course.std()


def _lagged(x: np.ndarray, tau: float) -> np.ndarray:
    """tau y' = x - y in closed form over each second, x a straight line within it."""
    a = np.exp(-1.0 / tau)
    out, state = np.empty_like(x), x[0]
    out[0] = state
    for i in range(1, len(x)):
        slope = x[i] - x[i - 1]
        state = a * state + (1 - a) * (x[i - 1] - tau * slope) + slope
        out[i] = state
    return out


def _backlash(x: np.ndarray, half: float) -> np.ndarray:
    out, state = np.empty_like(x), x[0]
    for i, v in enumerate(x):
        state = max(min(state, v + half), v - half)
        out[i] = state
    return out


def _delayed(x: np.ndarray, d: float) -> np.ndarray:
    t = np.arange(len(x), dtype=float)
    return np.interp(t - d, t, x)


@dataclass
class _Camera:
    """The physical truth of one camera: base, rates, hidden effects with their constants."""

    sensor: tuple[int, int, float]
    base: np.ndarray
    rates: np.ndarray  # (16,) per K
    T0: float
    effects: list[dict] = field(default_factory=list)


def _view(rng: np.random.Generator, c: float) -> np.ndarray:
    """A camera that looks into the corner: (6,) EOP."""
    target = np.array([225.0, 225.0, 225.0]) + rng.normal(0, 12, 3)
    direction = np.array([1.0, 1.0, 1.0]) + rng.normal(0, 0.08, 3)
    place = target + direction / np.linalg.norm(direction) * 1050.0 * rng.uniform(0.95, 1.1)
    z = (place - target) / np.linalg.norm(place - target)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    a = rng.uniform(-0.15, 0.15)
    R = np.stack([np.cos(a) * x + np.sin(a) * y, -np.sin(a) * x + np.cos(a) * y, z], 1)
    phi = np.arcsin(R[0, 2])
    return np.array([np.arctan2(-R[1, 2], R[2, 2]), phi, np.arctan2(-R[0, 1], R[0, 0]), *place])


def make_camera(rng: np.random.Generator, case: Case) -> tuple[str, _Camera]:
    name = case.camera or rng.choice(sorted(CAMERAS))
    width, height, pitch, c, A1 = CAMERAS[name]
    base = np.zeros(16)
    base[0] = c * rng.uniform(0.99, 1.01)
    base[1:3] = rng.normal(0, 15 * pitch, 2)
    base[3] = A1 * rng.uniform(0.7, 1.3)
    base[4] = rng.normal(0, 1e-4)
    base[6:8] = rng.normal(0, 1e-4, 2)
    base[8:10] = rng.normal(0, 2e-4, 2)
    base[10:] = _view(rng, c)
    rates = np.zeros(16)
    rates[0] = rng.choice([-1, 1]) * c * rng.uniform(4e-5, 1.5e-4)
    way = rng.uniform(0, 2 * np.pi)
    rates[1:3] = rng.uniform(0.25, 0.9) * pitch * np.array([np.cos(way), np.sin(way)])
    return name, _Camera((width, height, pitch), base, rates, 20.0)


def _direction(rng: np.random.Generator, camera: _Camera) -> np.ndarray:
    """A random mix of c, x0, y0 in which every part is worth about as much in the image."""
    v = rng.normal(size=3)
    v /= np.linalg.norm(v)
    out = np.zeros(16)
    out[0] = v[0] * 2.5 * camera.sensor[2]
    out[1:3] = v[1:] * camera.sensor[2]
    return out


def hide(rng: np.random.Generator, name: str, camera: _Camera, truth: dict) -> dict:
    """Draw the constants of one effect; its size is scaled afterwards."""
    e: dict = {"effect": name, "size": 1.0}
    if name == "thermal_lag":
        e["tau"] = float(np.exp(rng.uniform(np.log(25), np.log(240))))
    elif name == "time_offset":
        e["d"] = float(rng.choice([-1, 1]) * rng.uniform(8, 60))
    elif name == "hysteresis":
        e["half_width"] = float(rng.uniform(0.4, 2.5))
    elif name == "softening":
        e["T_k"] = float(truth["T_quantile"](rng.uniform(0.35, 0.7)))
    elif name == "self_heating":
        e["tau"] = float(np.exp(rng.uniform(np.log(60), np.log(600))))
    elif name == "cyclic_interference":
        e["P"] = float(np.exp(rng.uniform(np.log(45), np.log(500))))
    elif name == "second_heat_source":
        e["channel"] = "board_temperature"
    elif name == "target_displacement":
        e["targets"] = sorted(int(v) for v in rng.choice(147, rng.integers(1, 5), replace=False))
        e["vector"] = rng.normal(size=3)
    elif name == "defocus":
        e["coldest"] = truth["coldest"]  # one law of noise for the camera, not one per series
    if name in ("nonlinear_expansion", "softening", "thermal_gradient", "permanent_set",
                "self_heating", "creep", "slip", "cyclic_interference", "second_heat_source",
                OUTSIDE):  # fmt: skip
        e["along"] = _direction(rng, camera)
    elif name == "housing_tilt":
        e["along"] = np.zeros(16)
        e["along"][10:13] = rng.normal(size=3) * 1e-5
    elif name == "radial_distortion_drift":
        e["along"] = np.zeros(16)
        e["along"][3] = 1e-5
        if rng.random() < 0.4:
            e["along"][4] = rng.normal() * 2e-6
    elif name == "decentering_drift":
        e["along"] = np.zeros(16)
        e["along"][6:8] = rng.normal(size=2) * 1e-5
    elif name == "affinity_drift":
        e["along"] = np.zeros(16)
        e["along"][8:10] = rng.normal(size=2) * 1e-5
    elif name == "test_field_expansion":
        e["axes"] = rng.uniform(0.2, 1.0, 3) * 1e-5
    return e


def _fresh(rng: np.random.Generator, e: dict, first: bool, seconds: int) -> dict:
    """What belongs to one series: instants and phases."""
    f = dict(e)
    if e["effect"] in ("slip", "target_displacement"):
        f["time"] = float(rng.uniform(0.2, 0.8) * seconds)
        f["happens"] = first or rng.random() < 0.6
    if e["effect"] == "cyclic_interference":
        f["phase"] = float(rng.uniform(0, 2 * np.pi))
    return f


def true_parameters(
    camera: _Camera,
    effects: list[dict],
    climate_: dict[str, np.ndarray],
    unknown: np.ndarray,
    frames: np.ndarray,
    points: np.ndarray,
    eop: np.ndarray,
    offsets: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (E, 16), object points (E, n, 3) and noise factor (E,) at the frames."""
    T = climate_["temperature"]
    t = np.arange(len(T), dtype=float)
    drive = T
    for e in effects:
        size = e["size"]
        if e["effect"] == "thermal_lag":
            drive = _lagged(drive, max(e["tau"] * size, 1e-3))
        elif e["effect"] == "time_offset":
            drive = _delayed(drive, e["d"] * size)
        elif e["effect"] == "hysteresis":
            drive = _backlash(drive, e["half_width"] * size)
    extra = np.zeros((len(t), 16))
    scale = np.zeros((len(t), 3))
    noise = np.ones(len(t))
    moved = []
    for e in effects:
        name, size = e["effect"], e["size"]
        course = None
        if name == "nonlinear_expansion":
            course = (T - camera.T0) ** 2 / 100.0
        elif name == "softening":
            course = np.maximum(T - e["T_k"], 0)
        elif name == "thermal_gradient":
            course = np.gradient(T) * 100
        elif name == "permanent_set":
            course = np.maximum.accumulate(T)
        elif name == "self_heating":
            course = 1 - np.exp(-t / e["tau"])
        elif name == "creep":
            course = t / 1000
        elif name == "slip":
            course = (t >= e["time"]).astype(float) * e["happens"]
        elif name == "cyclic_interference":
            course = np.sin(2 * np.pi * t / e["P"] + e["phase"])
        elif name == "second_heat_source":
            course = climate_[e["channel"]]
        elif name in (
            "housing_tilt",
            "radial_distortion_drift",
            "decentering_drift",
            "affinity_drift",
        ):
            course = T - camera.T0
        elif name == OUTSIDE:
            course = unknown
        elif name == "test_field_expansion":
            scale += size * (T - camera.T0)[:, None] * e["axes"]
        elif name == "defocus":
            noise = noise * (1 + size * np.clip(T - e["coldest"], 0, None) * 0.02)
        elif name == "target_displacement" and e["happens"]:
            moved.append((e["targets"], size * np.asarray(e["vector"]), e["time"]))
        if course is not None and "along" in e:
            extra += size * course[:, None] * e["along"]

    def at(v: np.ndarray) -> np.ndarray:
        return np.interp(frames, t, v)

    p = np.tile(camera.base, (len(frames), 1))
    p[:, 10:] = eop
    p += offsets
    p += at(drive - camera.T0)[:, None] * camera.rates
    p += np.stack(
        [at(extra[:, j]) if extra[:, j].any() else np.zeros(len(frames)) for j in range(16)], 1
    )
    if any(e["effect"] == "slip" for e in effects):  # a step is not interpolated
        for e in effects:
            if e["effect"] == "slip":
                s = e["size"] * e["happens"]
                p -= s * at((t >= e["time"]).astype(float))[:, None] * e["along"]
                p += s * (frames >= e["time"])[:, None] * e["along"]
    X = points[None] * (1 + np.stack([at(scale[:, k]) for k in range(3)], 1))[:, None, :]
    for rows, vector, time in moved:
        X[:, rows] += (frames >= time)[:, None, None] * vector
    return p, X, at(noise)


def _left_over(
    uv: np.ndarray, camera: _Camera, points: np.ndarray, eop: np.ndarray, T: np.ndarray
) -> float:
    """RMS px that the base model, fitted to noise-free image points, leaves over."""
    p0 = camera.base.copy()
    p0[10:] = eop
    steps = np.array([1e-4, 1e-4, 1e-4, 1e-6, 1e-7, 1e-8, 1e-6, 1e-6, 1e-6, 1e-6,
                      1e-6, 1e-6, 1e-6, 1e-2, 1e-2, 1e-2])  # fmt: skip
    both = np.vstack([p0 + np.diag(steps), p0 - np.diag(steps)])
    f = image(np.broadcast_to(points, (32, *points.shape)), both, camera.sensor)
    J = ((f[:16] - f[16:]) / (2 * steps)[:, None, None]).reshape(16, -1).T
    J = J / np.linalg.norm(J, axis=0)
    y = (uv - uv.mean(0)).reshape(len(uv), -1)
    T = T - T.mean()
    # the constants take the mean of each epoch's image; rates of c, x0, y0 take the part along T
    slope = (T @ y) / (T @ T)
    G = J[:, :3]
    y = y - np.outer(T, G @ np.linalg.lstsq(G, slope, rcond=None)[0])
    # the mean is taken by IOP and EOP as far as they can; the rest is a target offset, also base
    return float(np.sqrt(np.mean(y**2)))


def generate(case: Case) -> tuple[list[Series], dict]:
    """M1 and M2 of one camera, and the truth."""
    rng = np.random.default_rng([case.seed, 77])
    camera_name, camera = make_camera(rng, case)
    nominal = corner_field()
    seconds = int(case.epochs * case.interval) + 20
    programmes = case.programmes
    if programmes is None:
        first = str(rng.choice(PROGRAMMES))
        others = [p for p in PROGRAMMES if p != first] if case.hard else list(PROGRAMMES)
        programmes = (first, str(rng.choice(others)))
    climates = [climate(rng, p, seconds) for p in programmes]
    unknowns = [_smooth_unknown(rng, seconds) for _ in programmes]
    T1 = climates[0]["temperature"]
    pool = {
        "T_quantile": lambda q: float(T1.min() + q * (T1.max() - T1.min())),
        "coldest": min(float(c["temperature"].min()) for c in climates),
    }
    if "softening" in case.effects:  # a threshold that both series pass
        T2 = climates[1]["temperature"]
        low, high = max(T1.min(), T2.min()), min(T1.max(), T2.max())
        if high - low > 3:
            pool["T_quantile"] = lambda q: float(low + q * (high - low))
    hidden = [hide(rng, name, camera, pool) for name in case.effects]
    views = [camera.base[10:], camera.base[10:] + rng.normal(0, 1, 6) * [2e-3] * 1 + 0.0]
    views[1] = camera.base[10:] + rng.normal(0, 1, 6) * np.array([2e-3, 2e-3, 2e-3, 3, 3, 3])
    shift = np.zeros(16)
    shift[:3] = rng.normal(0, 1, 3) * np.array([2, 1, 1]) * camera.sensor[2]
    offsets = [np.zeros(16), shift]
    frame_axis = []
    for _ in programmes:
        f = case.interval * np.arange(case.epochs)
        if case.hard:
            f = f + rng.uniform(-2, 2, case.epochs)
            f -= f[0]
        frame_axis.append(f)
    per_series = [[_fresh(rng, e, k == 0, seconds) for e in hidden] for k in range(2)]

    def leftover(size: float, which: int) -> float:
        e = dict(per_series[0][which], size=size)
        if e["effect"] == "defocus":
            _, _, nf = true_parameters(camera, [e], climates[0], unknowns[0], frame_axis[0],
                                       nominal, views[0], offsets[0])  # fmt: skip
            return float(np.sqrt(np.mean((case.noise_px * nf) ** 2 - case.noise_px**2)))
        p, X, _ = true_parameters(camera, [e], climates[0], unknowns[0], frame_axis[0], nominal,
                                  views[0], offsets[0])  # fmt: skip
        T = np.interp(frame_axis[0], np.arange(seconds), T1)
        return _left_over(image(X, p, camera.sensor), camera, nominal, views[0], T)

    for k, e in enumerate(hidden):
        if e["effect"] in ("thermal_lag", "time_offset", "hysteresis"):
            # half of them by the size of the camera's rates, half by the parameter itself
            base_rates = camera.rates.copy()
            if rng.random() < 0.5 and len(hidden) == 1:
                camera.rates = camera.rates * np.clip(
                    case.strength_px / max(leftover(1.0, k), 1e-9), 0.25, 2.0
                )
            low, high = 1e-3, 30.0
            for _ in range(40):
                middle = np.sqrt(low * high)
                low, high = (
                    (middle, high) if leftover(middle, k) < case.strength_px else (low, middle)
                )
            size = np.sqrt(low * high)
            limit = {"thermal_lag": 900 / e.get("tau", 1), "time_offset": 200 / abs(e.get("d", 1)),
                     "hysteresis": 6 / e.get("half_width", 1)}[e["effect"]]  # fmt: skip
            size = min(size, limit)
            del base_rates
        else:
            size = 1.0
            for _ in range(30):
                got = leftover(size, k)
                if abs(got / case.strength_px - 1) < 1e-3:
                    break
                size *= case.strength_px / max(got, 1e-12)
        e["size"] = size
        for s in per_series:
            s[k]["size"] = size

    built = []
    count = 2 if case.with_m2 else 1
    field_error = rng.normal(0, 0.02, nominal.shape) if case.hard else np.zeros_like(nominal)
    for s in range(count):
        frames = frame_axis[s]
        p, X, noise = true_parameters(camera, per_series[s], climates[s], unknowns[s], frames,
                                      nominal + field_error, views[s], offsets[s])  # fmt: skip
        uv = image(X, p, camera.sensor)
        built.append(
            _measure(rng, case, camera_name, f"M{s + 1}", frames, uv, noise, climates[s], nominal)
        )
    truth = {
        "case": dict(case.__dict__.items()),
        "camera": camera_name,
        "programmes": list(programmes),
        "effects": [[_plain(e, camera.sensor[2]) for e in s] for s in per_series],
    }
    return built, truth


def _plain(e: dict, pitch: float) -> dict:
    """The truth of an effect in the units of EFFECTS.md."""
    name, size = e["effect"], e["size"]
    out: dict = {"effect": name}
    for key in ("tau", "d", "half_width"):
        if key in e:
            out[key] = e[key] * (
                size if name in ("thermal_lag", "time_offset", "hysteresis") else 1
            )
    for key in ("T_k", "P", "channel", "targets", "time", "happens", "phase"):
        if key in e:
            out[key] = e[key]
    unit = {"nonlinear_expansion": 0.01, "thermal_gradient": 100.0, "creep": 1e-3}.get(name, 1.0)
    if "along" in e:
        for j in np.flatnonzero(e["along"]):
            out["a_" + _PARAMETERS[j]] = float(size * unit * e["along"][j])
    if name == "target_displacement":
        out["vector_mm"] = [float(v) for v in size * np.asarray(e["vector"])]
    if name == "test_field_expansion":
        out["axes"] = [float(v) for v in size * e["axes"]]
    if name == "defocus":
        out["per_kelvin_above_coldest"] = 0.02 * size
        out["coldest"] = e["coldest"]
    del pitch
    return out


def _measure(
    rng: np.random.Generator,
    case: Case,
    camera: str,
    name: str,
    frames: np.ndarray,
    uv: np.ndarray,
    noise: np.ndarray,
    climate_: dict[str, np.ndarray],
    nominal: np.ndarray,
) -> Series:
    """What the detector and the thermometers make of the truth."""
    E, n = uv.shape[:2]
    sigma = case.noise_px
    measured = uv + rng.normal(size=uv.shape) * (sigma * noise)[:, None, None]
    if case.hard:
        if rng.random() < 0.5:  # in time: each target's own slow wander
            rho = np.exp(-case.interval / rng.uniform(30, 120))
            wander = np.empty_like(uv)
            state = rng.normal(size=uv.shape[1:])
            for i in range(E):
                state = rho * state + np.sqrt(1 - rho**2) * rng.normal(size=uv.shape[1:])
                wander[i] = state
            measured += 0.01 * wander
        else:  # in the image: air that shimmers, neighbours move together
            place = uv.mean(0)
            d = np.linalg.norm(place[:, None] - place[None], axis=-1)
            L = np.linalg.cholesky(np.exp(-0.5 * (d / 250.0) ** 2) + 1e-6 * np.eye(n))
            measured += 0.01 * np.einsum("ij,ejk->eik", L, rng.normal(size=uv.shape))
    width, height = CAMERAS[camera][:2]
    seen = (
        (uv[..., 0] > 5) & (uv[..., 0] < width - 5) & (uv[..., 1] > 5) & (uv[..., 1] < height - 5)
    )
    seen &= rng.random((E, n)) > 0.02
    gross = rng.random((E, n)) < 0.002
    away = rng.uniform(0.5, 8, (E, n, 1)) * rng.choice([-1, 1], (E, n, 2))
    measured = measured + gross[..., None] * away
    read_at = frames + rng.uniform(-1, 1, E)
    t = np.arange(len(climate_["temperature"]), dtype=float)
    temperatures = {}
    for k, (channel, course) in enumerate(climate_.items()):
        raw = np.interp(read_at, t, course) + rng.normal(0, case.thermometer_k, E)
        value = np.round(raw / 0.0625) * 0.0625
        if case.hard:
            value[rng.random(E) < 0.02] = np.nan
        temperatures[channel] = value
        del k
    keep = np.ones(E, bool)
    if case.hard:
        keep = rng.random(E) > 0.03
        keep[0] = True  # time begins with the series: without its begin the truth is another
        for _ in range(rng.integers(1, 4)):  # somebody walks through
            begin = int(rng.integers(0, E - 8))
            x = rng.uniform(0.1, 0.9) * width
            wide = rng.uniform(0.08, 0.2) * width
            for i in range(begin, begin + int(rng.integers(2, 7))):
                seen[i] &= np.abs(uv[i, :, 0] - x) > wide
                x += 0.06 * width
    rows = np.flatnonzero(keep)
    row_epoch, row_target = np.nonzero(seen[rows])
    start = 1_600_000_000.0
    return Series(
        name, camera, rows + 1, frames[rows] + start, read_at[rows] + start,
        {k: v[rows] for k, v in temperatures.items()}, row_epoch, row_target,
        measured[rows][row_epoch, row_target], sigma, nominal, case.interval,
    )  # fmt: skip


def write(series: Series, folder: Path) -> None:
    """The recording as CONVENTIONS §3 has it."""
    folder.mkdir(parents=True, exist_ok=True)
    width, height, pitch, c, _ = CAMERAS[series.camera]
    lines = [
        "format: thermocald-recording/1", f"name: {series.camera}-{series.name}",
        f"series: {series.name}", f"interval: {series.interval}",
        (f"camera: {{name: {series.camera}, width: {width}, height: {height}, "
        f"pixel_pitch: {pitch}, principal_distance: {c}}}"),
        "temperatures:",
        *(f"  {k}: {{unit: degC, resolution: 0.0625}}" for k in series.temperatures),
    ]  # fmt: skip
    (folder / "recording.yaml").write_text("\n".join(lines) + "\n")
    head = ["epoch", "frame_time", "temperature_time", *series.temperatures, "frame"]
    rows = [",".join(head)]
    for i, number in enumerate(series.epoch):
        values = [series.temperatures[k][i] for k in series.temperatures]
        cells = ["" if np.isnan(v) else f"{v:.4f}" for v in values]
        rows.append(
            f"{number},{series.frame_time[i]:.3f},{series.temperature_time[i]:.3f},"
            + ",".join(cells)
            + ","
        )
    (folder / "epochs.csv").write_text("\n".join(rows) + "\n")
    rows = ["epoch,target,x,y,sx,sy"]
    for i, j, (x, y) in zip(series.row_epoch, series.row_target, series.xy, strict=True):
        rows.append(f"{series.epoch[i]},{j + 1},{x:.4f},{y:.4f},{series.sigma},{series.sigma}")
    (folder / "observations.csv").write_text("\n".join(rows) + "\n")
    rows = ["target,X,Y,Z,diameter,sX,sY,sZ"]
    rows += [
        f"{j + 1},{x:.4f},{y:.4f},{z:.4f},12.0,0.02,0.02,0.02"
        for j, (x, y, z) in enumerate(series.field_nominal)
    ]
    (folder / "testfield.csv").write_text("\n".join(rows) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--effect", action="append", default=[])
    parser.add_argument("--px", type=float, default=0.3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hard", action="store_true")
    parser.add_argument("--epochs", type=int, default=180)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    a = parser.parse_args()
    series, truth = generate(Case(tuple(a.effect), a.px, a.seed, a.hard, epochs=a.epochs))
    for s in series:
        write(s, a.out / s.name)
    a.truth.write_text(json.dumps(truth, indent=1, default=str))


if __name__ == "__main__":
    main()
