"""The image of a circular target: a blurred disc fitted to the grey values, and its centre.

A pixel p lies at q in the target's plane (`outline`), at radius ρ = |q|; its distance from the
outline is d = (1 − ρ)/|∇ρ|. The optics blur the step at the outline with a Gaussian, the pixel
integrates over its area (variance 1/12 px²), and the outline's curvature κ moves the blurred edge
inwards by κs²/2, which gives

    I(p) = (b + a Φ(z)) (1 + g·(p − c)),   z = (d − κs²/2)/s,   s² = blur² + 1/12

with background b, contrast a, and the gradient g of the light. Neglected terms are symmetric about
the centre, and do not move it.

The parameters are, in this order, x, y (px), m11, m12, m22 (correction of the shape,
q := (I + m) q), blur (px), b, a (DN), gx, gy (1/px). Coordinates are relative to a pixel near the
target, so that single precision is good to 1e-5 px; it takes half the time of double.

All ten are fitted by Gauss-Newton, many targets at once, with the pixels near the outline only. The
covariance of a centre is that of its own fit with the noise of the frame: the precision reaches the
Cramér-Rao bound, and the covariance is realistic. The local map (`outline`) defines the measured
centre: with a camera it is the projected 3D centre, without one the centre of the ellipse.

A target that cannot be measured gets a reason instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from thermocald.arrays import Array, Image, Single, scratch
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.linalg import inverse_2x2, scaled_solve
from thermocald.photogrammetry.targets.frame_status import (
    NoiseModel,
    estimate_noise,
    saturation_level,
)
from thermocald.photogrammetry.targets.outline import LocalMap, Windows, windows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


_PIXEL_VARIANCE = 1 / 12
_QUANTISATION_SD = np.sqrt(1 / 12)
_NORM = float(1 / np.sqrt(2 * np.pi))
# Φ(z) = (1 + tanh(z·polynomial(z²)))/2 to 2e-5, fitted by minimax on 0 ≤ z ≤ 6.
_CDF = (-3.171207e-4, 3.680406e-2, 0.79771415)


def normal_cdf(z: Single) -> Single:
    """Return the standard normal distribution function to 2e-5, ten times as fast as exactly."""
    z = np.minimum(np.maximum(z, np.float32(-6.0)), np.float32(6.0))
    square = z * z
    value = 0.5 + 0.5 * np.tanh(z * ((_CDF[0] * square + _CDF[1]) * square + _CDF[2]))
    return cast("Single", value)


def first_reasons(tests: Sequence[tuple[NDArray[np.bool_], str]]) -> NDArray[Any]:
    """Return the text (n,) of the first test (n,) that is true, empty if none is."""
    bad, words = zip(*tests, strict=True)
    reasons: NDArray[Any] = np.select(bad, words, "").astype(object)
    return reasons


_PROFILE_PX = 10.0


def neighbour_correlations(
    x: Array | Single, use: NDArray[np.bool_], r: Array | Single, depth: Array | Single,
    contrast: Array,
) -> tuple[Array, NDArray[np.int64]]:  # fmt: skip
    """Return the correlation (n,) of a target's residuals r (n, m) in pixels that are neighbours in
    a row, and the number of pairs (n,).

    x (n, m) px: row by row, those in `use` first; depth (n, m) px: inside the outline. The mean
    profile across all outlines, as of a sharpened image, is removed first: it is common to all
    targets, and symmetric. contrast (n,).
    """
    bins = np.rint(np.clip(2.0 * (depth + _PROFILE_PX), 0.0, 4.0 * _PROFILE_PX)).astype(np.int64)
    used = bins[use]
    sums = np.bincount(used, (r / contrast[:, None])[use], int(4 * _PROFILE_PX) + 1)
    profile = sums / np.maximum(np.bincount(used, minlength=len(sums)), 1)
    r = np.where(use, r - profile[bins] * contrast[:, None], 0.0)
    beside = (np.diff(x, axis=1) == 1) & use[:, 1:]
    pairs = beside.sum(axis=1)
    products = np.sum(r[:, 1:] * r[:, :-1], axis=1, where=beside) / np.maximum(pairs, 1)
    squares = np.sum(r * r, axis=1) / np.maximum(use.sum(axis=1), 1)
    return products / np.maximum(squares, 1e-9), pairs


def _in_plane(maps: LocalMap, m: Array, ex: Single, ey: Single) -> tuple[Single, ...]:
    """Map pixels ex, ey (n, k), relative to the centres, into their targets' planes.

    m (n, 3): corrections of the shapes. Returns, (n, k) each, the radius ρ, |∇ρ|, the unit normal
    x, y in the image, det ∂q/∂p, the plane coordinates s, t before the shape's correction, and the
    unit radius vector u, v. q = (I + m)(J⁻¹e − ½ J⁻¹ H[J⁻¹e, J⁻¹e]) = L e − P[e, e]; neglected
    terms are of third order, and move no centre. A = ∂q/∂e = L − 2 P[e, ·], and q = ½ (L + A) e.
    """
    inverse = maps.inverse
    shape = m[:, [[0, 1], [1, 2]]] + np.eye(2)
    L = shape @ inverse
    bend = (L @ maps.second)[:, :, [[0, 1], [1, 2]]]
    twice = np.swapaxes(inverse, 1, 2)[:, None] @ bend @ inverse[:, None]  # 2 P
    # the elements of A and ½ (L + A), linear in 1, ex, ey
    linear = np.empty((len(m), 2, 2, 2, 3), dtype=np.float32)
    linear[..., 0] = L[:, None]
    linear[:, 0, ..., 1:] = -twice
    linear[:, 1, ..., 1:] = -0.5 * twice
    e = scratch("positions", (3, *ex.shape), np.float32)
    e[0], e[1], e[2] = 1.0, ex, ey
    elements = scratch("elements", (8, *ex.shape), np.float32)
    np.matmul(linear.reshape(-1, 8, 3), e.transpose(1, 0, 2), out=elements.transpose(1, 0, 2))
    a11, a12, a21, a22, ux, uy, vx, vy = elements
    u, v = ux * ex + uy * ey, vx * ex + vy * ey
    back = inverse_2x2(shape).astype(np.float32)[..., None]
    s, t = back[:, 0, 0] * u + back[:, 0, 1] * v, back[:, 1, 0] * u + back[:, 1, 1] * v
    rho = np.maximum(np.sqrt(u * u + v * v), 1e-6)
    u, v = u / rho, v / rho
    nx, ny = a11 * u + a21 * v, a12 * u + a22 * v  # ∇ρ = Aᵀ(u, v)
    slope = np.maximum(np.sqrt(nx * nx + ny * ny), 1e-9)
    return rho, slope, nx / slope, ny / slope, a11 * a22 - a12 * a21, s, t, u, v


def blurred_disc(
    maps: LocalMap, parameters: Array, x: Single, y: Single, out: Single | None = None
) -> tuple[Single, Single]:
    """Return grey values (n, k) and derivatives (10, n, k) of n discs at pixels x, y (n, k) px.

    Only shape and curvature are taken from `maps`; the centres are those of the parameters (n, 10),
    in the coordinates of x and y, which should be small. The derivatives with respect to centre and
    shape neglect the change of |∇ρ| and κ, whose effect is zero on the outline. out: array for the
    derivatives.
    """
    p = parameters.astype(np.float32)
    ex, ey = x - p[:, 0, None], y - p[:, 1, None]
    rho, slope, nx, ny, determinant, s, t, u, v = _in_plane(maps, parameters[:, 2:5], ex, ey)
    blur, b, a, gx, gy = (p[:, i, None] for i in range(5, 10))
    width = np.sqrt(blur * blur + np.float32(_PIXEL_VARIANCE))
    # half the outline's curvature tangentᵀ AᵀA tangent/|∇ρ| = (det A)²/|∇ρ|³, since A maps the
    # tangent to a vector of length det A/|∇ρ| across the radius
    other = determinant / slope
    kappa = 0.5 * other * other / slope
    d = (1 - rho) / slope
    z = (d / width - kappa * width).astype(np.float32, copy=False)
    phi = normal_cdf(z)
    light = 1 + gx * ex + gy * ey
    reflect = b + a * phi
    edge = np.exp(-0.5 * z * z) * (_NORM * a) * light
    j = np.empty((10, *x.shape), dtype=np.float32) if out is None else out
    # with respect to the blur: edge (d/s² + κ/2) (−blur/s)
    np.multiply(edge * (d / (width * width) + kappa), -blur / width, out=j[5])
    edge /= width
    np.multiply(edge, nx, out=j[0])
    np.multiply(edge, ny, out=j[1])
    edge /= -slope
    u *= edge
    v *= edge
    np.multiply(u, s, out=j[2])
    np.add(u * t, v * s, out=j[3])
    np.multiply(v, t, out=j[4])
    j[6] = light
    np.multiply(phi, light, out=j[7])
    np.multiply(reflect, ex, out=j[8])
    np.multiply(reflect, ey, out=j[9])
    return reflect * light, j


_SMALLEST_SEMI_AXIS_PX = 1.8
_LARGEST_SATURATION = 0.05
_LARGEST_MOVE = 0.6  # of the minor semi-axis, and at least two px
_LARGEST_SHAPE = 0.35
_CONVERGED_PX = 0.03
_BLUR_SETTLED_PX = 0.1
_FLAT = 0.003  # of the contrast per px of movement
_FEWEST_FOR_LEVEL = 8
_LEAST_CONTRAST = 6.0  # times the noise
_ITERATIONS = 12
_MISFIT = 2.0  # largest residual sd, in the frame's noise, of a target that is not covered
_MISFIT_CONTRAST = 0.015
# An image sharper than any lens makes it (reduced, or drawn) shows the squares of the pixels, which
# the model smooths: by this share of the contrast at zero blur, by nothing from half a pixel on.
_MISFIT_SQUARES, _ROUND_FROM_PX = 0.035, 0.5
_FEWEST_PIXELS = 24
_STEP_LIMITS = np.array([1.0, 1.0, 0.15, 0.15, 0.15, 0.5, np.inf, np.inf, 0.02, 0.02])


@dataclass(frozen=True, slots=True, eq=False)
class CircleFit:
    """The fits of n circles.

    parameters (n, 10): of `blurred_disc`; covariances (n, 2, 2) px²: of the centres; misfit (n,):
    residual sd over the frame's noise; saturation (n,): share of the pixels used; reasons (n,): why
    a fit failed, empty if it is good; noise: of the frame.
    """

    parameters: Array
    covariances: Array
    misfit: Array
    saturation: Array
    reasons: NDArray[Any]
    noise: NoiseModel

    @property
    def points(self) -> Array:
        """The centres (n, 2) px."""
        return self.parameters[:, :2]

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which fits are good (n,)."""
        return np.asarray(self.reasons == "", dtype=bool)

    def missed(self, rows: NDArray[np.int64]) -> dict[int, str]:
        """Return {row: reason} of the failed fits; rows (n,): those of the test field."""
        bad = ~self.good
        return dict(zip(rows[bad].tolist(), self.reasons[bad], strict=True))

    def observations(self, rows: NDArray[np.int64], keep: NDArray[np.bool_]) -> Observations:
        """Return some of the fits (mask) as observations; rows (n,): those of the test field."""
        p = self.parameters[keep]
        quality = {
            "blur": p[:, 5],
            "contrast": p[:, 7],
            "grey": p[:, 6],
            "noise": np.sqrt(self.noise.variance(p[:, 6])).astype(float),
            "saturation": self.saturation[keep],
            "misfit": self.misfit[keep],
        }
        return Observations.build(rows[keep], p[:, :2], self.covariances[keep], quality)


def fit_circles(
    image: Image,
    maps: LocalMap,
    coded: NDArray[np.bool_] | None = None,
    blur: float = 0.9,
    noise: NoiseModel | None = None,
    start: Array | None = None,
) -> CircleFit:
    """Fit circles whose approximate outlines are `maps`.

    image (H, W): grey, 8 or 16 bit; coded (n,): which have a code ring; blur: approximate value,
    px; noise: that of earlier frames, by default estimated from this frame; start (n, 10):
    approximate parameters.
    """
    n = len(maps)
    coded = np.zeros(n, dtype=bool) if coded is None else coded
    parts = list(windows(image, maps, coded, blur))
    work = scratch("partials", (2, 10 * max((w.x.size for w in parts), default=0)), np.float32)
    given = noise
    parameters, noise = _first_step(parts, maps, start, noise, work)
    normal = np.zeros((n, 10, 10))
    pixels, square, saturation, last_step = (np.zeros(n) for _ in range(4))
    cut = np.zeros(n, dtype=bool)
    top, residuals = saturation_level(image), []
    for w in parts:
        mine = maps.select(w.rows)
        fitted = _step(w, mine, parameters[w.rows], noise, work)
        for _ in range(_ITERATIONS - 1):  # only fits that have not converged
            left = np.flatnonzero(~fitted[5])
            if not len(left):
                break
            again = _step(w.select(left), mine.select(left), fitted[0][left], noise, work)
            for column, new in zip(cast("tuple[NDArray[Any], ...]", fitted), again, strict=True):
                column[left] = new
        parameters[w.rows], value, residual, normal[w.rows], last_step[w.rows] = fitted[:5]
        pixels[w.rows] = w.weight.sum(axis=1)
        square[w.rows] = np.sum(w.weight / noise.variance(value) * residual * residual, axis=1)
        saturation[w.rows] = np.sum(w.weight * (w.grey >= top), axis=1)
        cut[w.rows] = w.cut
        residuals.append(residual)
    saturation /= np.maximum(pixels, 1)
    variance = square / np.maximum(pixels - 10, 1)
    # the noise is too large so far if outlines were predicted some pixels off
    own_sd = _noise_sd(parameters, noise) * np.sqrt(np.minimum(variance, 1))
    shown = np.abs(parameters[:, 7]) > _LEAST_CONTRAST * np.maximum(own_sd, _QUANTISATION_SD)
    if given is None and np.count_nonzero(shown) >= _FEWEST_FOR_LEVEL:
        # Its level is that of all residuals, since paper and compression cause noise at edges too;
        # but a hand or a glare of one grey value has no noise.
        level = float(np.median(variance[shown]))
        noise, variance, normal = noise.scaled(level), variance / level, normal / level
    if given is None:
        alike = shown & (variance < _MISFIT**2)
        rho = _usual_correlation(parts, residuals, maps, parameters, alike)
        noise = replace(noise, spread=(1 + rho) / (1 - rho))
    # A target that is significantly noisier than the frame has its own noise.
    own = np.where(variance > 1 + 4 * np.sqrt(2 / np.maximum(pixels, 1)), variance, 1.0)
    cofactors = scaled_solve(normal, np.eye(10)[None, :, :2], 1e-12)[:, :2]
    covariances = cofactors * (noise.spread * own)[:, None, None]
    none = np.full(n, "", dtype=object)
    fit = CircleFit(parameters, covariances, np.sqrt(variance), saturation, none, noise)
    return replace(fit, reasons=_reasons(fit, maps, cut, pixels, last_step))


def _first_step(
    parts: Sequence[Windows],
    maps: LocalMap,
    start: Array | None,
    noise: NoiseModel | None,
    work: Single,
) -> tuple[Array, NoiseModel]:
    """Take the first step with a third of the pixels; return the parameters (n, 10), and the noise.

    The residuals where the image is flat show how the noise grows with the light.
    """
    parameters = np.zeros((len(maps), 10))
    greys, residuals = [np.zeros(0, dtype=np.float32)], [np.zeros(0, dtype=np.float32)]
    for w in parts:
        begin = w.begin if start is None else start[w.rows]
        thin = w.thinned()
        p, value, residual, *_ = _step(thin, maps.select(w.rows), begin, noise, work)
        parameters[w.rows] = p
        # where a movement of a px hardly changes the grey value
        slope = np.abs(work[0, : 2 * thin.x.size]).reshape(2, *thin.x.shape).max(axis=0)
        flat = (thin.weight > 0) & (slope < _FLAT * np.abs(p[:, 7, None]))
        greys.append(value[flat])
        residuals.append(residual[flat])
    return parameters, noise or estimate_noise(
        np.concatenate(greys), np.concatenate(residuals), 3 * len(maps)
    )


def _step(
    w: Windows,
    maps: LocalMap,
    begin: Array,
    noise: NoiseModel | None,
    work: Single,
) -> tuple[Array, Single, Single, Array, Array, NDArray[np.bool_]]:
    """Take one step of Gauss-Newton.

    Returns the parameters (n, 10), values and residuals (n, k) after it, the normal matrices
    (n, 10, 10), the steps (n,) px, and which fits have converged (n,). work (2, m): memory, for the
    partials (10, n, k) first, which would take longer to allocate than to fill.
    """
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
    rhs = (by_target @ residual[..., None])[..., 0]
    delta = np.clip(scaled_solve(N, rhs, 1e-9), -_STEP_LIMITS, _STEP_LIMITS)
    p += delta
    p[:, 5] = np.clip(p[:, 5], 0.2, 6.0)
    p[:, 2:5] = np.clip(p[:, 2:5], -0.6, 0.6)
    p[:, :2] += w.origin
    change = (j.transpose(1, 2, 0) @ delta[..., None].astype(np.float32))[..., 0]
    step = np.abs(delta[:, :2]).max(axis=1)
    settled = (step < _CONVERGED_PX) & (np.abs(delta[:, 5]) < _BLUR_SETTLED_PX)
    return p, value + change, residual - change, N, step, settled


def _usual_correlation(
    parts: Sequence[Windows], residuals: Sequence[Single], maps: LocalMap, parameters: Array,
    alike: NDArray[np.bool_],
) -> float:  # fmt: skip
    """Return the correlation of neighbouring residuals of some targets (mask), 0 if negative."""
    rho = []
    for every, residual in zip(parts, residuals, strict=True):
        some = np.flatnonzero(alike[every.rows])
        w = every.select(some)
        p = parameters[w.rows]
        (x, y), shape = (p[:, :2] - w.origin).T[:, :, None], p[:, 2:5]
        radius, slope, *_ = _in_plane(maps.select(w.rows), shape, w.x - x, w.y - y)
        depth = (1 - radius) / slope
        rho.append(neighbour_correlations(w.x, w.weight > 0, residual[some], depth, p[:, 7])[0])
    return float(np.clip(np.median(np.concatenate(rho)), 0.0, 0.9)) if alike.any() else 0.0


def _noise_sd(parameters: Array, noise: NoiseModel) -> Array:
    """Return the noise (n,) DN of the brighter of disc and background."""
    return np.asarray(np.sqrt(noise.variance(parameters[:, 6] + np.maximum(parameters[:, 7], 0))))


def _reasons(
    fit: CircleFit, maps: LocalMap, cut: NDArray[np.bool_], pixels: Array, step: Array
) -> NDArray[Any]:
    minor = maps.semi_axes[:, 1]
    p = fit.parameters
    move = np.hypot(*(p[:, :2] - maps.centre).T)
    noise_sd = _noise_sd(p, fit.noise)
    shape = np.abs(p[:, 2:5]).max(axis=1, initial=0.0)
    misfit_dn = fit.misfit * noise_sd
    sharpness = np.clip(1 - p[:, 5] / _ROUND_FROM_PX, 0, 1)
    excused = (_MISFIT_CONTRAST + _MISFIT_SQUARES * sharpness) * np.abs(p[:, 7])
    covered = (fit.misfit > _MISFIT) & (misfit_dn > excused)
    tests = (
        (cut, "cut off by the image's edge"),
        ((minor < _SMALLEST_SEMI_AXIS_PX) | (pixels < _FEWEST_PIXELS), "too small"),
        (fit.saturation > _LARGEST_SATURATION, "saturated"),
        (
            ~np.isfinite(p).all(axis=1) | (np.abs(p[:, 7]) < _LEAST_CONTRAST * noise_sd),
            "too little contrast",
        ),
        (p[:, 5] > np.maximum(0.75 * minor, 1.2), "too blurred for its size"),
        (
            (move > np.maximum(_LARGEST_MOVE * minor, 2.0))
            | (step > 0.05)
            | (shape > _LARGEST_SHAPE),
            "no circle where the target should be",
        ),
        (covered, "covered in part or disturbed"),
    )
    return first_reasons(tests)
