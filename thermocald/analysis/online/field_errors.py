"""What errs in one epoch's orientation: the noise of its image points, and the test field.

An adjustment's covariance holds both. In a sequence of epochs they are different things: the noise
is drawn again in every epoch, the errors of the targets' coordinates stay the same. With the design
matrices A (parameters) and B (coordinates), the weights W and Q = (AᵀWA)⁻¹ the estimate errs by
G e + K d, where G = QAᵀW, K = GB, e the noise and d the errors of the coordinates.

The level of the noise is measured from the differences between the residuals of consecutive epochs,
in which the errors of the field cancel; sigma0 would mix in how well the field's standard
deviations are stated.

Source: Mikhail and Ackermann (1976), Observations and Least Squares, chapter 4 (propagation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import partials, project
from thermocald.photogrammetry.epoch.gauss_markov import point_covariances

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.field.testfield import Observations, TestField

__all__ = ["EpochErrors", "FieldErrors"]

_MEMORY = 50  # epochs over which the level of the noise is averaged
_LEAST_DEGREES = 10.0
_MOVED_PX = 30.0  # from here on the partials are others
_OTHER_LENS = 0.02  # of c: another lens, and partials that correlate otherwise
_LOWEST, _HIGHEST = 0.05, 20.0  # of the measured over the stated variance of an image point


@dataclass(frozen=True, slots=True, eq=False)
class EpochErrors:
    """How one epoch's 16 parameters err.

    noise (16, 16): covariance from the image points alone, zero where held; influence (16, 3 T): of
    the coordinates of all T targets, per mm, zero for targets that the epoch did not use.
    """

    noise: Array
    influence: Array


class FieldErrors:
    """Splits the covariance of consecutive epochs before one test field.

    variances (3 T,): of the targets' coordinates, mm²; level: measured over stated variance of the
    image points, the first epoch's σ₀² until two are there.
    """

    def __init__(self, sensor: Sensor, testfield: TestField) -> None:
        self.variances: Array = np.square(testfield.sigmas).ravel()
        self.level = 1.0
        self._sensor = sensor
        self._field = testfield
        self._before: tuple[Array, Array] | None = None
        self._linearised: tuple[Array, Array, Array] | None = None
        self._c = 0.0
        self._compared = 0

    def split(
        self, adjustment: Adjustment, observations: Observations, field_variance: float = 1.0
    ) -> EpochErrors:
        """The errors of an epoch that has a result, from its own adjustment.

        adjustment: of these observations; its covariance tells which parameters are free;
        field_variance: by what the stated covariance of the coordinates is to be multiplied.
        """
        free = np.flatnonzero(np.diag(adjustment.covariance) > 0)
        used = observations.select(~np.isin(observations.targets, adjustment.rejected))
        rows = used.targets
        A, B = self._design(adjustment.values)
        A, B = A[rows], np.sqrt(field_variance) * B[rows]
        image = _blocks(point_covariances(used, None, None))
        total = _blocks(point_covariances(used, B, self._field.sigmas[rows] ** 2))
        A = A[:, :, free]
        WA = np.linalg.solve(total, A)
        G = np.einsum("uv,niv->nui", _inverse(np.einsum("niu,niv->uv", A, WA)), WA)
        noise = np.einsum("nui,nij,nvj->uv", G, image, G)
        information = np.einsum("niu,niv->uv", A, np.linalg.solve(image, A))
        influence = np.zeros((16, len(self._field), 3))
        influence[np.ix_(free, rows)] = np.einsum("nui,nik->unk", G, B)
        self._measure_level(adjustment, used, influence.reshape(16, -1)[free], noise, information)
        if not self._compared:
            # One epoch alone: its own residuals, which hold the field's errors too.
            redundancy = 2 * len(used) - len(free)
            own = min(max(adjustment.sigma0**2, _LOWEST), _HIGHEST)
            self.level = own if redundancy >= _LEAST_DEGREES else max(own, 1.0)
        covariance = np.zeros((16, 16))
        covariance[np.ix_(free, free)] = self.level * noise
        return EpochErrors(covariance, influence.reshape(16, -1))

    def _design(self, values: Array) -> tuple[Array, Array]:
        """Partials of all targets, at one orientation while the camera stays about there.

        Partials of every epoch's own values would differ by its noise, and a filter would take
        these differences for information on the field.
        """
        points = self._field.points
        at = self._linearised
        if at is not None:
            now = project(self._sensor, values[:10], values[10:], points)
            moved = float(np.nanmedian(np.abs(now - at[0])))
            if not moved < _MOVED_PX or abs(values[0] / self._c - 1.0) > _OTHER_LENS:
                at = None
        if at is None:
            self._c = float(values[0])
            at = self._linearised = partials(self._sensor, values[:10], values[10:], points)
        return at[1], at[2]

    def _measure_level(
        self,
        adjustment: Adjustment,
        used: Observations,
        influence: Array,
        noise: Array,
        information: Array,
    ) -> None:
        """Compare the residuals with those of the epoch before.

        influence (u, 3 T), noise (u, u) of the free parameters; information (u, u): that of the
        image points alone.
        """
        residuals = np.full((len(self._field), 2), np.nan)
        residuals[adjustment.targets] = adjustment.residuals
        whitened = np.full_like(residuals, np.nan)
        whitened[used.targets] = residuals[used.targets] / used.sigmas
        before, self._before = self._before, (whitened, influence)
        if before is None or len(before[1]) != len(influence):
            return
        both = np.isfinite(before[0][:, 0]) & np.isfinite(whitened[:, 0])
        u = float(len(influence))
        # The weights hold the field too: only without it the trace is the number of unknowns.
        overlap = min(float(np.sum(noise * information)), u)
        degrees = 2.0 * np.count_nonzero(both) - 2.0 * u + overlap
        if degrees < _LEAST_DEGREES:
            return
        found = float(np.sum((whitened[both] - before[0][both]) ** 2))
        # Other targets in view: the field's errors shift the parameters by something else.
        shift = influence - before[1]
        found -= float(np.sum((shift * self.variances @ shift.T) * information))
        found = min(max(found / (2.0 * degrees), _LOWEST), _HIGHEST)
        self._compared = min(self._compared + 1, _MEMORY)
        self.level += (found - self.level) / self._compared


def _blocks(covariance: Array) -> Array:
    """Covariances (n, 3), elements xx, yy, xy, as matrices (n, 2, 2)."""
    xx, yy, xy = covariance.T
    out: Array = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    return out


def _inverse(N: Array) -> Array:
    """Inverse of normal equations whose parameters differ by ten orders."""
    scale = 1.0 / np.sqrt(np.diag(N))
    inverse: Array = np.linalg.inv(N * np.outer(scale, scale)) * np.outer(scale, scale)
    return inverse
