"""The figures of a study in object space: error clouds, errors by image point (Figures 10, 11)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.output.figures.numbers import percent
from thermocald.output.figures.panels import Curve, Figure, Panel

if TYPE_CHECKING:
    from thermocald.analysis.study.study import CameraStudy
    from thermocald.arrays import Array

__all__ = ["error_figure", "point_figure"]

_DRAWN = 400


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
        "image point, row by row from top left",
        "cm",
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
