"""The tables of a study's report: headings and cells as text, ready to be copied."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from thermocald.numbers import (
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
from thermocald.report import Table

if TYPE_CHECKING:
    from thermocald.analysis.study.deviations import Deviation
    from thermocald.analysis.study.series_study import (
        ChannelStudy,
        SeriesStudy,
        Significance,
        StudySettings,
    )
    from thermocald.analysis.study.study import CameraStudy

_FIXED = {"first": "first epoch", "mean": "mean", "last": "last epoch"}


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


def dependence_tables(camera: CameraStudy) -> list[Table]:
    """Correlation and slope on each thermometer (the reference's section 4.3)."""
    return [
        _dependence_table(study, channel)
        for study in camera.series
        for channel in study.channels
        if channel.dependences
    ]


def _dependence_table(study: SeriesStudy, channel: ChannelStudy) -> Table:
    rows = []
    for name, d in channel.dependences.items():
        k, unit = (1000.0, "µm") if UNITS[name] == "mm" else (1.0, UNITS[name])
        pitch = study.series.sensor.pixel_pitch
        in_px = with_sd(d.slope / pitch, d.sd_slope / pitch) if name in ("c", "x0", "y0") else ""
        rows.append(
            (
                parameter_label(name),
                coefficient(d.r),
                f"{d.n}",
                f"{d.n_effective:.0f}",
                p_text(channel.p_naive_holm[name]),
                p_text(channel.p_holm[name]),
                with_sd(k * d.slope, k * d.sd_slope, f"{unit}/K" if unit else "1/K"),
                in_px,
                f"{d.misfit:.1f}",
            )
        )
    t = channel.thermometer
    return Table(
        f"Dependence on {parameter_label(t.name)}, {study.series.name}",
        (
            "parameter",
            "r",
            "n",
            "n effective",
            "p naive",
            "p",
            "slope ± sd",
            "px/K",
            "scatter / noise",
        ),
        tuple(rows),
        f"r: Pearson's correlation. p naive counts every epoch as independent; p holds whatever "
        "the memory of the noise; both are corrected for the number of parameters (Holm). n "
        "effective: independent epochs that the series is worth. The slope counts the "
        f"thermometer's noise of {plain(t.sd, 'K', 2)}, its sd the memory of the noise. "
        "Scatter / noise above 1: the straight line does not explain all.",
    )


def cluster_table(camera: CameraStudy) -> Table | None:
    """Fractions of the errors, means, maxima (Table 7), and of the camera's own path."""
    mc, first = camera.montecarlo, camera.first_order
    if mc is None or first is None:
        return None
    cm = [limit / 10 for limit in mc.clusters_mm]
    names = [f"< {cm[0]:g} cm"]
    names += [f"{a:g}–{b:g} cm" for a, b in pairwise(cm)]
    names.append(f"> {cm[-1]:g} cm")

    def row(label: str, fractions: object, mean: float, largest: float) -> tuple[str, ...]:
        shown = [percent(float(v), 1) for v in np.asarray(fractions, dtype=float)]
        return (label, *shown, f"{mean / 10:.2f} cm", f"{largest / 10:.1f} cm")

    return Table(
        f"Errors on a plane at {mc.distance_mm / 1000:g} m",
        ("", *names, "mean", "mean of maxima"),
        (
            row("simulated", mc.fractions, mc.overall_mean, mc.mean_largest),
            row(
                "first order",
                np.maximum(first.fractions, 0.0),
                float(first.mean.mean()),
                float(first.expected_largest.mean()),
            ),
            *(
                row(f"own path, {_FIXED[t.reference]} fixed", t.fractions, t.mean, t.mean_largest)
                for t in camera.trajectories
            ),
        ),
        f"{mc.sets:,} sets of interior orientation, seed {mc.seed}, {len(mc.image_points)} image "
        "points. First order is the analytic propagation of the same covariance: where it differs "
        "from the simulation, linear error propagation fails. The mean of maxima depends on the "
        "number of sets and, by some per cent, on the seed. The draws are normal about the series' "
        "mean, with the correlations of the adjustments; the own path is that of the measured "
        "epochs, against one interior orientation that is held fixed.",
    )


def point_table(camera: CameraStudy) -> Table | None:
    """Errors per grid point (Figure 11)."""
    mc, first = camera.montecarlo, camera.first_order
    if mc is None or first is None:
        return None
    rows = []
    for k, point in enumerate(mc.image_points):
        values, vectors = np.linalg.eigh(mc.covariance[k])
        major = vectors[:, 1]
        angle = float(np.degrees(np.arctan2(major[1], major[0]))) % 180
        rows.append(
            (
                f"{point[0]:.0f}, {point[1]:.0f}",
                f"{mc.mean[k] / 10:.2f}",
                f"{first.mean[k] / 10:.2f}",
                f"{mc.largest[k] / 10:.1f}",
                f"{first.expected_largest[k] / 10:.1f}",
                f"{np.sqrt(values[1]) / 10:.2f} × {np.sqrt(max(values[0], 0.0)) / 10:.2f}",
                f"{angle:.0f}°",
                f"{np.linalg.norm(mc.mean_error[k]):.2f}",
            )
        )
    return Table(
        "Errors by image point",
        (
            "image point px",
            "mean cm",
            "mean cm, first order",
            "largest cm",
            "largest cm, first order",
            "ellipse sd cm",
            "direction",
            "bias mm",
        ),
        tuple(rows),
        "Direction of the longer axis, from X (right) towards Y (up) as the camera looks. "
        "Bias is what the mean error vector keeps: an effect of second order.",
    )
