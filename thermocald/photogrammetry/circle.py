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
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.blurred_disc import blurred_disc, edge_distance
from thermocald.photogrammetry.noise import NoiseModel, estimate_noise
from thermocald.photogrammetry.outline import LocalMap
from thermocald.photogrammetry.ring_code import RING_INNER

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Image = NDArray[np.uint8] | NDArray[np.uint16]

__all__ = ["CircleFit", "fit_circles", "windows"]

REACH_PX = 4.5
"""Pixels farther from the outline carry nothing about the centre."""
_SMALLEST_SEMI_AXIS_PX = 1.8
_LARGEST_SATURATION = 0.05
_LARGEST_MOVE = 0.6  # of the minor semi-axis, and at least two px
_LARGEST_SHAPE = 0.35
_CONVERGED_PX = 0.01
_ITERATIONS = 12
_RING_CLEARANCE = 2.6  # standard deviations of the blur between a used pixel and the code ring
_MISFIT = 3.0  # residual sd over the frame's noise beyond which something covers the target
_MISFIT_CONTRAST = 0.03
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
    """The pixels about some targets: rows of the targets, x, y, grey, weight (n, k); k is padded,
    the padding has weight 0. cut (n,): whether the image's edge cuts the target.
    """

    rows: NDArray[np.int64]
    x: Array
    y: Array
    grey: Array
    weight: Array
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
    reach_px = max(reach, 4.5 * blur)
    half = np.ceil(maps.half_extent.max(axis=1) + reach_px).astype(int)
    order = np.argsort(half, kind="stable")
    flat = image.ravel()
    start = 0
    while start < len(order):
        stop = start + 1
        while (
            stop < len(order)
            and (stop + 1 - start) * (2 * half[order[stop]] + 1) ** 2 <= chunk_pixels
            and half[order[stop]] <= 1.25 * half[order[start]] + 1
        ):
            stop += 1
        rows = order[start:stop]
        start = stop
        part = maps.select(rows)
        h = int(half[rows].max())
        offset = np.arange(-h, h + 1)
        origin = np.rint(part.centre).astype(int)
        ix = np.tile(offset, len(offset))[None] + origin[:, :1]
        iy = np.repeat(offset, len(offset))[None] + origin[:, 1:]
        d, rho = edge_distance(part, ix - part.centre[:, :1], iy - part.centre[:, 1:])
        use = np.abs(d) <= reach_px
        if np.any(coded[rows]):
            # d = (1 − ρ)/|∇ρ|, so the ring's inner edge is (2 − ρ)/|∇ρ| = d (2 − ρ)/(1 − ρ) away
            with np.errstate(divide="ignore", invalid="ignore"):
                ring = np.where(rho > 1, d * (RING_INNER - rho) / (1 - rho), np.inf)
            use &= ~coded[rows, None] | (ring >= _RING_CLEARANCE * blur)
        inside = (ix >= 0) & (ix < width) & (iy >= 0) & (iy < height)
        cut = np.any(~inside & (d > -2.0), axis=1)
        use &= inside
        count = use.sum(axis=1)
        k = max(int(count.max()), 1)
        first = np.argsort(~use, axis=1, kind="stable")[:, :k]
        ix, iy = np.take_along_axis(ix, first, 1), np.take_along_axis(iy, first, 1)
        used = np.arange(k)[None] < count[:, None]
        grey = flat[np.where(used, iy * width + ix, 0)].astype(float)
        yield Windows(rows, ix.astype(float), iy.astype(float), grey, used.astype(float), cut)


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
    parameters = np.zeros((n, 10))
    normal = np.zeros((n, 10, 10))
    pixels = np.zeros(n)
    square = np.zeros(n)
    saturation = np.zeros(n)
    last_step = np.full(n, np.inf)
    cut = np.zeros(n, dtype=bool)
    top = np.iinfo(image.dtype).max
    parts = list(windows(image, maps, coded, blur)) if n else []
    # The second pass begins where the first ended, with weights by the noise the first one found.
    for final in (False, True):
        greys, residuals = [], []
        for w in parts:
            part = maps.select(w.rows)
            if final:
                begin, rounds = parameters[w.rows], 1
            else:
                begin = _begin(w, part, blur) if start is None else start[w.rows]
                rounds = iterations
            p, value, step, N = _gauss_newton(w, part, begin, noise, rounds)
            parameters[w.rows], last_step[w.rows], normal[w.rows] = p, step, N
            r = w.grey - value
            greys.append(value[w.weight > 0])
            residuals.append(r[w.weight > 0])
            weight = w.weight / (noise.variance(value) if noise is not None else 1.0)
            square[w.rows] = np.sum(weight * r * r, axis=1)
            pixels[w.rows] = w.weight.sum(axis=1)
            cut[w.rows] = w.cut
            saturation[w.rows] = np.sum(w.weight * (w.grey >= top), axis=1) / np.maximum(
                pixels[w.rows], 1
            )
        if noise is not None:
            break
        noise = (
            estimate_noise(np.concatenate(greys), np.concatenate(residuals))
            if greys
            else NoiseModel(1.0)
        )
    assert noise is not None
    misfit = np.sqrt(square / np.maximum(pixels - 10, 1))
    covariances = (
        _centre_covariance(normal)
        * np.maximum(
            1.0, np.where(misfit**2 > 1 + 4 * np.sqrt(2 / np.maximum(pixels, 1)), misfit**2, 1.0)
        )[:, None, None]
    )
    fit = CircleFit(parameters, covariances, misfit, saturation, ("",) * n, noise)
    return replace(fit, reasons=_reasons(fit, maps, cut, pixels, last_step))


def _begin(w: Windows, maps: LocalMap, blur: float) -> Array:
    """Background and contrast from the pixels well outside and inside, the rest from the map."""
    d, _ = edge_distance(maps, w.x - maps.centre[:, :1], w.y - maps.centre[:, 1:])
    outside, inside = w.weight * (d < -1.5), w.weight * (d > 1.0)
    p = np.zeros((len(maps), 10))
    p[:, :2] = maps.centre
    p[:, 5] = blur
    p[:, 6] = np.sum(outside * w.grey, axis=1) / np.maximum(outside.sum(axis=1), 1)
    p[:, 7] = np.sum(inside * w.grey, axis=1) / np.maximum(inside.sum(axis=1), 1) - p[:, 6]
    p[:, 7] = np.where(np.abs(p[:, 7]) < 1, 1.0, p[:, 7])
    return p


def _gauss_newton(
    w: Windows, maps: LocalMap, begin: Array, noise: NoiseModel | None, rounds: int
) -> tuple[Array, Array, Array, Array]:
    """Parameters, grey values, size of the last step of the centre (px), normal matrices."""
    p = begin.copy()
    weight = w.weight
    value, j = blurred_disc(maps, p, w.x, w.y)
    step = np.full(len(p), np.inf)
    N = np.zeros((len(p), 10, 10))
    for _ in range(rounds):
        if noise is not None:
            weight = w.weight / noise.variance(value)
        jw = j * weight[:, None, :]
        N = jw @ np.swapaxes(j, 1, 2)
        rhs = (jw @ (w.grey - value)[..., None])[..., 0]
        delta = np.clip(_solve(N, rhs), -_STEP_LIMITS, _STEP_LIMITS)
        p = p + delta
        p[:, 5] = np.clip(p[:, 5], 0.2, 6.0)
        p[:, 2:5] = np.clip(p[:, 2:5], -0.6, 0.6)
        step = np.abs(delta[:, :2]).max(axis=1)
        value, j = blurred_disc(maps, p, w.x, w.y)
        if bool(np.all(step < _CONVERGED_PX)):
            break
    return p, value, step, N


def _solve(N: Array, rhs: Array) -> Array:
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
