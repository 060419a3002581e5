"""A generator of recordings with a hidden effect, which shares no code with thermocald.

Projection, heat and noise are its own, on a time axis of one second, from CONVENTIONS and EFFECTS
alone. Series are scored in memory, or written as recordings (CONVENTIONS §3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tests.blind.case import CAMERAS, PROGRAMMES, Case
from tests.blind.field_motion import moved_field
from tests.blind.hidden import bisected, fresh, hide, left_over, make_camera, true_parameters
from tests.blind.outside import trajectories
from tests.blind.world import climate, corner_field, image, smooth_unknown
from tests.recordings import write_recording

START = 1_600_000_000.0  # s UTC, of the first frame
_PARAMETERS = (
    "c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2",
    "omega", "phi", "kappa", "X0", "Y0", "Z0",
)  # fmt: skip


class Unseen(Exception):
    """The effect changes nothing with this seed's temperatures."""


@dataclass(frozen=True, eq=False)
class Series:
    """One recording in memory.

    times, reading_times (E,) s UTC; temperatures {name: (E,)} °C; points (E, T, 2) px, NaN where
    not seen; sigma px; interval s; columns {name: (E,)}: other recorded quantities.
    """

    name: str
    camera: str
    numbers: np.ndarray
    times: np.ndarray
    reading_times: np.ndarray
    temperatures: dict[str, np.ndarray]
    points: np.ndarray
    sigma: float
    interval: float
    columns: dict[str, np.ndarray] = field(default_factory=dict)


def generate(case: Case) -> tuple[list[Series], dict]:
    """Generate M1 and M2 of one camera; return them and the truth."""
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
    humidity: list[np.ndarray] = []
    if case.influence:
        own = np.random.default_rng([case.seed, 78])
        unknowns, humidity = trajectories(own, case.influence, climates, seconds)
    else:
        unknowns = [smooth_unknown(rng, seconds) for _ in programmes]
    T1 = climates[0]["temperature"]
    pool = {
        "T_quantile": lambda q: float(T1.min() + q * (T1.max() - T1.min())),
        "coldest": min(float(c["temperature"].min()) for c in climates),
    }
    if "softening" in case.effects:  # a threshold within the range of both series
        T2 = climates[1]["temperature"]
        low, high = max(T1.min(), T2.min()), min(T1.max(), T2.max())
        if high - low > 3:
            pool["T_quantile"] = lambda q: float(low + q * (high - low))
    hidden = [hide(rng, name, camera, pool) for name in case.effects]
    rng.normal(0, 1, 6)  # unused, but keeps the recordings of a seed unchanged
    turned = rng.normal(0, 1, 6) * np.array([2e-3, 2e-3, 2e-3, 3, 3, 3])
    views = [camera.base[10:], camera.base[10:] + turned]
    offsets = [np.zeros(16), np.zeros(16)]
    offsets[1][:3] = rng.normal(0, 1, 3) * np.array([2, 1, 1]) * camera.sensor[2]
    frame_axis = [case.interval * np.arange(case.epochs) for _ in programmes]
    for s, regular in enumerate(frame_axis if case.hard else ()):
        uneven = regular + rng.uniform(-2, 2, case.epochs)
        frame_axis[s] = uneven - uneven[0]
    per_series = [[fresh(rng, e, k == 0, seconds) for e in hidden] for k in range(2)]

    def predicted(s: int, effects: list[dict], points: np.ndarray) -> tuple[np.ndarray, ...]:
        return true_parameters(camera, effects, climates[s], unknowns[s], frame_axis[s], points,
                               views[s], offsets[s])  # fmt: skip

    def leftover(size: float, which: int) -> float:
        e = dict(per_series[0][which], size=size)
        p, X, nf = predicted(0, [e], nominal)
        if e["effect"] == "defocus":
            return float(np.sqrt(np.mean((case.noise_px * nf) ** 2 - case.noise_px**2)))
        T = np.interp(frame_axis[0], np.arange(seconds), T1)
        return left_over(image(X, p, camera.sensor), camera, nominal, views[0], T)

    for k, e in enumerate(hidden):
        if e["effect"] in ("thermal_lag", "time_offset", "hysteresis"):
            # scale the camera's rates in half of the cases, then the parameter
            if rng.random() < 0.5 and len(hidden) == 1:
                camera.rates = camera.rates * np.clip(
                    case.strength_px / max(leftover(1.0, k), 1e-9), 0.25, 2.0
                )
            size = bisected(lambda s, k=k: leftover(s, k), case.strength_px, 1e-3, 30.0)
            limit = {"thermal_lag": 900 / e.get("tau", 1), "time_offset": 200 / abs(e.get("d", 1)),
                     "hysteresis": 6 / e.get("half_width", 1)}[e["effect"]]  # fmt: skip
            size = min(size, limit)
        else:
            size = 1.0
            for _ in range(30):
                got = leftover(size, k)
                if abs(got / case.strength_px - 1) < 1e-3:
                    break
                size *= case.strength_px / max(got, 1e-12)
            else:
                raise Unseen(f"{e['effect']} {case.influence or ''} has almost no effect in M1")
        e["size"] = size
        for s in per_series:
            s[k]["size"] = size

    built = []
    field_error = rng.normal(0, 0.02, nominal.shape) if case.hard else np.zeros_like(nominal)
    for s in range(1 + case.with_m2):
        frames = frame_axis[s]
        p, X, noise = predicted(s, per_series[s], nominal + field_error)
        if case.field_motion and s == 0:
            X = moved_field(np.random.default_rng([case.seed, 79]), case.field_motion, X, frames)
        uv = image(X, p, camera.sensor)
        one = _measure(rng, case, camera_name, f"M{s + 1}", frames, uv, noise, climates[s])
        if case.record_humidity:
            read = np.interp(one.times - START, np.arange(seconds), humidity[s])
            one = replace(one, columns={"humidity": read})
        built.append(one)
    truth = {
        "case": vars(case),
        "camera": camera_name,
        "programmes": list(programmes),
        "effects": [[_plain(e) for e in s] for s in per_series],
    }
    return built, truth


def _plain(e: dict) -> dict:
    """Return the truth of an effect in the units of EFFECTS.md."""
    name, size = e["effect"], e["size"]
    out: dict = {"effect": name}
    scaled = size if name in ("thermal_lag", "time_offset", "hysteresis") else 1
    for key in ("tau", "d", "half_width"):
        if key in e:
            out[key] = e[key] * scaled
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
) -> Series:
    """Measure the true image points and temperatures, with noise and gross errors."""
    E, n = uv.shape[:2]
    sigma = case.noise_px
    measured = uv + rng.normal(size=uv.shape) * (sigma * noise)[:, None, None]
    if case.hard:
        if rng.random() < 0.5:  # in time: each target wanders slowly
            rho = np.exp(-case.interval / rng.uniform(30, 120))
            wander = np.empty_like(uv)
            state = rng.normal(size=uv.shape[1:])
            for i in range(E):
                state = rho * state + np.sqrt(1 - rho**2) * rng.normal(size=uv.shape[1:])
                wander[i] = state
            measured += 0.01 * wander
        else:  # in the image: shimmering air moves neighbours together
            place = uv.mean(0)
            d = np.linalg.norm(place[:, None] - place[None], axis=-1)
            L = np.linalg.cholesky(np.exp(-0.5 * (d / 250.0) ** 2) + 1e-6 * np.eye(n))
            measured += 0.01 * np.einsum("ij,ejk->eik", L, rng.normal(size=uv.shape))
    width, height = CAMERAS[camera][:2]
    seen = np.all((uv > 5) & (uv < np.array([width, height]) - 5), axis=-1)
    seen &= rng.random((E, n)) > 0.02
    gross = rng.random((E, n)) < 0.002
    away = rng.uniform(0.5, 8, (E, n, 1)) * rng.choice([-1, 1], (E, n, 2))
    measured = measured + gross[..., None] * away
    read_at = frames + rng.uniform(-1, 1, E)
    t = np.arange(len(climate_["temperature"]), dtype=float)
    temperatures = {}
    for channel, course in climate_.items():
        raw = np.interp(read_at, t, course) + rng.normal(0, case.thermometer_k, E)
        value = np.round(raw / 0.0625) * 0.0625
        if case.hard:
            value[rng.random(E) < 0.02] = np.nan
        temperatures[channel] = value
    keep = np.ones(E, bool)
    if case.hard:
        keep = rng.random(E) > 0.03
        keep[0] = True  # the truth's time begins with the first epoch
        for _ in range(rng.integers(1, 4)):  # people walk through the image
            begin = int(rng.integers(0, E - 8))
            x = rng.uniform(0.1, 0.9) * width
            wide = rng.uniform(0.08, 0.2) * width
            for i in range(begin, begin + int(rng.integers(2, 7))):
                seen[i] &= np.abs(uv[i, :, 0] - x) > wide
                x += 0.06 * width
    rows = np.flatnonzero(keep)
    return Series(
        name, camera, rows + 1, frames[rows] + START, read_at[rows] + START,
        {k: v[rows] for k, v in temperatures.items()},
        np.where(seen[..., None], measured, np.nan)[rows], sigma, case.interval,
    )  # fmt: skip


def write(series: Series, folder: Path) -> None:
    """Write the recording (CONVENTIONS §3)."""
    width, height, pitch, c, _ = CAMERAS[series.camera]
    head = {
        "name": f"{series.camera}-{series.name}", "series": series.name,
        "interval": series.interval,
        "camera": {"name": series.camera, "width": width, "height": height, "pixel_pitch": pitch,
                   "principal_distance": c},
        "temperatures": {k: {"unit": "degC", "resolution": 0.0625} for k in series.temperatures},
    }  # fmt: skip
    field = [
        [j, *(f"{v:.4f}" for v in place), "12.0", 0.02, 0.02, 0.02]
        for j, place in enumerate(corner_field(), 1)
    ]
    write_series(series, [row[0] for row in field], head, folder, field)


def write_series(
    series: Series, targets: Sequence, head: dict, folder: Path, field: Sequence = ()
) -> None:
    """Write a recording with names of the targets, a head, and rows of the test field."""
    epochs = []
    for i, number in enumerate(series.numbers):
        times = f"{series.times[i]:.3f}", f"{series.reading_times[i]:.3f}"
        read = (values[i] for values in series.temperatures.values())
        epochs.append([number, *times, *("" if np.isnan(v) else f"{v:.4f}" for v in read), ""])
    observations = [
        [number, name, f"{x:.4f}", f"{y:.4f}", series.sigma, series.sigma]
        for number, points in zip(series.numbers, series.points, strict=True)
        for name, (x, y) in zip(targets, points, strict=True)
        if np.isfinite(x)
    ]
    write_recording(folder, head, epochs, observations, field)
