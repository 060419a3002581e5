"""The outcome of a study in a few sentences, for readers who stop there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.output.figures.numbers import (
    coefficient,
    duration,
    parameter_label,
    percent,
    plain,
)
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from thermocald.analysis.study.deviations import Deviation
    from thermocald.analysis.study.series_study import SeriesStudy
    from thermocald.analysis.study.study import CameraStudy

__all__ = ["summary"]

_CLOSE = 0.9
_TOGETHER = 0.9
_NOISE_AGREES = 1.15
_FIXED = {
    "first": "with that of the first epoch",
    "mean": "with the mean",
    "last": "with that of the last epoch",
}


def summary(camera: CameraStudy) -> list[str]:
    """Sentences; none that the data do not support."""
    sentences = [s for study in camera.series if (s := _change(study))]
    sentences += [s for study in camera.series if (s := _dependence(study))]
    sentences += [s for study in camera.series if (s := _noise(study))]
    mc = camera.montecarlo
    if mc is not None:
        sentences.append(
            f"In object space, at {mc.distance_mm / 1000:g} m, interior orientations drawn from "
            "independent normal distributions about the series' mean (the reference's procedure) "
            f"make errors of {mc.overall_mean / 10:.2f} cm on average and up to "
            f"{mc.mean_largest / 10:.1f} cm (mean of the largest of {mc.sets:,} draws); "
            f"{percent(float(mc.fractions[0]))} stay below {mc.clusters_mm[0] / 10:g} cm."
        )
        sentences += _trajectory(camera, mc.clusters_mm[0])
    return sentences


def _trajectory(camera: CameraStudy, limit_mm: float) -> list[str]:
    """The camera's own path alongside the draws, and what the draws leave out."""
    if not camera.trajectories:
        return []
    parts = [
        f"{percent(float(one.fractions[0]))} {_FIXED[one.reference]}" for one in camera.trajectories
    ]
    text = (
        f"The camera itself, along its own path, stays below {limit_mm / 10:g} cm in "
        f"{', '.join(parts[:-1])} and {parts[-1]} as the fixed interior orientation."
    )
    strong = []
    for i, j in ((1, 2), (0, 1), (0, 2)):
        over_time = float(camera.over_time[i, j])
        if not abs(over_time) >= _TOGETHER:
            continue
        words = f"{parameter_label(IOP_NAMES[i])} and {parameter_label(IOP_NAMES[j])}"
        strong.append(f"{words} {coefficient(over_time)}")
    if strong and camera.correlations is not None:
        drawn = coefficient(float(camera.correlations.median[1, 2]))
        text += (
            f" Over time its parameters move together (r of {', '.join(strong)}), which the draws "
            f"leave out (r of x₀ and y₀ in the draws: {drawn})."
        )
    return [text]


def _change(study: SeriesStudy) -> str:
    s, d = study.series, study.deviations
    if not d or len(s) < 2:
        return ""
    words = []
    if "x0" in d and "y0" in d:
        pitch = s.sensor.pixel_pitch
        way = np.hypot(*((s.values[:, k] - s.values[0, k]) / pitch for k in (1, 2)))
        moved, farthest = float(way[-1]), float(way.max())
        sd = float(np.hypot(d["x0"].sd_change, d["y0"].sd_change)) / pitch
        if farthest > max(1.5 * moved, 6 * sd):
            words.append(
                f"the principal point moved by up to {plain(farthest, 'px', 3)} and ended "
                f"{plain(moved, 'px', 3)} from where it started"
            )
        elif moved > 3 * sd:
            words.append(f"the principal point moved by {plain(moved, 'px', 3)}")
        else:
            words.append(f"the principal point stayed within {plain(3 * sd, 'px', 2)}")
    if "c" in d:
        words.append(_distance(d["c"]))
    if not words:
        return ""
    time = duration(float(s.time_s[-1] - s.time_s[0]))
    return f"{s.name}: in {time} {' and '.join(words)}{_warmed(study)}."


def _distance(c: Deviation) -> str:
    """What the principal distance did."""
    if c.returned:
        grew = "grew" if c.largest > 0 else "shrank"
        ended = "where it started" if abs(c.change) < 3 * c.sd_change else (
            f"{plain(1000 * abs(c.change), 'µm', 2)} {'longer' if c.change > 0 else 'shorter'}"
        )  # fmt: skip
        return (
            f"the principal distance {grew} by up to {plain(1000 * abs(c.largest), 'µm', 2)} and "
            f"ended {ended}"
        )
    if abs(c.change) > 3 * c.sd_change:
        grew = "grew" if c.change > 0 else "shrank"
        return f"the principal distance {grew} by {plain(1000 * abs(c.change), 'µm', 2)}"
    return "the principal distance did not change beyond its uncertainty"


def _warmed(study: SeriesStudy) -> str:
    """What the reference temperature did meanwhile."""
    reference = study.series.reference
    if reference is None or reference.name not in study.deviations:
        return ""
    d = study.deviations[reference.name]
    name = parameter_label(reference.name)
    if d.returned:
        rose = "rose" if d.largest > 0 else "fell"
        return (
            f" while {name} {rose} by up to {plain(abs(d.largest), 'K', 3)} (range "
            f"{plain(d.range, 'K', 3)}) and ended {plain(d.change, 'K', 3)} from where it started"
        )
    return f" while {name} changed by {plain(d.change, 'K', 3)}"


def _noise(study: SeriesStudy) -> str:
    """Where the noise found is another than the stated one."""
    ratio = study.noise_ratio
    if not np.isfinite(ratio) or 1 / _NOISE_AGREES <= ratio <= _NOISE_AGREES:
        return ""
    sigma0 = float(np.sqrt(np.mean(np.square(study.series.sigma0))))
    return (
        f"{study.series.name}: neighbouring epochs scatter {ratio:.2f} times as much as the "
        f"standard deviations state (σ₀ {sigma0:.2f})."
    )


def _dependence(study: SeriesStudy) -> str:
    channel = next((c for c in study.channels if c.dependences), None)
    if channel is None:
        return ""
    close = [parameter_label(n) for n, d in channel.dependences.items() if abs(d.r) >= _CLOSE]
    significant = [parameter_label(n) for n, p in channel.p_holm.items() if p < 0.05]
    name = parameter_label(channel.thermometer.name)
    if not significant:
        return f"{study.series.name}: no parameter depends significantly on {name}."
    text = f"{study.series.name}: {', '.join(significant)} depend significantly on {name}"
    return text + (f", {', '.join(close)} closely (|r| ≥ {_CLOSE})." if close else ".")
