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

from thermocald.photogrammetry.blurred_disc import blurred_disc, edge_distance
from thermocald.photogrammetry.noise import NoiseModel, estimate_noise
from thermocald.photogrammetry.ring_code import RING_INNER

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from thermocald.photogrammetry.outline import LocalMap

    Array = NDArray[np.float64]
    Single = NDArray[np.float32]
    Image = NDArray[np.uint8] | NDArray[np.uint16]

__all__ = ["CircleFit", "Windows", "fit_circles", "windows"]

REACH_PX = 4.0
"""Pixels farther from the outline carry nothing about the centre."""
_SMALLEST_SEMI_AXIS_PX = 1.8
_LARGEST_SATURATION = 0.05
_LARGEST_MOVE = 0.6  # of the minor semi-axis, and at least two px
_LARGEST_SHAPE = 0.35
_CONVERGED_PX = 0.03
_ITERATIONS = 12
_THIN = 3
_RING_CLEARANCE = 2.6  # standard deviations of the blur between a used pixel and the code ring
_MISFIT = 2.0  # residual sd over the frame's noise beyond which something covers the target
_MISFIT_CONTRAST = 0.015
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


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The pixels about some targets.

    rows (n,) of the targets; pixel (n, k): place in the flat image; origin (n, 2) px; x, y relative
    to it, grey, weight (n, k); k is padded, the padding has weight 0. begin (n, 10): parameters to
    begin with; cut (n,): whether the image's edge cuts the target.
    """

    rows: NDArray[np.int64]
    pixel: NDArray[np.int64]
    origin: Array
    x: Single
    y: Single
    grey: Single
    weight: Single
    begin: Array
    cut: NDArray[np.bool_]


def windows(
    image: Image,
    maps: LocalMap,
    coded: NDArray[np.bool_],
    blur: float = 0.9,
    reach: float = REACH_PX,
    chunk_pixels: int = 40_000,
) -> Iterator[Windows]:
    """The pixels near each outline, targets of like size together.

    coded (n,): targets with a code ring, which is kept out at `blur` px.
    """
    height, width = image.shape
    reach_px = max(reach, 4.0 * blur)
    half = np.ceil(maps.half_extent + reach_px).astype(int)
    pixels = np.prod(2 * half + 1, axis=1)
    # Targets of like size and like shape share a window.
    order = np.lexsort((half[:, 0], half.max(axis=1) // 3))
    flat = image.ravel()
    start = 0
    while start < len(order):
        stop, common = start + 1, half[order[start]]
        while stop < len(order):
            larger = np.maximum(common, half[order[stop]])
            area = int(np.prod(2 * larger + 1))
            if (stop + 1 - start) * area > chunk_pixels or area > 1.5 * pixels[order[start]]:
                break
            stop, common = stop + 1, larger
        rows = order[start:stop]
        start = stop
        # The ellipse alone is good enough to choose pixels by.
        part = maps.select(rows).without_eccentricity()
        ox, oy = (np.arange(-h, h + 1) for h in common.tolist())
        lx, ly = np.tile(ox, len(oy))[None], np.repeat(oy, len(ox))[None]
        origin = np.rint(part.centre).astype(np.int64)
        centre = (part.centre - origin).astype(np.float32)
        x, y = lx.astype(np.float32) - centre[:, :1], ly.astype(np.float32) - centre[:, 1:]
        d, rho = edge_distance(part, x, y)
        use = np.abs(d) <= reach_px
        if np.any(coded[rows]):
            # d = (1 − ρ)/|∇ρ|, so the ring's inner edge is (2 − ρ)/|∇ρ| = d (2 − ρ)/(1 − ρ) away
            with np.errstate(divide="ignore", invalid="ignore"):
                ring = np.where(rho > 1, d * (RING_INNER - rho) / (1 - rho), np.inf)
            use &= ~coded[rows, None] | (ring >= _RING_CLEARANCE * blur)
        cut = np.zeros(len(rows), dtype=bool)
        if np.any(origin < common) or np.any(origin + common >= (width, height)):
            ix, iy = lx + origin[:, :1], ly + origin[:, 1:]
            inside = (ix >= 0) & (ix < width) & (iy >= 0) & (iy < height)
            cut = np.any(~inside & (d > -2.0), axis=1)
            use &= inside
        count = use.sum(axis=1)
        k = max(int(count.max()), 1)
        # The pixels used, moved to the front of each row.
        where = np.flatnonzero(use)
        row = np.repeat(np.arange(len(rows)), count)
        place = np.arange(len(where)) + (k * np.arange(len(rows)) - (np.cumsum(count) - count))[row]
        shape = (len(rows), k)
        at = np.zeros(shape, dtype=np.int64)
        at.ravel()[place] = where - row * use.shape[1]
        weight = np.zeros(shape, dtype=np.float32)
        weight.ravel()[place] = 1.0
        distance = np.zeros(shape, dtype=np.float32)
        distance.ravel()[place] = d.ravel()[where]
        base = origin[:, 1:] * width + origin[:, :1]
        pixel = np.where(weight > 0, (ly * width + lx)[0].take(at) + base, 0)
        grey = flat.take(pixel).astype(np.float32)
        outside, inside = weight * (distance < -1.5), weight * (distance > 1.0)
        begin = np.zeros((len(rows), 10))
        begin[:, :2] = part.centre
        begin[:, 5] = blur
        begin[:, 6] = np.sum(outside * grey, axis=1) / np.maximum(outside.sum(axis=1), 1)
        begin[:, 7] = np.sum(inside * grey, axis=1) / np.maximum(inside.sum(axis=1), 1)
        begin[:, 7] -= begin[:, 6]
        begin[:, 7] += np.abs(begin[:, 7]) < 1
        yield Windows(
            rows, pixel, origin.astype(float), lx[0].astype(np.float32).take(at),
            ly[0].astype(np.float32).take(at), grey, weight, begin, cut,
        )  # fmt: skip


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
    fits = []
    for w in parts:
        begin = w.begin if start is None else start[w.rows]
        fits.append(_gauss_newton(w, maps.select(w.rows), begin, noise, iterations))
    if noise is None:
        pairs = list(zip(parts, fits, strict=True))
        greys = [f.value[:, ::_THIN][w.weight[:, ::_THIN] > 0] for w, f in pairs]
        residuals = [f.residual[:, ::_THIN][w.weight[:, ::_THIN] > 0] for w, f in pairs]
        empty = [np.zeros(0, dtype=np.float32)]
        noise = estimate_noise(
            np.concatenate(greys or empty), np.concatenate(residuals or empty), 10 * n // _THIN
        )
    parameters = np.zeros((n, 10))
    normal = np.zeros((n, 10, 10))
    pixels, square, saturation, last_step = (np.zeros(n) for _ in range(4))
    cut = np.zeros(n, dtype=bool)
    top = np.iinfo(image.dtype).max
    for w, f in zip(parts, fits, strict=True):
        p, N, residual, weight = f.parameters, f.normal, f.residual, w.weight
        if not f.weighted and noise.is_constant(f.value):
            weight, N = weight / noise.variance(f.value.mean()), N / noise.variance(f.value.mean())
        elif not f.weighted:
            # One more step with the frame's own noise; so small that the partials still hold.
            weight = weight / noise.variance(f.value)
            jw = f.partials * weight[:, None, :]
            N = (jw @ np.swapaxes(f.partials, 1, 2)).astype(float)
            delta = _limited(N, (jw @ residual[..., None])[..., 0])
            change = np.swapaxes(f.partials, 1, 2) @ delta[..., None].astype(np.float32)
            p, residual = p + delta, residual - change[..., 0]
        else:
            weight = weight / noise.variance(f.value)
        parameters[w.rows] = p
        normal[w.rows] = N
        last_step[w.rows] = f.step
        pixels[w.rows] = w.weight.sum(axis=1)
        square[w.rows] = np.sum(weight * residual * residual, axis=1)
        saturation[w.rows] = np.sum(w.weight * (w.grey >= top), axis=1)
        cut[w.rows] = w.cut
    saturation /= np.maximum(pixels, 1)
    misfit = np.sqrt(square / np.maximum(pixels - 10, 1))
    covariances = (
        _centre_covariance(normal)
        * np.maximum(
            1.0, np.where(misfit**2 > 1 + 4 * np.sqrt(2 / np.maximum(pixels, 1)), misfit**2, 1.0)
        )[:, None, None]
    )
    fit = CircleFit(parameters, covariances, misfit, saturation, ("",) * n, noise)
    return replace(fit, reasons=_reasons(fit, maps, cut, pixels, last_step))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    parameters: Array
    value: Single
    residual: Single
    partials: Single
    normal: Array
    step: Array
    weighted: bool


def _gauss_newton(
    w: Windows, maps: LocalMap, begin: Array, noise: NoiseModel | None, rounds: int
) -> _Fit:
    """Iterate until the centres stand; value and residual are those after the last step."""
    p = begin.copy()
    p[:, :2] -= w.origin
    step = np.full(len(p), np.inf)
    for k in range(max(rounds, 1)):
        # The first step only has to come near: a third of the pixels will do.
        thin = slice(None, None, _THIN if k == 0 and rounds > 1 else None)
        x, y, mask = w.x[:, thin], w.y[:, thin], w.weight[:, thin]
        value, j = blurred_disc(maps, p, x, y)
        weight = mask if noise is None else mask / noise.variance(value)
        jw = j * weight[:, None, :]
        residual = w.grey[:, thin] - value
        N = (jw @ np.swapaxes(j, 1, 2)).astype(float)
        delta = _limited(N, (jw @ residual[..., None])[..., 0])
        p = p + delta
        p[:, 5] = np.clip(p[:, 5], 0.2, 6.0)
        p[:, 2:5] = np.clip(p[:, 2:5], -0.6, 0.6)
        step = np.abs(delta[:, :2]).max(axis=1)
        if thin.step is None and bool(np.all(step < _CONVERGED_PX)):
            break
    change = (np.swapaxes(j, 1, 2) @ delta[..., None].astype(np.float32))[..., 0]
    p[:, :2] += w.origin
    return _Fit(p, value + change, residual - change, j, N, step, noise is not None)


def _limited(N: Array, rhs: NDArray[np.floating[Any]]) -> Array:
    delta: Array = np.clip(_solve(N, rhs), -_STEP_LIMITS, _STEP_LIMITS)
    return delta


def _solve(N: Array, rhs: NDArray[np.floating[Any]]) -> Array:
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", N), 1e-12))
    scaled = N / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(N.shape[-1])
    solution: Array = np.linalg.solve(scaled, (rhs / scale)[..., None])[..., 0] / scale
    return solution


def _centre_covariance(N: Array) -> Array:
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", N), 1e-12))
    inverse = np.linalg.inv(
        N / (scale[:, :, None] * scale[:, None, :]) + 1e-12 * np.eye(N.shape[-1])
    )
    part: Array = inverse[:, :2, :2] / (scale[:, :2, None] * scale[:, None, :2])
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
    covered = (fit.misfit > _MISFIT) & (misfit_dn > _MISFIT_CONTRAST * np.abs(p[:, 7]))
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
