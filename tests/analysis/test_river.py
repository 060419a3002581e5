"""Rendered rivers from cold starts to knocks: the water line's sds, and flagged scenes.

There are two banks with crosses on boards, water, leaves, sun, night, rain and knocks.
The projection and its inverse are computed by `tests.main_paths.crooked` and this module, which
share no code with the program. Frames have a quarter of the camera's pixels in each direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

from tests.analysis.test_gauge import NAMES, POSE, RATES, SD, SD_RATE, START, thermal_camera
from tests.blind.world import turn as rotation
from tests.main_paths.crooked import CAMERA, PITCH, SIZE, project
from thermocald.analysis.thermal.control_points import ControlPoints
from thermocald.analysis.thermal.correction import RowBlock
from thermocald.analysis.thermal.gauge import GaugeCalibrator
from thermocald.analysis.thermal.places import Places, measure_places
from thermocald.analysis.thermal.scene import follow_scene
from thermocald.epoch import Epoch
from thermocald.photogrammetry.epoch.measuring import Plane, place_on
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.frame.templates import Templates
from thermocald.store.logger.temperatures import TemperatureLog

BINNED = 4
WIDTH, HEIGHT = SIZE[0] // BINNED, SIZE[1] // BINNED
KINDS = ("day", "cold start", "sun", "night", "rain", "knocked", "hidden")
TAU = 600.0
SURVEY_MM, LEVEL_SD, LINE_PX, NOISE_DN, NOISE_K = 8.0, 5.0, 0.1, 2.0, 0.05
STEP_S = 60.0
HOURS = 2.5
_FINE = 8  # boards are drawn at this scale and averaged
_BANK = 2_500.0  # mm from the middle to the foot of the banks
_SLOPE = 0.5


def small(points: np.ndarray) -> np.ndarray:
    """Convert pixels of the sensor to pixels of the small frame."""
    return (points + 0.5) / BINNED - 0.5


def texture(rng: np.random.Generator, smooth: float) -> np.ndarray:
    fine = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), smooth)
    coarse = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 12)
    return 110 + 22 * fine / fine.std() + 15 * coarse / coarse.std()


@dataclass
class River:
    """One gauge: its camera, banks, boards, and temperatures.

    boards (n, 3) mm; moments s; warmth °C at the thermometer; inside °C in the lens, which lags
    behind; shown: the readings.
    """

    seed: int
    kind: str
    boards_count: int = 10
    lag: float = TAU
    pose: np.ndarray = field(default_factory=POSE.copy)

    def __post_init__(self) -> None:
        self.rng = rng = np.random.default_rng(self.seed)
        self.off = {k: rng.normal(0, SD[k]) for k in NAMES}
        self.rate = {k: RATES[k] + rng.normal(0, SD_RATE) for k in NAMES}
        n = self.boards_count
        y = 7_500 + (np.arange(n) // 2 + rng.uniform(0, 0.5, n)) * 25_000 / n
        x = np.where(np.arange(n) % 2, 1, -1) * rng.uniform(0.32, 0.42, n) * (y + 1_000)
        self.boards = np.column_stack([x, y, self.ground(x) + 300])
        self.turned = rng.uniform(-0.4, 0.4, n)
        surveyed = self.boards + rng.normal(0, SURVEY_MM, self.boards.shape)
        self.field = TestField.build([f"g{i}" for i in range(n)], surveyed, SURVEY_MM)
        self.level = rng.normal(0, LEVEL_SD)
        self.plane = Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]), LEVEL_SD)
        self.bank = spline_filter(texture(rng, 1.8).astype(float))
        self._course()

    def _course(self) -> None:
        """Draw a morning: two hours that only a logger records, then the camera's hours."""
        self.moments = START + np.arange(-7200.0, HOURS * 3600 + 1, STEP_S)
        hours = (self.moments - START) / 3600
        cold = self.rng.uniform(2, 8)
        gain = {"sun": 9.0, "cold start": 3.0}.get(self.kind, 6.0) + self.rng.uniform(-1, 1)
        self.warmth = cold + gain * np.clip(hours, 0, None)
        if self.kind == "cold start":  # it comes from a warm room
            self.warmth[hours < 0] = self.rng.normal(cold, 12.0)
        inside = [self.warmth[0]]
        for before, now in zip(self.warmth, self.warmth[1:], strict=False):
            # temperature is linear between two readings
            slope, gone = (now - before) / STEP_S, np.exp(-STEP_S / self.lag)
            start = before - slope * self.lag
            inside.append(start + slope * STEP_S + (inside[-1] - start) * gone)
        self.inside = np.array(inside)
        self.shown = self.warmth + self.rng.normal(0, NOISE_K, len(hours))
        self.log = TemperatureLog(self.moments, {"housing": self.shown})

    @staticmethod
    def ground(x: np.ndarray) -> np.ndarray:
        """Return the height of the banks, mm."""
        return _SLOPE * (np.abs(x) - _BANK)

    def interior(self, k: int) -> dict[str, float]:
        """Return the camera's c, x0, y0 at a moment."""
        return {n: CAMERA[n] + self.off[n] + self.rate[n] * (self.inside[k] - 20.0) for n in NAMES}

    def image(self, points: np.ndarray, k: int) -> np.ndarray:
        """Project points at a moment, px of the small frame."""
        return small(project(points, self.pose, **self.interior(k)))

    def waterline(self) -> np.ndarray:
        """Return points (3, 3) mm of the water line on the banks."""
        x = _BANK + self.level / _SLOPE
        z = self.level
        return np.array([[-x, 9_000, z], [x, 14_000, z], [-x, 19_000, z]])

    def frame(self, k: int, light: float = 1.0, clear: bool = False) -> np.ndarray:
        """Render the frame of a moment: banks, sky, moving water, boards, leaves, noise.

        clear: without rain and obstacles.
        """
        rng = self.rng
        away, wet = self._looked_at(k)
        texels = map_coordinates(self.bank, away.T[::-1], prefilter=False, mode="reflect")
        image = texels.reshape(HEIGHT, WIDTH).astype(np.float32)
        self._draw_boards(image, k)
        image = (1 - wet) * image + wet * texture(rng, 3.0)
        for _ in range(30):
            x, y = rng.uniform(0, WIDTH), rng.uniform(0, HEIGHT)
            axes = tuple(rng.uniform(2, 6, 2).round().astype(int).tolist())
            cv2.ellipse(image, (int(x), int(y)), axes, rng.uniform(0, 180), 0, 360,
                        float(rng.uniform(40, 180)), -1, cv2.LINE_AA)  # fmt: skip
        if self.kind == "hidden" and not clear:
            self._hide(image, k)
        image = light * cv2.GaussianBlur(image, (0, 0), 0.7)
        if self.kind == "rain" and not clear:
            self._rain(image)
        noisy = image + rng.normal(0, NOISE_DN, image.shape)
        return np.clip(np.round(noisy), 0, 255).astype(np.uint8)

    def _looked_at(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return each pixel's place in the image of the banks (H·W, 2), and the share of water."""
        at, R, now = self.pose[3:], rotation(*self.pose[:3]), self.interior(k)
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH].reshape(2, -1)
        x = ((u + 0.5) * BINNED - 0.5 - (SIZE[0] - 1) / 2) * PITCH - now["x0"]
        y = -((v + 0.5) * BINNED - 0.5 - (SIZE[1] - 1) / 2) * PITCH - now["y0"]
        a, b = x.copy(), y.copy()
        for _ in range(8):
            r2 = a**2 + b**2
            radial = CAMERA["A1"] * r2 + CAMERA["A2"] * r2**2
            b1, b2 = CAMERA["B1"], CAMERA["B2"]
            a, b = (x - a * radial - b1 * (r2 + 2 * a**2) - 2 * b2 * a * b,
                    y - b * radial - b2 * (r2 + 2 * b**2) - 2 * b1 * a * b)  # fmt: skip
        ray = np.column_stack([a, b, np.full(a.shape, -now["c"])]) @ R.T
        reach = []
        for side in (-1.0, 1.0):  # 0 = Z - slope (side X - bank)
            steep = ray[:, 2] - _SLOPE * side * ray[:, 0]
            height = at[2] - _SLOPE * (side * at[0] - _BANK)
            with np.errstate(divide="ignore"):
                t = -height / steep
            reach.append(np.where(t > 0, t, np.inf))
        t = np.minimum(*reach)
        sky = ~(t < 1e5)
        X = at + np.where(sky, 1e5, t)[:, None] * ray
        there = small(project(X, POSE, *(CAMERA[n] for n in NAMES)))
        wet = np.where(sky, 0.0, np.clip(0.5 + (self.level - X[:, 2]) / 30.0, 0, 1))
        return there, wet.reshape(HEIGHT, WIDTH).astype(np.float32)

    def _draw_boards(self, image: np.ndarray, k: int) -> None:
        for centre, turn in zip(self.boards, self.turned, strict=True):
            x, y = np.round(self.image(centre[None], k)[0]).astype(int)
            half = 26
            if not (half < x < WIDTH - half - 1 and half < y < HEIGHT - half - 1):
                continue
            window = image[y - half : y + half + 1, x - half : x + half + 1]
            fine = cv2.resize(window, None, fx=_FINE, fy=_FINE, interpolation=cv2.INTER_NEAREST)
            cosine, sine = np.cos(turn), np.sin(turn)
            for size, grey in (((270, 270), 40.0), ((230, 60), 225.0), ((60, 230), 225.0)):
                flat = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size
                flat = flat @ np.array([[cosine, sine], [-sine, cosine]])
                corners = centre + np.column_stack([flat[:, 0], np.zeros(4), flat[:, 1]])
                seen = (self.image(corners, k) - [x - half, y - half] + 0.5) * _FINE - 0.5
                cv2.fillConvexPoly(fine, np.round(seen * 16).astype(np.int32), grey, cv2.LINE_AA, 4)
            window[:] = cv2.resize(fine, window.shape[::-1], interpolation=cv2.INTER_AREA)

    def _hide(self, image: np.ndarray, k: int) -> None:
        for centre in self.boards[: self.hidden]:
            x, y = np.round(self.image(centre[None], k)[0]).astype(int)
            image[max(y - 24, 0) : y + 24, max(x - 24, 0) : x + 24] = 100

    def _rain(self, image: np.ndarray) -> None:
        soft = cv2.GaussianBlur(image, (0, 0), 6)
        drops = np.zeros(image.shape, np.float32)
        for _ in range(14):
            at = tuple(self.rng.integers(0, [WIDTH, HEIGHT]).tolist())
            cv2.circle(drops, at, int(self.rng.integers(20, 45)), 1.0, -1, cv2.LINE_AA)
        drops = cv2.GaussianBlur(drops, (0, 0), 4)
        image[:] = (1 - drops) * image + drops * soft

    @property
    def hidden(self) -> int:
        """The number of hidden boards, in some scenes nearly all."""
        return self.seed % self.boards_count

    def knock(self) -> None:
        """Knock the mount: turn it by at least a twentieth of a degree, shift it by centimetres."""
        self.pose = self.pose + np.concatenate(
            [np.deg2rad(self.rng.choice([-1, 1], 3) * self.rng.uniform(0.05, 0.2, 3)),
             self.rng.normal(0, 30, 3)]
        )  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """A scene's results: statuses of its epochs, and whether a movement was reported.

    chi2, chi2_first: of the water line's six coordinates with control points in the frame, and in
    the first frame only, or NaN; before, after: thermal drift of the water line, mm, without and
    with the model; flagged: the scene shows movement, or could not be followed.
    """

    kind: str
    statuses: tuple[str, ...]
    moved: bool
    chi2: float
    chi2_first: float
    before: float
    after: float
    flagged: bool


def play(seed: int, kind: str, folder: Path) -> Outcome:
    """Render a gauge's frames, and run the program on them."""
    river = River(seed, kind)
    thermal = thermal_camera(TAU).for_images(WIDTH, HEIGHT)
    begin, last = int(7200 / STEP_S), len(river.moments) - 1
    reference = river.frame(begin, clear=True)
    n = len(river.boards)
    clicked = np.round(river.image(river.boards, begin) + river.rng.normal(0, 0.6, (n, 2)))
    clicks = Observations(np.arange(n), clicked, np.ones((n, 2)))
    gauge = GaugeCalibrator(thermal, river.field, Templates(reference, river.field, clicks))
    first = gauge.calibrate(_epoch(river, begin), reference)
    for k in range(begin + 1, last - 1):
        gauge.predictor.take(river.moments[k], {"housing": river.shown[k]})
    before, after = _drift(river, thermal, first, begin, last)
    if kind == "knocked":
        river.knock()
    light = 0.015 if kind == "night" else river.rng.uniform(0.85, 1.1)
    shots, done, moved = [(begin, reference)], [], False
    for k in (last - 1, last):
        shots.append((k, river.frame(k, light)))
        done.append(gauge.calibrate(_epoch(river, k), shots[-1][1]))
        moved |= gauge.movement is not None
    uv = river.image(river.waterline(), last) + river.rng.normal(0, LINE_PX, (3, 2))
    chi2, now = math.nan, done[-1].adjustment
    if now.interior is not None and now.exterior is not None:
        at = place_on(gauge.sensor, now.values, now.covariance, uv, LINE_PX, river.plane)
        chi2 = _chi2(*at, river.waterline())
    places = _measured(river, thermal, first, uv, last)
    course = follow_scene(thermal, river.log, _files(folder, river, shots))
    flagged = bool(course.movements) or not course.seen.any()
    return Outcome(
        kind, tuple(d.adjustment.status for d in (first, *done)), moved, chi2,
        _chi2(places.points, places.covariance, river.waterline()), before, after, flagged,
    )  # fmt: skip


def _epoch(river: River, k: int) -> Epoch:
    return Epoch(k, river.moments[k], river.moments[k], {"housing": river.shown[k]})


def _measured(river: River, thermal, first, uv: np.ndarray, k: int) -> Places:
    """Measure image points of a moment, with the control points of the first frame."""
    control = ControlPoints(river.field, first.epoch.observations, np.zeros(3), "mm")
    observed = np.column_stack([uv, np.full(uv.shape, LINE_PX)])
    when = river.moments[int(7200 / STEP_S)]
    times = np.full(len(uv), river.moments[k])
    lines = list(range(len(uv)))
    rows = RowBlock([], lines, [{} for _ in uv], times, observed, [])
    return measure_places(thermal, river.log, control, when, river.plane, [rows])


def _drift(river: River, thermal, first, begin: int, last: int) -> tuple[float, float]:
    """Return the RMS thermal drift of the water line, mm, without and with the model."""
    then, now = (
        _measured(river, thermal, first, river.image(river.waterline(), k), k)
        for k in (begin, last)
    )
    return tuple(
        float(np.sqrt(np.mean(np.sum((X - then.points) ** 2, axis=1))))
        for X in (now.without, now.points)
    )


def _chi2(X: np.ndarray, C: np.ndarray, truth: np.ndarray) -> float:
    rows = np.flatnonzero(np.arange(X.size) % 3 < 2)
    error = (X - truth).ravel()[rows]
    return float(error @ np.linalg.solve(C[np.ix_(rows, rows)], error))


def _files(folder: Path, river: River, shots) -> list[tuple[Path, float]]:
    out = []
    for k, image in shots:
        path = folder / f"{river.seed}-{k}.png"
        cv2.imwrite(str(path), image)
        out.append((path, float(river.moments[k])))
    return out


GRID_M = np.array([192_000.0, 313_000.0, 138.0])  # origin of the example's coordinates
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "river"
_MORNING = 1_714_975_200.0  # 6 May 2024, 06:00 UTC
_SHOTS = (120, 150, 180, 210, 240, 270)  # moments of the example's photographs
_KNOCKED = 4  # the mount is turned from this photograph on


def write_example(folder: Path = EXAMPLE) -> River:
    """Write the tutorial's gauge: photographs, control points, a logger's file, a model."""
    river = River(7, "day")
    river.level = 120.0
    river.moments = river.moments - START + _MORNING
    thermal = thermal_camera(TAU).for_images(WIDTH, HEIGHT)
    photographs = folder / "photographs"
    photographs.mkdir(parents=True, exist_ok=True)
    thermal.save(folder / "camera.thermal.yaml")
    names = []
    for i, k in enumerate(_SHOTS):
        if i == _KNOCKED:
            turn = np.deg2rad([0.03, -0.02, 0.0])
            river.pose = river.pose + np.concatenate([turn, np.zeros(3)])
        moment = datetime.fromtimestamp(float(river.moments[k]), UTC)
        names.append(f"{moment:%Y%m%d-%H%M%S}.jpg")
        image = river.frame(k, river.rng.uniform(0.9, 1.05), clear=True)
        cv2.imwrite(str(photographs / names[-1]), image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    river.pose = POSE.copy()
    clicks = np.round(river.image(river.boards, _SHOTS[0]))
    rows = [
        [name, *(f"{v:.4f}" for v in at / 1000 + GRID_M), *[SURVEY_MM / 1000] * 3, *uv, 1, 1]
        for name, at, uv in zip(river.field.names, river.field.points, clicks, strict=True)
    ]
    _write(folder / "gcp.csv", "target,X,Y,Z,sX,sY,sZ,x,y,sx,sy", rows)
    readings = zip(river.moments.tolist(), river.shown.tolist(), strict=True)
    _write(
        folder / "logger.csv", "time,temperature", [[f"{t:.0f}", f"{T:.2f}"] for t, T in readings]
    )
    section = 1e-3 * np.array([[-6e3, 0, 0], [-_BANK, 0, 0], [_BANK, 0, 0], [6e3, 0, 0]])
    section[:, 1] = 12.0
    section[:, 2] = river.ground(1000 * section[:, 0]) / 1000
    points = [", ".join(f"{v:.3f}" for v in at) for at in section + GRID_M]
    (folder / "section.yaml").write_text(f"profile: [[{'], ['.join(points)}]]\nsd: 0.005\n")
    x = _BANK + river.level / _SLOPE
    touched = np.array([[-x, 12_000.0, river.level], [x, 12_000.0, river.level]])
    seen = []
    for i in (0, 3):
        uv = river.image(touched, _SHOTS[i]) + river.rng.normal(0, 0.3, (2, 2))
        seen += [[f"{river.moments[_SHOTS[i]]:.0f}", side, *(f"{v:.1f}" for v in at), 0.3, 0.3]
                 for side, at in zip(("left", "right"), uv, strict=True)]  # fmt: skip
    _write(folder / "waterline.csv", "time,name,x,y,sx,sy", seen)
    return river


def _write(path: Path, head: str, rows: list[list[object]]) -> None:
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")


@pytest.mark.slow
def test_the_water_line_has_true_sds_and_doubtful_scenes_are_flagged(tmp_path):
    """Two scenes of each kind; `python -m benchmarks.river` has more."""
    scenes = [play(300 + seed, KINDS[seed % len(KINDS)], tmp_path) for seed in range(14)]
    posed = np.array([s.chi2 for s in scenes]) / 6
    still = np.array([s.chi2_first for s in scenes if not s.flagged]) / 6
    # the six coordinates of a scene correlate, so these few scenes give a ratio to a tenth
    assert np.sqrt(posed.mean()) == pytest.approx(1.0, abs=0.3)
    assert np.sqrt(still.mean()) == pytest.approx(1.0, abs=0.3)
    before, after = np.array([(s.before, s.after) for s in scenes]).T
    assert np.mean(before**2) > 100 * np.mean(after**2)
    assert {s.kind for s in scenes if s.moved} == {"knocked"}
    assert all(s.moved for s in scenes if s.kind == "knocked")
    assert {s.kind for s in scenes if s.flagged} == {"knocked", "night"}
    assert all(s.flagged for s in scenes if s.kind in ("knocked", "night"))
    assert all(s.statuses[1:] == ("last_pose",) * 2 for s in scenes if s.kind == "night")


@pytest.mark.slow
def test_the_shipped_example_is_up_to_date(tmp_path):
    """Texts are identical, photographs differ at most by the JPEG encoder."""
    write_example(tmp_path)
    for path in sorted(p for p in tmp_path.rglob("*") if p.is_file()):
        shipped = EXAMPLE / path.relative_to(tmp_path)
        if path.suffix == ".jpg":
            a, b = (cv2.imread(str(p), cv2.IMREAD_GRAYSCALE).astype(float) for p in (path, shipped))
            assert np.abs(a - b).mean() < 2.0
        else:
            assert path.read_text() == shipped.read_text(), path.name


if __name__ == "__main__":
    write_example()
