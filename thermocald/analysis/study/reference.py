"""Comparison with the reference: its figures beside ours, from simulated, adjusted presets.

Figures are quoted from section 4 of Elias, Eltner, Liebold and Maas (2020), Sensors 20, 643. The
presets simulate the drift that the reference reports (principal point, principal distance, σ₀); the
errors in object space, correlations and significance are results. There are two series per camera,
as in the reference.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from thermocald.analysis.series.recorded import series_epochs
from thermocald.analysis.study.measured import measured_series
from thermocald.analysis.study.study import study_camera
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.physics.presets import PRESETS, preset_simulation
from thermocald.store.recording.reader import open_recording

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.analysis.study.measured import StudySettings
    from thermocald.analysis.study.study import CameraStudy

    _Row = tuple[str, str, str, float, float, float]
    """The fields of a Comparison after `camera`."""


SERIES = (("M1", 1), ("M2", 2))
"""Names and seeds of the two series of each camera."""


@dataclass(frozen=True, slots=True)
class Quoted:
    """The figures of a camera that the reference quotes; None if its text does not.

    below: percentage of errors below 1.5 cm; mean_cm, maxima_cm: mean error and mean of the nine
    maxima; direction: of the principal point's shift during warming; opposed: x0 and y0 change in
    opposite directions (r near -1); B_follows, sigma0_follows: whether the decentring distortion
    and σ₀ are highly correlated with the temperature; far: the reference's word on errors from 5 to
    10 cm; moved_px, c_mm: changes of principal point and distance; focus_mm: change of the depth of
    field at 1 m; sigma0_ratio: σ₀ at the highest temperature over the first.
    """

    below: float | None
    mean_cm: float
    maxima_cm: float
    direction: str
    opposed: bool | None
    B_follows: bool | None
    sigma0_follows: bool
    far: str | None = None
    moved_px: float | None = None
    c_mm: float | None = None
    focus_mm: float | None = None
    sigma0_ratio: float | None = None


_NEXUS = ("lower right", True, True, False)
_GALAXY = ("upper left", True, None, True)
QUOTED = {
    "nexus5-cold": Quoted(67.0, 1.3, 6.2, *_NEXUS, None, 16.0, 0.007, 5.0),
    "nexus5-warm": Quoted(98.0, 0.6, 2.9, *_NEXUS, "unlikely", 8.0, 0.003, 3.0),
    "galaxy-s8-cold": Quoted(20.0, 3.0, 12.9, *_GALAXY, "likely", 40.0, 0.007, 3.0),
    "galaxy-s8-warm": Quoted(93.0, 0.8, 3.5, *_GALAXY, "unlikely", 11.0, 0.003, 2.0),
    "rpi-v2.1-heating": Quoted(
        None, 1.1, 4.5, "lower left", None, True, True, "unlikely", sigma0_ratio=3.5
    ),
}
"""The quoted figures by preset.

"Strong correlations between temperature and decentring for the RPi camera and the LG Nexus 5"; "σ₀
of the S8 and the RPi highly correlated with the temperature but not of the Nexus 5";
"errors up to 10 cm are likely" (S8, cold), "deviations of more than 5 cm are unlikely" (warm; the
RPi "similar"), "errors > 10 cm appeared hardly ever" (all). Table 7 itself is not quoted beyond
that."""

_DIRECTIONS = {
    "lower right": (-90.0, 0.0),
    "upper left": (90.0, 180.0),
    "lower left": (-180.0, -90.0),
}
"""Bounds of the direction in degrees, from right (0) towards up."""
_STRONG, _WEAK = 0.7, 0.5  # |r| from which a correlation is strong, and below which it is not
_UNLIKELY = 1.0  # at most so many per cent of all errors
_LIKELY = 5.0  # at least so many per cent of all errors

_CLOSE = 0.98


@dataclass(frozen=True, slots=True)
class Comparison:
    """A figure of the reference and ours; text: as the reference states it.

    low, high: bounds within which ours counts as reproduced.
    """

    JSON: ClassVar = {"text": "reference", "low": "", "high": "", "reproduced": "reproduced"}

    camera: str
    quantity: str
    unit: str
    text: str
    ours: float
    low: float
    high: float

    @property
    def reproduced(self) -> bool:
        """True if our figure is within the bounds."""
        return self.low <= self.ours <= self.high


def reference_studies(settings: StudySettings, advance: Callable[[int], None]) -> list[CameraStudy]:
    """Study every preset with its own f-number, from two series simulated, read and adjusted."""
    studies = []
    for preset in QUOTED:
        measured = []
        with tempfile.TemporaryDirectory() as folder:
            for name, seed in SERIES:
                path = Path(folder) / name
                preset_simulation(preset, seed, name).write(path)
                recording = open_recording(path)
                table = series_epochs(recording, AdjustmentSettings(), "series", jobs=settings.jobs)
                one = measured_series(recording, table, preset)
                # the folder no longer exists when the study is read
                source = f"preset {preset}, series {name}, seed {seed}"
                measured.append(replace(one, source=source))
                advance(1)
        own = replace(settings, f_number=PRESETS[preset].f_number)
        studies.append(study_camera(preset, measured, own))
    return studies


def compare(camera: CameraStudy) -> list[Comparison]:
    """Compare the study of a preset with the figures of the reference."""
    quoted, mc, series = QUOTED[camera.label], camera.montecarlo, camera.series
    if mc is None:
        return []
    # changes of the interior orientation
    changes = [one.deviations for one in series]
    pitch = series[0].series.sensor.pixel_pitch
    px = np.mean([np.hypot(d["x0"].change, d["y0"].change) / pitch for d in changes])
    # direction of the principal point's largest shift, degrees from right towards up
    paths = [one.series.path_px for one in series]
    steps = [path[int(np.argmax(np.linalg.norm(path, axis=1)))] for path in paths]
    right, up = np.mean(steps, axis=0)
    where = float(np.degrees(np.arctan2(up, right)))
    c = np.mean([d["c"].change for d in changes])
    rows = [
        *_about("principal point, last − first", "px", quoted.moved_px, px, 0.5),
        ("principal point, direction", "°", quoted.direction, where,
         *_DIRECTIONS[quoted.direction]),
        *_about("principal distance, last − first", "mm", quoted.c_mm, c, 0.0005),
    ]  # fmt: skip
    focus = [abs(one.focus.change) for one in series if one.focus is not None]
    if focus:
        rows += _about("depth of field at 1 m, change", "mm", quoted.focus_mm, np.mean(focus), 1.0)
    ratio = max(one.series.sigma0.max() / one.series.sigma0[0] for one in series)
    rows += _about("σ₀ at its highest over the first", "", quoted.sigma0_ratio, ratio, 0.35)
    rows += _statistics(quoted, camera)
    # the classes of Table 7 that the text mentions, means and maxima
    percent = (100 * mc.fractions).tolist()
    rows += _about("errors below 1.5 cm at 10 m", "%", quoted.below, percent[0], 3.0)
    if quoted.far == "likely":
        rows.append(("errors of 5 to 10 cm", "%", "likely", percent[2], _LIKELY, np.inf))
    elif quoted.far == "unlikely":
        beyond = percent[2] + percent[3]
        rows.append(("errors above 5 cm", "%", "unlikely", beyond, -np.inf, _UNLIKELY))
    rows.append(("errors above 10 cm", "%", "hardly ever", percent[3], -np.inf, _UNLIKELY))
    rows += _about("mean error at 10 m", "cm", quoted.mean_cm, mc.overall_mean / 10, 0.1)
    largest, bound = mc.mean_largest / 10, 0.15 * quoted.maxima_cm
    rows += _about("mean of the maximum errors", "cm", quoted.maxima_cm, largest, bound)
    return [Comparison(camera.label, *row) for row in rows]


def _statistics(quoted: Quoted, camera: CameraStudy) -> list[_Row]:
    """Return the rows of the correlations and of the F-test."""
    rows: list[_Row] = []
    absolute = [
        {name: abs(d.r) for name, d in one.channels[0].dependences.items()} for one in camera.series
    ]
    for name in ("c", "x0", "y0"):
        least = min(r[name] for r in absolute)
        rows.append((f"|r| of {name} with the temperature", "", "nearly 1", least, _CLOSE, np.inf))
    if quoted.B_follows is not None:
        largest = float(np.mean([max(r["B1"], r["B2"]) for r in absolute]))
        quantity = "largest |r| of B1, B2 with the temperature"
        rows.append((quantity, "", "strong", largest, _STRONG, np.inf))
    text, low, high = ("high", _STRONG, 1.0) if quoted.sigma0_follows else ("not high", 0.0, _WEAK)
    sigma0 = float(np.mean([r["sigma0"] for r in absolute]))
    rows.append(("|r| of σ₀ with the temperature", "", text, sigma0, low, high))
    if quoted.opposed is not None:
        r = float(camera.over_time[1, 2])
        rows.append(("r of x0 with y0 over time", "", "near −1", r, -1.0, -_CLOSE))
    for name in ("c", "x0", "y0"):
        share = float(np.mean([one.significance[name].success_ratio for one in camera.series]))
        rows.append((f"F-test of {name}, success ratio", "", "near 1", share, 0.9, np.inf))
    return rows


def _about(
    quantity: str, unit: str, quote: float | None, ours: np.floating | float, bound: float
) -> list[_Row]:
    """Return the row of a quoted figure, [] if not quoted; bound: how far ours may differ."""
    if quote is None:
        return []
    return [(quantity, unit, f"{quote:g}", float(ours), quote - bound, quote + bound)]
