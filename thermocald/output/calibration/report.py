"""The report of a calibration from photographs: one HTML file that works offline.

Residuals and coverage show what a standard deviation does not: distortion that the model leaves,
and parts of the image in which no target was seen.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald import __version__
from thermocald.output.figures.draw import draw_panel, inline_svg
from thermocald.output.figures.numbers import (
    UNITS,
    coefficient,
    parameter_label,
    percent,
    plain,
    with_sd,
)
from thermocald.output.figures.panels import PALETTE, Curve, Panel
from thermocald.output.page import render_page
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.analysis.camera.photographs import PhotographResult, Photographs
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = ["coverage", "render_calibration"]

_TEMPLATE = Path(__file__).parent / "templates" / "calibration.html.j2"
_CELLS = (12, 9)
_LONGEST = 0.06  # of the image width, for a long arrow
_MOST_ARROWS = 3000
_RINGS = 10


def render_calibration(
    result: Photographs, sensor: Sensor, name: str, made: datetime | None = None
) -> str:
    """The report as HTML text; made: the time that it bears, by default now."""
    at = made or datetime.now(tz=UTC)
    posed = [p for p in result.photographs if len(p.points)]
    return render_page(
        _TEMPLATE,
        title=f"Calibration of {name}",
        made=f"Made on {at:%Y-%m-%d at %H:%M} UTC with thermocald {__version__}.",
        device=f"{name}, {sensor.width} × {sensor.height} px of {sensor.pixel_pitch * 1000:g} µm.",
        summary=_summary(result, posed, sensor),
        figures=[
            (inline_svg(draw_panel(panel), f"f{i}", panel.title), panel.title, caption)
            for i, (panel, caption) in enumerate(_panels(posed, sensor))
        ],
        interior=_interior(result, sensor),
        correlations=_correlations(result),
        photographs=[_photograph(p) for p in result.photographs],
    )


def coverage(points: Array, sensor: Sensor) -> float:
    """Fraction of the cells of a grid over the image in which a target was seen."""
    x = np.clip((points[:, 0] + 0.5) / sensor.width * _CELLS[0], 0, _CELLS[0] - 1).astype(int)
    y = np.clip((points[:, 1] + 0.5) / sensor.height * _CELLS[1], 0, _CELLS[1] - 1).astype(int)
    return len(set(zip(x.tolist(), y.tolist(), strict=True))) / (_CELLS[0] * _CELLS[1])


def _summary(result: Photographs, posed: Sequence[PhotographResult], sensor: Sensor) -> list[str]:
    if not posed:
        return [f"Not calibrated: {result.reason}."]
    points = np.concatenate([p.points[p.used] for p in posed])
    residuals = np.concatenate([p.residuals[p.used] for p in posed])
    left_out = sum(int(np.count_nonzero(~p.used)) for p in posed)
    rms = float(np.sqrt(np.mean(residuals**2)))
    sentences = [
        (
            f"{len(posed)} of {len(result.photographs)} photographs, {len(points)} image points, "
            f"{left_out} left out; residuals of {rms:.3f} px (RMS per coordinate)."
        ),
        (
            f"The points cover {percent(coverage(points, sensor))} of the image. Where there are "
            "none the distortion is extrapolated."
        ),
    ]
    if result.estimated:
        sentences.insert(
            0, f"Interior orientation estimated: σ₀ {result.sigma0:.2f}, redundancy "
            f"{result.redundancy}.",
        )  # fmt: skip
    else:
        sentences.insert(0, f"Interior orientation held, not estimated: {result.reason}.")
    return sentences


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
    factor = _LONGEST * sensor.width / max(length, 1e-9)
    power = 10.0 ** np.floor(np.log10(factor))
    factor = float(max(m for m in (1.0, 2.0, 5.0) if m * power <= factor) * power)
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_ARROWS)).astype(int))
    start, end = points[rows], points[rows] + factor * residuals[rows]
    gap = np.full(len(rows), np.nan)
    x = np.column_stack([start[:, 0], end[:, 0], gap]).ravel()
    y = sensor.height - np.column_stack([start[:, 1], end[:, 1], gap]).ravel()
    panel = Panel(
        f"Residuals, {factor:g} times enlarged", "x in px", "y in px, up",
        (_frame(sensor), Curve("", x, y, "line", PALETTE[0])), equal=True,
    )  # fmt: skip
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
        Curve("mean ± 2 sd", x, y, "band", PALETTE[1], y - 2 * sd, y + 2 * sd),
    )
    panel = Panel(
        "Residuals outwards", "distance from the image centre in px", "px", curves,
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


def _interior(result: Photographs, sensor: Sensor) -> list[tuple[str, str, str]]:
    """Name, value with sd, the same in px for what has one."""
    if result.interior is None:
        return []
    rows = []
    variance = np.diag(result.covariance)[:10]
    for name, value, v in zip(IOP_NAMES, result.interior.as_array(), variance, strict=True):
        if not v > 0:
            rows.append((parameter_label(name), f"{plain(value, UNITS[name], 6)} (held)", ""))
            continue
        sd = float(np.sqrt(v))
        pitch = sensor.pixel_pitch
        in_px = with_sd(value / pitch, sd / pitch, "px") if name in ("c", "x0", "y0") else ""
        rows.append((parameter_label(name), with_sd(value, sd, UNITS[name]), in_px))
    return rows


def _correlations(result: Photographs) -> list[tuple[str, str]]:
    """Pairs that correlate by more than 0.5, the strongest first."""
    sd = np.sqrt(np.diag(result.covariance)[:10])
    free = np.flatnonzero(sd > 0)
    found = [
        (float(result.covariance[i, j] / sd[i] / sd[j]), i, j)
        for a, i in enumerate(free)
        for j in free[a + 1 :]
    ]
    return [
        (f"{parameter_label(IOP_NAMES[i])}, {parameter_label(IOP_NAMES[j])}", coefficient(r))
        for r, i, j in sorted(found, key=lambda one: -abs(one[0]))
        if abs(r) > 0.5
    ]


def _photograph(p: PhotographResult) -> dict[str, Any]:
    where = "–"
    if p.exterior is not None:
        values = p.exterior.as_array()[3:]
        where = ", ".join(
            with_sd(float(v), float(s)) for v, s in zip(values, p.exterior_sd[3:], strict=True)
        )
    return {
        "name": Path(p.path).name,
        "status": p.status.replace("_", " ") + (f": {p.reason}" if p.reason else ""),
        "targets": p.n_targets,
        "left_out": len(p.rejected),
        "rms": f"{p.rms_px:.3f}" if np.isfinite(p.rms_px) else "–",
        "where": where,
    }
