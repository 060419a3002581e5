"""The tables of what the changes of a camera do in object space."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from thermocald.output.figures.numbers import percent
from thermocald.output.study.tables import Table

if TYPE_CHECKING:
    from thermocald.analysis.study.study import CameraStudy

__all__ = ["cluster_table", "point_table"]

_FIXED = {"first": "first epoch", "mean": "mean", "last": "last epoch"}


def cluster_table(camera: CameraStudy) -> Table | None:
    """Fractions of the errors, means, maxima (Table 7), and of the camera's own path."""
    mc, first = camera.montecarlo, camera.first_order
    if mc is None or first is None:
        return None
    cm = [limit / 10 for limit in mc.clusters_mm]
    names = [f"< {cm[0]:g} cm"]
    names += [f"{a:g}–{b:g} cm" for a, b in pairwise(cm)]
    names.append(f"> {cm[-1]:g} cm")

    def row(label: str, fractions: object, mean: float, largest: float) -> tuple[str, ...]:
        shown = [percent(float(v), 1) for v in np.asarray(fractions, dtype=float)]
        return (label, *shown, f"{mean / 10:.2f} cm", f"{largest / 10:.1f} cm")

    return Table(
        f"Errors on a plane at {mc.distance_mm / 1000:g} m",
        ("", *names, "mean", "mean of maxima"),
        (
            row("simulated", mc.fractions, mc.overall_mean, mc.mean_largest),
            row(
                "first order",
                np.maximum(first.fractions, 0.0),
                float(first.mean.mean()),
                float(first.expected_largest.mean()),
            ),
            *(
                row(f"own path, {_FIXED[t.reference]} fixed", t.fractions, t.mean, t.mean_largest)
                for t in camera.trajectories
            ),
        ),
        f"{mc.sets:,} sets of interior orientation, seed {mc.seed}, {len(mc.image_points)} image "
        "points. First order is the analytic propagation of the same covariance: where it differs "
        "from the simulation, linear error propagation fails. The mean of maxima depends on the "
        "number of sets and, by some per cent, on the seed. The draws are normal about the series' "
        "mean, with the correlations of the adjustments; the own path is that of the measured "
        "epochs, against one interior orientation that is held fixed.",
    )


def point_table(camera: CameraStudy) -> Table | None:
    """Errors per grid point (Figure 11)."""
    mc, first = camera.montecarlo, camera.first_order
    if mc is None or first is None:
        return None
    rows = []
    for k, point in enumerate(mc.image_points):
        values, vectors = np.linalg.eigh(mc.covariance[k])
        major = vectors[:, 1]
        angle = float(np.degrees(np.arctan2(major[1], major[0]))) % 180
        rows.append(
            (
                f"{point[0]:.0f}, {point[1]:.0f}",
                f"{mc.mean[k] / 10:.2f}",
                f"{first.mean[k] / 10:.2f}",
                f"{mc.largest[k] / 10:.1f}",
                f"{first.expected_largest[k] / 10:.1f}",
                f"{np.sqrt(values[1]) / 10:.2f} × {np.sqrt(max(values[0], 0.0)) / 10:.2f}",
                f"{angle:.0f}°",
                f"{np.linalg.norm(mc.mean_error[k]):.2f}",
            )
        )
    return Table(
        "Errors by image point",
        (
            "image point px",
            "mean cm",
            "mean cm, first order",
            "largest cm",
            "largest cm, first order",
            "ellipse sd cm",
            "direction",
            "bias mm",
        ),
        tuple(rows),
        "Direction of the longer axis, from X (right) towards Y (up) as the camera looks. "
        "Bias is what the mean error vector keeps: an effect of second order.",
    )
