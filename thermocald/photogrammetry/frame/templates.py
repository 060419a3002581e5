"""Natural control points, measured by least-squares matching with patches of a reference frame.

Somebody clicked the points in the reference frame once. Where what is there is symmetric about a
point (a cross, a checkered board) that point is measured and stands for the click; elsewhere, such
as at the corner of a wall, the click defines the point and keeps its standard deviation. In a frame
the patch is searched by correlation, then fitted with shift, affinity, brightness and contrast.

Source: Gruen, A. (1985): Adaptive least squares correlation, S. Afr. J. of Photogrammetry 14(3);
Luhmann et al. (2014), section 5.4.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from thermocald.errors import ConfigurationError, GeometryError, ImageError
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.frame.measurement import Measurement
from thermocald.photogrammetry.targets.frame_status import OK, FrameStatus, inspect_frame
from thermocald.photogrammetry.targets.image_file import EncodedImage, decode_grey

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array

MATCHING_SD = "matching_px"
"""Quality of an observation: its sd without that of the click, which all frames share."""

_HALF = 12  # px of a patch to either side of its point
_SEARCH_PX = 30  # a point is looked for so far from where it should be
_SYMMETRIC = (5, 8, 12)  # px, the windows in which a centre of symmetry is sought
_SYMMETRY = 0.75  # correlation of a window with itself turned by 180°
_FARTHEST_CLICK = 2.5  # its standard deviations
_MARGIN = 8  # px about what a spline is asked for
_ALIKE = 0.75  # correlation of a patch with the frame
_FEWEST = 3
_ITERATIONS = 15
_CONVERGED_PX = 1e-3
_INTERPOLATED_PX = 0.01  # what a spline through pixels makes of edges that are as sharp as these
_LEAST_CONTRAST = 3.0  # DN, root mean square


@dataclass(frozen=True, eq=False)
class _Patch:
    """A point's patch: row of the field, its place px and its definition's covariance (2, 2) px²,
    grey values (m, m), and why it cannot be used.
    """

    row: int
    point: Array
    defined: Array
    grey: Array
    symmetric: bool


class Templates:
    """Measures control points (rows of `field`) in frames, from a reference frame and clicks."""

    def __init__(self, reference: NDArray[Any], field: TestField, clicks: Observations) -> None:
        self._shape, self._field = reference.shape, field
        self.patches = [
            _patch(reference, int(row), point, sigma)
            for row, point, sigma in zip(clicks.targets, clicks.points, clicks.sigmas, strict=True)
            if _inside(reference, point)
        ]
        self._shift = np.zeros(2)
        self._sought = _SEARCH_PX

    @classmethod
    def read(cls, path: Path, field: TestField, clicks: Observations) -> Self:
        """Read the reference frame; ConfigurationError where it shows too few of the points."""
        try:
            made = cls(decode_grey(path), field, clicks)
        except ImageError as error:
            raise ConfigurationError(f"control_reference {path}: {error}") from error
        if len(made.patches) < _FEWEST:
            raise ConfigurationError(
                f"control_reference {path}: {len(made.patches)} control points have x, y within "
                f"the frame; at least {_FEWEST} are needed"
            )
        return made

    @property
    def reference(self) -> Observations:
        """The points in the reference frame, as measured."""
        at = np.array([p.point for p in self.patches]).reshape(-1, 2)
        C = np.array([p.defined for p in self.patches]).reshape(-1, 2, 2)
        rows = np.array([p.row for p in self.patches], dtype=np.int64)
        return _observations(rows, at, C, np.zeros(len(rows)))

    def reset(self) -> None:
        """Forget where the points were in the last frame."""
        self._shift, self._sought = np.zeros(2), _SEARCH_PX

    def measure(self, image: NDArray[Any] | EncodedImage) -> Measurement:
        """Measure a frame; raises ImageError where it cannot be decoded."""
        if isinstance(image, EncodedImage):
            image = image.whole()
        status = inspect_frame(image, (self._shape[1], self._shape[0]))
        if not status.ok:
            return Measurement(Observations.none(), status)
        missed: dict[int, str] = {}
        found = []
        for patch in self.patches:
            try:
                found.append((patch, *self._matched(image, patch)))
            except GeometryError as error:
                missed[patch.row] = str(error)
        if len(found) < _FEWEST and self._shift.any():
            self.reset()
            return self.measure(image)
        if found:
            self._shift = np.median([at - p.point for p, at, _ in found], axis=0)
        at = np.array([a for _, a, _ in found]).reshape(-1, 2)
        own = np.array([C for _, _, C in found]).reshape(-1, 2, 2)
        whole = own + np.array([p.defined for p, _, _ in found]).reshape(-1, 2, 2)
        rows = np.array([p.row for p, _, _ in found], dtype=np.int64)
        seen = _observations(rows, at, whole, np.sqrt(np.trace(own, axis1=1, axis2=2) / 2))
        if len(seen) < _FEWEST:
            names = ", ".join(self._field.names[row] for row in missed)
            status = FrameStatus("too_few", f"not recognised: {names}")
            return Measurement(seen, status, missed)
        return Measurement(seen, OK, missed)

    def _matched(self, image: NDArray[Any], patch: _Patch) -> tuple[Array, Array]:
        """Where a patch is in an image, and its covariance px²; GeometryError where it is not."""
        place = _searched(image, patch.grey, patch.point + self._shift, self._sought)
        return match(image, patch.grey, place)


def match(image: NDArray[Any], patch: Array, start: Array) -> tuple[Array, Array]:
    """Fit a patch (m, m) to an image from a start: its centre (2,) px and covariance (2, 2) px².

    The covariance is that of the residuals, enlarged by their correlation between neighbours.
    Raises GeometryError where it does not converge, or is unlike.
    """
    half = patch.shape[0] // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    weight = np.exp(-0.5 * (u**2 + v**2) / (half / 1.8) ** 2)
    gy, gx = np.gradient(patch.astype(float))
    p = np.array([*start, 1.0, 0.0, 0.0, 1.0])
    J = np.stack([gx, gy, gx * u, gx * v, gy * u, gy * v, patch, np.ones_like(u)], axis=-1)
    J, root = J.reshape(-1, 8), np.sqrt(weight).ravel()
    N = np.linalg.pinv((J * weight.reshape(-1, 1)).T @ J, rcond=1e-9, hermitian=True)
    gain, r = 1.0, np.zeros(patch.shape)
    for _ in range(_ITERATIONS):
        sampled = _sampled(image, p, u, v)
        flat = sampled.ravel()
        # brightness and contrast first, then how the frame's patch lies against the template
        B = np.stack([patch.ravel(), np.ones(flat.size)], axis=1) * root[:, None]
        (gain, level), *_ = np.linalg.lstsq(B, flat * root, rcond=None)
        if gain <= 0:
            raise GeometryError("not recognised")
        r = (sampled - level) / gain - patch
        step = N @ (J.T @ (weight * r).ravel())
        # inverse compositional: the step is the template's, and is undone in the frame
        A, S = p[2:].reshape(2, 2), np.eye(2) + step[2:6].reshape(2, 2)
        A = A @ np.linalg.inv(S)
        p = np.concatenate([p[:2] - A @ step[:2], A.ravel()])
        if np.abs(p[:2] - start).max() > half or not 0.5 < np.linalg.det(A) < 2.0:
            raise GeometryError("the match runs away")
        if np.abs(step[:2]).max() < _CONVERGED_PX:
            break
    else:
        raise GeometryError("the match does not converge")
    if _correlation(_sampled(image, p, u, v), patch, weight) < _ALIKE:
        raise GeometryError("not recognised")
    freedom = weight.sum() ** 2 / (weight**2).sum() - 8
    variance = float((weight * r**2).sum() / weight.sum()) * (1 + 8 / max(freedom, 1.0))
    M = (J * (weight**2).reshape(-1, 1)).T @ J
    A = p[2:].reshape(2, 2)
    covariance = A @ (N @ M @ N)[:2, :2] @ A.T * variance * _correlated(r)
    return p[:2], covariance + _INTERPOLATED_PX**2 * np.eye(2)


def symmetry_centre(
    image: NDArray[Any], click: Array, farthest: float
) -> tuple[Array, Array] | None:
    """Return the point near a click about which the image is symmetric, and its covariance px²."""
    best = None
    for half in _SYMMETRIC:
        found = _centre(image, click, half, farthest)
        if found is not None and (best is None or found[2] > best[2]):
            best = found
    return None if best is None else best[:2]


def _centre(
    image: NDArray[Any], click: Array, half: int, farthest: float
) -> tuple[Array, Array, float] | None:
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    weight = np.exp(-0.5 * (u**2 + v**2) / (half / 1.5) ** 2)
    # a click is a pixel or two off: the best start first
    offsets = np.arange(-np.floor(farthest), farthest + 0.5)
    starts = [click + np.array([dx, dy]) for dy in offsets for dx in offsets]
    windows = [_sampled(image, np.array([*at, 1, 0, 0, 1]), u, v) for at in starts]
    alike = [_correlation(w, w[::-1, ::-1], weight) for w in windows]
    p = starts[int(np.argmax(alike))].copy()
    for _ in range(_ITERATIONS):
        w = _sampled(image, np.array([*p, 1, 0, 0, 1]), u, v)
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
    w = _sampled(image, np.array([*p, 1, 0, 0, 1]), u, v)
    symmetric = _correlation(w, w[::-1, ::-1], weight)
    if symmetric < _SYMMETRY:
        return None
    inverse = np.linalg.inv(N)
    M = (J * (weight**2).reshape(-1, 1)).T @ J
    # each pair of pixels stands there twice
    variance = 2.0 * float((weight * r**2).sum() / weight.sum())
    return p, inverse @ M @ inverse * variance * _correlated(r), symmetric


def _patch(image: NDArray[Any], row: int, click: Array, sigma: Array) -> _Patch:
    found = symmetry_centre(image, click, _FARTHEST_CLICK * float(sigma.max()))
    point, defined = (click, np.diag(sigma**2)) if found is None else found
    v, u = np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1].astype(np.float64)
    grey = _sampled(image, np.array([*point, 1, 0, 0, 1]), u, v)
    return _Patch(row, np.array(point), defined, grey, found is not None)


def _inside(image: NDArray[Any], point: Array) -> bool:
    height, width = image.shape
    margin = _HALF + 2
    x, y = point
    return bool(margin <= x < width - margin and margin <= y < height - margin)


def _searched(image: NDArray[Any], patch: Array, near: Array, reach: int) -> Array:
    """The pixel where a patch correlates best; GeometryError outside the image."""
    half = patch.shape[0] // 2
    x, y = (round(float(c)) for c in near)
    left, top = max(x - reach - half, 0), max(y - reach - half, 0)
    window = image[top : y + reach + half + 1, left : x + reach + half + 1].astype(np.float32)
    if x < 0 or y < 0 or min(window.shape) <= 2 * half or window.std() < _LEAST_CONTRAST:
        raise GeometryError("outside the frame, or in the dark")
    score = cv2.matchTemplate(window, patch.astype(np.float32), cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    return np.array([left + column + half, top + row + half], dtype=float)


def _sampled(image: NDArray[Any], p: Array, u: Array, v: Array) -> Array:
    """Grey values at x = p0 + p2 u + p3 v, y = p1 + p4 u + p5 v, by cubic splines.

    OpenCV's remap would do so on 1/32 px only.
    """
    x, y = p[0] + p[2] * u + p[3] * v, p[1] + p[4] * u + p[5] * v
    height, width = image.shape
    left, top = max(int(x.min()) - _MARGIN, 0), max(int(y.min()) - _MARGIN, 0)
    right, bottom = min(int(x.max()) + _MARGIN, width), min(int(y.max()) + _MARGIN, height)
    if right - left < _MARGIN or bottom - top < _MARGIN:
        raise GeometryError("outside the frame")
    part = image[top:bottom, left:right].astype(float)
    values: Array = map_coordinates(part, [y - top, x - left], order=3, mode="nearest")
    return values


def _correlation(a: Array, b: Array, weight: Array) -> float:
    total = weight.sum()
    da, db = (x - (weight * x).sum() / total for x in (a, b))
    scale = np.sqrt((weight * da**2).sum() * (weight * db**2).sum())
    return float((weight * da * db).sum() / scale) if scale > 0 else 0.0


def _correlated(r: Array) -> float:
    """How much larger a mean's variance is than of independent residuals, by their neighbours."""
    square = float((r**2).mean())
    if not square > 0:
        return 1.0
    along = [float((r[:, 1:] * r[:, :-1]).mean()), float((r[1:] * r[:-1]).mean())]
    rho = np.clip(np.array(along) / square, 0.0, 0.9)
    return float(np.prod((1 + rho) / (1 - rho)))


def _observations(rows: NDArray[np.int64], at: Array, C: Array, own: Array) -> Observations:
    order = np.argsort(rows)
    sigmas = np.sqrt(np.stack([C[:, 0, 0], C[:, 1, 1]], axis=1))[order]
    return Observations(rows[order], at[order], sigmas, C[order, 0, 1], {MATCHING_SD: own[order]})
