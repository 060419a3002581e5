"""How the exterior orientation of a series is estimated: what was asked for, or the data show."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, IOP, free_columns
from thermocald.photogrammetry.series.mount import FEWEST_EPOCHS, estimate_movement
from thermocald.photogrammetry.series.movement import STILL, Movement, together
from thermocald.photogrammetry.series.normals import linearise

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.series.estimator import Estimate, SeriesEstimator
    from thermocald.photogrammetry.series.result import Exterior

__all__ = ["choose", "loose_bound", "observed_movement"]

_LOOSE_PX = 3.0  # far beyond what a mount trembles, and what one epoch knows of its perspective


def loose_bound(series: SeriesEstimator, start: Array) -> Array:
    """A bound (6, 6) of the mount to some pixels in the image by each parameter."""
    A = linearise(series.sensor, series.testfield, start[IOP], start[EOP]).A[..., EOP]
    return np.diag((A**2).sum(axis=1).mean(axis=0)) / _LOOSE_PX**2


def choose(
    series: SeriesEstimator, asked: Exterior, estimate: Estimate
) -> tuple[SeriesEstimator, str]:
    """The series with the exterior orientation that a first estimate allows, and why."""
    good = int(estimate.system.good.sum())
    if asked == "auto" and good < FEWEST_EPOCHS:
        own = replace(series, s=replace(series.s, exterior="per_epoch"), bound=None)
        return own, f"{good} epochs do not show how the mount moves ({FEWEST_EPOCHS} would)"
    movement = observed_movement(series, estimate)
    px = movement.image_px(estimate.system.design.at.A)
    noise = movement.noise_px(estimate.system.design.at.A)
    if movement.still and asked == "auto":
        still = replace(series, s=replace(series.s, exterior="series"), bound=None)
        return still, f"no movement of the mount beyond the noise of an epoch ({noise:.3f} px)"
    mount = replace(series, bound=movement.precision(), movement=movement)
    how = ""
    if movement.memory:
        part = movement.slow_fraction(estimate.system.design.at.A)
        slowly = f"over about {movement.memory:.0f} epochs"
        how = f", {part:.0%} of it {slowly if movement.memory < good / 3 else 'slowly'}"
    if movement.jumps:
        how += f", with jumps at row {', '.join(map(str, movement.jumps))}"
    return mount, f"the mount moves by {px:.3f} px about its mean pose{how}"


def observed_movement(series: SeriesEstimator, estimate: Estimate) -> Movement:
    """The variance components of the mount's movements."""
    system = estimate.system
    variance = series.variance(estimate)
    at = system.design.at
    before = np.concatenate([at.iop, at.eop])
    b = system.gradient(estimate.residuals)
    N = system.N
    b = b + np.einsum("eij,ej->ei", N, estimate.values - before)
    correlated = None
    if series.s.target_noise:
        pairs = series.pairs(estimate, system.use)
        if len(pairs):
            typical = (series.grid.weights * system.use[..., None])[system.good].mean(axis=0)
            extra = pairs.normal_matrices(typical[None], at.A[..., EOP])[0]
            correlated = extra / variance**2
    free = np.array(free_columns(series.s.free), dtype=np.int64)
    good = system.good & np.isfinite(b).all(axis=1)  # without epochs that diverged
    found, starts = [], []
    for part in series.windows or (slice(0, len(N)),):
        if good[part].sum() < FEWEST_EPOCHS and series.windows:
            continue
        starts.append(part.start)
        found.append(
            estimate_movement(
                N[part] / variance, b[part] / variance, free, good[part],
                series.s.drift_period, correlated,
            )
        )  # fmt: skip
    return together(found, starts) if found else STILL
