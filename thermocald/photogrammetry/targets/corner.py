"""Corners of markers and squares, measured by fitting a blurred wedge to the grey values around.

At a corner two straight edges meet. Blurred by the optics, its grey values follow the probability
that a bivariate normal variate lies in a quadrant, with the cosine between the edges' normals as
the correlation. Position, both edge directions, blur, background, and contrast are estimated by
Levenberg's method for many corners at once. The covariance is that of least squares with the
variance of the fit's own residuals. A gradient of the light (a lamp, its reflection) is estimated
too where it is significant; everywhere it would cost up to 40 % of the precision. The errors of a
JPEG are correlated from pixel to pixel: across an edge they cancel, along it they add up. The
correlation ρ of neighbouring residuals of all corners enlarges the variance by (1 + ρ)/(1 − ρ),
that of a mean of a first-order autoregression. With a JPEG of quality 30 to 95, error over standard
deviation is 0.8 to 1.6, most often 1.0 to 1.2.

The tone curve of a photograph shifts blurred edges towards their dark side, at gamma 0.45 by a
quarter of the blur. The residuals across all edges of a frame show it, and it is corrected: error
over standard deviation is 1.0 to 1.6 then, in a coarse JPEG 2, with a curve shaped like an S to 9.

If squares touch at a corner (chessboards, AprilGrids), the opposite quadrant is dark as well. The
grey values decide whether it is added to the model.

Source: the quadrant probability as Mehler's tetrachoric series; the idea of fitting a parametric
grey-value corner, Deriche, R. and Giraudon, G. (1993): A computational approach for corner and
vertex detection, IJCV 10(2), 101–124.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.linalg import scaled_solve
from thermocald.photogrammetry.targets.circle import (
    first_reasons,
    neighbour_correlations,
    normal_cdf,
)
from thermocald.photogrammetry.targets.frame_status import saturation_level

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image, Mask, Single


_REACH_PX = 10.0  # how far along the edges pixels are used
_CHUNK = 256  # corners that are fitted together
_SERIES_TERMS = 9
_ITERATIONS = 20
_CONVERGED_PX = 2e-4
_LARGEST_MOVE_PX = 1.5
_LARGEST_MOVE_SHARE = 0.015  # of the side, in addition: reduced images cut outlines short
_BLUR_LIMITS_PX = (0.3, 4.0)
_SADDLE_REACH = 0.25  # of the marker's side
_FAR = 40.0  # standard deviations of the blur; the series would overflow where a fit runs away
_LARGEST_SATURATION = 0.3  # where paper is cut at full scale; sharpened edges alone reach a tenth
_CUT = 0.05, 0.998  # the same where few pixels of paper are used: share, and paper over full scale
_LEAST_SD = 0.3  # DN, of quantisation
_BITS_PX = 3.3  # rendered markers: how far blurred bits move a corner, per blur and their share
_BITS_BLURS = 3.0  # blurs between a marker's bits and pixels that show the tone curve
_EDGE_BLURS = 2.0  # blurs about an edge that are needed for it
_FEWEST_FOR_TONE = 8  # corners
_CURVED = 3.0  # standard deviations, from which a tone curve is corrected
_OTHER_PROFILE = 0.5  # rendered: demosaiced, denoised and clipped frames, 0.25 to 0.5
_CLEAR = 6.0  # times its variance, from which the light's squared gradient is corrected
_LARGEST_CORRELATION = 0.93  # the series converges too slowly for edges at less than 22°


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """The approximate places of corners.

    rows (n,): of the test field; places (n, 2) px; before, after (n, 2) px: their neighbours along
    the outline; quiet (n,) px: width of the marker's border and of the quiet zone around it, beyond
    which no pixels are used.
    """

    rows: NDArray[np.int64]
    places: Array
    before: Array
    after: Array
    quiet: Array

    def __len__(self) -> int:
        return len(self.rows)

    @classmethod
    def none(cls) -> Corners:
        """Return no corners."""
        places = np.empty((0, 2))
        return cls(np.empty(0, dtype=np.int64), places, places, places, np.empty(0))

    def select(self, some: slice | Mask) -> Corners:
        """Return some of the corners."""
        return Corners(*(getattr(self, f.name)[some] for f in fields(self)))

    def joined(self, other: Corners) -> Corners:
        """Return these corners and others, whose places count if both have a corner."""
        mine = self.select(~np.isin(self.rows, other.rows))
        pairs = ((getattr(mine, f.name), getattr(other, f.name)) for f in fields(self))
        return Corners(*(np.concatenate(pair) for pair in pairs))

    def moved(self, found: Observations) -> Corners:
        """Move places and neighbours to the observed corners, those not observed by the median."""
        _, here, there = np.intersect1d(self.rows, found.targets, return_indices=True)
        own = found.points[there] - self.places[here]
        shift = np.zeros_like(self.places) + (np.median(own, axis=0) if len(own) else 0.0)
        shift[here] = own
        return Corners(
            self.rows, self.places + shift, self.before + shift, self.after + shift, self.quiet
        )


def measure_corners(image: Image, corners: Corners, missed: dict[int, str]) -> Observations:
    """Measure corners in an image (H, W), grey, 8 or 16 bit.

    Returns observations with the quality `blur` px, `contrast`, `grey` (background), `noise` DN,
    `saturation` (share of pixels). `missed` receives {row: reason} for corners that cannot be
    measured.
    """
    found = Observations.none()
    for i in range(0, len(corners), _CHUNK):
        some, reasons = _fit(image, corners.select(slice(i, i + _CHUNK)))
        missed.update(reasons)
        found = found.joined(some)
    return found


def _wedge(h: Single, k: Single, rho: Single) -> Single:
    """Return P(H < h, K < k) of standard normals with correlation rho; h, k (n, m), rho (n, 1)."""
    value: Single = normal_cdf(h) * normal_cdf(k)
    density = np.exp(-0.5 * (h * h + k * k)) / (2 * np.pi)
    he_h, he_k = np.ones_like(h), np.ones_like(k)
    last_h, last_k = np.zeros_like(h), np.zeros_like(k)
    factor = rho * density
    for n in range(1, _SERIES_TERMS + 1):
        value += factor * he_h * he_k
        he_h, last_h = h * he_h - (n - 1) * last_h, he_h
        he_k, last_k = k * he_k - (n - 1) * last_k, he_k
        factor = factor * rho / (n + 1)
    return value


def _model(p: Array, x: Array, y: Array, saddle: NDArray[np.bool_]) -> tuple[Single, Single]:
    """Return grey values (n, m) and derivatives (n, m, 7) at pixels x, y (n, m) px.

    p (n, 7): x, y, angle1, angle2, blur, b, a, with the angles of the inward normals of the two
    edges; saddle (n,): whether the opposite quadrant is dark too. Single precision is enough: its
    rounding is a thousandth of that of grey values.
    """
    t1, t2, s, b, a = (p[:, i, None].astype(np.float32) for i in range(2, 7))
    c1, s1, c2, s2 = np.cos(t1), np.sin(t1), np.cos(t2), np.sin(t2)
    dx, dy = ((v - p[:, i, None]).astype(np.float32) for i, v in enumerate((x, y)))
    h: Single = ((c1 * dx + s1 * dy) / s).astype(np.float32, copy=False)
    k: Single = ((c2 * dx + s2 * dy) / s).astype(np.float32, copy=False)
    rho = np.clip(c1 * c2 + s1 * s2, -_LARGEST_CORRELATION, _LARGEST_CORRELATION)
    root = np.sqrt(1 - rho * rho)
    w = _wedge(np.clip(h, -_FAR, _FAR), np.clip(k, -_FAR, _FAR), rho)
    norm = np.float32(1 / np.sqrt(2 * np.pi))
    wh = norm * np.exp(-0.5 * h * h) * normal_cdf((k - rho * h) / root)
    wk = norm * np.exp(-0.5 * k * k) * normal_cdf((h - rho * k) / root)
    wr = np.exp(-0.5 * (h * h - 2 * rho * h * k + k * k) / root**2) / (2 * np.pi * root)
    if saddle.any():
        # the opposite quadrant added: P(H > h, K > k) = 1 − Φ(h) − Φ(k) + P(H < h, K < k)
        both = saddle[:, None]
        w = np.where(both, 1 - normal_cdf(h) - normal_cdf(k) + 2 * w, w)
        wh = np.where(both, 2 * wh - norm * np.exp(-0.5 * h * h), wh)
        wk = np.where(both, 2 * wk - norm * np.exp(-0.5 * k * k), wk)
        wr = np.where(both, 2 * wr, wr)
    sine = s1 * c2 - c1 * s2  # dρ/dt2 = −dρ/dt1
    j = np.empty((*h.shape, 7), np.float32)
    j[..., 0] = -a * (wh * c1 + wk * c2) / s
    j[..., 1] = -a * (wh * s1 + wk * s2) / s
    j[..., 2] = a * (wh * (c1 * dy - s1 * dx) / s - wr * sine)
    j[..., 3] = a * (wk * (c2 * dy - s2 * dx) / s + wr * sine)
    j[..., 4] = -a * (wh * h + wk * k) / s
    j[..., 5] = 1.0
    j[..., 6] = w
    return b + a * w, j


def _is_saddle(grey: Array, d1: Array, d2: Array, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where (n,) squares touch: the opposite quadrant is as dark as the corner's own."""

    def mean(mask: NDArray[np.bool_]) -> Array:
        count = np.maximum((near & mask).sum(axis=1), 1)
        total: Array = np.sum(grey * (near & mask), axis=1) / count
        return total

    clear = (np.abs(d1) > 1.5) & (np.abs(d2) > 1.5)
    own, beside = mean(clear & (d1 > 0) & (d2 > 0)), mean(clear & (d1 * d2 < 0))
    opposite = mean(clear & (d1 < 0) & (d2 < 0))
    dark: NDArray[np.bool_] = np.abs(opposite - own) < np.abs(opposite - beside)
    return dark & (clear & near & (d1 < 0) & (d2 < 0)).any(axis=1)


class _Pixels(NamedTuple):
    """The pixels around n corners: x, y px, grey (n, m), which are used, and the saddles (n,)."""

    x: Array
    y: Array
    grey: Array
    use: Mask
    saddle: Mask


def _depth(d1: Array, d2: Array, saddle: Mask) -> Array:
    """Return the distances (n, m) of pixels from the outline, positive inside, from those to the
    lines of the two edges.
    """
    opposite = np.sign(d1 * d2) * np.minimum(np.abs(d1), np.abs(d2))
    return np.where(saddle[:, None], opposite, np.minimum(d1, d2))


def _side(found: Corners) -> Array:
    """Return the length (n,) px of the shorter side at each corner."""
    sides = np.stack([found.before, found.after]) - found.places
    side: Array = np.linalg.norm(sides, axis=-1).min(axis=0)
    return side


def _margin(found: Corners) -> Array:
    """Return how far (n,) px from the edges pixels are used."""
    # Two px less, to keep blurred bits and neighbours out; but an edge itself needs two px.
    return np.maximum(found.quiet - 2.0, 2.0)


def _pixels(image: Image, found: Corners) -> tuple[_Pixels, Array, Mask]:
    """Return the pixels to fit, initial parameters (n, 7), and which corners the edge cuts off."""
    corners, n, side = found.places, len(found), _side(found)
    height, width = image.shape
    along = np.minimum(0.45 * side, _REACH_PX)
    half = int(np.ceil(along.max()))
    down, right = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    x, y = (np.rint(corners).astype(int).T)[..., None] + np.stack([right, down])[:, None]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    grey = image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(float)
    px, py = x.astype(float), y.astype(float)
    away = np.hypot(px - corners[:, 0, None], py - corners[:, 1, None])
    # angles of both edges' normals: across one side, towards the other
    sides, angles = ((found.before - corners).T, (found.after - corners).T), []
    for (side_x, side_y), (other_x, other_y) in (sides, sides[::-1]):
        towards = np.sign(side_x * other_y - side_y * other_x)
        angles.append(np.arctan2(towards * side_x, -towards * side_y))
    placed = np.column_stack([corners, *angles])
    d1, d2 = _from_edges(placed, px, py)
    margin = _margin(found)[:, None]
    saddle = _is_saddle(grey, d1, d2, inside & (away <= along[:, None]))
    # the square opposite to a marker of an AprilGrid is a third as large as the marker
    along = np.where(saddle, np.minimum(along, _SADDLE_REACH * side), along)
    depth = _depth(d1, d2, saddle)
    use = inside & (np.abs(depth) <= margin) & (away <= along[:, None])
    cut_off = np.any(~inside & (away < 3), axis=1)
    # each corner's used pixels first, so that the others can be left out
    first = np.argsort(~use, axis=1, kind="stable")[:, : max(int(use.sum(axis=1).max()), 1)]
    px, py, grey, depth, use = (np.take_along_axis(v, first, 1) for v in (px, py, grey, depth, use))

    def share(mask: Mask) -> Array:
        part = np.where(use & mask, grey, np.nan)
        empty = ~np.isfinite(part).any(axis=1)
        part[empty] = grey[empty]
        return np.nanmedian(part, axis=1)

    background = share(depth < -1)
    contrast = share(depth > 1) - background
    contrast = np.where(np.abs(contrast) < 1, 1.0, contrast)
    p = np.column_stack([placed, np.full(n, 1.2), background, contrast])
    return _Pixels(px, py, grey, use, saddle), p, cut_off


def _from_edges(p: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the distances (n, m) of pixels x, y (n, m) from the lines of both edges, inwards.

    p (n, 4): places and angles of the corners.
    """
    x0, y0, t1, t2 = p.T[:, :, None]
    dx, dy = x - x0, y - y0
    return np.cos(t1) * dx + np.sin(t1) * dy, np.cos(t2) * dx + np.sin(t2) * dy


def _minimise(pixels: _Pixels, p: Array) -> tuple[Array, Array, Single, Array]:
    """Minimise the squares by Levenberg's method from parameters (n, 7).

    Returns the parameters, the residuals (n, m), the partials (n, m, 7), the last steps (n, 7).
    """
    px, py, grey, use, saddle = pixels
    weight, n = use.astype(float), len(p)
    damping = np.full(n, 1e-2)

    def cost(q: Array, rows: NDArray[np.int64]) -> tuple[Array, Array, Single]:
        value, j = _model(q, px[rows], py[rows], saddle[rows])
        r = (grey[rows] - value) * weight[rows]
        return np.sum(r * r, axis=1, dtype=float), r, j

    open_ = np.arange(n)  # corners that still move
    chi, r, j = cost(p, open_)
    step = np.full((n, 7), np.inf)
    for _ in range(_ITERATIONS):
        j_open = j[open_]
        jw = j_open * weight[open_, :, None]
        normal_matrix = np.swapaxes(jw, 1, 2) @ j_open
        rhs = np.swapaxes(jw, 1, 2) @ r[open_, :, None]
        diagonal = np.einsum("nii->ni", normal_matrix)
        scaled = normal_matrix + np.eye(7) * (damping[open_, None] * diagonal + 1e-9)[:, None, :]
        now = np.linalg.solve(scaled, rhs)[..., 0]
        now[:, 4] = np.clip(now[:, 4], -0.4, 0.4)
        trial = p[open_] + now
        trial[:, 4] = np.clip(trial[:, 4], *_BLUR_LIMITS_PX)
        trial_chi, trial_r, trial_j = cost(trial, open_)
        better = trial_chi <= chi[open_] * (1 + 1e-12)
        won = open_[better]
        p[won], chi[won] = trial[better], trial_chi[better]
        r[won], j[won] = trial_r[better], trial_j[better]
        damping[open_] = np.where(
            better, damping[open_] * 0.1, np.minimum(damping[open_] * 10, 1e6)
        )
        step[open_] = now
        open_ = open_[np.abs(now[:, :2]).max(axis=1) >= _CONVERGED_PX]
        if len(open_) == 0:
            break
    return p, r, j, step


def _correlation(pixels: _Pixels, p: Array, r: Array) -> Array:
    """Return the correlation (n,) of neighbouring residuals r (n, m), 0 if negative: that of all
    corners, or a corner's own if that is significantly larger, as where it is covered in part.
    """
    depth = _depth(*_from_edges(p[:, :4], pixels.x, pixels.y), pixels.saddle)
    own, pairs = neighbour_correlations(pixels.x, pixels.use, r, depth, p[:, 6])
    usual = np.median(own) if len(own) else 0.0
    rho = np.where(own > usual + 3.0 / np.sqrt(pairs), own, usual)
    return np.clip(rho, 0.0, 0.9)


def _correct_light(pixels: _Pixels, p: Array, r: Array, j: Single, variance: Array) -> Array:
    """Correct parameters and residuals in place for a gradient of the light, if it is significant.

    Returns the cofactors (n, 2, 2) of the places. The gradient has a prior variance by which its
    square exceeds the noise of many, so that the correction sets in continuously.
    """
    from_corner = np.stack([pixels.x, pixels.y], axis=2) - p[:, None, :2]
    by_light = (pixels.grey - r)[..., None] * from_corner
    every = np.concatenate([j, by_light], axis=2) * pixels.use[..., None]
    N, b = np.swapaxes(every, 1, 2) @ every, (r[:, None] @ every)[:, 0]
    Q = scaled_solve(N, np.eye(9)[None, :, 7:], 1e-12)[:, 7:]
    light = np.sum(Q * b[:, None, 7:], axis=2)
    noise = np.trace(Q, axis1=1, axis2=2) * variance
    prior = np.maximum(np.sum(light**2, axis=1) - _CLEAR * noise, 1e-9 * noise + 1e-300) / 2
    N[:, [7, 8], [7, 8]] += (variance / prior)[:, None]
    step = scaled_solve(N, b, 1e-12)
    p += step[:, :7]
    r -= (every @ step[..., None])[..., 0]
    return scaled_solve(N, np.eye(9)[None, :, :2], 1e-12)[:, :2]


def _correct_tone(
    pixels: _Pixels, p: Array, r: Array, j: Single, variance: Array, quiet: Array
) -> Array:
    """Correct parameters in place for the camera's tone curve, if it is significant.

    A photograph's grey values are not linear in the light, which shifts blurred edges towards the
    dark side. To first order the curve adds κ |a| w (1 − w) to the wedge w, with κ common to all
    corners; it is estimated where no blurred bits are. A tone curve brightens, κ > 0; where κ is
    negative, edges have another profile than assumed, as in a demosaiced or denoised frame, and the
    corners are off by up to half of what the curve would do. Returns what this, or the error of
    κ, adds to the covariances (n, 2, 2) of the places.
    """
    depth = _depth(*_from_edges(p[:, :4], pixels.x, pixels.y), pixels.saddle)
    free = quiet - _BITS_BLURS * p[:, 4]
    near = (np.abs(depth) < free[:, None]) & (free > _EDGE_BLURS * p[:, 4])[:, None] & pixels.use
    w = j[..., 6]
    curve = np.abs(p[:, 6, None]) * w * (1 - w)

    def response(use: Mask) -> Array:
        """Return the parameters (n, 7) that imitate the curve."""
        some = j * use[..., None]
        N, b = np.swapaxes(some, 1, 2) @ some, (curve[:, None] @ some)[:, 0]
        return scaled_solve(N.astype(float), b.astype(float), 1e-9)

    left = (curve - (j @ response(near)[..., None])[..., 0]) * near
    weight = 1.0 / np.maximum(variance, _LEAST_SD**2)
    information = float(weight @ np.sum(left * left, axis=1))
    kappa = float(weight @ np.sum(left * r, axis=1)) / max(information, 1e-300)
    tested = kappa**2 * information
    if np.count_nonzero(near.any(axis=1)) < _FEWEST_FOR_TONE or tested < _CURVED**2:
        return np.zeros((len(p), 2, 2))
    kappa *= 1 - _CURVED**2 / tested  # sets in continuously
    by = response(pixels.use)
    unit: Array = by[:, :2, None] * by[:, None, :2]
    if kappa < 0:
        return unit * (_OTHER_PROFILE * kappa) ** 2
    p -= kappa * by
    return unit / information


def _fit(image: Image, found: Corners) -> tuple[Observations, dict[int, str]]:
    """Fit corners together; return the observations, and {row: reason} of failed fits."""
    pixels, p, cut_off = _pixels(image, found)
    p, r, j, step = _minimise(pixels, p)
    m = pixels.use.sum(axis=1)
    variance = np.sum(r * r, axis=1) / np.maximum(m - 7, 1)
    cofactors = _correct_light(pixels, p, r, j, variance)
    residual_sd = np.sqrt(variance)
    move = np.hypot(*(p[:, :2] - found.places).T)
    top = saturation_level(image)
    saturated = pixels.use & (pixels.grey >= top)
    saturation = np.sum(saturated, axis=1) / np.maximum(m, 1)
    tests = (
        (cut_off, "cut off by the image's edge"),
        (m < 20, "too small"),
        (
            (saturation > _LARGEST_SATURATION)  # edges are pixels off
            | (saturation > _CUT[0]) & (p[:, 5:7].cumsum(axis=1).max(axis=1) > _CUT[1] * top),
            "saturated",
        ),
        (
            ~np.isfinite(p).all(axis=1) | ~(np.abs(step[:, :2]).max(axis=1) < 0.02),
            "the fit does not converge",
        ),
        (
            move > _LARGEST_MOVE_PX + _LARGEST_MOVE_SHARE * _side(found),
            "no corner where the marker has one",
        ),
        (np.abs(np.cos(p[:, 2] - p[:, 3])) > 0.95, "too oblique"),
        # an area of one grey value, as of a shadow, has no residuals
        (np.abs(p[:, 6]) < 5 * np.maximum(residual_sd, _LEAST_SD), "too little contrast"),
    )
    reasons = first_reasons(tests)
    good = reasons == ""
    some, fitted = _Pixels(*(v[good] for v in pixels)), p[good]
    rho = _correlation(some, fitted, r[good])
    variance[good] *= (1 + rho) / (1 - rho)
    tone = _correct_tone(some, fitted, r[good], j[good], variance[good], found.quiet[good])
    p[good] = fitted
    quality = {
        # without the width of the pixel
        "blur": np.sqrt(np.maximum(p[:, 4] ** 2 - 1 / 12, 0.0)),
        "contrast": p[:, 6],
        "grey": p[:, 5],
        "noise": residual_sd,
        "saturation": saturation,
    }
    # the blur brings a marker's bits to its edges, which moves the corner by their pattern
    margin, blur = _margin(found), p[:, 4]
    bits = normal_cdf(((margin / 2 - found.quiet) / blur).astype(np.float32)) * ~pixels.saddle
    covariances = cofactors * variance[:, None, None]
    covariances += np.square(_BITS_PX * blur * bits / margin)[:, None, None] * np.eye(2)
    observations = Observations.build(
        found.rows[good], p[good, :2], covariances[good] + tone,
        {name: values[good] for name, values in quality.items()},
    )  # fmt: skip
    return observations, dict(zip(found.rows[~good].tolist(), reasons[~good], strict=True))
