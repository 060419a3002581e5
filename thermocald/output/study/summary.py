"""The outcome of a study in a few sentences, for readers who stop there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.output.figures.numbers import parameter_label, percent, plain

if TYPE_CHECKING:
    from thermocald.analysis.study.series_study import SeriesStudy
    from thermocald.analysis.study.study import CameraStudy

__all__ = ["summary"]

_CLOSE = 0.9


def summary(camera: CameraStudy) -> list[str]:
    """Sentences; none is said that the data do not carry."""
    sentences = [s for study in camera.series if (s := _change(study))]
    sentences += [s for study in camera.series if (s := _dependence(study))]
    mc = camera.montecarlo
    if mc is not None:
        sentences.append(
            f"In object space, at {mc.distance_mm / 1000:g} m, that means errors of "
            f"{mc.overall_mean / 10:.2f} cm on average and up to {mc.mean_largest / 10:.1f} cm "
            f"(mean of the largest of {mc.sets:,} draws); {percent(float(mc.shares[0]))} stay "
            f"below {mc.clusters_mm[0] / 10:g} cm."
        )
    return sentences


def _change(study: SeriesStudy) -> str:
    s, d = study.series, study.deviations
    if not d or len(s) < 2:
        return ""
    minutes = (s.time_s[-1] - s.time_s[0]) / 60
    words = []
    if "x0" in d and "y0" in d:
        pitch = s.sensor.pixel_pitch
        way = np.hypot(*((s.values[:, k] - s.values[0, k]) / pitch for k in (1, 2)))
        moved, farthest = float(way[-1]), float(way.max())
        sd = float(np.hypot(d["x0"].sd_change, d["y0"].sd_change)) / pitch
        if farthest > max(1.5 * moved, 6 * sd):
            words.append(
                f"the principal point moved by up to {plain(farthest, 'px', 3)} and ended "
                f"{plain(moved, 'px', 3)} from where it began"
            )
        elif moved > 3 * sd:
            words.append(f"the principal point moved by {plain(moved, 'px', 3)}")
        else:
            words.append(f"the principal point stayed within {plain(3 * sd, 'px', 2)}")
    if "c" in d:
        c = d["c"]
        if abs(c.change) > 3 * c.sd_change:
            grew = "grew" if c.change > 0 else "shrank"
            words.append(f"the principal distance {grew} by {plain(1000 * abs(c.change), 'µm', 2)}")
        else:
            words.append("the principal distance did not change beyond its uncertainty")
    reference = s.reference
    warmed = ""
    if reference is not None and reference.name in d:
        change = d[reference.name].change
        warmed = f" while {reference.name.replace('_', ' ')} changed by {plain(change, 'K', 3)}"
    if not words:
        return ""
    return f"{s.name}: in {minutes:.0f} minutes {' and '.join(words)}{warmed}."


def _dependence(study: SeriesStudy) -> str:
    channel = next((c for c in study.channels if c.dependences), None)
    if channel is None:
        return ""
    close = [parameter_label(n) for n, d in channel.dependences.items() if abs(d.r) >= _CLOSE]
    significant = [parameter_label(n) for n, p in channel.p_holm.items() if p < 0.05]
    name = channel.thermometer.name.replace("_", " ")
    if not significant:
        return f"{study.series.name}: no parameter depends significantly on {name}."
    text = f"{study.series.name}: {', '.join(significant)} depend significantly on {name}"
    return text + (f", {', '.join(close)} closely (|r| ≥ {_CLOSE})." if close else ".")
