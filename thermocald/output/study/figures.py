"""The figures of a study: each with a caption that says in words what it shows for this camera.

Numbered as in the report; the reference's figures (Elias et al. 2020) that they correspond to are
named in docs/explanation/study.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.figures import BAND, PALETTE, Arrows, Curve, Figure, Panel, thin
from thermocald.numbers import UNITS, parameter_label, percent, plain, superscript
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.analysis.study.series_study import SeriesStudy
    from thermocald.analysis.study.study import CameraStudy
    from thermocald.arrays import Array

_DECADES = 30.0
_DRAWN = 400  # errors of a cloud


def deviation_figure(camera: CameraStudy) -> Figure:
    """Every parameter minus its first value over time (the reference's Figures 3 and 5)."""
    panels = [
        _time_panel(camera, parameter_label(name), UNITS[name], IOP_NAMES.index(name))
        for name in free_parameters(camera)
    ]
    panels.append(_sigma0_panel(camera))
    panels += _temperature_panels(camera)
    words = []
    for study in camera.series:
        d = study.deviations
        if "x0" in d and "y0" in d:
            moved = (
                float(np.hypot(d["x0"].change, d["y0"].change)) / study.series.sensor.pixel_pitch
            )
            words.append(f"in {study.series.name} by {plain(moved, 'px', 3)}")
    moved_text = f" The principal point has moved {' and '.join(words)}." if words else ""
    return Figure(
        "deviations",
        "Deviations from the first epoch",
        "Each parameter minus its value in the first epoch. The bands are 95 % of what one epoch's "
        "adjustment leaves uncertain; a line that leaves its band has moved." + moved_text,
        tuple(panels),
    )


def has_course(camera: CameraStudy) -> bool:
    """Whether any series has two epochs, between which a curve could be drawn."""
    return any(len(study.series) > 1 for study in camera.series)


def _time_panel(camera: CameraStudy, title: str, unit: str, k: int) -> Panel:
    scale, label = scaled(unit, extent(camera, k))
    curves = []
    for i, study in enumerate(camera.series):
        s = study.series
        value, band = scale * (s.values[:, k] - s.values[0, k]), scale * BAND * s.sds[:, k]
        t, value, band = thin(s.time_s / 60, value, band)
        curves.append(Curve(s.name, t, value, "band", PALETTE[i % 7], value - band, value + band))
    return Panel(f"Δ{title}", "time in min", f"Δ{title}{label or ' (no unit)'}", tuple(curves))


def extent(camera: CameraStudy, k: int) -> float:
    """How far IOP number k goes over time."""
    return max(float(np.ptp(study.series.values[:, k])) for study in camera.series)


def scaled(unit: str, extent: float) -> tuple[float, str]:
    """A factor that makes numbers of this extent easy to read, and how to label the axis."""
    if unit == "mm":
        return 1000.0, " in µm"
    if not extent > 0 or 0.01 <= extent < 1000:
        return 1.0, f" in {unit}" if unit else ""
    exponent = int(np.floor(np.log10(extent)))
    return 10.0**-exponent, f" in 10{superscript(exponent)} {unit}".rstrip()


def _sigma0_panel(camera: CameraStudy) -> Panel:
    curves = []
    for i, study in enumerate(camera.series):
        s = study.series
        t, ratio = thin(s.time_s / 60, s.sigma0 / s.sigma0[0])
        curves.append(Curve(s.name, t, ratio, "line", PALETTE[i % 7]))
    return Panel("σ₀ / first σ₀", "time in min", "ratio (no unit)", tuple(curves))


def _temperature_panels(camera: CameraStudy) -> list[Panel]:
    by_name: dict[str, list[Curve]] = {}
    for i, study in enumerate(camera.series):
        for t in study.series.thermometers:
            if np.isfinite(t.values).any():
                time_min, values = thin(study.series.time_s / 60, t.values)
                curve = Curve(study.series.name, time_min, values, "line", PALETTE[i % 7])
                by_name.setdefault(t.name, []).append(curve)
    return [
        Panel(parameter_label(name), "time in min", "temperature in °C", tuple(curves))
        for name, curves in by_name.items()
    ]


def principal_point_figure(camera: CameraStudy, name: str = "principal-point") -> Figure | None:
    """The path of the principal point on the sensor (the reference's Figures 4 and 6)."""
    if not {"x0", "y0"} <= set(free_parameters(camera)) or not has_course(camera):
        return None
    curves, words = [], []
    for i, study in enumerate(camera.series):
        s = study.series
        x = (s.values[:, 1] - s.values[0, 1]) / s.sensor.pixel_pitch
        y = (s.values[:, 2] - s.values[0, 2]) / s.sensor.pixel_pitch
        rows = np.unique(np.linspace(0, len(s) - 1, min(len(s), 600)).astype(int))
        curves.append(Curve(s.name, x[rows], y[rows], "line", PALETTE[i % 7]))
        curves.append(Curve("", x[:1], y[:1], "points", "#000000"))
        words.append(f"{s.name}: {_direction(float(x[-1]), float(y[-1]))}")
        farthest = float(np.max(np.hypot(x, y)))
        if farthest > 1.5 * np.hypot(x[-1], y[-1]):
            words[-1] += f" in the end, {plain(farthest, 'px', 3)} away at most"
    panel = Panel(
        "Path of the principal point",
        "Δx₀ in px, right",
        "Δy₀ in px, up",
        tuple(curves),
        equal=True,
    )
    return Figure(
        name,
        "Principal point",
        f"Where the principal point has gone from its first position (black dot). "
        f"{'; '.join(words)}.",
        (panel,),
    )


def movement_figure(camera: CameraStudy) -> Figure | None:
    """Directional zoom: how the image of a still scene moves (Figures 4 and 6)."""
    moved = [
        (study.series, study.grid, study.displacement)
        for study in camera.series
        if study.displacement is not None and np.any(study.displacement)
    ]
    if not moved:
        return None
    lengths = [float(np.max(np.linalg.norm(vectors, axis=1))) for *_, vectors in moved]
    panels = []
    for i, (series, grid, vectors) in enumerate(moved):
        frame = (series.sensor.width, series.sensor.height)
        arrows = Arrows(grid, vectors, frame, PALETTE[i % 7], max(lengths))
        panels.append(Panel(series.name, "x in px", "y in px, down", (), arrows=arrows))
    words = [
        f"{plain(length, 'px', 3)} in {series.name}"
        for length, (series, *_) in zip(lengths, moved, strict=True)
    ]
    return Figure(
        "movement",
        "Movement of the image",
        "How points of a scene that stands still move in the image from the first to the last "
        "epoch, because the interior orientation changes. The largest "
        f"movement is {' and '.join(words)}. Equal arrows are a shift of the principal point; "
        "arrows that point outwards are a longer principal distance.",
        tuple(panels),
        columns=2,
    )


def significance_figure(camera: CameraStudy) -> Figure | None:
    """Moving variance over moving mean squared sd, with the limit of the F-test."""
    panels = []
    for name in free_parameters(camera):
        curves = []
        critical = None
        for i, study in enumerate(camera.series):
            test = study.significance.get(name)
            if test is None:
                continue
            critical = test.critical
            curves.append(
                Curve(
                    study.series.name,
                    test.course[:, 0] / 60,
                    test.course[:, 1],
                    "line",
                    PALETTE[i % 7],
                )
            )
        if critical is not None:
            panels.append(
                Panel(
                    parameter_label(name),
                    "time in min",
                    "variance ratio (no unit)",
                    tuple(curves),
                    log_y=_spans_decades(curves),
                    horizontal=((critical, "limit"),),
                )
            )
    if not panels:
        return None
    ratios = [
        (
            name,
            float(
                np.mean(
                    [
                        s.significance[name].success_ratio
                        for s in camera.series
                        if name in s.significance
                    ]
                )
            ),
        )
        for name in free_parameters(camera)
    ]
    always = [parameter_label(n) for n, r in ratios if r >= 0.9]
    rarely = [parameter_label(n) for n, r in ratios if r <= 0.1]
    words = ""
    if always:
        words += f" {', '.join(always)} vary significantly nearly all the time."
    if rarely:
        words += f" {', '.join(rarely)} hardly vary more than their standard deviations explain."
    return Figure(
        "significance",
        "Variation against uncertainty",
        "Variance of each parameter in a moving window over the mean of its squared standard "
        "deviations in that window. Above the dashed limit the variation is significantly greater "
        "than the uncertainty." + words,
        tuple(panels),
    )


def _spans_decades(curves: list[Curve]) -> bool:
    """Whether positive curves need a logarithmic axis."""
    low = min(float(np.min(c.y)) for c in curves)
    return low > 0 and max(float(np.max(c.y)) for c in curves) / low > _DECADES


def _direction(x: float, y: float) -> str:
    """`16.2 px to the lower right` of a movement in px, y up."""
    length = float(np.hypot(x, y))
    vertical = "upper" if y > 0.38 * length else "lower" if y < -0.38 * length else ""
    horizontal = "right" if x > 0.38 * length else "left" if x < -0.38 * length else ""
    words = " ".join(w for w in (vertical, horizontal) if w)
    words = {"upper": "top", "lower": "bottom"}.get(words, words)
    return f"{plain(length, 'px', 3)} to the {words}"


def free_parameters(camera: CameraStudy) -> list[str]:
    """IOP that are free in any series."""
    return [n for n in IOP_NAMES if any(n in study.series.free for study in camera.series)]


def dependence_figure(
    camera: CameraStudy, name: str = "temperature-dependence", only: Sequence[str] = ()
) -> Figure | None:
    """Parameters over the reference temperature with the fitted lines (Figure 7).

    name: of the figure; only: parameters to show, by default all.
    """
    figure_name = name
    panels, words = [], []
    for name in only or [*free_parameters(camera), "sigma0"]:
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
                    f"{delta}{parameter_label(name)}{label or ' (no unit)'}",
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
        figure_name,
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


def error_figure(camera: CameraStudy) -> Figure | None:
    """Error clouds on the object plane, one panel per grid point (Figures 10 and 11)."""
    mc, first = camera.montecarlo, camera.first_order
    if mc is None or first is None:
        return None
    limits = mc.clusters_mm
    colours = ("#1b7837", "#7fbf7b", "#e6a800", "#d6278a", "#7b3294", "#000000")
    size = round(np.sqrt(len(mc.image_points)))
    panels = []
    for k in range(len(mc.image_points)):
        errors = mc.sample[:_DRAWN, k]
        distance = np.linalg.norm(errors, axis=1)
        cluster = np.searchsorted(limits, distance, side="right")
        curves = [
            Curve(
                _cluster_name(limits, j),
                errors[cluster == j, 0] / 10,
                errors[cluster == j, 1] / 10,
                "points",
                colours[min(j, 5)],
            )
            for j in range(len(limits) + 1)
            if np.any(cluster == j)
        ]
        x, y = _ellipse(mc.covariance[k], mc.mean_error[k])
        curves.append(Curve("95 %, simulated", x / 10, y / 10, "line", "#000000"))
        x, y = _ellipse(first.covariance[k], np.zeros(2))
        curves.append(Curve("95 %, first order", x / 10, y / 10, "line", "#d55e00", dashed=True))
        panels.append(Panel(_place(k, size), "ΔX in cm", "ΔY in cm", tuple(curves), equal=True))
    worst = int(np.argmax(mc.largest))
    return Figure(
        "object-space-errors",
        f"Errors on a plane at {mc.distance_mm / 1000:g} m",
        f"Where {mc.sets:,} drawn interior orientations put each image point on a plane at "
        f"{mc.distance_mm / 1000:g} m, relative to where it belongs ({min(_DRAWN, mc.sets)} are "
        f"drawn). {percent(float(mc.fractions[0]))} of all errors are below {limits[0] / 10:g} cm, "
        f"the mean is {mc.overall_mean / 10:.2f} cm; the largest, {mc.largest[worst] / 10:.1f} cm, "
        f"arises at the {_place(worst, size)}.",
        tuple(panels),
        columns=size,
    )


def point_figure(camera: CameraStudy) -> Figure | None:
    """Mean and largest error of each grid point, and the mean of the largest (Figure 11)."""
    mc, first = camera.montecarlo, camera.first_order
    if mc is None or first is None:
        return None
    number = np.arange(1.0, len(mc.image_points) + 1)
    panel = Panel(
        "Mean and largest error",
        "image point from top left (number)",
        "error in cm",
        (
            Curve("largest", number, mc.largest / 10, "line", "#7fbf7b"),
            Curve("mean", number, mc.mean / 10, "line", "#1b7837"),
            Curve(
                "largest, first order",
                number,
                first.expected_largest / 10,
                "line",
                "#d55e00",
                dashed=True,
            ),
            Curve("mean, first order", number, first.mean / 10, "line", "#000000", dashed=True),
        ),
        horizontal=((mc.mean_largest / 10, "mean of the largest"),),
    )
    k = int(np.argmin(mc.largest))
    return Figure(
        "errors-by-point",
        "Errors by image point",
        f"Mean and largest error of each image point, and the mean of the largest, "
        f"{mc.mean_largest / 10:.1f} cm. The largest error is least at the "
        f"{_place(k, round(np.sqrt(len(number))))}. A "
        "shifting principal point moves all points alike, a changing principal distance those "
        "at the image's edges most.",
        (panel,),
    )  # fmt: skip


def _cluster_name(limits: tuple[float, ...], j: int) -> str:
    if j == 0:
        return f"< {limits[0] / 10:g} cm"
    if j == len(limits):
        return f"> {limits[-1] / 10:g} cm"
    return f"{limits[j - 1] / 10:g}–{limits[j] / 10:g} cm"


def _place(k: int, size: int) -> str:
    """Name of a grid point."""
    if size != 3:
        return f"row {k // size + 1}, column {k % size + 1}"
    vertical, horizontal = ("top", "", "bottom")[k // 3], ("left", "", "right")[k % 3]
    name = " ".join(word for word in (vertical, horizontal) if word)
    return name + (" corner" if vertical and horizontal else " edge") if name else "image centre"


def _ellipse(covariance: Array, centre: Array) -> tuple[Array, Array]:
    """Outline of the 95 % ellipse."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 73)
    scale = np.sqrt(5.991 * np.maximum(values, 0))  # chi-square with 2 degrees of freedom
    x, y = vectors @ (scale[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    return x + centre[0], y + centre[1]
