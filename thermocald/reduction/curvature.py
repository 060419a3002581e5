"""The second linearisation: what the image does beyond first order.

A drift of several pixels leaves some thousandths of a pixel to the curvature of the projection,
which is more than a discovery has to see. The trajectories found so far say how much, epoch by
epoch.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import project

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit
    from thermocald.reduction.series import ReducedSeries

__all__ = ["curved", "relinearised"]

_WORTH_PX = 0.0005


def curved(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries] | None:
    """All series with the curvature taken off; None where it matters in none."""
    out = [relinearised(fitter, fit, s) for s in range(len(fitter.series))]
    if all(e is None for e in out):
        return None
    return [e or old for e, old in zip(out, fitter.series, strict=True)]


def relinearised(
    fitter: HypothesisFitter, fit: Fit, series: int, beyond: Array | None = None
) -> ReducedSeries | None:
    """One series with the curvature taken off its observations; None where it does not matter.

    What was taken off before is taken into account. beyond (E, P): trajectories that the hypothesis
    leaves, px-scaled.
    """
    e = fitter.series[series]
    if e.blocks is not None:
        return None
    bend = _bend(fitter, fit, series, beyond)
    change = bend if e.bend is None else bend - e.bend
    if float(np.sqrt(np.mean(change**2))) < _WORTH_PX:
        return None
    weights = e.weights / e.correlation
    b = e.b - np.einsum("eti,tik->ek", weights[..., :2] * change, e.columns)
    k = e.N.shape[-1]
    values = np.linalg.solve(e.N + 1e-6 * np.eye(k), b[..., None])[..., 0]
    return replace(
        e,
        b=b,
        values=values,
        yy=np.einsum("ek,ek->e", values, b),
        hidden=e.hidden.less(change) if e.hidden else None,
        bend=bend,
    )


def _bend(fitter: HypothesisFitter, fit: Fit, series: int, beyond: Array | None) -> Array:
    """What the image (E, T, 2) px of one series does beyond first order, but for its mean."""
    e = fitter.series[series]
    C, V, index = fit.designs[series]
    moved = (C * fit.coefficients[index]) @ V.T
    if beyond is not None:
        moved = moved + beyond
    rest = np.einsum("epq,eq->p", e.N, e.values - moved)
    # levels along combinations that the field cannot determine stay where they were
    level = np.linalg.lstsq(e.N.sum(axis=0), rest, rcond=1e-6)[0]
    step = moved + level
    parameters = step / e.scale
    points = e.source.field.points * (1.0 + parameters[:, None, 16:])
    seen = project(e.source.sensor, e.at.iop + parameters[:, :10],
                   e.at.eop + parameters[:, 10:16], points)  # fmt: skip
    straight = e.at.predicted + np.einsum("tik,ek->eti", e.columns, step)
    there = e.weights[..., :1] > 0
    bend = np.where(there, np.nan_to_num(seen - straight), 0.0)
    total = np.maximum(there.sum(axis=0), 1)
    out: Array = np.where(there, bend - bend.sum(axis=0) / total, 0.0)
    return out
