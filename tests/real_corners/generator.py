"""Effects hidden in real image points: a fixed camera's corners, moved as by heat.

The corners are those of `aviary-*` (shared/data), without thermal effects: a camera that trembles
and is knocked, boards that people hide. Each corner is moved by the difference of two projections,
with the camera at a temperature and at rest. The first half of the epochs is M1, the second M2;
they are 30 s apart and have an invented temperature. The noise is real, the truth known. Climate
and effects are from `tests.blind`, which shares no code with the program.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from tests.blind.case import PROGRAMMES
from tests.blind.generator import Series, write_series
from tests.blind.hidden import Camera, bisected, fresh, hide, left_over, true_parameters
from tests.blind.world import climate, image, smooth_unknown
from tests.recordings import read_rows

CAMERAS = ("aviary-cam0", "aviary-cam1", "aviary-cam2", "aviary-cam6")
NINE = (
    "thermal_lag", "time_offset", "nonlinear_expansion", "softening", "thermal_gradient",
    "permanent_set", "hysteresis", "self_heating", "creep",
)  # fmt: skip
OTHERS = ("slip", "cyclic_interference", "second_heat_source", "radial_distortion_drift",
          "decentering_drift", "test_field_expansion")  # fmt: skip
INTERVAL = 30.0
SIGMA = 0.1
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"

# Interior and exterior orientation (CONVENTIONS §2) of the four cameras, from an adjustment of
# their mean images; only differences of projections are used
_POSES = {
    "aviary-cam0": [12.7227907, -0.00394516905, -0.00917670977, -0.00115192562, 5.22191654e-06,
                    1.14776586e-08, -5.26401957e-05, 7.77528791e-05, -0.000329844366,
                    -4.6728178e-05, -2.11727426, -1.28070603, 2.66493111, 371.45511, 2179.88244,
                    215.696174],
    "aviary-cam1": [12.7614618, -0.054490284, -0.0231433588, -0.0010691853, 4.73792741e-06,
                    1.08812008e-08, -0.000177788072, 3.31403292e-05, 0.000742453377,
                    6.99856159e-05, 2.17809005, -1.29156208, 0.617105309, 350.980518, 192.037117,
                    231.935262],
    "aviary-cam2": [12.6846634, 0.2565361, 0.201644335, -0.00127238462, 6.32118413e-06,
                    1.6211782e-08, 5.73383751e-05, 3.46146101e-05, -0.000363380511,
                    0.000231064947, 0.731911573, -1.34056326, -0.834859088, 367.554107, 201.909818,
                    2298.20253],
    "aviary-cam6": [12.7463703, 0.0959551159, 0.120901281, -0.00115152574, 4.34642586e-06,
                    1.25812535e-08, 4.64596969e-05, 2.94771339e-05, -0.000233357198,
                    5.6273837e-05, -0.775551648, 1.32448156, 2.33635912, 5674.28713, 2056.6197,
                    2270.8213],
}  # fmt: skip


@dataclass(frozen=True)
class RealCase:
    """Effects hidden in a camera's corners; strength_px of each effect, by default 0.2 to 0.3."""

    camera: str
    effects: tuple[str, ...] = ()
    seed: int = 0
    strength_px: float | None = None


@cache
def corners(camera: str) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return the targets' names and points (T, 3) mm, and image points (E, T, 2) px or NaN."""
    field = read_rows(SHARED / camera / "testfield.csv")
    names = tuple(row["target"] for row in field)
    place = np.array([[float(row[k]) for k in "XYZ"] for row in field])
    rows = read_rows(SHARED / camera / "observations.csv")
    numbers = sorted({int(row["epoch"]) for row in rows})
    points = np.full((len(numbers), len(names), 2), np.nan)
    for row in rows:
        at = numbers.index(int(row["epoch"])), names.index(row["target"])
        points[at] = float(row["x"]), float(row["y"])
    return names, place, points


def generate(case: RealCase) -> tuple[list[Series], dict]:
    """Generate M1 and M2; return them and the truth."""
    rng = np.random.default_rng([case.seed, 4711, CAMERAS.index(case.camera)])
    _, place, points = corners(case.camera)
    head = yaml.safe_load((SHARED / case.camera / "recording.yaml").read_text())["camera"]
    pitch = head["pixel_pitch"]
    sensor = (head["width"], head["height"], pitch)
    base = np.array(_POSES[case.camera])
    camera = Camera(sensor, base, np.zeros(16))
    camera.rates[0] = rng.choice([-1, 1]) * base[0] * rng.uniform(4e-5, 1.5e-4)
    way = rng.uniform(0, 2 * np.pi)
    camera.rates[1:3] = rng.uniform(0.25, 0.9) * pitch * np.array([np.cos(way), np.sin(way)])
    half = len(points) // 2
    halves = [points[:half], points[half:]]
    seconds = int(INTERVAL * (len(points) - half)) + 20
    programmes = [str(p) for p in rng.choice(PROGRAMMES, 2)]
    climates = [climate(rng, p, seconds) for p in programmes]
    unknowns = [smooth_unknown(rng, seconds) for _ in programmes]
    first, second = (c["temperature"] for c in climates)
    low, high = max(first.min(), second.min()), min(first.max(), second.max())
    pool = {"T_quantile": lambda q: float(low + q * (high - low)), "coldest": low}
    hidden = [hide(rng, name, camera, pool) for name in case.effects]
    own = [[fresh(rng, e, k == 0, seconds) for e in hidden] for k in range(2)]
    frames = [INTERVAL * np.arange(len(h)) for h in halves]
    strength = case.strength_px or float(rng.uniform(0.2, 0.3))
    seen = np.isfinite(points[..., 0]).mean(axis=0) > 0.5
    still = np.zeros(16)

    def moved(effects: list[dict], k: int) -> np.ndarray:
        p, X, _ = true_parameters(
            camera, effects, climates[k], unknowns[k], frames[k], place, base[10:], still
        )
        return image(X, p, sensor)

    def left(size: float, which: int) -> float:
        uv = moved([dict(own[0][which], size=size)], 0)[:, seen]
        T = np.interp(frames[0], np.arange(seconds), first)
        return left_over(uv, camera, place[seen], base[10:], T)

    for k, e in enumerate(hidden):
        size = _size(lambda s, k=k: left(s, k), e, camera, strength)
        for s in own:
            s[k]["size"] = size
    at_rest = image(place[None], base[None], sensor)
    built = []
    for k, (corner, times) in enumerate(zip(halves, frames, strict=True)):
        read = {
            name: np.interp(times, np.arange(seconds), course) + rng.normal(0, 0.04, len(times))
            for name, course in climates[k].items()
        }
        at = times + 1.6e9 + 1e5 * k
        points = corner + moved(own[k], k) - at_rest
        numbers = np.arange(len(times)) + 1 + k * half
        name = f"M{k + 1}"
        built.append(Series(name, head["name"], numbers, at, at, read, points, SIGMA, INTERVAL))
    truth = {
        "case": dict(case.__dict__.items()), "strength_px": strength, "programmes": programmes,
        "effects": [
            {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in e.items()}
            for e in own[0]
        ],
    }  # fmt: skip
    return built, truth


def _size(left, e: dict, camera: Camera, strength: float) -> float:
    """Return the factor of an effect's constants with which the base model leaves `strength` px."""
    if e["effect"] in ("thermal_lag", "time_offset", "hysteresis"):
        # the parameter is limited to realistic values; larger rates compensate for that
        limits = {"thermal_lag": 300 / e.get("tau", 1), "time_offset": 90 / abs(e.get("d", 1)),
                  "hysteresis": 4 / e.get("half_width", 1)}  # fmt: skip
        most = limits[e["effect"]]
        if left(most) < strength:
            for _ in range(20):
                camera.rates *= strength / left(most)
            return float(most)
        return bisected(left, strength, 1e-3, most)
    size = 1.0
    for _ in range(30):
        size *= strength / max(left(size), 1e-12)
    return float(size)


def write(series: Series, source: str, folder: Path) -> None:
    """Write the series as a recording (CONVENTIONS §3)."""
    head = yaml.safe_load((SHARED / source / "recording.yaml").read_text())
    head |= {"name": f"{source}-{series.name}", "series": series.name, "interval": INTERVAL}
    head["temperatures"] = {name: {"unit": "degC"} for name in series.temperatures}
    write_series(series, corners(source)[0], head, folder)
    (folder / "testfield.csv").write_text((SHARED / source / "testfield.csv").read_text())
