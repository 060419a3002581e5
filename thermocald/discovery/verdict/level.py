"""The level of a discovered model: camera and orientation at T₀, with all effects at zero.

The readings' errors move the level as they move the drifts, and so do the drifts' own: level and
drifts are one system of normal equations, from which the thermometers' errors are eliminated. What
the test field's coordinates do to the level is added.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.linalg import inverse_of_determined, scaled_inverse

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit
    from thermocald.reduction.series import ReducedSeries

__all__ = ["level_of"]

_P = len(PARAMETER_NAMES)


def level_of(fitter: HypothesisFitter, fit: Fit) -> tuple[Array, Array]:
    """Level (16,) of the first series about its linearisation, px-scaled, and its sds (16,).

    The scales of the test field are held. The sds hold the noise of image and thermometers, the
    drifts' own errors, and the stated errors of the test field's coordinates.
    """
    C, V = fitter.design(fit.terms, fit.blocks, 0, centred=False)[:2]
    index, weighting = fit.designs[0][2], fit.weightings[0]
    searched = list(fit.searched)
    dC, dV, mapping = fitter.derivatives(fit, searched, 0, centred=False)
    A, _, coupling = weighting.joint(np.hstack([C, dC]), np.hstack([V, dV]))
    drifts = coupling[:, : C.shape[1]] @ fit.coefficients[index]
    own = weighting.level_normal[:_P, :_P]
    level = inverse_of_determined(own) @ (weighting.level_b - drifts)[:_P]

    K = len(fit.coefficients)
    T = np.zeros((len(A) + _P, _P + K + len(searched)))
    T[np.arange(C.shape[1]), _P + index] = 1.0
    T[C.shape[1] : len(A), _P + K :] = mapping
    T[len(A) :, :_P] = np.eye(_P)
    normal = T.T @ np.block([[A, coupling[:_P].T], [coupling[:_P], own]]) @ T
    empty = np.diag(normal) <= 0
    normal[empty, empty] = 1e12  # a coefficient of another series
    variance = np.diag(scaled_inverse(normal))[:_P] + _of_the_field(fitter.series[0])
    return level, np.sqrt(variance)


def _of_the_field(series: ReducedSeries) -> Array:
    """Variances (16,) that the errors of the targets' coordinates give the level, px-scaled."""
    weights = series.weights[..., :2].sum(axis=0)
    A = series.columns[..., :_P]
    WA = A * weights[..., None]
    lever = np.einsum("tci,tcx->itx", WA, series.at.B).reshape(_P, -1)
    moved = inverse_of_determined(np.einsum("tci,tcj->ij", WA, A)) @ (
        lever * series.source.field.sigmas.ravel()
    )
    return np.asarray(np.einsum("ij,ij->i", moved, moved))
