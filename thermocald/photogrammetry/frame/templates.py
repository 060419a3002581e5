"""Natural control points, measured by least-squares matching with patches of a reference frame.

The user has clicked the points in the reference frame. If the image around a click is symmetric
about a point (a cross, a checkered board), this point is measured and replaces the click; if not,
as at the corner of a wall, the click with its standard deviation defines the point. In a frame, a
patch is searched by correlation, then fitted with shift, affinity, brightness and contrast.

Source: Gruen, A. (1985): Adaptive least squares correlation, S. Afr. J. of Photogrammetry 14(3);
Luhmann et al. (2014), section 5.4.5.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np

from thermocald.errors import ConfigurationError, ImageError
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.frame.measurement import Measurement
from thermocald.photogrammetry.targets.frame_status import OK, FrameStatus, inspect_frame
from thermocald.photogrammetry.targets.image_file import EncodedImage, decode_grey

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array

MATCHING_SD = "matching_px"
"""The quality of an observation that is its sd without that of the click, common to all frames."""

_HALF = 12  # px of a patch to either side of its point
_SEARCH_PX = 30  # how far from its expected place a point is searched
_TRACKED_PX = 8  # the same, first, if the last frame gives the place
_SYMMETRIC = (5, 8, 12)  # px, the windows in which a centre of symmetry is sought
_SYMMETRY = 0.75  # correlation of a window with itself turned by 180°
_FARTHEST_CLICK = 2.5  # standard deviations of a click
_AWAY_PX = 5  # how far a fit may be from the place found by the search
_REACH = _HALF + _AWAY_PX + 6  # px to either side of a start that a fit uses
_ALIKE = 0.75  # least correlation of a patch with the frame
_FEWEST = 3
_ITERATIONS = 15
_CONVERGED_PX = 1e-3
_INTERPOLATED_PX = 0.01  # sd of the interpolation by splines at sharp edges
_LEAST_CONTRAST = 3.0  # DN, root mean square


class Templates:
    """Measures control points (rows of `field`) in frames, from a reference frame and clicks.

    The derivatives of the patches by shift, affinity, brightness and contrast are computed once.
    """

    def __init__(self, reference: NDArray[Any], field: TestField, clicks: Observations) -> None:
        self._shape, self._field = reference.shape, field
        height, width = reference.shape
        margin = _HALF + 2
        low, high = (margin, margin), (width - margin, height - margin)
        inside = ((clicks.points >= low) & (clicks.points < high)).all(axis=1)
        self._rows = clicks.targets[inside]
        pairs = zip(clicks.points[inside], clicks.sigmas[inside], strict=True)
        # a click defines a centre of symmetry near it, or else is the point itself
        meant = []
        for click, sigma in pairs:
            farthest = _FARTHEST_CLICK * float(sigma.max())
            found = (_find_centre(reference, click, half, farthest) for half in _SYMMETRIC)
            centres = [centre for centre in found if centre is not None]
            default = click, np.diag(sigma**2)
            meant.append(max(centres, key=lambda c: c[2])[:2] if centres else default)
        self._points = np.array([point for point, _ in meant]).reshape(-1, 2)
        self._defined = np.array([C for _, C in meant]).reshape(-1, 2, 2)
        # the patches, and their steps of least squares
        v, u = np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1].astype(np.float64)
        spline = _spline(reference, self._points, _HALF + 8)
        unturned = np.tile([1.0, 0.0, 0.0, 1.0], (len(self._points), 1))
        every = np.arange(len(self._points))
        grey = _sampled(spline, every, np.hstack([self._points, unturned]), u, v)
        self._grey, self._grid = grey, (u.ravel(), v.ravel())
        self._weight = np.exp(-0.5 * (u**2 + v**2) / (_HALF / 1.8) ** 2)
        gy, gx = np.gradient(grey, axis=(1, 2)) if len(grey) else (grey, grey)
        flat = [gx, gy, gx * u, gx * v, gy * u, gy * v, grey, np.ones_like(grey)]
        J = np.stack(flat, axis=-1).reshape(len(grey), self._weight.size, 8)
        weighted = J * self._weight.reshape(-1, 1)
        N = np.linalg.pinv(np.swapaxes(weighted, -1, -2) @ J, rcond=1e-9, hermitian=True)
        self._step = N @ np.swapaxes(weighted, -1, -2)
        self._sandwich = (self._step @ np.swapaxes(self._step, -1, -2))[:, :2, :2]
        self.reset()

    @classmethod
    def read(cls, path: Path, field: TestField, clicks: Observations) -> Self:
        """Read the reference frame; ConfigurationError if too few of the points are in it."""
        try:
            made = cls(decode_grey(path), field, clicks)
        except ImageError as error:
            raise ConfigurationError(f"control_reference {path}: {error}") from error
        if len(made._rows) < _FEWEST:
            raise ConfigurationError(
                f"control_reference {path}: {len(made._rows)} control points have x, y within "
                f"the frame; at least {_FEWEST} are needed"
            )
        return made

    @property
    def image_size(self) -> tuple[int, int]:
        """The width and height of the reference frame, px."""
        return self._shape[1], self._shape[0]

    @property
    def reference(self) -> Observations:
        """The measured points in the reference frame."""
        none = np.zeros(len(self._rows))
        return Observations.build(self._rows, self._points, self._defined, {MATCHING_SD: none})

    def reset(self) -> None:
        """Forget where the points were in the last frame."""
        self._shift, self._reach = np.zeros(2), _SEARCH_PX

    def measure(self, image: NDArray[Any] | EncodedImage) -> Measurement:
        """Measure a frame; raises ImageError if it cannot be decoded."""
        if isinstance(image, EncodedImage):
            image = image.whole()  # not reused, since a gauge takes a frame a minute
        status = inspect_frame(image, self.image_size)
        if not status.ok:
            return Measurement(Observations.none(), status)
        found = self._search(image)
        if len(found.observations) < _FEWEST and self._shift.any():
            self.reset()
            found = self._search(image)
        return found

    def _search(self, image: NDArray[Any]) -> Measurement:
        """Match all patches, first near their places in the last frame, then farther away."""
        places, covariance, reasons = found = self._match(image, self._reach, slice(None))
        if self._reach < _SEARCH_PX and (lost := np.flatnonzero(reasons != "")).size:
            for column, again in zip(found, self._match(image, _SEARCH_PX, lost), strict=True):
                column[lost] = again
        ok = reasons == ""
        if ok.any():
            self._shift = np.median((places - self._points)[ok], axis=0)
        own = covariance[ok]
        spread = np.sqrt(np.trace(own, axis1=1, axis2=2) / 2)
        seen = Observations.build(
            self._rows[ok], places[ok], own + self._defined[ok], {MATCHING_SD: spread}
        )
        missed = dict(zip(self._rows[~ok].tolist(), reasons[~ok], strict=True))
        if len(seen) < _FEWEST:
            names = ", ".join(self._field.names[row] for row in missed)
            return Measurement(seen, FrameStatus("too_few", f"not recognised: {names}"), missed)
        self._reach = _TRACKED_PX
        return Measurement(seen, OK, missed)

    def _match(
        self, image: NDArray[Any], reach: int, rows: NDArray[np.int64] | slice
    ) -> tuple[Array, Array, NDArray[Any]]:
        """Search some patches within `reach` px of their expected places, and fit them.

        Returns places (n, 2) px, covariances (n, 2, 2) px², and why a patch was not found (n,).
        """
        places = self._points[rows] + self._shift
        reasons = np.full(len(places), "outside the frame, or in the dark", dtype=object)
        for k, patch in enumerate(self._grey[rows]):
            x, y = (round(float(c)) for c in places[k])
            left, top = max(x - reach - _HALF, 0), max(y - reach - _HALF, 0)
            if x < 0 or y < 0:
                continue
            window = image[top : y + reach + _HALF + 1, left : x + reach + _HALF + 1]
            window = window.astype(np.float32)
            if min(window.shape) > 2 * _HALF and cv2.meanStdDev(window)[1][0, 0] >= _LEAST_CONTRAST:
                score = cv2.matchTemplate(window, patch.astype(np.float32), cv2.TM_CCOEFF_NORMED)
                row, column = np.unravel_index(int(np.argmax(score)), score.shape)
                places[k], reasons[k] = (left + column + _HALF, top + row + _HALF), ""
        covariance = np.zeros((len(places), 2, 2))
        seen = np.flatnonzero(reasons == "")
        which = np.arange(len(self._grey))[rows][seen]
        places[seen], covariance[seen], reasons[seen] = self._fit(image, places[seen], which)
        return places, covariance, reasons

    def _fit(
        self, image: NDArray[Any], start: Array, rows: NDArray[np.int64]
    ) -> tuple[Array, Array, NDArray[Any]]:
        """Fit some patches to an image from their starts (n, 2) px; return as `_match`.

        The covariance is from the residuals, enlarged for the correlation between neighbours. A
        patch has a reason if its fit does not converge, or if it is not similar.
        """
        n, (u, v) = len(rows), self._grid
        grey, weight = self._grey[rows].reshape(n, -1), self._weight.ravel() / self._weight.sum()
        spline = _spline(image, start, _REACH)
        p = np.hstack([start, np.tile([1.0, 0.0, 0.0, 1.0], (n, 1))])
        r, alike = np.zeros(grey.shape), np.zeros(n)
        reasons = np.full(n, "the match does not converge", dtype=object)
        mean = grey @ weight
        variance = ((grey - mean[:, None]) ** 2) @ weight
        todo = np.arange(n)
        for _ in range(_ITERATIONS):
            if not todo.size:
                break
            sampled = _sampled(spline, todo, p[todo], u, v)
            # brightness and contrast first, then the shift and affinity of the frame's patch
            common = (sampled * (grey[todo] - mean[todo, None])) @ weight
            gain = np.where(common > 0, common / np.maximum(variance[todo], 1e-12), 1.0)
            middle = sampled @ weight
            level = middle - gain * mean[todo]
            spread = ((sampled - middle[:, None]) ** 2) @ weight * variance[todo]
            alike[todo] = common / np.sqrt(np.maximum(spread, 1e-12))
            r[todo] = (sampled - level[:, None]) / gain[:, None] - grey[todo]
            step = (self._step[rows[todo]] @ r[todo][:, :, None])[:, :, 0]
            # inverse compositional: the step moves the template, and is inverted for the frame
            a, b, c, d = step[:, 2:6].T + np.array([[1.0], [0.0], [0.0], [1.0]])
            inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
            A = p[todo, 2:].reshape(-1, 2, 2) @ inverse.transpose(2, 0, 1)
            p[todo, :2] -= (A @ step[:, :2, None])[:, :, 0]
            p[todo, 2:] = A.reshape(-1, 4)
            size = np.linalg.det(A)
            away = np.abs(p[todo, :2] - start[todo]).max(axis=1) > _AWAY_PX
            away |= ~((size > 0.5) & (size < 2.0))
            dark = common <= 0
            done = np.abs(step[:, :2]).max(axis=1) < _CONVERGED_PX
            for which, why in ((done, ""), (away, "the match runs away"), (dark, "not recognised")):
                reasons[todo[which]] = why
            todo = todo[~(done | away | dark)]
        reasons[(alike < _ALIKE) & (reasons == "")] = "not recognised"
        own = self._weight
        freedom = own.sum() ** 2 / (own**2).sum() - 8
        scale = (r**2 @ weight) * (1 + 8 / max(freedom, 1.0))
        scale *= _correlated(r.reshape(n, *own.shape))
        A = p[:, 2:].reshape(-1, 2, 2)
        covariance = A @ self._sandwich[rows] @ np.swapaxes(A, -1, -2) * scale[:, None, None]
        return p[:, :2], covariance + _INTERPOLATED_PX**2 * np.eye(2), reasons


def _spline(image: NDArray[Any], middle: Array, reach: int) -> tuple[Array, NDArray[np.int64]]:
    """Fit cubic splines to windows of an image, `reach` px to each side of places (n, 2).

    Beyond the image its edge pixels are repeated. Returns coefficients (n, m, m) and first pixels
    (n, 2). OpenCV's remap interpolates at 1/32 px only, and SciPy takes 20 MB of a daemon's memory.

    Source: Unser, M., Aldroubi, A., Eden, M. (1993): B-spline signal processing, IEEE Transactions
    on Signal Processing 41(2).
    """
    first = np.round(middle).astype(np.int64) - reach
    along = np.arange(2 * reach + 1)
    x = np.clip(first[:, :1] + along, 0, image.shape[1] - 1)
    y = np.clip(first[:, 1:] + along, 0, image.shape[0] - 1)
    inverse = _spline_inverse(len(along))
    return inverse @ image[y[:, :, None], x[:, None, :]] @ inverse.T, first


def _sampled(
    spline: tuple[Array, NDArray[np.int64]], rows: NDArray[np.int64], p: Array, u: Array, v: Array
) -> Array:
    """Return values (k, …) of the splines `rows` at x = p0 + p2 u + p3 v, y = p1 + p4 u + p5 v.

    p (k, 6).
    """
    coefficients, first = spline
    size, each = coefficients.shape[1], (..., *[None] * u.ndim)
    a = (p - np.pad(first[rows], [(0, 0), (0, 4)]))[each]
    x, y = a[:, 0] + a[:, 2] * u + a[:, 3] * v, a[:, 1] + a[:, 4] * u + a[:, 5] * v
    (column, wx), (line, wy) = _basis(x, size), _basis(y, size)
    window = rows[each] * size**2
    at, flat = window + line * size + column, coefficients.ravel()
    values = np.zeros(at.shape)
    for i in range(4):
        row = sum(wx[j] * flat[i * size + j :].take(at) for j in range(4))
        values += wy[i] * row
    return values


@lru_cache(maxsize=16)
def _spline_inverse(size: int) -> Array:
    """Return the matrix from samples to coefficients of a cubic spline mirrored at its ends."""
    M = (4.0 * np.eye(size) + np.eye(size, k=1) + np.eye(size, k=-1)) / 6.0
    M[0, 1] = M[-1, -2] = 2.0 / 6.0
    return np.asarray(np.linalg.inv(M), dtype=float)


def _basis(x: Array, size: int) -> tuple[NDArray[np.int64], list[Array]]:
    """Return the first of the four coefficients at positions, and their weights."""
    whole = np.clip(np.floor(x), 1, size - 3)
    t = np.clip(x - whole, 0.0, 1.0)
    s = 1.0 - t
    t2, s2 = t * t, s * s  # a power takes ten times as long
    t3, s3 = t2 * t / 6, s2 * s / 6
    weights = [s3, 2 / 3 - t2 + 3 * t3, 2 / 3 - s2 + 3 * s3, t3]
    return whole.astype(np.int64) - 1, weights


def _find_centre(
    image: NDArray[Any], click: Array, half: int, farthest: float
) -> tuple[Array, Array, float] | None:
    """Return a centre of symmetry near a click, its covariance px², and the symmetry; or None."""
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    weight = np.exp(-0.5 * (u**2 + v**2) / (half / 1.5) ** 2)
    # a click may be off by pixels: start at the most symmetric one
    offsets = np.arange(-np.floor(farthest), farthest + 0.5)
    starts = [click + np.array([dx, dy]) for dy in offsets for dx in offsets]
    spline = _spline(image, click[None], half + 2 * math.ceil(farthest) + 4)

    def window(*at: float) -> Array:
        p = np.array([[*at, 1.0, 0.0, 0.0, 1.0]])
        values: Array = _sampled(spline, np.zeros(1, dtype=np.int64), p, u, v)[0]
        return values

    windows = [window(*at) for at in starts]
    alike = [_symmetry(w, weight) for w in windows]
    p = starts[int(np.argmax(alike))].copy()
    for _ in range(_ITERATIONS):
        w = window(*p)
        gy, gx = (np.asarray(g) for g in np.gradient(w))
        J = np.stack([gx - gx[::-1, ::-1], gy - gy[::-1, ::-1]], axis=-1).reshape(-1, 2)
        r = w - w[::-1, ::-1]
        N = (J * weight.reshape(-1, 1)).T @ J
        if np.linalg.cond(N) > 1e3:
            return None
        step = -np.linalg.solve(N, J.T @ (weight * r).ravel())
        p += step
        if np.abs(p - click).max() > farthest:
            return None
        if np.abs(step).max() < _CONVERGED_PX:
            break
    w = window(*p)
    symmetric = _symmetry(w, weight)
    if symmetric < _SYMMETRY:
        return None
    inverse = np.linalg.inv(N)
    M = (J * (weight**2).reshape(-1, 1)).T @ J
    # each pair of pixels is counted twice
    variance = 2.0 * float((weight * r**2).sum() / weight.sum())
    return p, inverse @ M @ inverse * variance * _correlated(r), symmetric


def _symmetry(window: Array, weight: Array) -> float:
    """Return a window's weighted correlation with itself turned by 180°; 0 without contrast."""
    # the weights are symmetric too, so that mean and variance of both are equal
    off = window - (weight * window).sum() / weight.sum()
    variance = float((weight * off**2).sum())
    return float((weight * off * off[::-1, ::-1]).sum()) / variance if variance > 0 else 0.0


def _correlated(r: Array) -> Array:
    """Return by what factor correlation between neighbouring residuals (…, m, m) enlarges the
    variance of their mean.
    """
    square = np.maximum(np.square(r).mean(axis=(-2, -1)), 1e-300)
    along = (r[..., 1:] * r[..., :-1]).mean(axis=(-2, -1)) / square
    down = (r[..., 1:, :] * r[..., :-1, :]).mean(axis=(-2, -1)) / square
    rho = np.clip([along, down], 0.0, 0.9)
    factor: Array = np.prod((1 + rho) / (1 - rho), axis=0)
    return factor
