"""The tables of a study's report: headings and cells as text, ready to be copied."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.output.figures.numbers import (
    UNITS,
    coefficient,
    duration,
    p_text,
    parameter_label,
    percent,
    plain,
    rounded,
    with_sd,
)
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from thermocald.analysis.study.deviations import Deviation
    from thermocald.analysis.study.series_study import (
        SeriesStudy,
        Significance,
        StudySettings,
    )
    from thermocald.analysis.study.study import CameraStudy

__all__ = [
    "Table",
    "correlation_noise_table",
    "deviation_table",
    "focus_table",
    "overview_table",
    "significance_table",
]


@dataclass(frozen=True, slots=True)
class Table:
    """Headings and rows of text; note: what the columns mean."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def overview_table(camera: CameraStudy) -> Table:
    """What was measured."""
    rows = []
    for study in camera.series:
        s = study.series
        lost = sum(s.without_result.values())
        rows.append(
            (
                s.name,
                s.camera,
                f"{s.sensor.width} × {s.sensor.height} px of {s.sensor.pixel_pitch * 1000:g} µm",
                f"{len(s)}" + (f" of {len(s) + lost}" if lost else ""),
                duration(float(s.time_s[-1] - s.time_s[0])),
                f"{s.interval_s:.1f} s" if len(s) > 1 else "–",
                _temperatures(study),
                _noise(study),
                ", ".join(parameter_label(name) for name in s.free),
            )
        )
    return Table(
        "Series",
        (
            "series",
            "camera",
            "sensor",
            "epochs",
            "duration",
            "interval",
            "temperature",
            "σ₀; noise / stated",
            "estimated",
        ),
        tuple(rows),
        "Temperature: first to last epoch, and its range. σ₀ is that of the adjustments, against "
        "the stated standard deviations of the image points; noise / stated is the scatter between "
        "neighbouring epochs over the stated standard deviations of the parameters.",
    )


def _temperatures(study: SeriesStudy) -> str:
    s = study.series
    t = study.deviations.get(s.reference.name) if s.reference else None
    return f"{t.first:.1f} to {t.last:.1f} °C, range {t.range:.1f} K" if t else "–"


def _noise(study: SeriesStudy) -> str:
    sigma0 = float(np.sqrt(np.mean(np.square(study.series.sigma0))))
    ratio = f"{study.noise_ratio:.2f}" if np.isfinite(study.noise_ratio) else "–"
    return f"{sigma0:.2f}; {ratio}"


def deviation_table(camera: CameraStudy) -> Table:
    """Last minus first (Table 2)."""
    names = list(dict.fromkeys(n for study in camera.series for n in study.deviations))
    rows = []
    for name in names:
        for study in camera.series:
            d = study.deviations.get(name)
            if d is None:
                continue
            unit = UNITS.get(name, "K")
            # Positions are given in mm, their changes in µm.
            k, change_unit = (1000.0, "µm") if unit == "mm" else (1.0, unit)
            level_unit = "°C" if unit == "K" else unit
            rows.append(
                (
                    parameter_label(name),
                    study.series.name,
                    rounded(d.first, d.sd_change, level_unit),
                    rounded(d.last, d.sd_change, level_unit),
                    with_sd(k * d.change, k * d.sd_change, change_unit),
                    _in_pixels(name, d, study.series.sensor.pixel_pitch),
                    plain(k * d.largest, change_unit, 3),
                    plain(k * d.range, change_unit, 3),
                    plain(k * d.sd_over_time, change_unit, 3),
                )
            )
    return Table(
        "Deviations, last minus first epoch",
        (
            "parameter",
            "series",
            "first",
            "last",
            "last − first ± sd",
            "in px",
            "largest",
            "range",
            "sd over time",
        ),
        tuple(rows),
        "The standard deviation alongside a difference is that of the two adjustments (for "
        "temperatures: of the two readings). Largest is the greatest departure from the first "
        "epoch, range the largest minus the smallest value, noise included; sd over "
        "time is what the simulation below draws from.",
    )


def _in_pixels(name: str, d: Deviation, pitch: float) -> str:
    return with_sd(d.change / pitch, d.sd_change / pitch) if name in ("c", "x0", "y0") else ""


def focus_table(camera: CameraStudy, settings: StudySettings) -> Table | None:
    """Change of the depth of field."""
    rows = [
        (
            study.series.name,
            f"{f.first.near:.0f} to {plain(f.first.far, digits=4)} mm",
            f"{f.last.near:.0f} to {plain(f.last.far, digits=4)} mm",
            with_sd(f.change, f.sd_change, "mm"),
        )
        for study in camera.series
        if (f := study.focus) is not None
    ]
    if not rows:
        return None
    confusion = next(s.focus.confusion for s in camera.series if s.focus is not None)
    return Table(
        f"Depth of field, focused at {settings.focus_mm / 1000:g} m",
        ("series", "sharp at first", "sharp at last", "change ± sd"),
        tuple(rows),
        f"For f/{settings.f_number:g} and a circle of confusion of {confusion * 1000:.1f} µm, the "
        "principal distance taken as focal length.",
    )


def significance_table(camera: CameraStudy, settings: StudySettings) -> Table | None:
    """Success ratios of the F-test and the p-value of the whole series (Tables 4 and 5)."""
    tested = [study for study in camera.series if study.significance]
    if not tested:
        return None
    rows = []
    for name in IOP_NAMES:
        for study in tested:
            test = study.significance.get(name)
            if test is not None:
                rows.append(
                    (
                        parameter_label(name),
                        study.series.name,
                        percent(test.success_ratio),
                        plain(test.median_ratio, digits=3),
                        f"{test.critical:.3f}",
                        f"{test.degrees_variance}; {test.degrees_sd:.0f}",
                        f"{test.tests} ({test.left_out})",
                        *_drift_cells(test),
                    )
                )
    return Table(
        "Is the variation greater than the uncertainty?",
        (
            "parameter",
            "series",
            "success ratio",
            "median variance ratio",
            "limit",
            "degrees of freedom",
            "epochs tested (left out)",
            "p, no drift",
            "p, within sds",
            "noise / stated",
        ),
        tuple(rows),
        f"F-test at each epoch: variance of {settings.window} consecutive epochs against the "
        f"mean of their squared standard deviations, one-sided at α = {settings.alpha:g}. "
        f"Neighbouring windows have {settings.window - 1} of {settings.window} epochs in common, "
        "so the success ratio is not a probability; of a parameter that does not drift, about α of "
        "the epochs succeed by chance, and more where its noise exceeds the stated standard "
        "deviations or has a memory. The p-values are for the whole series and corrected for the "
        "number of parameters (Holm). No drift: the slow changes are noise, of whatever size and "
        "memory. Within sds: all variation is noise of the stated standard deviations, whatever "
        "its memory. Noise / stated: scatter between neighbouring epochs over the stated standard "
        "deviation, 1 where they agree.",
    )


def _drift_cells(test: Significance) -> tuple[str, str, str]:
    if test.drift is None:
        return ("–", "–", "–")
    noise = with_sd(test.drift.noise_ratio, test.drift.sd_noise_ratio)
    return (p_text(test.p_holm), p_text(test.p_excess_holm), noise)


def correlation_noise_table(camera: CameraStudy) -> Table | None:
    """Noise of the correlation coefficients over the epochs (section 4.3)."""
    if camera.correlations is None:
        return None
    free = [k for k in range(10) if camera.sds[k] > 0]
    median, noise, largest = (
        camera.correlations.median,
        camera.correlations.noise,
        camera.correlations.largest,
    )
    rows = [
        (
            f"{parameter_label(IOP_NAMES[i])}, {parameter_label(IOP_NAMES[j])}",
            coefficient(float(median[i, j])),
            f"{noise[i, j]:.4f}",
            f"{largest[i, j]:.4f}",
        )
        for a, i in enumerate(free)
        for j in free[a + 1 :]
    ]
    return Table(
        "Correlations of the interior orientation",
        ("pair", "median", "noise (sd)", "largest deviation"),
        tuple(rows),
        f"From {camera.correlations.epochs} covariance matrices of the adjustments.",
    )
