"""The thermometer as an instrument: its noise, and the smooth trajectory of its readings.

The smooth trajectory is only the point at which non-linear operators are linearised. The readings
themselves remain the data, and their error is propagated through each operator (`likelihood`), so
that a kink that the smoothing has rounded is not mistaken for an effect.

Source: Eilers (2003), A perfect smoother, Analytical Chemistry 75, 3631-3636; generalised
cross-validation as Golub, Heath, Wahba (1979), Technometrics 21, 215-223.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import mad_sd

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array, Index, Mask

USUAL_THERMOMETER_SD = 0.05  # K, if it cannot be estimated
# a normal distribution without what is beyond k sigma, and its sd, √(1 - 2 k φ(k) / (2 Φ(k) - 1))
CLIPPED_AT, CLIPPED_SD = 2.2, 0.9162
_SMOOTHING = np.logspace(-1, 5, 19)
_OFTEN_SHARP = 0.2  # share of sharp intervals above which a sharp bend need not be a kink
_KINK = 1.5  # times the usual sharp bend, which a kink must then exceed
_ALIKE = 0.75  # of the sharpest bend near it, which a kink must then reach
_STRAIGHT = 0.25  # of a reading's noise: root-sum-square that straight lines may miss in a series
_STEADY = 1.5  # readings, on average, that a coarse thermometer shows alike, at least
_WITHIN = 0.05  # of a coarse thermometer's step: its noise, which its readings do not show
_PARTS = 4  # of an interval between two readings in which a straight line is not accurate enough


@dataclass(frozen=True, eq=False)
class Thermometer:
    """A temperature column as an instrument, on knots: its reading times and latent times between.

    times (K,) s; trajectory (K,) °C: smoothed, without gaps, the point of linearisation; NaN at
    knots of other columns; deviation (K,) K: reading minus trajectory; sd (K,) K: of the
    independent errors; mixing (K, K), sparse: errors of the knots = mixing @ independent errors,
    where a latent time has the errors of the readings next to it and its own; real (K,): whether a
    knot is a reading time; noise K: of one reading; coarse: whether its steps dominate its errors.
    """

    times: Array
    trajectory: Array
    deviation: Array
    sd: Array
    mixing: csr_array
    real: NDArray[np.bool_]
    noise: float
    coarse: bool = False

    @property
    def erring(self) -> Index:
        """The knots with an error of their own (S,); curves have only that of their readings."""
        return np.flatnonzero(self.mixing.diagonal() > 0)

    @property
    def bulge(self) -> float:
        """The lead of the curves between readings over straight lines, in intervals of readings.

        It is h/12τ for a temperature that settles with the time constant τ.
        """
        from scipy.integrate import trapezoid  # NumPy's has another name in 1.26 than in 2

        known = np.isfinite(self.trajectory)
        t, T, read = self.times[known], self.trajectory[known], self.times[self.real]
        ahead = T - np.interp(t, read, self.trajectory[self.real])
        slope = np.gradient(T, t)
        power = float(trapezoid(slope**2, t)) * float(np.median(np.diff(read)))
        return abs(float(trapezoid(ahead * slope, t))) / power if power > 0 else 0.0

    def _jumps(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the reading times (R,) s and the slope's jumps K/s around each interval (R - 1,).

        The noise is subtracted from the jumps; a third value tells which are significant.
        """
        t, y = self.times[self.real], (self.trajectory + self.deviation)[self.real]
        bend, limit = _measure_bends(t, y, self.noise)
        size = np.sqrt(np.maximum(bend**2 - (limit / 3.0) ** 2, 0.0)) / np.diff(t)
        return t, size, np.abs(bend) > limit

    def between(self, times: Array, seen: Array, late: float) -> Array:
        """Return the sd (E,) K of the temperature at some times due to jumps of its slope.

        seen (E,) K/s: jumps of the slope as measured by the images; late s: the camera's delay. A
        jump at an unknown instant between two readings makes the straight line between them wrong
        by an eighth of the jump times the interval. If the readings themselves show the jump, the
        value in the middle of the interval is an unknown (`find_times_between`); a kink anywhere
        then differs from the lines to this value by up to 0.05 of jump times interval, half way
        between.
        """
        t, size, sharp = self._jumps()
        i = np.clip(np.searchsorted(t, times - late, side="right") - 1, 0, len(t) - 2)
        width = np.diff(t)[i]
        share = np.clip((times - late - t[i]) / width, 0.0, 1.0)
        known = 0.05 * size[i] * width * np.abs(np.sin(2.0 * np.pi * share))
        reach = np.median(width)
        first = np.searchsorted(times, times - reach)
        last = np.searchsorted(times, times + reach, side="right")
        windows = np.ravel([first, last], order="F")
        hidden = 0.125 * width * np.maximum.reduceat(np.append(seen, 0.0), windows)[::2]
        return np.asarray(np.where(sharp[i], known, hidden))

    def slope_jump(self, times: Array) -> Array:
        """Return the sd (E,) K/s of the rate at some times due to jumps next to them."""
        t, size, _ = self._jumps()
        middle, reach = 0.5 * (t[:-1] + t[1:]), 1.1 * float(np.median(np.diff(t)))
        first = np.searchsorted(middle, times - reach, side="right")
        last = np.searchsorted(middle, times + reach)
        near = (size[i:j].max(initial=0.0) for i, j in zip(first, last, strict=True))
        return 0.5 * np.fromiter(near, dtype=float, count=len(times))


def find_step(readings: Array, resolution: float | None) -> float:
    """Return a thermometer's step, K: as stated, or as its readings show if they often repeat."""
    known = readings[np.isfinite(readings)]
    shown = np.unique(np.round(known, 6))
    if len(shown) < 2 or 2 * len(shown) > len(known):
        return resolution or 0.0
    return max(resolution or 0.0, float(np.diff(shown).min()))


@dataclass(frozen=True, eq=False)
class Passages:
    """The passages of the temperature from one step of a coarse thermometer to the next.

    times (P,) s, values (P,) °C half way between two readings, sd (P,) K; readings (R,) °C: between
    the passages; bow (R,) K: the sd of what they differ from straight lines.
    """

    times: Array
    values: Array
    sd: Array
    readings: Array
    bow: Array


def find_passages(times: Array, readings: Array, resolution: float | None) -> Passages | None:
    """Find where the temperature passes the steps of a coarse thermometer; None if it is fine.

    An error due to steps stays the same as long as the reading does: not the readings but the times
    at which they change tell the temperature. Between two passages it may be bent as much as its
    slope changes; before the first, after the last and where it turns, it is anywhere in the step.
    That is one error per run of equal readings, however many there are. Passages that follow each
    other after equal times, or to and fro, have much of their error in common.
    """
    step = find_step(readings, resolution)
    rows = np.flatnonzero(np.isfinite(readings) & np.isfinite(times))
    y, t = readings[rows], times[rows]
    first = np.flatnonzero(np.diff(y, prepend=np.inf) != 0.0)
    if step <= 0.0 or len(first) < 3 or len(y) < _STEADY * len(first):
        return None  # without a step, values that are held are noise
    from scipy.interpolate import PchipInterpolator

    size = np.diff(first, append=len(y))
    before = first[1:] - 1
    at, values = 0.5 * (t[before] + t[before + 1]), 0.5 * (y[before] + y[before + 1])
    error = step / np.sqrt(12.0)
    sd = error / np.minimum(size[:-1], size[1:])
    sd = np.hypot(sd, max(_estimate_excess(at, values, sd), _WITHIN * step))
    apart = size[1:-1]
    new = np.append([True, True], apart[1:] != apart[:-1])
    new[1:] &= np.diff(values) != 0.0
    group = np.cumsum(new) - 1
    sd = sd * np.sqrt(0.5 + 0.5 * np.bincount(group))[group]  # half of the error in common
    run = np.repeat(np.arange(len(first)), size)
    begin, end = np.append(t[0], at), np.append(at, t[-1])
    share = np.clip((t - begin[run]) / np.maximum(end - begin, 1e-9)[run], 0.0, 1.0)
    slope = np.diff(values) / size[1:-1]  # K per reading
    change = np.abs(np.diff(slope, prepend=slope[:1], append=slope[-1:]))
    bow = np.full(len(first), error)
    straight = np.flatnonzero(slope != 0.0)
    bend = size[1:-1] * np.maximum(change[:-1], change[1:]) / 8.0
    bow[1 + straight] = np.minimum(bend, error)[straight]
    shape = 4.0 * share * (1.0 - share)
    shape[run == 0] = 1.0 - share[run == 0]
    shape[run == len(first) - 1] = share[run == len(first) - 1]
    line = PchipInterpolator(at, values)(np.clip(t, at[0], at[-1]))
    within, spread = np.full(len(readings), np.nan), np.full(len(readings), np.nan)
    open_ = np.isin(run, 1 + straight, invert=True)
    within[rows] = line + np.where(open_, shape * (y - line), 0.0)
    spread[rows] = np.hypot(shape * (bow * np.sqrt(size))[run], 0.1 * _WITHIN * step)
    return Passages(at, values, sd, within, spread)


def _estimate_excess(t: Array, y: Array, sd: Array) -> float:
    """Return the noise K of values (P,) at times (P,) s beyond their sds (P,), 0 if none shows."""
    if len(y) < 8:
        return 0.0
    own = np.convolve(sd**2, np.full(4, 0.25), mode="valid")
    square = np.minimum(_third_differences(t, y) ** 2, 9.0 * np.median(own))
    return float(np.sqrt(max(np.average(square - own, weights=own**-2.0), 0.0)))


def estimate_reading_noise(times: Array, readings: Array, resolution: float | None) -> float:
    """Estimate the standard deviation of a reading, K, including quantisation.

    It is computed from third divided differences, as thermometers are not read at even intervals,
    clipped iteratively at 2.2 sigma, so that a switched lamp, which affects four of them, does not
    count as noise. It is at least the error due to the resolution. Fewer than eight readings do not
    show it, and a typical value is returned.
    """
    there = np.isfinite(readings) & np.isfinite(times)
    t, values = times[there], readings[there]
    floor = find_step(values, resolution) / np.sqrt(12.0)
    if len(values) < 8:
        return max(float(floor), USUAL_THERMOMETER_SD)
    d = _third_differences(t, values)
    # with few readings, two kinks affect four in ten, which clipping alone would never remove
    spread = mad_sd(d)
    kept = np.abs(d) <= 4.0 * spread if spread > 0.0 else np.ones(len(d), dtype=bool)
    scale = 0.0
    for _ in range(20):
        scale = float(np.sqrt(np.mean(d[kept] ** 2))) / CLIPPED_SD
        now = np.abs(d) <= max(CLIPPED_AT * scale, 1e-12)
        if np.array_equal(now, kept):
            break
        kept = now
    return float(max(scale, floor, 1e-6))


def _third_differences(t: Array, y: Array) -> Array:
    """Return third divided differences of neighbours, scaled to the variance of one reading."""
    at, values = np.lib.stride_tricks.sliding_window_view([t, y], len(t) - 3, axis=1)  # (4, n)
    apart = at[:, None] - at
    apart[apart == 0.0] = 1e-3
    apart[np.arange(4), np.arange(4)] = 1.0
    product = np.prod(apart, axis=1)
    return np.asarray(np.sum(values / product, axis=0) / np.sqrt(np.sum(product**-2.0, axis=0)))


def find_times_between(
    times: Array, readings: Array, resolution: float | None
) -> tuple[Array, Array]:
    """Find instants between two readings at which the temperature leaves the straight line.

    Returns latent and curved instants. Latent ones are in intervals with a kink: where a lamp was
    switched, the trajectory differs from the straight line by up to a quarter of the bend, and the
    maximum may be between two readings.

    Curved ones are on the curve through neighbouring readings. For a warming that slows down, the
    straight line is too low by a twelfth of h² T'' on average: little in one interval, but always
    of one sign, so that it acts like a delay of h²/12τ. There are none beside a kink, and none at
    all if the lines miss less than a quarter of a reading's noise in total.
    """
    valid = np.isfinite(readings)
    t, y = times[valid], readings[valid]
    noise = estimate_reading_noise(t, y, resolution)
    bend, limit = _measure_bends(t, y, noise)
    size = np.abs(bend)
    sharp = size > limit
    if sharp.any() and sharp.mean() > _OFTEN_SHARP:
        # with bends everywhere, a kink is a particularly sharp one
        padded = np.pad(size, 2)
        # a kink at a reading bends both intervals equally, and noise decides which one more
        sharp &= size >= _ALIKE * np.max([padded[k : k + len(size)] for k in range(5)], axis=0)
        sharp &= size > _KINK * np.median(size[size > limit])
    latent = 0.5 * (t[:-1] + t[1:])[sharp]
    missed = max(float(np.sum(bend[~sharp] ** 2 - (limit / 3.0) ** 2)), 0.0)
    if np.sqrt(missed) / 24.0 < _STRAIGHT * noise:
        return latent, np.zeros(0)
    share = np.arange(1, _PARTS) / _PARTS
    return latent, (t[:-1, None] + share * np.diff(t)[:, None])[~sharp].ravel()


def _measure_bends(t: Array, y: Array, noise: float) -> tuple[Array, float]:
    """Return the change of slope around each interval times its length (K - 1,) K, and 3 sigma."""
    if len(t) < 4:
        return np.zeros(max(len(t) - 1, 0)), np.inf
    h = np.diff(t)
    slope = np.diff(y) / h
    bend = np.zeros(len(h))
    bend[1:-1] = (slope[2:] - slope[:-2]) * h[1:-1]
    bend[0], bend[-1] = (slope[1] - slope[0]) * h[0], (slope[-1] - slope[-2]) * h[-1]
    return bend, 3.0 * 2.0 * noise


def smooth_channel(
    times: Array, readings: Array, own: Mask, latent: Mask, curved: Mask,
    resolution: float | None, noises: Array | None = None, passed: Mask | None = None,
) -> Thermometer:  # fmt: skip
    """Smooth a column on knots: its own times, and other columns' knots, which stay NaN.

    times (K,) s ascending, readings (K,) °C with NaN where missing; own, latent, curved (K,):
    whether a knot is a reading time of this column, a latent time of it, or a time on the curve
    through its neighbours; noises (K,) K: of readings that are means of many, or coarse; passed
    (K,): whether a knot is a passage of a coarse thermometer, whose lines replace the smoothing.
    """
    from scipy.sparse import csr_array

    if noises is None:
        noise = estimate_reading_noise(times, readings, resolution)
    else:
        noise = float(np.nanmedian(noises[own]))
    valid = np.isfinite(readings)
    t, y = times[own], readings[own]
    there = np.isfinite(y)
    smooth = filled = np.interp(t, t[there], y[there])
    if passed is None and valid.sum() >= 8 and float(np.ptp(readings[valid])) > 3 * noise:
        smooth = _smooth(filled, there.astype(float), noise)
    trajectory, sd = np.full(len(times), np.nan), np.full(len(times), 1e-6)
    trajectory[own] = smooth
    sd[own] = noise if noises is None else noises[own]
    if not there.all():
        # a gap is as uncertain as the change of the temperature across it
        missing = np.flatnonzero(own)[~there]
        sd[missing] = (2.0 * noise + np.abs(np.gradient(smooth)))[~there]
    diagonal = np.flatnonzero(~curved)
    entries = [(np.ones(len(diagonal)), diagonal, diagonal)]  # of the mixing: value, row, column
    knot, rows, bent = np.flatnonzero(own), np.flatnonzero(latent), np.flatnonzero(curved)
    index = np.clip(np.searchsorted(t, times[rows]) - 1, 0, max(len(t) - 2, 0))
    if passed is not None:
        from thermocald.physics.operators import interpolation_matrix

        between, through = np.flatnonzero(own & ~passed), np.flatnonzero(passed)
        lines = interpolation_matrix(times[passed], times[between]).tocoo()
        entries.append((lines.data, between[lines.row], through[lines.col]))
    if len(bent):
        points, weights = _weigh_neighbours(t, times[bent], np.isin(np.arange(len(t) - 1), index))
        trajectory[bent] = np.sum(weights * smooth[points], axis=1)
        at, side = np.nonzero(weights)
        entries.append((weights[at, side], bent[at], knot[points[at, side]]))
    if len(rows):
        share = (times[rows] - t[index]) / (t[index + 1] - t[index])
        bulge, sd[rows] = _estimate_kinks(*_measure_bends(t, filled, noise), index, noise)
        trajectory[rows] = (1 - share) * smooth[index] + share * smooth[index + 1] - bulge
        entries += [(1 - share, rows, knot[index]), (share, rows, knot[index + 1])]
    values, *places = map(np.concatenate, zip(*entries, strict=True))
    mixing = csr_array((values, tuple(places)), shape=(len(times), len(times)))
    deviation = np.nan_to_num(readings - trajectory)
    return Thermometer(times, trajectory, deviation, sd, mixing, own, noise)


def _estimate_kinks(bend: Array, limit: float, index: Index, noise: float) -> tuple[Array, Array]:
    """Return by how much kinks bulge in the middle of some intervals (n,), K, and the sds.

    bend (K - 1,), limit: of `_measure_bends`.
    """
    size = np.where(np.abs(bend) > limit, np.abs(bend), 0.0)
    # a kink at a random place bulges by 1/8 of the bend in the middle, ± 0.07; intervals next to it
    # have a bend too, but no bulge
    padded = np.pad(size, 1)
    top = (size > 0) & (size >= padded[:-2]) & (size >= padded[2:])
    return (bend / 8 * top)[index], 0.12 * size[index] + 0.25 * noise


def _weigh_neighbours(t: Array, at: Array, sharp: NDArray[np.bool_]) -> tuple[Index, Array]:
    """Return the two readings on either side of times (n,) and their weights in a curve, (n, 4).

    sharp (K - 1,): intervals that no curve may cross; readings beyond them have no weight.
    """
    i = np.searchsorted(t, at) - 1
    points = i[:, None] + np.arange(-1, 3)
    within = (points >= 0) & (points < len(t))
    points, sharp = np.clip(points, 0, len(t) - 1), np.pad(sharp, 1)
    within[:, 0] &= ~sharp[i]
    within[:, 3] &= ~sharp[i + 2]
    apart = t[points][:, :, None] - t[points][:, None, :]
    others = within[:, None, :] & within[:, :, None] & ~np.eye(4, dtype=bool)
    ratio = np.divide(
        (at[:, None] - t[points])[:, None, :], apart, out=np.ones(apart.shape), where=others
    )
    return points, np.where(within, np.prod(ratio, axis=2), 0.0)


def extend(channel: Thermometer) -> Thermometer:
    """Add knots with their uncertainty before the start and after the end.

    Delays need such times, and so does the state at the start. Before the start, the temperature is
    constant (the past begins with the series); after the end, it continues along its slope. The sd
    is about half the slope times the time elapsed.
    """
    t = channel.times
    k = np.flatnonzero(np.isfinite(channel.trajectory))
    step = float(np.median(np.diff(t[channel.real])))
    before = -step * np.array([12.0, 6.0, 3.0, 0.5]) + t[0]
    after = step * np.array([0.5, 1.5, 3.0, 6.0, 12.0]) + t[-1]
    first = np.polyfit(t[k[:4]], channel.trajectory[k[:4]], 1)[0]
    last = np.polyfit(t[k[-4:]], channel.trajectory[k[-4:]], 1)[0]
    held = np.full(len(before), channel.trajectory[k[0]])
    carried = channel.trajectory[k[-1]] + last * (after - t[-1]) * 0.7
    K, n, m = len(t), len(before), len(after)
    from scipy.sparse import block_diag, csr_array

    edge = np.concatenate([np.arange(n), np.arange(n + K, n + K + m)])
    at = np.concatenate([np.full(n, n + k[0]), np.full(m, n + k[-1])])
    ends = csr_array((np.ones(n + m), (edge, at)), shape=(n + K + m, n + K + m))
    mixing = csr_array(block_diag([np.eye(n), channel.mixing, np.eye(m)]) + ends)
    rate = float(np.sqrt(np.mean(np.gradient(channel.trajectory[k], t[k]) ** 2)))
    early = 0.5 * abs(first) * (t[0] - before) + 0.1 * channel.noise
    late = 0.5 * (abs(last) + rate) * (after - t[-1]) + 0.1 * channel.noise
    return replace(
        channel, times=np.concatenate([before, t, after]),
        trajectory=np.concatenate([held, channel.trajectory, carried]),
        deviation=np.pad(channel.deviation, (n, m)), sd=np.concatenate([early, channel.sd, late]),
        mixing=mixing, real=np.pad(channel.real, (n, m)),
    )  # fmt: skip


def _smooth(values: Array, weights: Array, noise: float) -> Array:
    """Smooth by a penalty on second differences but for kinks, set by cross-validation."""
    from scipy.linalg import solveh_banded

    n = len(values)
    second = np.convolve(values, [1.0, -2.0, 1.0], mode="valid")
    kink = np.abs(second) > 4.0 * np.sqrt(6.0) * noise
    loose = np.where(kink, 1e-4, 1.0)
    band = np.zeros((3, n))  # upper form of DᵀWD
    for offset, coefficient in enumerate((1.0, -2.0, 1.0)):
        band[2, offset : offset + n - 2] += loose * coefficient**2
    band[1, 1 : n - 1] += -2.0 * loose
    band[1, 2:] += -2.0 * loose
    band[0, 2:] += loose
    eigenvalues = (2.0 - 2.0 * np.cos(np.pi * np.arange(n) / n)) ** 2
    best, chosen = np.inf, values
    for penalty in _SMOOTHING:
        system = penalty * band
        system[2] += weights
        z = solveh_banded(system, weights * values)
        free = n - float(np.sum(1.0 / (1.0 + penalty * eigenvalues)))
        score = float(np.sum(weights * (values - z) ** 2)) / free**2
        if score < best:
            best, chosen = score, z
    return np.asarray(chosen, dtype=float)


def thermometers(
    times: Array,
    readings: Mapping[str, Array],
    resolutions: Mapping[str, float | None],
    noises: Mapping[str, Array] | None = None,
) -> tuple[Array, dict[str, Thermometer]]:
    """Return common knots (K,) s, and all columns on them as instruments.

    The knots are the reading times and each column's latent and curved times, or its passages if it
    is coarse. noises {column: (R,)} K: of readings that are means of many; there are no times
    between those.
    """
    nothing = np.zeros(0)
    coarse = {
        name: None if noises else find_passages(times, r, resolutions.get(name))
        for name, r in readings.items()
    }
    between = {
        name: (nothing, nothing)
        if noises or coarse[name]
        else find_times_between(times, r, resolutions.get(name))
        for name, r in readings.items()
    }
    every = [instants for pair in between.values() for instants in pair]
    passages = [found.times for found in coarse.values() if found]
    knots, first = np.unique(np.concatenate([times, *every, *passages]), return_index=True)
    from_reading = first < len(times)
    channels = {}
    for name, r in readings.items():
        found, resolution = coarse[name], resolutions.get(name)
        sds = found.bow if found else noises[name] if noises else None
        on_knots, known, passed = np.full(len(knots), np.nan), None, None
        on_knots[from_reading] = (found.readings if found else r)[first[from_reading]]
        latent, curved = (np.isin(knots, instants) for instants in between[name])
        own = from_reading & ~latent & ~curved
        if sds is not None:
            known = np.full(len(knots), np.nan)
            known[from_reading] = sds[first[from_reading]]
        if found and known is not None:
            passed = np.isin(knots, found.times)
            own |= passed
            on_knots[passed], known[passed] = found.values, found.sd
        channel = smooth_channel(knots, on_knots, own, latent, curved, resolution, known, passed)
        if found:
            noise = estimate_reading_noise(times, r, resolution)
            channel = replace(channel, noise=noise, coarse=True)
        channels[name] = extend(channel)
    return next(iter(channels.values())).times, channels
