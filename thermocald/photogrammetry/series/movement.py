"""How far a mount moves: a covariance without and one with memory, and what they do to a series."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.linalg import symmetric_power
from thermocald.photogrammetry.series.variance_components import mean_variance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array

__all__ = ["STILL", "Movement", "together"]

_HIDDEN = 0.3  # of the noise's variance: too little to estimate it epoch by epoch
_FLAT = 1e-6  # of the noise: directions without movement


@dataclass(frozen=True, eq=False)
class Movement:
    """How far a mount moves about its mean pose over a series.

    white, slow (6, 6): covariance of the exterior orientation, rad and mm, of a movement without
    and with memory, about the mean over the series; memory: epochs after which the latter has lost
    63 % of its correlation; noise (6, 6): covariance of the pose of one epoch with its interior
    orientation held; jumps: the epochs from which on it stood elsewhere.
    """

    white: Array
    slow: Array
    memory: float
    noise: Array
    jumps: tuple[int, ...] = ()

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of an epoch's movement."""
        return self.white + self.slow

    @property
    def still(self) -> bool:
        """Whether no movement was found that one epoch's noise would not hide."""
        whiten = self._whitening()
        inside = np.linalg.eigvalsh(whiten @ self.covariance @ whiten.T)
        return bool(inside[-1] < _HIDDEN)

    def _whitening(self) -> Array:
        """T with T · noise · Tᵀ = 1."""
        root = symmetric_power(_scaled(self.noise), -0.5, 1e-12)
        whitening: Array = root / np.sqrt(np.diag(self.noise))
        return whitening

    def precision(self) -> Array:
        """Inverse covariance (6, 6); directions without movement are held to 1e-3 of the noise."""
        T = self._whitening()
        inside = T @ self.covariance @ T.T
        return T.T @ symmetric_power(inside, -1.0, _FLAT) @ T

    def image_px(self, A: Array) -> float:
        """Movement of the image, px, by partials (T, 2, 16): RMS over targets, per coordinate."""
        return _rms_px(A, self.covariance)

    def noise_px(self, A: Array) -> float:
        """The same of what an epoch's noise is mistaken for."""
        return _rms_px(A, self.noise)

    def slow_fraction(self, A: Array) -> float:
        """Fraction of the movement's variance in the image that has a memory."""
        return (_rms_px(A, self.slow) / max(self.image_px(A), 1e-12)) ** 2

    def tilt(self, weights: Array) -> Array:
        """Covariance (6, 6) of Σ w m over the epochs, weights (E,): of a line, say."""
        white: Array = self.white * float(weights @ weights)
        if not self.slow.any():
            return white
        # w'Rw for R = φ^|i-j| in one pass
        phi, carried, total = float(np.exp(-1.0 / self.memory)), 0.0, 0.0
        for first in range(0, len(weights), 1 << 16):
            for w in weights[first : first + (1 << 16)].tolist():
                total += w * (w + 2.0 * carried)
                carried = phi * (carried + w)
        about_mean = 1.0 - mean_variance(phi, int(np.count_nonzero(weights)))
        return white + self.slow * (total / max(about_mean, 1e-6))


STILL = Movement(np.zeros((6, 6)), np.zeros((6, 6)), 0.0, np.eye(6))
"""A mount that does not move."""


def together(movements: Sequence[Movement], starts: Sequence[int]) -> Movement:
    """The mean of the movements of parts of a series, which start at some epochs.

    The memory is the longest; jumps count as those of the series.
    """
    return Movement(
        np.mean([m.white for m in movements], axis=0),
        np.mean([m.slow for m in movements], axis=0),
        max(m.memory for m in movements),
        np.mean([m.noise for m in movements], axis=0),
        tuple(start + row for m, start in zip(movements, starts, strict=True) for row in m.jumps),
    )


def _rms_px(A: Array, covariance: Array) -> float:
    E = A[..., EOP]
    return float(np.sqrt(np.einsum("tki,ij,tkj->tk", E, covariance, E).mean()))


def _scaled(Q: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(Q))
    scaled: Array = Q * np.outer(scale, scale)
    return scaled
