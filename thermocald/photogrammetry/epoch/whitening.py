"""The covariance of each image point of an epoch, and equations freed of it.

The object coordinates' covariance is added to the image point's, which eliminates them. After a
multiplication by the inverse Cholesky factors all observations have unit weight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations

__all__ = ["Whitening", "point_covariances"]


def point_covariances(
    observations: Observations, B: Array | None, target_variances: Array | None
) -> Array:
    """Covariance (n, 3) px² of each image point, xx, yy, xy, its object coordinates' included."""
    out = np.zeros((3, len(observations)))
    np.square(observations.sigmas.T, out=out[:2])
    if observations.covariances is not None:
        out[2] = observations.covariances
    if B is not None and target_variances is not None:
        out[0] += (B[:, 0] ** 2 * target_variances).sum(axis=1)
        out[1] += (B[:, 1] ** 2 * target_variances).sum(axis=1)
        out[2] += (B[:, 0] * B[:, 1] * target_variances).sum(axis=1)
    return out.T


@dataclass(frozen=True, eq=False)
class Whitening:
    """Multiplication by the inverse Cholesky factors of the points' covariances.

    factor (2, n) px⁻¹: one over the diagonal of the Cholesky factors; slope (n,): regression of y
    on x, None where no x and y are correlated.
    """

    factor: Array
    slope: Array | None

    @classmethod
    def build(cls, covariance: Array) -> Whitening:
        """From the covariances (n, 3) px² of the points: xx, yy, xy."""
        xy = covariance[:, 2]
        variances, slope = covariance.T[:2], None
        if xy.any():
            slope = xy / covariance[:, 0]
            variances = variances.copy()
            variances[1] -= slope * xy
        return cls(1.0 / np.sqrt(variances), slope)

    def whiten(self, pairs: Array) -> Array:
        """Pairs (..., 2, n), in place."""
        if self.slope is not None:
            pairs[..., 1, :] -= self.slope * pairs[..., 0, :]
        pairs *= self.factor
        return pairs

    def colour(self, pair: Array) -> Array:
        """The inverse of `whiten` for one pair (2, n), as a copy."""
        coloured: Array = pair / self.factor
        if self.slope is not None:
            coloured[1] += self.slope * coloured[0]
        return coloured
