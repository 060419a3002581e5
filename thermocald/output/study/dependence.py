"""How the parameters depend on the temperature: the figure and the tables of the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.output.figures.numbers import (
    UNITS,
    coefficient,
    p_text,
    parameter_label,
    plain,
    with_sd,
)
from thermocald.output.figures.panels import PALETTE, Curve, Figure, Panel
from thermocald.output.study.figures import extent, free_parameters, scaled
from thermocald.output.study.tables import Table
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from thermocald.analysis.study.series_study import ChannelStudy, SeriesStudy
    from thermocald.analysis.study.study import CameraStudy

__all__ = ["dependence_figure", "dependence_tables"]


def dependence_figure(camera: CameraStudy) -> Figure | None:
    """Parameters over the reference temperature with the fitted lines (Figure 7)."""
    panels, words = [], []
    for name in [*free_parameters(camera), "sigma0"]:
        curves = []
        scale, label = 1.0, ""
        if name != "sigma0":
            scale, label = scaled(UNITS[name], extent(camera, IOP_NAMES.index(name)))
        for i, study in enumerate(camera.series):
            if not study.channels or name not in study.channels[0].dependences:
                continue
            curves += _dependence_curves(study, name, scale, PALETTE[i % 7])
        if curves:
            reference = camera.series[0].channels[0].thermometer.name
            delta = "" if name == "sigma0" else "Δ"
            panels.append(
                Panel(
                    parameter_label(name),
                    f"{parameter_label(reference)} in °C",
                    f"{delta}{parameter_label(name)}{label}",
                    tuple(curves),
                )
            )
            r = [
                s.channels[0].dependences[name].r
                for s in camera.series
                if s.channels and name in s.channels[0].dependences
            ]
            if min(abs(v) for v in r) >= 0.9:
                words.append(parameter_label(name))
    if not panels:
        return None
    follow = (
        f" {', '.join(words)} follow{'s' if len(words) == 1 else ''} it closely (|r| ≥ 0.9)."
        if words
        else " No parameter follows it closely (|r| ≥ 0.9)."
    )
    return Figure(
        "temperature-dependence",
        "Dependence on the temperature",
        "Each parameter against the reference temperature, with the straight line that counts the "
        "noise of both." + follow,
        tuple(panels),
    )


def _dependence_curves(study: SeriesStudy, name: str, scale: float, colour: str) -> list[Curve]:
    s = study.series
    temperature = s.thermometers[0].values
    if name == "sigma0":
        value = s.sigma0
    else:
        column = s.values[:, IOP_NAMES.index(name)]
        value = scale * (column - column[0])
    rows = np.flatnonzero(np.isfinite(temperature))
    t, v = temperature[rows], value[rows]
    ends = np.array([t.min(), t.max()])
    slope = scale * study.channels[0].dependences[name].slope
    shown = np.unique(np.linspace(0, len(t) - 1, min(len(t), 400)).astype(int))
    return [
        Curve(s.name, t[shown], v[shown], "points", colour),
        Curve("", ends, v.mean() + slope * (ends - t.mean()), "line", colour),
    ]


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
