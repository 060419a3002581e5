"""The generator's camera: base, rates, and hidden effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tests.blind.case import CAMERAS, OUTSIDE, Case
from tests.blind.world import backlash, delayed, image, lagged

T0 = 20.0


@dataclass
class Camera:
    """The truth of one camera: base, rates, hidden effects with their constants."""

    sensor: tuple[int, int, float]
    base: np.ndarray
    rates: np.ndarray  # (16,) per K
    effects: list[dict] = field(default_factory=list)


def _view(rng: np.random.Generator, c: float) -> np.ndarray:
    """Draw the exterior orientation (6,) of a camera that looks into the corner."""
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


def make_camera(rng: np.random.Generator, case: Case) -> tuple[str, Camera]:
    name = case.camera or str(rng.choice(sorted(CAMERAS)))
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
    return name, Camera((width, height, pitch), base, rates)


def _direction(rng: np.random.Generator, camera: Camera) -> np.ndarray:
    """Draw a mix of c, x0, y0 that contribute about equally in the image."""
    v = rng.normal(size=3)
    v /= np.linalg.norm(v)
    out = np.zeros(16)
    out[0] = v[0] * 2.5 * camera.sensor[2]
    out[1:3] = v[1:] * camera.sensor[2]
    return out


def _scattered(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# the constants of an effect, drawn with what is known of both series
CONSTANTS: dict[str, Callable[[np.random.Generator, dict], dict]] = {
    "thermal_lag": lambda rng, _: {"tau": _scattered(rng, 25, 240)},
    "time_offset": lambda rng, _: {"d": float(rng.choice([-1, 1]) * rng.uniform(8, 60))},
    "hysteresis": lambda rng, _: {"half_width": float(rng.uniform(0.4, 2.5))},
    "softening": lambda rng, known: {"T_k": float(known["T_quantile"](rng.uniform(0.35, 0.7)))},
    "self_heating": lambda rng, _: {"tau": _scattered(rng, 60, 600)},
    "cyclic_interference": lambda rng, _: {"P": _scattered(rng, 45, 500)},
    "second_heat_source": lambda *_: {"channel": "board_temperature"},
    "target_displacement": lambda rng, _: {
        "targets": sorted(int(v) for v in rng.choice(147, rng.integers(1, 5), replace=False)),
        "vector": rng.normal(size=3)},
    # the noise depends on temperature equally in both series
    "defocus": lambda _, known: {"coldest": known["coldest"]},
    # a bracket of some decimetres that bends with or without a lag
    "mount_motion": lambda rng, _: {"tau": float(rng.choice([1e-3, _scattered(rng, 60, 500)]))},
    "test_field_expansion": lambda rng, _: {"axes": rng.uniform(0.2, 1.0, 3) * 1e-5},
}  # fmt: skip


def hide(rng: np.random.Generator, name: str, camera: Camera, known: dict) -> dict:
    """Draw the constants of one effect; its size is scaled afterwards."""
    e: dict = {"effect": name, "size": 1.0, **CONSTANTS.get(name, lambda *_: {})(rng, known)}
    along = np.zeros(16)
    if name in ("nonlinear_expansion", "softening", "thermal_gradient", "permanent_set",
                "self_heating", "creep", "slip", "cyclic_interference", "second_heat_source",
                OUTSIDE):  # fmt: skip
        along = _direction(rng, camera)
    elif name in ("housing_tilt", "mount_motion"):
        along[10:13] = rng.normal(size=3) * 1e-5
        if name == "mount_motion":
            along[13:16] = rng.normal(size=3) * 1e-2
    elif name == "radial_distortion_drift":
        along[3] = 1e-5
        if rng.random() < 0.4:
            along[4] = rng.normal() * 2e-6
    elif name in ("decentering_drift", "affinity_drift"):
        first = 6 if name == "decentering_drift" else 8
        along[first : first + 2] = rng.normal(size=2) * 1e-5
    return {**e, "along": along} if along.any() else e


def fresh(rng: np.random.Generator, e: dict, first: bool, seconds: int) -> dict:
    """Draw the instants and phases of one series."""
    f = dict(e)
    if e["effect"] in ("slip", "target_displacement"):
        f["time"] = float(rng.uniform(0.2, 0.8) * seconds)
        f["happens"] = first or rng.random() < 0.6
    if e["effect"] == "cyclic_interference":
        f["phase"] = float(rng.uniform(0, 2 * np.pi))
    return f


# the course of an effect, from its constants, temperature, time, climate, and what was not recorded
COURSES: dict[str, Callable[..., np.ndarray]] = {
    "nonlinear_expansion": lambda e, T, *_: (T - T0) ** 2 / 100.0,
    "softening": lambda e, T, *_: np.maximum(T - e["T_k"], 0),
    "thermal_gradient": lambda e, T, *_: np.gradient(T) * 100,
    "permanent_set": lambda e, T, *_: np.maximum.accumulate(T),
    "self_heating": lambda e, T, t, *_: 1 - np.exp(-t / e["tau"]),
    "creep": lambda e, T, t, *_: t / 1000,
    "slip": lambda e, T, t, *_: (t >= e["time"]).astype(float) * e["happens"],
    "cyclic_interference": lambda e, T, t, *_: np.sin(2 * np.pi * t / e["P"] + e["phase"]),
    "second_heat_source": lambda e, T, t, climate_, _: climate_[e["channel"]],
    "mount_motion": lambda e, T, *_: lagged(T, e["tau"]) - T0,
    OUTSIDE: lambda *known: known[-1],
}


def true_parameters(
    camera: Camera,
    effects: list[dict],
    climate_: dict[str, np.ndarray],
    unknown: np.ndarray,
    frames: np.ndarray,
    points: np.ndarray,
    eop: np.ndarray,
    offsets: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return parameters (E, 16), object points (E, n, 3) and noise factors (E,) at the frames."""
    T = climate_["temperature"]
    t = np.arange(len(T), dtype=float)
    drive = T
    for e in effects:
        size = e["size"]
        if e["effect"] == "thermal_lag":
            drive = lagged(drive, max(e["tau"] * size, 1e-3))
        elif e["effect"] == "time_offset":
            drive = delayed(drive, e["d"] * size)
        elif e["effect"] == "hysteresis":
            drive = backlash(drive, e["half_width"] * size)
    extra = np.zeros((len(t), 16))
    scale = np.zeros((len(t), 3))
    noise = np.ones(len(t))
    moved = []
    for e in effects:
        name, size = e["effect"], e["size"]
        if "along" in e:
            course = COURSES.get(name, lambda _, T, *__: T - T0)(e, T, t, climate_, unknown)
            extra += size * course[:, None] * e["along"]
        elif name == "test_field_expansion":
            scale += size * (T - T0)[:, None] * e["axes"]
        elif name == "defocus":
            noise = noise * (1 + size * np.clip(T - e["coldest"], 0, None) * 0.02)
        elif name == "target_displacement" and e["happens"]:
            moved.append((e["targets"], size * np.asarray(e["vector"]), e["time"]))

    def at(v: np.ndarray) -> np.ndarray:
        return np.interp(frames, t, v)

    p = np.tile(camera.base, (len(frames), 1))
    p[:, 10:] = eop
    p += offsets
    p += at(drive - T0)[:, None] * camera.rates
    p += np.stack(
        [at(extra[:, j]) if extra[:, j].any() else np.zeros(len(frames)) for j in range(16)], 1
    )
    for e in effects:
        if e["effect"] == "slip":  # a step is not interpolated
            s = e["size"] * e["happens"]
            p -= s * at((t >= e["time"]).astype(float))[:, None] * e["along"]
            p += s * (frames >= e["time"])[:, None] * e["along"]
    # the lens moves along its axis, so the rays keep their angles
    p[:, 3:10] *= (camera.base[0] / p[:, :1]) ** np.array([2, 4, 6, 1, 1, 0, 0])
    X = points[None] * (1 + np.stack([at(scale[:, k]) for k in range(3)], 1))[:, None, :]
    for rows, vector, time in moved:
        X[:, rows] += (frames >= time)[:, None, None] * vector
    return p, X, at(noise)


def bisected(left: Callable[[float], float], strength: float, low: float, high: float) -> float:
    """Return the size between `low` and `high` at which `left`(size) is `strength`."""
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if left(middle) < strength else (low, middle)
    return float(np.sqrt(low * high))


def left_over(
    uv: np.ndarray, camera: Camera, points: np.ndarray, eop: np.ndarray, T: np.ndarray
) -> float:
    """Return the RMS, px, of noise-free image points that the base model leaves."""
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
    # constants explain the mean over the epochs; rates of c, x0, y0 explain the part along T
    slope = (T @ y) / (T @ T)
    G = J[:, :3]
    y = y - np.outer(T, G @ np.linalg.lstsq(G, slope, rcond=None)[0])
    # IOP, EOP and target offsets of the base model explain the mean completely
    return float(np.sqrt(np.mean(y**2)))
