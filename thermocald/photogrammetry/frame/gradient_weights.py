"""Fixed gradient weights: the next epoch's centres as weighted sums of grey values.

Between epochs a centre moves by hundredths of a pixel, and the blurred disc of the last fit is
still the right one to the first order. One step of Gauss-Newton from there is a sum over pixels
whose weights can be kept: δ = N⁻¹ Jᵀ W (g − model). It is as precise as the fit itself, at the
Cramér-Rao bound. Errors of second order are even about the centre and drop out; those of third
order reach a thousandth of a pixel at 0.15 px, where the weights have to be renewed.

A change of light scales the partials; it is estimated with the rest and taken out of the step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from thermocald.photogrammetry.targets.circle import blurred_disc
from thermocald.photogrammetry.targets.outline import windows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image, Single
    from thermocald.photogrammetry.targets.frame_status import NoiseModel
    from thermocald.photogrammetry.targets.outline import LocalMap

__all__ = ["GradientWeights", "LinearStep"]


@dataclass(frozen=True, slots=True, eq=False)
class LinearStep:
    """What fixed weights say of a frame: parameters (n, 10) as `blurred_disc`; moved (n,) px since
    the weights were made; covariances (n, 2, 2) px² and misfit (n,) with the noise as it was then.
    """

    parameters: Array
    moved: Array
    covariances: Array
    misfit: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    rows: NDArray[np.int64]
    pixel: NDArray[np.int64]
    value: Single
    weight: Single
    weighted_partials: Single


@dataclass(frozen=True, slots=True, eq=False)
class GradientWeights:
    """Weights for n targets, made from their parameters (n, 10).

    inverse (n, 10, 10): of the normal matrices; freedom (n,): pixels beyond the parameters.
    """

    parameters: Array
    parts: tuple[_Part, ...]
    inverse: Array
    freedom: Array

    @classmethod
    def build(
        cls,
        image: Image,
        maps: LocalMap,
        coded: NDArray[np.bool_],
        parameters: Array,
        noise: NoiseModel,
    ) -> Self:
        """From fitted parameters (n, 10); of the image only the size counts."""
        parts = []
        inverse = np.zeros((len(parameters), 10, 10))
        freedom = np.ones(len(parameters))
        placed = maps.at(parameters[:, :2])
        blur = float(np.median(parameters[:, 5])) if len(parameters) else 0.9
        for w in windows(image, placed, coded, blur):
            p = parameters[w.rows].copy()
            p[:, :2] -= w.origin
            value, j = blurred_disc(placed.select(w.rows), p, w.x, w.y)
            weight = (w.weight / noise.variance(value)).astype(np.float32)
            jw = np.ascontiguousarray((j * weight).transpose(1, 0, 2))
            N = (jw @ j.transpose(1, 2, 0)).astype(float)
            scale = np.sqrt(np.maximum(np.einsum("nii->ni", N), 1e-12))
            scaled = N / (scale[:, :, None] * scale[:, None, :]) + 1e-10 * np.eye(10)
            inverse[w.rows] = np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])
            freedom[w.rows] = np.maximum(w.weight.sum(axis=1) - 10, 1)
            parts.append(_Part(w.rows, w.pixel.astype(np.int64), value, weight, jw))
        return cls(parameters, tuple(parts), inverse, freedom)

    def apply(self, image: Image) -> LinearStep:
        """The step from the weights' own epoch to this image, which must be of the same size."""
        n = len(self.parameters)
        rhs, square = np.zeros((n, 10)), np.zeros(n)
        flat = image.ravel()
        for part in self.parts:
            r = flat.take(part.pixel, mode="clip").astype(np.float32)
            r -= part.value
            rhs[part.rows] = (part.weighted_partials @ r[..., None])[..., 0]
            r *= r
            r *= part.weight
            square[part.rows] = r.sum(axis=1)
        delta = (self.inverse @ rhs[..., None])[..., 0]
        square -= np.sum(rhs * delta, axis=1)
        contrast = self.parameters[:, 7]
        # Position, shape and blur act in proportion to the contrast there is now.
        gain = contrast / np.where(np.abs(contrast + delta[:, 7]) > 0.1 * np.abs(contrast),
                                   contrast + delta[:, 7], np.inf)  # fmt: skip
        delta[:, :6] *= gain[:, None]
        return LinearStep(
            self.parameters + delta,
            np.abs(delta[:, :2]).max(axis=1, initial=0.0),
            self.inverse[:, :2, :2] * (gain**2)[:, None, None],
            np.sqrt(np.maximum(square, 0.0) / self.freedom),
        )
