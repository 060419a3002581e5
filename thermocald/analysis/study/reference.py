"""The reference's figures beside ours: the presets, simulated, adjusted, and studied.

Numbers are quoted from section 4 of Elias, Eltner, Liebold and Maas (2020), Sensors 20, 643. The
presets put in what the reference reports of the drift (principal point, principal distance, σ₀);
what comes out at the other end, errors in object space, correlations, significance, is computed.
Two series per camera, as there.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.study.input import from_recording
from thermocald.analysis.study.study import StudySettings, study_camera
from thermocald.simulation.presets import PRESETS, preset_simulation
from thermocald.store.recording.reader import open_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.analysis.study.measured import MeasuredSeries
    from thermocald.analysis.study.study import CameraStudy

__all__ = ["Comparison", "Quoted", "compare", "reference_series", "reference_studies"]

SERIES = (("M1", 1), ("M2", 2))
"""Names and seeds of the two series of each camera."""


@dataclass(frozen=True, slots=True)
class Quoted:
    """What the reference says of a camera; None where its text does not.

    share: of errors below 1.5 cm; mean_cm, maxima_cm: mean error and mean of the nine maxima;
    moved_px, c_mm: principal point and distance; focus_mm: depth of field at 1 m; sigma0_ratio: at
    the highest temperature over the first.
    """

    share: float | None
    mean_cm: float
    maxima_cm: float
    moved_px: float | None = None
    c_mm: float | None = None
    focus_mm: float | None = None
    sigma0_ratio: float | None = None


QUOTED = {
    "nexus5-cold": Quoted(0.67, 1.3, 6.2, 16.0, 0.007, 5.0),
    "nexus5-warm": Quoted(0.98, 0.6, 2.9, 8.0, 0.003, 3.0),
    "galaxy-s8-cold": Quoted(0.20, 3.0, 12.9, 40.0, 0.007, 3.0),
    "galaxy-s8-warm": Quoted(0.93, 0.8, 3.5, 11.0, 0.003, 2.0),
    "rpi-v2.1-heating": Quoted(None, 1.1, 4.5, sigma0_ratio=3.5),
}
"""By preset."""

_CLOSE = 0.98


@dataclass(frozen=True, slots=True)
class Comparison:
    """One figure of the reference beside ours; text is how the reference puts it.

    low, high: what counts as reproduced.
    """

    camera: str
    quantity: str
    unit: str
    text: str
    ours: float
    low: float
    high: float

    @property
    def reproduced(self) -> bool:
        """Whether ours lies within the bounds."""
        return self.low <= self.ours <= self.high


def reference_series(
    preset: str, advance: Callable[[int], None] = lambda _: None
) -> list[MeasuredSeries]:
    """Both series of a preset, simulated to a recording, read again, and adjusted."""
    measured = []
    with tempfile.TemporaryDirectory() as folder:
        for name, seed in SERIES:
            path = Path(folder) / name
            preset_simulation(preset, seed, name).write(path)
            one = from_recording(open_recording(path), preset)
            # The folder is gone when the study is read.
            measured.append(replace(one, source=f"preset {preset}, series {name}, seed {seed}"))
            advance(1)
    return measured


def reference_studies(
    settings: StudySettings | None = None,
    presets: Sequence[str] = tuple(QUOTED),
    advance: Callable[[int], None] = lambda _: None,
) -> list[CameraStudy]:
    """The study of every preset; the f-number is each camera's own."""
    base = settings or StudySettings()
    return [
        study_camera(
            preset,
            reference_series(preset, advance),
            replace(base, f_number=PRESETS[preset].f_number),
        )
        for preset in presets
    ]


def compare(camera: CameraStudy) -> list[Comparison]:
    """What the reference says of this preset, and what the study found."""
    quoted = QUOTED[camera.label]
    mc = camera.montecarlo
    if mc is None:
        return []
    found: list[Comparison] = []

    def add(
        quantity: str, unit: str, text: str, ours: float, low: float, high: float = np.inf
    ) -> None:
        found.append(Comparison(camera.label, quantity, unit, text, float(ours), low, high))

    def about(quantity: str, unit: str, quote: float | None, ours: float, bound: float) -> None:
        if quote is not None:
            add(quantity, unit, f"{quote:g}", ours, quote - bound, quote + bound)

    deviations = [study.deviations for study in camera.series]
    pitch = camera.series[0].series.sensor.pixel_pitch
    moved = [np.hypot(d["x0"].change, d["y0"].change) / pitch for d in deviations]
    about("principal point, last − first", "px", quoted.moved_px, float(np.mean(moved)), 0.5)
    changes = [d["c"].change for d in deviations]
    about("principal distance, last − first", "mm", quoted.c_mm, float(np.mean(changes)), 0.0005)
    focus = [abs(s.focus.change) for s in camera.series if s.focus is not None]
    about("depth of field at 1 m, change", "mm", quoted.focus_mm, float(np.mean(focus)), 1.0)
    ratios = [float(s.series.sigma0.max() / s.series.sigma0[0]) for s in camera.series]
    if quoted.sigma0_ratio is not None:
        about("σ₀ at its highest over the first", "", quoted.sigma0_ratio, max(ratios), 0.35)
    for name in ("c", "x0", "y0"):
        r = [abs(s.channels[0].dependences[name].r) for s in camera.series]
        add(f"|r| of {name} with the temperature", "", "nearly 1", min(r), _CLOSE)
    for name in ("c", "x0", "y0"):
        ratio = [s.significance[name].success_ratio for s in camera.series]
        add(f"F-test of {name}, success ratio", "", "near 1", float(np.mean(ratio)), 0.9)
    if quoted.share is not None:
        about("errors below 1.5 cm at 10 m", "%", 100 * quoted.share, 100 * mc.shares[0], 3.0)
    about("mean error at 10 m", "cm", quoted.mean_cm, mc.overall_mean / 10, 0.1)
    about(
        "mean of the maximum errors", "cm", quoted.maxima_cm, mc.mean_largest / 10,
        0.15 * quoted.maxima_cm,
    )  # fmt: skip
    return found
