"""The figures of a study, each with a caption that states what it shows for this camera.

Figure numbers in parentheses are those of the reference (Elias et al. 2020); the correspondence is
listed in docs/explanation/study.md.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.arrays import spread_rows
from thermocald.figures import (
    BAND,
    GREY,
    PALETTE,
    Arrows,
    Curve,
    Figure,
    Panel,
    draw_matrix,
    image_panel,
    thin,
)
from thermocald.numbers import (
    UNITS,
    distinct_names,
    enumerated,
    parameter_label,
    percent,
    plain,
    spanned,
    superscript,
    typeset_powers,
    with_sd,
    without_numbers,
)
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from thermocald.analysis.study.study import CameraStudy, SeriesStudy
    from thermocald.arrays import Array

_SEVERAL = 3  # series that are described together
_DRAWN = 400  # points of a cloud
FEWEST_FOR_R = 10  # epochs: fewer are correlated by chance
_ALIKE = 0.005  # correlations that differ by less are printed alike
_CLUSTERS = ("#1b7837", "#7fbf7b", "#e6a800", "#d6278a", "#7b3294", "#000000")


def study_figures(camera: CameraStudy) -> dict[str, Figure]:
    """Return the figures of a camera's study by name, without those the data do not support."""
    moving = any(len(study.series) > 1 for study in camera.series)
    made = (
        deviation_figure(camera) if moving else None,
        principal_point_figure(camera) if moving else None,
        _movement_figure(camera),
        _significance_figure(camera),
        dependence_figure(camera),
        *_object_space(camera),
        *_matrices(camera),
    )
    return {figure.name: figure for figure in made if figure is not None}


def _styled(camera: CameraStudy) -> Iterator[tuple[SeriesStudy, dict[str, Any]]]:
    """Yield each series with its colour; the lines of those after the tenth are dashed."""
    for i, study in enumerate(camera.series):
        yield study, {"colour": PALETTE[i % len(PALETTE)], "dashed": i >= len(PALETTE)}


def by_series(
    camera: CameraStudy, texts: Iterable[tuple[SeriesStudy, str]], *, name_all: bool = True
) -> list[str]:
    """Return texts on single series, each once, with the names of its series in front.

    From three series on, texts that differ only in their numbers are one, with the smallest and the
    largest of them. name_all: whether a text on all series has their names too.
    """
    groups: dict[object, dict[str, list[str]]] = {}
    for study, text in texts:
        if text:
            text = typeset_powers(text)
            alike = without_numbers(text), tuple(t.name for t in study.series.thermometers)
            groups.setdefault(alike, {}).setdefault(text, []).append(study.series.name)
    said = []
    for names in groups.values():
        together = sum(map(len, names.values())) >= _SEVERAL
        for shown in [list(names)] if together else [[text] for text in names]:
            of = [name for text in shown for name in names[text]]
            who = f"{enumerated(of)}: "
            if len(of) == len(camera.series) and (len(of) >= _SEVERAL or not name_all):
                who = f"All {len(of)} series: " if name_all else ""
            said.append(who + spanned(shown))
    return said


def _free_parameters(camera: CameraStudy) -> list[str]:
    """Return the parameters of the interior orientation that are free in any series."""
    return [n for n in IOP_NAMES if any(n in study.series.free for study in camera.series)]


def _readable(camera: CameraStudy, name: str) -> tuple[float, str]:
    """Return a factor that makes the changes of a parameter easy to read, and the axis label."""
    unit, k = UNITS[name], IOP_NAMES.index(name)
    if unit == "mm":
        return 1000.0, f"Δ{parameter_label(name)} in µm"
    extent = max(float(np.ptp(study.series.values[:, k])) for study in camera.series)
    exponent = 0
    if extent > 0 and not 0.01 <= extent < 1000:
        exponent = int(np.floor(np.log10(extent)))
        unit = f"10{superscript(exponent)} {unit}".rstrip()
    return 10.0**-exponent, f"Δ{parameter_label(name)}{f' in {unit}' if unit else ' (no unit)'}"


def deviation_figure(camera: CameraStudy) -> Figure:
    """Draw every parameter minus its first value over time (Figures 3 and 5)."""
    panels, ratios = [], []
    temperatures: dict[str, list[Curve]] = {}
    for name in _free_parameters(camera):
        k, (scale, label), curves = IOP_NAMES.index(name), _readable(camera, name), []
        for study, style in _styled(camera):
            s = study.series
            change, band = scale * (s.values[:, k] - s.values[0, k]), scale * BAND * s.sds[:, k]
            t, y, half = thin(s.time_s / 60, change, band)
            curves.append(Curve(s.name, t, y, half=half, **style))
        panels.append(Panel(f"Δ{parameter_label(name)}", "time in min", label, tuple(curves)))
    for study, style in _styled(camera):
        s = study.series
        minutes = s.time_s / 60
        t, ratio = thin(minutes, s.sigma0 / s.sigma0[0])
        ratios.append(Curve(s.name, t, ratio, **style))
        for thermometer in s.thermometers:
            if np.isfinite(thermometer.values).any():
                t, celsius = thin(minutes, thermometer.values)
                temperatures.setdefault(thermometer.name, []).append(
                    Curve(s.name, t, celsius, **style)
                )
    panels.append(Panel("σ₀ / first σ₀", "time in min", "ratio (no unit)", tuple(ratios)))
    panels += [
        Panel(parameter_label(name), "time in min", "temperature in °C", tuple(curves))
        for name, curves in temperatures.items()
    ]
    return Figure(
        "deviations", "Deviations from the first epoch",
        "Each parameter minus its value in the first epoch. The band about a line is the 95 % "
        "uncertainty of one epoch's adjustment; changes smaller than that may be noise.",
        tuple(panels),
    )  # fmt: skip


def principal_point_figure(camera: CameraStudy) -> Figure | None:
    """Draw the path of the principal point on the sensor (Figures 4 and 6)."""
    if not {"x0", "y0"} <= set(_free_parameters(camera)):
        return None
    curves, words = [], []
    for study, style in _styled(camera):
        s = study.series
        x, y = s.path_px.T
        rows = spread_rows(len(s), 600)
        curves.append(Curve(s.name, x[rows], y[rows], **style))
        curves.append(Curve("", x[:1], y[:1], "points", "#000000"))
        way = _direction(float(x[-1]), float(y[-1]))
        farthest = float(np.max(np.hypot(x, y)))
        if farthest > 1.5 * np.hypot(x[-1], y[-1]):
            way += f" at the end, at most {plain(farthest, 'px', 3)} away"
        words.append((study, way))
    panel = Panel(
        "Path of the principal point", "Δx₀ in px, right", "Δy₀ in px, up", tuple(curves),
        equal=True,
    )  # fmt: skip
    return Figure(
        "principal-point", "Principal point",
        "The path of the principal point from its first position (black dot). "
        f"{'; '.join(by_series(camera, words))}.",
        (panel,),
    )  # fmt: skip


def _direction(x: float, y: float) -> str:
    """Describe a movement in px, y up, such as `16.2 px to the lower right`."""
    length = float(np.hypot(x, y))
    vertical = "upper" if y > 0.38 * length else "lower" if y < -0.38 * length else ""
    horizontal = "right" if x > 0.38 * length else "left" if x < -0.38 * length else ""
    words = " ".join(w for w in (vertical, horizontal) if w)
    words = {"upper": "top", "lower": "bottom"}.get(words, words)
    return f"{plain(length, 'px', 3)} to the {words}"


def _movement_figure(camera: CameraStudy) -> Figure | None:
    """Draw the directional zoom: the movement of the image of a static scene (Figures 4 and 6)."""
    moved = [
        (study, style["colour"], study.displacement)
        for study, style in _styled(camera)
        if study.displacement is not None and np.any(study.displacement)
    ]
    if not moved:
        return None
    longest = max(float(np.linalg.norm(vectors, axis=1).max()) for *_, vectors in moved)
    titles = distinct_names([study.series.name for study, *_ in moved], 18)
    panels, words = [], []
    for title, (study, colour, vectors) in zip(titles, moved, strict=True):
        sensor, covariance = study.series.sensor, study.displacement_covariance
        arrows = Arrows(study.grid, vectors, (sensor.width, sensor.height), colour, longest)
        panels.append(image_panel(title, arrows=arrows))
        lengths = np.linalg.norm(vectors, axis=1)
        k = int(lengths.argmax())
        length, along = float(lengths[k]), vectors[k] / lengths[k]
        sd = float("nan") if covariance is None else float(np.sqrt(along @ covariance[k] @ along))
        words.append((study, with_sd(length, sd, "px")))
    return Figure(
        "movement", "Movement of the image",
        "Movement of the points of a static scene in the image from the first to the last epoch, "
        "caused by the change of the interior orientation. Equal arrows show a shift of the "
        "principal point; arrows that point outwards show a longer principal distance. The largest "
        f"movement: {'; '.join(by_series(camera, words, name_all=False))}.",
        tuple(panels), columns=2,
    )  # fmt: skip


def _significance_figure(camera: CameraStudy) -> Figure | None:
    """Draw the moving variance over the moving mean of the squared sd, and the F-test's limit."""
    panels, always, rarely = [], [], []
    for name in _free_parameters(camera):
        tested = [
            (study.series.name, study.significance[name], style)
            for study, style in _styled(camera)
            if name in study.significance
        ]
        if not tested:
            continue
        label = parameter_label(name)
        curves = tuple(
            Curve(series, test.course[:, 0] / 60, test.course[:, 1], **style)
            for series, test, style in tested
        )
        limit = ((tested[-1][1].critical, "limit"),)
        panels.append(
            Panel(label, "time in min", "variance ratio (no unit)", curves, True, horizontal=limit)
        )
        ratio = float(np.mean([test.success_ratio for _, test, _ in tested]))
        if ratio >= 0.9:
            always.append(label)
        elif ratio <= 0.1:
            rarely.append(label)
    if not panels:
        return None
    words = f" {', '.join(always)} vary significantly nearly all the time." if always else ""
    if rarely:
        words += f" {', '.join(rarely)} hardly vary more than their standard deviations explain."
    return Figure(
        "significance", "Variation against uncertainty",
        "Variance of each parameter in a moving window over the mean of its squared standard "
        "deviations in that window. Above the dashed limit the variation is significantly greater "
        "than the uncertainty." + words,
        tuple(panels),
    )  # fmt: skip


def dependence_figure(camera: CameraStudy, only: Sequence[str] = ()) -> Figure | None:
    """Draw the parameters over the reference temperature with the fitted lines (Figure 7).

    only: parameters to show, by default all.
    """
    panels = []
    for name in only or [*_free_parameters(camera), "sigma0"]:
        shown = [
            (study, style)
            for study, style in _styled(camera)
            if study.channels and name in study.channels[0].dependences
        ]
        if not shown:
            continue
        scale, label = 1.0, "σ₀ (no unit)"
        if name != "sigma0":
            scale, label = _readable(camera, name)
        curves = [c for study, style in shown for c in _fitted(study, name, scale, style)]
        reference = parameter_label(shown[0][0].channels[0].thermometer.name)
        panels.append(Panel(parameter_label(name), f"{reference} in °C", label, tuple(curves)))
    if not panels:
        return None
    return Figure(
        "temperature-dependence", "Dependence on the temperature",
        "The change of each parameter since the first epoch against the reference temperature, "
        "with a straight line whose fit takes the noise of both into account.",
        tuple(panels),
    )  # fmt: skip


def _fitted(study: SeriesStudy, name: str, scale: float, style: dict[str, Any]) -> list[Curve]:
    """Return the curves of a parameter's changes over the temperature and of their line."""
    s = study.series
    value = s.sigma0
    if name != "sigma0":
        column = s.values[:, IOP_NAMES.index(name)]
        value = scale * (column - column[0])
    known = np.isfinite(s.thermometers[0].values)
    t, v = s.thermometers[0].values[known], value[known]
    ends = np.array([t.min(), t.max()])
    slope = scale * study.channels[0].dependences[name].slope
    rows = spread_rows(len(t), _DRAWN)
    return [
        Curve(s.name, t[rows], v[rows], "points", **style),
        Curve(s.name, ends, v.mean() + slope * (ends - t.mean()), **style),
    ]


def _object_space(camera: CameraStudy) -> Iterator[Figure]:
    """Draw the error clouds on the object plane, one panel per grid point, and the mean and largest
    errors of the points with the mean of the largest (Figures 10 and 11).
    """
    mc = camera.montecarlo
    if mc is None:
        return
    first = mc.first_order
    limits = mc.clusters_mm
    names = cluster_names(limits)
    size = round(np.sqrt(len(mc.image_points)))
    panels = []
    for k in range(len(mc.image_points)):
        errors = mc.sample[:_DRAWN, k]
        cluster = np.searchsorted(limits, np.linalg.norm(errors, axis=1), side="right")
        curves = []
        for j, name in enumerate(names):
            x, y = errors[cluster == j].T / 10
            if len(x):
                curves.append(Curve(name, x, y, "points", _CLUSTERS[min(j, 5)]))
        x, y = _ellipse(mc.covariance[k], mc.mean_error[k])
        curves.append(Curve("95 %, simulated", x / 10, y / 10, "line", "#000000"))
        x, y = _ellipse(first.covariance[k], np.zeros(2))
        curves.append(Curve("95 %, first order", x / 10, y / 10, "line", "#d55e00", dashed=True))
        panels.append(Panel(_place(k, size), "ΔX in cm", "ΔY in cm", tuple(curves), equal=True))
    worst = int(np.argmax(mc.largest))
    yield Figure(
        "object-space-errors", f"Errors on a plane at {mc.distance_mm / 1000:g} m",
        f"Errors of each image point on a plane at {mc.distance_mm / 1000:g} m for {mc.sets:,} "
        f"drawn interior orientations ({min(_DRAWN, mc.sets)} are shown). "
        f"{percent(float(mc.fractions[0]))} of all errors are below {limits[0] / 10:g} cm, "
        f"the mean is {plain(mc.overall_mean / 10, 'cm', 3)}; the largest, "
        f"{plain(mc.largest[worst] / 10, 'cm', 2)}, occurs at the {_place(worst, size)}.",
        tuple(panels), columns=size,
    )  # fmt: skip
    number = np.arange(1.0, len(mc.image_points) + 1)
    middle = np.full(len(number), mc.mean_largest / 10)
    by_point = (
        Curve("largest", number, mc.largest / 10, colour="#7fbf7b"),
        Curve("mean", number, mc.mean / 10, colour="#1b7837"),
        Curve("to first order", number, first.expected_largest / 10, colour="#d55e00", dashed=True),
        Curve("", number, first.mean / 10, colour="#d55e00", dashed=True),
        Curve("mean of largest", number, middle, colour=GREY, dashed=True),
    )
    panel = Panel(
        "Mean and largest error", "image point from top left (number)", "error in cm", by_point
    )
    least = int(np.argmin(mc.largest))
    yield Figure(
        "errors-by-point", "Errors by image point",
        f"Mean and largest error of each image point, and the mean of the largest, "
        f"{plain(mc.mean_largest / 10, 'cm', 2)}. The largest error is smallest at the "
        f"{_place(least, size)}. A shift of the principal point moves all points alike, a change "
        "of the principal distance moves those at the edges of the image most.",
        (panel,),
    )  # fmt: skip


def cluster_names(limits: Sequence[float]) -> list[str]:
    """Name the clusters of errors in cm; limits: mm."""
    cm = [f"{limit / 10:g}" for limit in limits]
    between = [f"{a}–{b} cm" for a, b in pairwise(cm)]
    return [f"< {cm[0]} cm", *between, f"> {cm[-1]} cm"]


def _place(k: int, size: int) -> str:
    """Return the name of a grid point."""
    if size != 3:
        return f"row {k // size + 1}, column {k % size + 1}"
    vertical, horizontal = ("top", "", "bottom")[k // 3], ("left", "", "right")[k % 3]
    name = " ".join(word for word in (vertical, horizontal) if word)
    return name + (" corner" if vertical and horizontal else " edge") if name else "image centre"


def _ellipse(covariance: Array, centre: Array) -> tuple[Array, Array]:
    """Return the outline of the 95 % ellipse."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 73)
    scale = np.sqrt(5.991 * np.maximum(values, 0))  # chi-square with 2 degrees of freedom
    x, y = vectors @ (scale[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    return x + centre[0], y + centre[1]


def _matrices(camera: CameraStudy) -> Iterator[Figure]:
    """Draw the correlations over the epochs of each series, and those within the adjustments."""
    for study in camera.series:
        if len(study.series) >= FEWEST_FOR_R:
            rows = np.flatnonzero(np.isfinite(study.matrix).any(axis=0))
            names = [parameter_label(study.columns[k]) for k in rows]
            title = f"Correlation matrix, {study.series.name}"
            yield Figure(
                f"correlation-{file_name(study.series.name)}",
                title,
                "Pearson's correlation over the epochs among parameters, σ₀ and temperatures. Red: "
                "they rise together; blue: one rises as the other falls.",
                drawing=draw_matrix(study.matrix[rows][:, rows], names, title),
            )
    free = [k for k in range(10) if camera.sds[k] > 0]
    if camera.correlations is not None and free:
        noise = float(np.max(camera.correlations.noise[free][:, free]))
        names = [parameter_label(IOP_NAMES[k]) for k in free]
        scatter = f"scatter by {plain(noise, digits=2)} at most" if noise > _ALIKE else "agree"
        yield Figure(
            "iop-correlations", "Correlations within the adjustments",
            "Correlation of the estimated parameters within an epoch's adjustment: median over "
            f"{camera.correlations.epochs} epochs, which {scatter}. High values are due to the "
            "geometry of the calibration, not to the temperature.",
            drawing=draw_matrix(
                camera.correlations.median[free][:, free], names, "Within the adjustments"
            ),
        )  # fmt: skip


def file_name(label: str) -> str:
    """Return a label as a file name: other characters than letters, digits, -_. are replaced."""
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in label).strip(".") or "camera"
