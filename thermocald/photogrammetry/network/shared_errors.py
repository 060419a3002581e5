"""The errors that the image points of one photograph share, in a network of photographs.

Another focus, a shifted principal point, a sheared image (rolling shutter), a bent field, and what
else bends the image smoothly. Their variances are estimated from the residuals.

Source: Harville, D. A. (1977): Maximum likelihood approaches to variance component estimation and
to related problems, Journal of the American Statistical Association 72, section 5.2.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.field.planes import plane_fit
from thermocald.photogrammetry.network.bundle import sum_at

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.network.bundle import Bundle, BundleAdjustment, Cofactors


_OF_CAMERA = ("c", "x0", "y0", "C1", "C2")
# of `_OF_CAMERA`, of the squares of a bent field, and of squares in the image
_KINDS = (0, 1, 1, 2, 2, 3, 3, 3, 4, 4, 4, 4, 4, 4)
_FEWEST_TO_COMPARE = 3  # photographs
_LEAST_SHARE = 1e-6  # of the largest eigenvalue, below which an error is absorbed altogether
_DISAGREE = 3.0  # standard deviations of the ratio of two variances
_ITERATIONS = 60
_WIDEST = 3.0  # the factor for a variance from hardly any degree of freedom


class SharedErrors(NamedTuple):
    """The errors that the image points of one photograph share.

    disagreement: how many times larger than by chance, 1 if that may be chance; noise: variance of
    unit weight without them; cameras (e, u), targets (e, 3m): roots of what the e errors add to
    the covariance.
    """

    disagreement: float
    noise: float
    cameras: Array
    targets: Array


def estimate_shared_errors(
    adjustment: BundleAdjustment,
    bundle: Bundle,
    found: Cofactors,
    variance: float,
    redundancy: float,
) -> SharedErrors:
    """Estimate the errors that the image points of one photograph share.

    variance: of unit weight, from all residuals. What all photographs have in common shows
    nothing and is left out.
    """
    rays, k, f, q = adjustment.rays, len(bundle.centres), len(adjustment.free), len(_KINDS)
    E, ones = _effects(adjustment, bundle), np.ones(len(adjustment.rays))
    v, by_camera, by_point = adjustment.linearised(bundle, ones)
    C, P, F = (np.swapaxes(part, 1, 2) for part in (by_camera, by_point, E))
    photo, target, m = rays.photo[:, None], rays.target[:, None], len(bundle.points)
    R = sum_at((f + 6 * k, k, q), (adjustment.columns, photo), C @ E)
    r = sum_at((m, 3, k, q), (target, np.arange(3), photo), P @ E)
    blocks = sum_at((k, q, q), (rays.photo,), F @ E)
    b = sum_at((k, q), (rays.photo,), F @ v[..., None])
    R_all, r_all = R.reshape(len(R), -1), r.reshape(-1, k * q)
    # how cameras and targets follow the errors
    cameras = found.cameras @ (R_all + found.follow @ r_all)
    targets = (found.own @ r.reshape(-1, 3, k * q)).reshape(r_all.shape)
    targets += found.follow.T @ cameras
    M = (-R_all.T @ cameras - r_all.T @ targets).reshape(k, q, k, q)
    np.einsum("iqip->iqp", M)[...] += blocks
    # their mean is eliminated
    of_mean = M.sum(axis=2).reshape(k * q, q)
    inverse = np.linalg.pinv(M.sum(axis=(0, 2)), rcond=1e-6, hermitian=True)
    b = b.ravel() - of_mean @ inverse @ b.sum(axis=0)
    M = M.reshape(k * q, k * q) - of_mean @ inverse @ of_mean.T
    values, vectors = np.linalg.eigh((M + M.T) / 2)
    known = values > _LEAST_SHARE * values[-1]
    rank = int(known.sum())
    left = redundancy - rank
    if k < _FEWEST_TO_COMPARE or left < rank:
        return SharedErrors(1.0, variance, 0 * cameras.T, 0 * targets.T)
    explained = float(np.sum((b @ vectors)[known] ** 2 / values[known]))
    noise = (variance * redundancy - explained) / left
    ratio = explained / rank / noise
    disagree = ratio > 1 + _DISAGREE * np.sqrt(2 / rank + 2 / left)
    sds = _variance_components(M / noise, b / noise, _WIDEST if disagree else 1.0)[:, None]
    return SharedErrors(
        float(np.sqrt(ratio)) if disagree else 1.0, noise, sds * cameras.T, sds * targets.T
    )


def _effects(adjustment: BundleAdjustment, bundle: Bundle) -> Array:
    """Return whitened partials (n, 2, q) of the image points by what photographs differ in
    (`_KINDS`), with a mean square of 1.
    """
    columns = np.array([IOP_NAMES.index(name) for name in _OF_CAMERA])
    every = replace(adjustment, free=columns, known=None)
    _, by_camera, by_point = every.linearised(bundle, np.ones(len(adjustment.rays)))
    middle, axes, _ = plane_fit(bundle.points)
    x, y, _ = ((bundle.points - middle) @ axes.T)[adjustment.rays.target].T
    bent = (by_point @ axes[2])[:, :, None] * np.stack([x * x, x * y, y * y], axis=1)[:, None]
    u, w = (adjustment.rays.points - adjustment.sensor.centre).T
    squares = np.stack([u * u, u * w, w * w], axis=1)
    smooth = adjustment.rays.whitening[..., None] * squares[:, None, None]
    smooth = smooth.reshape(len(squares), 2, 6)
    E = np.concatenate([by_camera[:, :, : len(columns)], bent, smooth], axis=2)
    size = np.sqrt(np.mean(np.sum(E * E, axis=1), axis=0))
    return E / np.where(size > 0, size, 1.0)


def _variance_components(M: Array, b: Array, widest: float) -> Array:
    """Return the standard deviation (k q,) of each photograph's errors by restricted maximum
    likelihood: one for all errors of a kind.

    M, b: their normal equations, for a noise of 1. With few photographs the variance itself is
    uncertain: it is that of Student's t with as many degrees of freedom as the data determine.
    """
    kinds = np.eye(max(_KINDS) + 1)[np.tile(_KINDS, len(b) // len(_KINDS))]
    start = (b**2 @ kinds) / np.maximum(M.diagonal() ** 2 @ kinds, 1e-300)
    variances = start
    for _ in range(_ITERATIONS):
        sds = np.sqrt(kinds @ variances)
        Q = np.linalg.inv(sds[:, None] * M * sds + np.eye(len(b)))
        errors = sds * (Q @ (sds * b))
        freedom = (1 - Q.diagonal()) @ kinds
        new = errors**2 @ kinds / np.maximum(freedom, 1e-12)
        new = np.clip(new, np.maximum(variances / 10, 1e-12 * start), variances * 10)
        # one that vanishes falls for long
        settled = np.all(np.abs(new - variances) < 1e-2 * variances + 1e-4 * start)
        variances = new
        if settled:
            break
    wider = np.minimum(freedom / np.maximum(freedom - 2, 1e-3), widest)
    result: Array = np.sqrt(kinds @ (variances * wider))
    return result
