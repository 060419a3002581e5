"""Circular targets, measured by fitting a blurred disc to the grey values about each outline.

Gauss-Newton on the ten parameters of `blurred_disc`, many targets at once, only pixels near the
outline; each centre gets the covariance of its own fit with the noise of the frame (`noise`), so
that it stands at the Cramér-Rao bound and says so truthfully. What the measured centre means is
the local map's affair (`outline`): with a camera the projected 3D centre, without one the centre
of the ellipse.

Targets that cannot be measured get a reason instead of a number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.targets.blurred_disc import blurred_disc
from thermocald.photogrammetry.targets.noise import NoiseModel, estimate_noise
from thermocald.photogrammetry.targets.scratch import scratch
from thermocald.photogrammetry.targets.windows import windows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image, Single
    from thermocald.photogrammetry.targets.outline import LocalMap
    from thermocald.photogrammetry.targets.windows import Windows

__all__ = ["CircleFit", "fit_circles"]

_SMALLEST_SEMI_AXIS_PX = 1.8
_LARGEST_SATURATION = 0.05
_LARGEST_MOVE = 0.6  # of the minor semi-axis, and at least two px
_LARGEST_SHAPE = 0.35
_CONVERGED_PX = 0.03
_BLUR_SETTLED_PX = 0.1
_FLAT = 0.003  # of the contrast per px of movement
_FEWEST_FOR_LEVEL = 8
_ITERATIONS = 12
_MISFIT = 2.0  # residual sd over the frame's noise beyond which something covers the target
_MISFIT_CONTRAST = 0.015
# An image sharper than any lens makes it (reduced, or drawn) shows the pixels' squares, which the
# model rounds off: up to so much of the contrast at no blur, nothing from half a pixel on.
_MISFIT_SQUARES, _ROUND_FROM_PX = 0.035, 0.5
_FEWEST_PIXELS = 24
_STEP_LIMITS = np.array([1.0, 1.0, 0.15, 0.15, 0.15, 0.5, np.inf, np.inf, 0.02, 0.02])


@dataclass(frozen=True, slots=True, eq=False)
class CircleFit:
    """n circles as fitted: parameters (n, 10) as `blurred_disc`, covariances (n, 2, 2) px² of the
    centres, misfit (n,) residual sd over the frame's noise, saturation (n,) share of the pixels
    used; reasons: n words, empty where the fit is good; noise: of the frame.
    """

    parameters: Array
    covariances: Array
    misfit: Array
    saturation: Array
    reasons: tuple[str, ...]
    noise: NoiseModel

    @property
    def points(self) -> Array:
        """Centres (n, 2) px."""
        return self.parameters[:, :2]

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which fits are good (n,)."""
        return np.array([not reason for reason in self.reasons], dtype=bool)


def fit_circles(
    image: Image,
    maps: LocalMap,
    coded: NDArray[np.bool_] | None = None,
    blur: float = 0.9,
    noise: NoiseModel | None = None,
    start: Array | None = None,
    iterations: int = _ITERATIONS,
) -> CircleFit:
    """Fit circles whose outlines are about where `maps` says.

    image (H, W) grey, 8 or 16 bit; coded (n,): which have a code ring; blur: px, to begin with;
    noise: as known from earlier frames, else estimated from this one; start (n, 10): parameters
    to begin with.
    """
    n = len(maps)
    coded = np.zeros(n, dtype=bool) if coded is None else coded
    parts = list(windows(image, maps, coded, blur)) if n else []
    parameters = np.zeros((n, 10))
    work = scratch("partials", (2, 10 * max((w.x.size for w in parts), default=0)), np.float32)
    greys, residuals = [np.zeros(0, dtype=np.float32)], [np.zeros(0, dtype=np.float32)]
    # One step with a third of the pixels brings the fit near, and its residuals where the image is
    # flat tell how the noise grows with the light; all pixels then finish it.
    for w in parts:
        begin = w.begin if start is None else start[w.rows]
        thin = w.thinned()
        f = _step(thin, maps.select(w.rows), begin, noise, work, noise is None)
        parameters[w.rows] = f.parameters
        if noise is None:
            greys.append(f.value[f.flat])
            residuals.append(f.residual[f.flat])
    given = noise is not None
    if noise is None:
        noise = estimate_noise(np.concatenate(greys), np.concatenate(residuals), 3 * n)
    normal = np.zeros((n, 10, 10))
    pixels, square, saturation, last_step = (np.zeros(n) for _ in range(4))
    cut = np.zeros(n, dtype=bool)
    top = np.iinfo(image.dtype).max
    for w in parts:
        begin = parameters[w.rows]
        f = _gauss_newton(w, maps.select(w.rows), begin, noise, iterations, work)
        parameters[w.rows], normal[w.rows], last_step[w.rows] = f.parameters, f.normal, f.step
        pixels[w.rows] = w.weight.sum(axis=1)
        weight = w.weight / noise.variance(f.value)
        square[w.rows] = np.sum(weight * f.residual * f.residual, axis=1)
        saturation[w.rows] = np.sum(w.weight * (w.grey >= top), axis=1)
        cut[w.rows] = w.cut
    saturation /= np.maximum(pixels, 1)
    variance = square / np.maximum(pixels - 10, 1)
    if not given and n >= _FEWEST_FOR_LEVEL:
        # Its level is that of all residuals: paper and compression make noise at edges too.
        level = float(np.median(variance))
        noise, variance, normal = noise.scaled(level), variance / level, normal / level
    # A target that is noisier than the frame by more than chance has its own noise.
    own = np.where(variance > 1 + 4 * np.sqrt(2 / np.maximum(pixels, 1)), variance, 1.0)
    covariances = _centre_covariance(normal) * np.maximum(own, 1.0)[:, None, None]
    fit = CircleFit(parameters, covariances, np.sqrt(variance), saturation, ("",) * n, noise)
    return replace(fit, reasons=_reasons(fit, maps, cut, pixels, last_step))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    parameters: Array
    value: Single
    residual: Single
    normal: Array
    step: Array
    stands: NDArray[np.bool_]
    flat: NDArray[np.bool_]

    def put(self, rows: NDArray[np.int64], other: _Fit) -> None:
        """Replace some targets' fits by others."""
        for name in ("parameters", "value", "residual", "normal", "step", "stands"):
            getattr(self, name)[rows] = getattr(other, name)


def _gauss_newton(
    w: Windows,
    maps: LocalMap,
    begin: Array,
    noise: NoiseModel | None,
    rounds: int,
    work: Single,
) -> _Fit:
    """Iterate until the centres stand; only what does not stand yet goes on.

    work (2, m): memory for the partials; asking the system for it again costs more than the sums.
    """
    f = _step(w, maps, begin, noise, work)
    for _ in range(rounds - 1):
        left = np.flatnonzero(~f.stands)
        if not len(left):
            break
        part = maps.select(left)
        f.put(left, _step(w.select(left), part, f.parameters[left], noise, work))
    return f


def _step(
    w: Windows,
    maps: LocalMap,
    begin: Array,
    noise: NoiseModel | None,
    work: Single,
    tells_noise: bool = False,
) -> _Fit:
    """One step of Gauss-Newton; value and residual are those after it."""
    p = begin.copy()
    p[:, :2] -= w.origin
    shape = (10, *w.x.shape)
    j, jw = (row[: 10 * w.x.size].reshape(shape) for row in work)
    value, _ = blurred_disc(maps, p, w.x, w.y, out=j)
    weight = w.weight if noise is None else w.weight / noise.variance(value)
    np.multiply(j, weight, out=jw)
    residual = w.grey - value
    by_target = jw.transpose(1, 0, 2)
    N = (by_target @ j.transpose(1, 2, 0)).astype(float)
    delta = _limited(N, (by_target @ residual[..., None])[..., 0])
    p += delta
    p[:, 5] = np.clip(p[:, 5], 0.2, 6.0)
    p[:, 2:5] = np.clip(p[:, 2:5], -0.6, 0.6)
    p[:, :2] += w.origin
    change = (j.transpose(1, 2, 0) @ delta[..., None].astype(np.float32))[..., 0]
    flat = np.zeros(0, dtype=bool)
    if tells_noise:
        # Where a px of movement would change the grey value by next to nothing.
        slope = np.maximum(np.abs(j[0]), np.abs(j[1]))
        flat = (w.weight > 0) & (slope < _FLAT * np.abs(p[:, 7, None]))
    step = np.abs(delta[:, :2]).max(axis=1)
    stands = (step < _CONVERGED_PX) & (np.abs(delta[:, 5]) < _BLUR_SETTLED_PX)
    return _Fit(p, value + change, residual - change, N, step, stands, flat)


def _limited(N: Array, rhs: NDArray[np.floating[Any]]) -> Array:
    delta: Array = np.clip(_solve(N, rhs), -_STEP_LIMITS, _STEP_LIMITS)
    return delta


def _solve(N: Array, rhs: NDArray[np.floating[Any]]) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", N), 1e-12))
    scaled = N * scale[:, :, None]
    scaled *= scale[:, None, :]
    np.einsum("nii->ni", scaled)[:] += 1e-9
    solution: Array = np.linalg.solve(scaled, (rhs * scale)[..., None])[..., 0] * scale
    return solution


def _centre_covariance(N: Array) -> Array:
    """Of the first two unknowns, from normal matrices (n, p, p)."""
    scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", N), 1e-12))
    scaled = N * scale[:, :, None] * scale[:, None, :] + 1e-12 * np.eye(N.shape[-1])
    first_two = np.eye(N.shape[-1])[None, :, :2]  # NumPy 1 takes (p, 2) for vectors
    columns = np.linalg.solve(scaled, first_two)
    part: Array = columns[:, :2] * scale[:, :2, None] * scale[:, None, :2]
    return part


def _reasons(
    fit: CircleFit, maps: LocalMap, cut: NDArray[np.bool_], pixels: Array, step: Array
) -> tuple[str, ...]:
    minor = maps.semi_axes[:, 1]
    p = fit.parameters
    move = np.hypot(*(p[:, :2] - maps.centre).T)
    noise_sd = np.sqrt(fit.noise.variance(np.maximum(p[:, 6], p[:, 6] + p[:, 7])))
    shape = np.abs(p[:, 2:5]).max(axis=1, initial=0.0)
    misfit_dn = fit.misfit * noise_sd
    sharpness = np.clip(1 - p[:, 5] / _ROUND_FROM_PX, 0, 1)
    excused = (_MISFIT_CONTRAST + _MISFIT_SQUARES * sharpness) * np.abs(p[:, 7])
    covered = (fit.misfit > _MISFIT) & (misfit_dn > excused)
    tests = (
        (cut, "cut off by the image's edge"),
        ((minor < _SMALLEST_SEMI_AXIS_PX) | (pixels < _FEWEST_PIXELS), "too small"),
        (fit.saturation > _LARGEST_SATURATION, "saturated"),
        (~np.isfinite(p).all(axis=1) | (np.abs(p[:, 7]) < 6 * noise_sd), "too little contrast"),
        (p[:, 5] > np.maximum(0.75 * minor, 1.2), "too blurred for its size"),
        (
            (move > np.maximum(_LARGEST_MOVE * minor, 2.0))
            | (step > 0.05)
            | (shape > _LARGEST_SHAPE),
            "no circle where the target should be",
        ),
        (covered, "covered in part or disturbed"),
    )
    reasons = np.full(len(p), "", dtype=object)
    for bad, word in reversed(tests):
        reasons[bad] = word
    return tuple(reasons.tolist())
