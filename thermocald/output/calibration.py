"""The report of a calibration from photographs: what was found, and what its residuals show.

Residuals and coverage show what a standard deviation does not: distortion that the model leaves,
and parts of the image in which no target was seen.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.figures import BAND, PALETTE, Arrows, Curve, Figure, Panel
from thermocald.numbers import (
    UNITS,
    coefficient,
    parameter_label,
    percent,
    plain,
    with_sd,
)
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.report import (
    Answer,
    Chapter,
    Section,
    Table,
    of_figure,
    render_report,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime

    from thermocald.analysis.camera.photographs import PhotographResult, Photographs
    from thermocald.arrays import Array

_CELLS = (12, 9)
_MOST_ARROWS = 3000
_RINGS = 10
_LITTLE_COVERED = 0.6


def render_calibration(
    result: Photographs, sensor: Sensor, name: str, made: datetime | None = None
) -> str:
    """Return the report as HTML text; made: the time that it bears, by default now."""
    posed = [p for p in result.photographs if len(p.points)]
    interior = Section(
        "Interior orientation",
        tables=tuple(t for t in (_interior(result, sensor), _correlations(result)) if t.rows),
    )
    figures = tuple(
        of_figure(Figure(f"f{i}", panel.title, caption, (panel,)))
        for i, (panel, caption) in enumerate(_panels(posed, sensor))
    )
    sections = [
        Section("Residuals and coverage", figures=figures[1:]),
        interior,
        Section("Photographs", tables=(_photographs(result),)),
    ]
    answer = _answer(result, posed, sensor)
    chapter = Chapter(
        f"Calibration of {name}",
        Answer(answer.sentence, figures[0] if figures else None, answer.more, answer.next_steps,
               answer.not_covered),
        tuple(s for s in sections if s.figures or s.tables),
        (f"{name}, {sensor.width} × {sensor.height} px of {sensor.pixel_pitch * 1000:g} µm.",),
    )  # fmt: skip
    return render_report(chapter.title, [chapter], made=made)


def coverage(points: Array, sensor: Sensor) -> float:
    """Fraction of the cells of a grid over the image in which a target was seen."""
    x = np.clip((points[:, 0] + 0.5) / sensor.width * _CELLS[0], 0, _CELLS[0] - 1).astype(int)
    y = np.clip((points[:, 1] + 0.5) / sensor.height * _CELLS[1], 0, _CELLS[1] - 1).astype(int)
    return len(set(zip(x.tolist(), y.tolist(), strict=True))) / (_CELLS[0] * _CELLS[1])


def _answer(result: Photographs, posed: Sequence[PhotographResult], sensor: Sensor) -> Answer:
    steps = [
        f"{Path(p.path).name}: {p.status.replace('_', ' ')}{f', {p.reason}' if p.reason else ''}."
        for p in result.photographs
        if not len(p.points)
    ]
    if not posed or result.interior is None:
        return Answer(f"Not calibrated: {result.reason}.", next_steps=tuple(steps))
    points = np.concatenate([p.points[p.used] for p in posed])
    residuals = np.concatenate([p.residuals[p.used] for p in posed])
    left_out = sum(int(np.count_nonzero(~p.used)) for p in posed)
    rms = float(np.sqrt(np.mean(residuals**2)))
    covered = coverage(points, sensor)
    if result.estimated:
        sentence = f"{_found(result, sensor)}."
        fit = f"; σ₀ {result.sigma0:.2f}, redundancy {result.redundancy}"
    else:
        sentence = f"The interior orientation is held, not estimated: {result.reason}."
        fit = ""
    more = (
        (
            f"{len(posed)} of {len(result.photographs)} photographs, {len(points)} image points, "
            f"{left_out} left out; residuals of {rms:.3f} px (RMS per coordinate){fit}. The points "
            f"cover {percent(covered)} of the image."
        ),
    )
    if covered < _LITTLE_COVERED:
        steps.append("Take photographs with the field in the parts of the image still empty.")
    if result.estimated:
        steps.append("Write the camera with --camera-out and use it in every later command.")
    return Answer(
        sentence, None, more, tuple(steps),
        (
            ("Temperatures other than that of the photographs: a series with a thermometer shows "
            "how the camera follows."),
            "Parts of the image without targets: there the distortion is extrapolated.",
            "Errors of the camera model, which the standard deviations do not hold.",
        ),
    )  # fmt: skip


def _found(result: Photographs, sensor: Sensor) -> str:
    """c, x0 and y0 with their standard deviations, mm and px."""
    assert result.interior is not None
    sds = np.sqrt(np.diag(result.covariance)[:3])
    parts = []
    for name, value, sd in zip(IOP_NAMES[:3], result.interior.as_array()[:3], sds, strict=True):
        pitch = sensor.pixel_pitch
        if sd > 0:
            parts.append(
                f"{parameter_label(name)} is {with_sd(value, float(sd), 'mm')} "
                f"({with_sd(value / pitch, float(sd) / pitch, 'px')})"
            )
    return f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else "".join(parts)


def _panels(posed: Sequence[PhotographResult], sensor: Sensor) -> list[tuple[Panel, str]]:
    if not posed:
        return []
    used = [p.points[p.used] for p in posed]
    points = np.concatenate(used)
    residuals = np.concatenate([p.residuals[p.used] for p in posed])
    return [
        _arrows(points, residuals, sensor),
        _coverage_map([p.path for p in posed], used, sensor),
        _by_radius(points, residuals, sensor),
        _scatter(residuals),
    ]


def _frame(sensor: Sensor) -> Curve:
    w, h = float(sensor.width), float(sensor.height)
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]], dtype=float)
    return Curve("", corners[:, 0], corners[:, 1], "line", "#888888")


def _arrows(points: Array, residuals: Array, sensor: Sensor) -> tuple[Panel, str]:
    length = float(np.percentile(np.linalg.norm(residuals, axis=1), 95))
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_ARROWS)).astype(int))
    arrows = Arrows(
        points[rows], residuals[rows], (sensor.width, sensor.height), PALETTE[0],
        max(1.5 * length, 1e-9),
    )  # fmt: skip
    panel = Panel("Residuals", "x in px", "y in px, down", (), arrows=arrows)
    return panel, (
        "Measured minus adjusted image points of all photographs. Without pattern they are noise; "
        "neighbours that point the same way are distortion that the model leaves, or targets that "
        "are not where the test field says."
    )


def _coverage_map(
    names: Sequence[Path | str], used: Sequence[Array], sensor: Sensor
) -> tuple[Panel, str]:
    curves = [_frame(sensor)]
    few = len(names) <= len(PALETTE)
    for i, (name, points) in enumerate(zip(names, used, strict=True)):
        curves.append(
            Curve(
                Path(name).name if few else "",
                points[:, 0],
                sensor.height - points[:, 1],
                "points",
                PALETTE[i % len(PALETTE)],
            )
        )
    panel = Panel("Coverage", "x in px", "y in px, up", tuple(curves), equal=True)
    return panel, "Where targets were seen, a colour per photograph, and the image's frame."


def _by_radius(points: Array, residuals: Array, sensor: Sensor) -> tuple[Panel, str]:
    from_centre = points - sensor.centre
    radius = np.linalg.norm(from_centre, axis=1)
    outwards = np.einsum("ni,ni->n", residuals, from_centre) / np.maximum(radius, 1e-9)
    order = np.argsort(radius)
    middles, means, sds = [], [], []
    for rows in np.array_split(order, min(_RINGS, len(order))):
        if len(rows) > 1:
            middles.append(float(radius[rows].mean()))
            means.append(float(outwards[rows].mean()))
            sds.append(float(outwards[rows].std(ddof=1)) / np.sqrt(len(rows)))
    x, y, sd = np.array(middles), np.array(means), np.array(sds)
    curves = (
        Curve("points", radius, outwards, "points", "#9fc4dc"),
        Curve("mean, 95 %", x, y, "band", PALETTE[1], y - BAND * sd, y + BAND * sd),
    )
    panel = Panel(
        "Residuals outwards", "distance from the image centre in px", "outwards in px", curves,
        horizontal=((0.0, ""),),
    )  # fmt: skip
    return panel, (
        "The residuals' component away from the image centre, and its mean in rings of as many "
        "points. A band that leaves zero is radial distortion that the model leaves."
    )


def _scatter(residuals: Array) -> tuple[Panel, str]:
    panel = Panel(
        "Residuals in x and y", "x in px", "y in px, down",
        (Curve("", residuals[:, 0], residuals[:, 1], "points", PALETTE[0]),), equal=True,
    )  # fmt: skip
    return panel, "The same residuals against each other: a round cloud without outliers."


def _interior(result: Photographs, sensor: Sensor) -> Table:
    """Values with their standard deviations, the same in px for what has one."""
    rows = []
    values = np.empty(0) if result.interior is None else result.interior.as_array()
    variance = np.diag(result.covariance)[:10]
    for name, value, v in zip(IOP_NAMES, values, variance, strict=False):
        if not v > 0:
            rows.append((parameter_label(name), f"{plain(value, UNITS[name], 6)} (held)", ""))
            continue
        sd = float(np.sqrt(v))
        pitch = sensor.pixel_pitch
        in_px = with_sd(value / pitch, sd / pitch, "px") if name in ("c", "x0", "y0") else ""
        rows.append((parameter_label(name), with_sd(value, sd, UNITS[name]), in_px))
    return Table(
        "Values",
        ("parameter", "value ± sd", "in px"),
        tuple(rows),
        "The standard deviations hold the noise of the image points and the errors of the test "
        "field's coordinates; errors of the camera model they do not hold.",
    )


def _correlations(result: Photographs) -> Table:
    """Pairs that correlate by more than 0.5, the strongest first."""
    sd = np.sqrt(np.diag(result.covariance)[:10])
    free = np.flatnonzero(sd > 0)
    found = [
        (float(result.covariance[i, j] / sd[i] / sd[j]), i, j)
        for a, i in enumerate(free)
        for j in free[a + 1 :]
    ]
    rows = [
        (f"{parameter_label(IOP_NAMES[i])}, {parameter_label(IOP_NAMES[j])}", coefficient(r))
        for r, i, j in sorted(found, key=lambda one: -abs(one[0]))
        if abs(r) > 0.5
    ]
    return Table("Correlations beyond ±0.5", ("pair", "r"), tuple(rows))


def _photographs(result: Photographs) -> Table:
    headings = ("photograph", "result", "targets", "left out", "RMS px", "X0, Y0, Z0 mm ± sd")
    return Table("Each photograph", headings, tuple(_photograph(p) for p in result.photographs))


def _photograph(p: PhotographResult) -> tuple[str, ...]:
    where = "–"
    if p.exterior is not None:
        values = p.exterior.as_array()[3:]
        where = ", ".join(
            with_sd(float(v), float(s)) for v, s in zip(values, p.exterior_sd[3:], strict=True)
        )
    return (
        Path(p.path).name,
        p.status.replace("_", " ") + (f": {p.reason}" if p.reason else ""),
        str(p.n_targets),
        str(len(p.rejected)),
        f"{p.rms_px:.3f}" if np.isfinite(p.rms_px) else "–",
        where,
    )
