"""The figures of a study: each with a caption that says in words what it shows for this camera.

Numbered as in the report; the reference's figures (Elias et al. 2020) that they correspond to are
named in docs/explanation/study.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.output.figures.numbers import UNITS, parameter_label, plain, superscript
from thermocald.output.figures.panels import PALETTE, Curve, Figure, Panel, thin
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from thermocald.analysis.study.study import CameraStudy

__all__ = [
    "deviation_figure",
    "extent",
    "free_parameters",
    "movement_figure",
    "principal_point_figure",
    "scaled",
    "significance_figure",
]

_BAND = 1.96
_DECADES = 30.0
_ARROW_SHARE = 0.12  # of the image width, for the longest arrow


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


def _time_panel(camera: CameraStudy, title: str, unit: str, k: int) -> Panel:
    scale, label = scaled(unit, extent(camera, k))
    curves = []
    for i, study in enumerate(camera.series):
        s = study.series
        value, band = scale * (s.values[:, k] - s.values[0, k]), scale * _BAND * s.sds[:, k]
        t, value, band = thin(s.time_s / 60, value, band)
        curves.append(Curve(s.name, t, value, "band", PALETTE[i % 7], value - band, value + band))
    return Panel(f"Δ{title}", "time in min", f"Δ{title}{label}", tuple(curves))


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
    return Panel("σ₀ / first σ₀", "time in min", "ratio", tuple(curves))


def _temperature_panels(camera: CameraStudy) -> list[Panel]:
    names = dict.fromkeys(t.name for study in camera.series for t in study.series.thermometers)
    panels = []
    for name in names:
        curves = []
        for i, study in enumerate(camera.series):
            for t in study.series.thermometers:
                if t.name == name:
                    time_min, values = thin(study.series.time_s / 60, t.values)
                    curves.append(
                        Curve(study.series.name, time_min, values, "line", PALETTE[i % 7])
                    )
        panels.append(Panel(parameter_label(name), "time in min", "°C", tuple(curves)))
    return panels


def principal_point_figure(camera: CameraStudy) -> Figure | None:
    """The path of the principal point on the sensor (the reference's Figures 4 and 6)."""
    if not {"x0", "y0"} <= set(free_parameters(camera)):
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
        "principal-point",
        "Principal point",
        f"Where the principal point has gone from its first position (black dot). "
        f"{'; '.join(words)}.",
        (panel,),
    )


def movement_figure(camera: CameraStudy) -> Figure | None:
    """Directional zoom: how the image of a still scene moves (Figures 4 and 6)."""
    panels, words = [], []
    for study in camera.series:
        if study.displacement is None:
            continue
        longest = float(np.max(np.linalg.norm(study.displacement, axis=1)))
        if longest == 0:
            continue
        width = study.series.sensor.width
        factor = _round_factor(_ARROW_SHARE * width / longest)
        start, end = study.grid, study.grid + factor * study.displacement
        height = study.series.sensor.height
        curves = [
            Curve("", np.array([a[0], b[0]]), height - np.array([a[1], b[1]]), "line", PALETTE[1])
            for a, b in zip(start, end, strict=True)
        ]
        curves.append(Curve("first epoch", start[:, 0], height - start[:, 1], "points", "#000000"))
        panels.append(
            Panel(
                f"{study.series.name}, {factor:g} times enlarged",
                "px",
                "px",
                tuple(curves),
                equal=True,
            )
        )
        words.append(f"{plain(longest, 'px', 3)} in {study.series.name}")
    if not panels:
        return None
    return Figure(
        "movement",
        "Movement of the image",
        "How points of a scene that stands still move in the image from the first to the last "
        "epoch, because the interior orientation changes (dots: first position). The largest "
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
                    "variance ratio",
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


def _round_factor(factor: float) -> float:
    """The next lower 1, 2, 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(factor))
    return float(max(m for m in (1.0, 2.0, 5.0) if m * power <= factor) * power)


def free_parameters(camera: CameraStudy) -> list[str]:
    """IOP that are free in any series."""
    return [n for n in IOP_NAMES if any(n in study.series.free for study in camera.series)]
