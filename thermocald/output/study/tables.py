"""The tables of a study's report: headings and cells as text, ready to copy."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

from thermocald.numbers import (
    UNITS,
    coefficient,
    distinct_names,
    duration,
    p_text,
    parameter_label,
    percent,
    plain,
    rounded,
    with_sd,
)
from thermocald.output.study.figures import cluster_names
from thermocald.report import Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.analysis.study.measured import StudySettings
    from thermocald.analysis.study.study import CameraStudy, Deviation, SeriesStudy
    from thermocald.arrays import Array

_Found = TypeVar("_Found")
_NAME_LETTERS = 18  # as in legends
_FIXED = {"first": "first epoch", "mean": "mean", "last": "last epoch"}


def overview_table(camera: CameraStudy) -> Table:
    """Return the table of the measured series."""

    def temperatures(study: SeriesStudy) -> str:
        reference = study.series.reference
        t = study.deviations.get(reference.name) if reference else None
        return f"{t.first:.1f} to {t.last:.1f} °C, range {t.range:.1f} K" if t else "–"

    def epochs(study: SeriesStudy) -> str:
        lost, count = sum(study.series.without_result.values()), len(study.series)
        return f"{count} of {count + lost}" if lost else str(count)

    def noise(study: SeriesStudy) -> str:
        ratio = f"{study.noise_ratio:.2f}" if np.isfinite(study.noise_ratio) else "–"
        return f"{study.series.rms_sigma0:.2f}; {ratio}"

    return Table.of(
        "Series",
        camera.series,
        {
            "series": lambda s: s.series.name,
            "camera": lambda s: s.series.camera,
            "epochs": epochs,
            "duration": lambda s: duration(float(s.series.time_s[-1] - s.series.time_s[0])),
            "interval": lambda s: f"{s.series.interval_s:.1f} s" if len(s.series) > 1 else "–",
            "temperature": temperatures,
            "σ₀; noise / stated": noise,
            "estimated": lambda s: ", ".join(map(parameter_label, s.series.free)) or "nothing",
            "exterior orientation": lambda s: s.series.exterior.replace("_", " "),
        },
        "Temperature: first to last epoch, and its range. σ₀ is that of the adjustments, against "
        "the stated standard deviations of the image points; noise / stated is the scatter between "
        "neighbouring epochs over the stated standard deviations of the parameters.",
    )


def _by_parameter(
    found: Sequence[tuple[SeriesStudy, Mapping[str, _Found]]],
) -> list[tuple[str, SeriesStudy, _Found, str]]:
    """Return rows (parameter, series, result, the series' short name) in order of parameters."""
    short = distinct_names([study.series.name for study, _ in found], _NAME_LETTERS)
    rows = [
        (name, study, result, label)
        for (study, results), label in zip(found, short, strict=True)
        for name, result in results.items()
    ]
    order = list(dict.fromkeys(name for name, *_ in rows))
    return sorted(rows, key=lambda row: order.index(row[0]))


def deviation_table(camera: CameraStudy) -> Table:
    """Return the table of last minus first epoch (Table 2)."""

    def level(name: str, d: Deviation, value: float) -> str:
        return rounded(value, d.sd_change, UNITS.get(name, "°C"))

    def change(name: str, value: float, sd: float | None = None) -> str:
        # Positions are given in mm, their changes in µm.
        factor, unit = _small_unit(UNITS.get(name, "K"))
        if sd is None:  # the unit stands with the difference: again it would take the columns' room
            return plain(factor * value, digits=3)
        return with_sd(factor * value, factor * sd, unit)

    return Table.of(
        "Deviations, last minus first epoch",
        _by_parameter([(study, study.deviations) for study in camera.series]),
        {
            "parameter": lambda r: parameter_label(r[0]),
            "series": lambda r: r[3],
            "first": lambda r: level(r[0], r[2], r[2].first),
            "last": lambda r: level(r[0], r[2], r[2].last),
            "last − first ± sd": lambda r: change(r[0], r[2].change, r[2].sd_change),
            "in px": lambda r: _in_pixels(r[1], r[0], r[2].change, r[2].sd_change),
            "largest": lambda r: change(r[0], r[2].largest),
            "range": lambda r: change(r[0], r[2].range),
            "sd over time": lambda r: change(r[0], r[2].sd_over_time),
        },
        "The standard deviation alongside a difference is that of the two adjustments (for "
        "temperatures: of the two readings). Largest is the greatest departure from the first "
        "epoch, range the largest minus the smallest value, noise included; sd over "
        "time is what the simulation below draws from. These three have the difference's unit.",
    )


def _small_unit(unit: str) -> tuple[float, str]:
    """Return the factor to the unit in which changes are given, and that unit."""
    return (1000.0, "µm") if unit == "mm" else (1.0, unit)


def _in_pixels(study: SeriesStudy, name: str, value: float, sd: float) -> str:
    """Return a change of c, x0 or y0 in px, "" for other parameters."""
    pitch = study.series.sensor.pixel_pitch
    return with_sd(value / pitch, sd / pitch) if name in ("c", "x0", "y0") else ""


def significance_table(camera: CameraStudy, settings: StudySettings) -> Table:
    """Return the success ratios of the F-test and the p-values of the series (Tables 4 and 5)."""
    return Table.of(
        "Is the variation greater than the uncertainty?",
        _by_parameter([(study, study.significance) for study in camera.series]),
        {
            "parameter": lambda r: parameter_label(r[0]),
            "series": lambda r: r[3],
            "success ratio": lambda r: percent(r[2].success_ratio),
            "median variance ratio": lambda r: plain(r[2].median_ratio, digits=3),
            "limit": lambda r: f"{r[2].critical:.3f}",
            "degrees of freedom": lambda r: f"{r[2].degrees_variance}; {r[2].degrees_sd:.0f}",
            "epochs tested (left out)": lambda r: f"{r[2].tests} ({r[2].left_out})",
            "p, no drift": lambda r: p_text(r[2].drift.p_holm) if r[2].drift else "–",
            "p, within sds": lambda r: p_text(r[2].drift.p_excess_holm) if r[2].drift else "–",
            "noise / stated": lambda r: (
                with_sd(r[2].drift.noise_ratio, r[2].drift.sd_noise_ratio) if r[2].drift else "–"
            ),
        },
        f"F-test at each epoch: variance of {settings.window} consecutive epochs against the "
        f"mean of their squared standard deviations, one-sided at α = {settings.alpha:g}. "
        f"Neighbouring windows have {settings.window - 1} of {settings.window} epochs in common, "
        "so the success ratio is not a probability. For a parameter without drift, about α of the "
        "epochs succeed by chance, and more if its noise exceeds the stated standard deviations or "
        "is correlated in time. The p-values are for the whole series and corrected for the number "
        "of parameters (Holm). Hypothesis of no drift: the slow changes are noise of any size and "
        "correlation in time. Within sds: all variation is noise of the stated standard "
        "deviations, with any correlation in time. Noise / stated: scatter between neighbouring "
        "epochs over the stated standard deviation, 1 if they agree.",
    )


def dependence_tables(camera: CameraStudy) -> list[Table]:
    """Return the table of correlation and slope on each thermometer (reference, section 4.3)."""

    def slope(name: str, value: float, sd: float) -> str:
        factor, unit = _small_unit(UNITS[name])
        return with_sd(factor * value, factor * sd, f"{unit or 1}/K")

    found = [(s, c) for s in camera.series for c in s.channels if c.dependences]
    tables = []
    for name in dict.fromkeys(c.thermometer.name for _, c in found):
        channels = [(s, c) for s, c in found if c.thermometer.name == name]
        sds = [f"{plain(c.thermometer.sd, 'K', 2)} in {s.series.name}" for s, c in channels]
        table = Table.of(
            f"Dependence on {parameter_label(name)}",
            _by_parameter([(s, c.dependences) for s, c in channels]),
            {
                "parameter": lambda r: parameter_label(r[0]),
                "series": lambda r: r[3],
                "r": lambda r: coefficient(r[2].r),
                "n": lambda r: f"{r[2].n}",
                "n effective": lambda r: f"{r[2].n_effective:.0f}",
                "p naive": lambda r: p_text(r[2].p_naive_holm),
                "p": lambda r: p_text(r[2].p_holm),
                "slope ± sd": lambda r: slope(r[0], r[2].slope, r[2].sd_slope),
                "px/K": lambda r: _in_pixels(r[1], r[0], r[2].slope, r[2].sd_slope),
                "scatter / noise": lambda r: f"{r[2].misfit:.1f}",
            },
            "r: Pearson's correlation. p naive treats every epoch as independent; p is valid for "
            "noise correlated in time; both are corrected for the number of parameters (Holm). n "
            "effective: number of independent epochs with the same information. The slope takes "
            f"the thermometer's noise ({', '.join(sds)}) into account, its sd the correlation of "
            "the noise. Scatter / noise above 1: the straight line does not explain all changes.",
        )
        tables.append(table)
    return tables


def object_space_tables(camera: CameraStudy) -> list[Table]:
    """Return the table of fractions, means and maxima of the errors (Table 7), also along the
    camera's own path, and the table of errors per grid point (Figure 11).
    """
    mc = camera.montecarlo
    if mc is None:
        return []
    first = mc.first_order

    def row(label: str, fractions: Array, mean: float, largest: float) -> tuple[str, ...]:
        shown = [percent(float(v), 1) for v in fractions]
        return (label, *shown, plain(mean / 10, "cm", 3), plain(largest / 10, "cm", 2))

    linear = np.maximum(first.fractions, 0.0)
    clusters = Table(
        f"Errors on a plane at {mc.distance_mm / 1000:g} m",
        ("", *cluster_names(mc.clusters_mm), "mean", "mean of maxima"),
        (
            row("simulated", mc.fractions, mc.overall_mean, mc.mean_largest),
            row("first order", linear, first.mean.mean(), first.expected_largest.mean()),
            *(
                row(f"own path, {_FIXED[t.reference]} fixed", t.fractions, t.mean, t.mean_largest)
                for t in camera.trajectories
            ),
        ),
        f"{mc.sets:,} sets of interior orientation, seed {mc.seed}, {len(mc.image_points)} image "
        "points. First order is the analytic propagation of the same covariance: where it differs "
        "from the simulation, linear error propagation fails. The mean of maxima depends on the "
        "number of sets and, by some per cent, on the seed. The draws are normal about the series' "
        "mean, with the correlations of the adjustments. Own path: the measured epochs against one "
        "interior orientation that is held fixed.",
    )
    values, vectors = np.linalg.eigh(mc.covariance)  # the longer axis is the last
    axes = np.sqrt(np.maximum(values, 0.0)) / 10
    direction = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])) % 180
    used = max(mc.sets - mc.folded, 1)
    chance = float(np.sqrt(np.trace(mc.covariance, axis1=1, axis2=2).mean() / used))
    points = Table.of(
        "Errors by image point",
        range(len(mc.image_points)),
        {
            "image point px": lambda k: "{:.0f}, {:.0f}".format(*mc.image_points[k]),
            "mean cm": lambda k: plain(mc.mean[k] / 10, "", 3),
            "mean cm, first order": lambda k: plain(first.mean[k] / 10, "", 3),
            "largest cm": lambda k: plain(mc.largest[k] / 10, "", 2),
            "largest cm, first order": lambda k: plain(first.expected_largest[k] / 10, "", 2),
            "ellipse sd cm": lambda k: f"{plain(axes[k, 1], '', 2)} × {plain(axes[k, 0], '', 2)}",
            "direction": lambda k: f"{direction[k]:.0f}°",
            "bias mm": lambda k: f"{np.linalg.norm(mc.mean_error[k]):.2f}",
        },
        "Direction: of the longer axis, from X (right) towards Y (up) as the camera sees them. "
        "Bias: length of the mean error vector, an effect of second order; chance alone gives "
        f"about {plain(chance, 'mm', 1)}.",
    )
    return [clusters, points]
