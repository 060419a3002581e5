"""Where a series is linearised: one camera for its mean image, and what the partials leave.

The normal equations of a series hold partial derivatives at one point. An error of that point is
one of the rates: the point is as sharp as the mean image is. The image does not follow the
principal distance in straight lines: over the range of a year that is a hundred-thousandth.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, project
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings, adjust
from thermocald.photogrammetry.epoch.cold_start import cold_start
from thermocald.photogrammetry.epoch.geometry import GeometryBounds
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.series.normals import linearise, normal_matrices, right_hand_sides
from thermocald.reduction.series import SeriesInput, solve

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.series.normals import Partials

__all__ = ["curvature", "linearised"]

_MEAN_IMAGE_PX, _SHARPEST_PX = 0.1, 1e-4  # standard deviation of the mean image's points
_ANY_GEOMETRY = GeometryBounds(0, 2.0, 1e9, 1e9, 0.0, 0.0)


def _loose(source: SeriesInput, affinity: bool) -> AdjustmentSettings:
    """All parameters free: where C1 or C2 is held, the principal point makes up for it, and the
    partials are those of another camera. Weak ones stay near zero.
    """
    c = source.principal_distance or source.sensor.width * source.sensor.pixel_pitch
    spreads = (0.3 / c**2, 0.3 / c**4, 0.3 / c**6, 0.02 / c, 0.02 / c, 0.02, 0.02)
    free = IOP_NAMES if affinity else IOP_NAMES[:-2]
    priors = {n: (0.0, sd) for n, sd in zip(IOP_NAMES[3:], spreads, strict=True) if n in free}
    return AdjustmentSettings(free, priors, max_rejected=0.9, bounds=_ANY_GEOMETRY)


def linearised(source: SeriesInput, affinity: bool) -> Partials:
    """The linearisation: one camera for the mean image of the series."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        mean = np.nanmedian(source.grid.points, axis=0)
    # targets seen in half of the epochs that show any carry the orientation
    looked = int(source.grid.observed.any(axis=1).sum())
    often = source.grid.observed.sum(axis=0) >= 0.5 * max(looked, 1)
    rows = np.flatnonzero(np.isfinite(mean[:, 0]) & often)
    seen = Observations(rows, mean[rows], np.full((len(rows), 2), _MEAN_IMAGE_PX))
    settings = _loose(source, affinity)
    found = cold_start(
        source.sensor, source.field, seen, settings, source.principal_distance,
        None if affinity else source.interior,
    )  # fmt: skip
    if found.interior is None or found.exterior is None:
        raise DataError(
            f"{source.name}: the camera cannot be oriented on its mean image: {found.reason}"
        )
    # as sharp as it is, else the weak priors pull at the camera: 1e-4 of a year's rates
    rejected = np.isin(seen.targets, found.rejected)
    left = float(np.sqrt(np.mean(np.square(found.residuals[~rejected]))))
    sigmas = np.full((len(rows), 2), np.clip(left, _SHARPEST_PX, _MEAN_IMAGE_PX))
    better = adjust(
        source.sensor, source.field, replace(seen, sigmas=sigmas), found.interior, found.exterior,
        replace(settings, snooping_alpha=0.0), rejected,
    )  # fmt: skip
    if better.interior is not None and better.exterior is not None:
        found = better
    return linearise(source.sensor, source.field, found.values[:10], found.values[10:])


def curvature(source: SeriesInput, at: Partials, weights: Array, misclosure: Array) -> Array:
    """What the partials leave of the image's movement with the principal distance (E, T, 2) px.

    A tenth of a per mille of the movement, which the rates of a year would hold. The principal
    distance is that of the image's scale and shift; the principal point moves the image in straight
    lines, and what a mount does is small against either.
    """
    A = at.A[:, :, :3]
    N = normal_matrices(weights, A)
    change = solve(N, right_hand_sides(weights, misclosure, A))[:, 0]
    low, high = at.iop.copy(), at.iop.copy()
    step = 1e-3 * float(at.iop[0])
    low[0], high[0] = at.iop[0] - step, at.iop[0] + step
    ends = project(source.sensor, np.stack([low, high]), at.eop, source.field.points)
    second = np.nan_to_num((ends.sum(axis=0) - 2.0 * at.predicted) / step**2)
    # a gross error that is not known yet is not the camera's
    change = np.where(np.abs(change) < 0.02 * at.iop[0], change, 0.0)
    out: Array = 0.5 * np.square(change)[:, None, None] * second
    return out
