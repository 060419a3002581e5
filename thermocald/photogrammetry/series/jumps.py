"""Jumps of a series: a knock of the mount, a slip of a lens, a touch, and what happened in a gap.

The trajectory may have jumps, if the mount was knocked or a lens slipped; a mount that was touched
is elsewhere for a moment. A jump that the perspective attributes to the interior orientation is
the camera's; every other one is a step of the mount's mean pose, estimated from the jump itself. In
a gap the camera may drift: only the perspective shows whether the mount moved, and by how much.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined, mad_sd

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.arrays import Array, Mask

    Step = tuple[Array, Array]
    """A step (k,) of the pose and the weights (k, k) of what is known of it."""


_LARGE = 5.0  # robust standard deviations of the change between neighbours; noise reaches 4
_CERTAIN = 6.0  # standard deviations of the step by the epochs around
_CERTAIN_CHI2 = 36.0  # χ² with 6 degrees of freedom of a step beside a bend
_BENT = 3.0  # standard deviations of the squares that straight lines leave
_LASTING = 0.5  # share of the change that must remain
_BESIDE = 5  # epochs between a step and a bend, within which either looks like the other
SIDE = 8  # epochs before and after a jump that give its step
_MOST = 8  # jumps examined
_ABRUPT = 0.5  # of the larger change next to it, by which a jump differs from both
_LOOSE = 9.0  # times the square of the image's change: variance of a step in any direction
_EXCLUDED = 29.0  # χ² with 6 degrees of freedom by which the perspective must exclude a step
_DRIFTS = 39.1  # χ² with 12 degrees of freedom, exceeded by chance in one of 10,000 series
_TOUCHED = 10.0  # usual deviations from what the epochs before or after predict
_BRIEF = 3  # epochs for which a mount may be touched
_NEIGHBOURS = 5  # epochs on one side that predict an epoch
_SHOWN = 22.5  # χ² with 6 degrees of freedom, exceeded by chance in one of a thousand gaps


def _find_touches(trajectory: Array, scale: Array) -> Mask:
    """Return the epochs (E,) in which the mount was elsewhere, as if touched.

    trajectory, scale: as in `find_jumps`. An epoch next to an end is not examined.
    """
    before, after = _predictions(trajectory)
    least = least_deviation(trajectory)
    deviation = least / scale[:, None]
    inside = slice(_NEIGHBOURS, len(trajectory) - _NEIGHBOURS)
    usual = np.maximum(np.median(deviation[inside], axis=0), 1.0)
    # a camera that suddenly drifts does not return
    returns = np.abs(after - before) < _LASTING * least
    touched = np.zeros(len(trajectory), dtype=bool)
    touched[inside] = ((deviation > _TOUCHED * usual) & returns)[inside].any(axis=1)
    return touched


def find_jumps(
    trajectory: Array, M: Array, g: Array, scale: Array, gaps: Sequence[int]
) -> tuple[Array, dict[int, Step], Array, Mask]:
    """Find the mount's jumps in a trajectory (E, k), in units of its noise.

    M (E, k, k), g (E, k): normal equations of the pose with the interior orientation free; scale
    (E,): noise of an epoch over the typical one, as a camera may defocus; gaps: the first epoch
    after each gap. Returns the trajectory without any jumps, what is known of the mount's by their
    epochs, the covariance (k, k) of a step in a gap that shows none, and the epochs (E,) in which
    the mount was elsewhere, as if touched.
    """
    jumps: dict[int, Step]
    left, jumps, hidden = trajectory.copy(), {}, np.zeros(M.shape[1:])
    # in a gap the camera drifts, too: only the perspective shows how far the mount moved
    for row in gaps:
        step, _ = _step(left, row)
        left[row:] -= step
        jumps[row] = np.zeros_like(step), _loose(step)
    for row, (moved, V) in zip(gaps, estimate_steps(M, g, jumps), strict=True):
        if _chi2(moved, V) < _SHOWN:
            del jumps[row]
            hidden = max(hidden, V, key=np.trace)
    pair = np.hypot(scale[1:], scale[:-1])[:, None]
    change = _without_drift(np.diff(left, axis=0)) / pair
    noise = pair * np.maximum(mad_sd(change, axis=0), 1.0)
    touches: list[tuple[slice, Array]] = []
    examined = {*gaps}
    while len(examined) < _MOST + len(gaps) and len(left) >= 4 * SIDE:
        every = np.diff(left, axis=0)
        change = _without_drift(every)
        size = np.where(_is_abrupt(every), np.abs(change) / noise, 0.0)
        for row in examined:
            size[row - 1] = 0.0
        worst = int(size.max(axis=1).argmax())
        row, column = worst + 1, int(size[worst].argmax())
        if size[worst, column] < _LARGE:
            break
        examined.add(row)
        step, factor = _step(left, row)
        lasting = _step(left, row, 1)[0][column]  # a spike is no jump
        certain = abs(step[column]) > _CERTAIN * noise[worst, column] * np.sqrt(factor / 2)
        jumped = certain and abs(lasting) >= _LASTING * abs(change[worst, column])
        sds = noise[worst] / np.sqrt(2.0)
        bend = _straight_bend(left, row, sds) if jumped else None
        if bend is not None:  # which may be anywhere between the two epochs
            variance = np.diag(factor * sds**2) + np.outer(bend, bend) / 12.0
        else:
            beside = _step_beside_bend(left, row, sds)
            if beside is None:
                continue
            row, last, step, variance = beside
            if last and _returns(left, row, last, step):
                left[row:last] -= step
                touches.append((slice(row, last), step))
            if last or not jumped or row in jumps:
                continue
        left[row:] -= step
        if jump := _find_mover(row, step, variance, M, g):
            jumps[row] = jump
    touched = _find_touches(left, scale)
    for away, step in touches:
        left[away] += step
        touched[away] = True
    return left, dict(sorted(jumps.items())), hidden, touched


def estimate_steps(M: Array, g: Array, jumps: Mapping[int, Step]) -> list[tuple[Array, Array]]:
    """Estimate the steps (k,) of the pose at some epochs, and their covariances (k, k).

    M (E, k, k), g (E, k): as in `find_jumps`; jumps: what is known of the steps, in order of time.
    """
    k = g.shape[1]
    starts = [0, *jumps]
    sums = [M[row:].sum(axis=0) for row in starts]
    each = range(len(starts))
    N = np.block([[sums[max(i, j)] for i in each] for j in each])
    right = np.concatenate([g[row:].sum(axis=0) for row in starts])
    for j, (step, weights) in enumerate(jumps.values(), start=1):
        own = np.arange(j * k, (j + 1) * k)
        N[own[:, None], own] += weights
        right[own] += weights @ step
    Q = inverse_of_determined(N)
    found = (Q @ right).reshape(-1, k)
    Q = Q.reshape(len(starts), k, len(starts), k)
    return [(found[j], Q[j, :, j]) for j in each[1:]]


def find_drift(M: Array, g: Array) -> Array:
    """Return the mean square (k, k) of the pose's drift about its mean, 0 if not significant.

    M (E, k, k), g (E, k): as in `find_jumps`. The drift is a parabola in time, to which the
    perspectives of all epochs together are far more sensitive than that of a single one.
    """
    n, k = g.shape
    u = np.linspace(-1.0, 1.0, n)
    basis = np.polynomial.legendre.legvander(u, 2)
    N = np.einsum("ea,eb,eij->aibj", basis, basis, M).reshape(3 * k, 3 * k)
    Q = inverse_of_determined(N)
    drift, V = (Q @ np.einsum("ea,ei->ai", basis, g).ravel())[k:], Q[k:, k:]
    if _chi2(drift, V) < _DRIFTS:
        return np.zeros((k, k))
    course: Array = basis[:, 1:] @ drift.reshape(2, k)
    return np.asarray(course.T @ course / n)


def least_deviation(trajectory: Array) -> Array:
    """Return how far each epoch of a trajectory (E, k) is from the parabola through those before it
    or after it, whichever is nearer: a spike is far from both, a kink from one.
    """
    return np.asarray(np.nanmin(np.abs(trajectory - _predictions(trajectory)), axis=0))


def _predictions(trajectory: Array) -> Array:
    """Return each epoch (2, E, k) as predicted by the parabolas through the epochs before it and
    after it, NaN near the ends.
    """
    n = _NEIGHBOURS
    predict = np.linalg.pinv(np.vander(np.arange(1.0, n + 1), 3))[-1]  # at 0
    windows = np.lib.stride_tricks.sliding_window_view(trajectory, n, axis=0)
    out = np.full((2, *trajectory.shape), np.nan)
    out[0, n:] = windows[:-1] @ predict[::-1]
    out[1, :-n] = windows[1:] @ predict
    return out


def _without_drift(change: Array) -> Array:
    """Return changes (E - 1, k) between neighbours less the median of those around."""
    padded = np.pad(change, ((SIDE, SIDE), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * SIDE + 1, axis=0)
    return change - np.median(windows, axis=-1)


def _is_abrupt(change: Array) -> Mask:
    """Return whether changes (E - 1, k) between neighbours stand out from those next to them.

    Where a camera warms up steeply, each change is large, but a little smaller than the last.
    """
    usual, next_to = np.empty_like(change), np.empty_like(change)
    usual[1:-1] = (change[:-2] + change[2:]) / 2
    usual[0], usual[-1] = 2 * change[1] - change[2], 2 * change[-2] - change[-3]
    next_to[1:-1] = np.maximum(np.abs(change[:-2]), np.abs(change[2:]))
    next_to[0], next_to[-1] = np.abs(change[1]), np.abs(change[-2])
    return np.asarray(np.abs(change - usual) > _ABRUPT * next_to)


def _step(trajectory: Array, row: int, apart: int = 0) -> tuple[Array, float]:
    """Return the step (k,) of a straight line at an epoch, and its variance over the noise's.

    apart: number of epochs on both sides that do not count.
    """
    t = np.arange(max(row - SIDE, 0), min(row + SIDE, len(trajectory))) - row
    t = t[(t < -apart) | (t >= apart)]
    estimator = np.linalg.pinv(np.column_stack([np.ones(len(t)), t, t >= 0]))[2]
    return estimator @ trajectory[row + t], float(estimator @ estimator)


def _straight_bend(trajectory: Array, row: int, sds: Array) -> Array | None:
    """Return the change of the rates (k,) at an epoch before and after which a trajectory (E, k) is
    straight; None if it is not, or if that change between two epochs may look like the step.

    sds (k,): of an epoch.
    """
    rows = np.arange(max(row - SIDE, 0), min(row + SIDE, len(trajectory)))
    u, after = rows - row + 0.5, rows >= row
    lines, y = np.column_stack([u**0, u, after, u * after]), trajectory[rows] / sds
    fit = np.linalg.pinv(lines) @ y
    left, (step, rate) = y - lines @ fit, np.linalg.norm(fit[2:], axis=1)
    freedom = left.size * (1.0 - 4.0 / len(rows))
    straight = float((left**2).sum()) < freedom + _BENT * np.sqrt(2.0 * freedom)
    return fit[3] * sds if straight and step > rate else None


def _step_beside_bend(
    trajectory: Array, row: int, sds: Array
) -> tuple[int, int, Array, Array] | None:
    """Return the epoch near `row` at which a trajectory (E, k) steps, the one at which it returns
    (0 if it stays), the step (k,) and its covariance (k, k); None if a bend alone explains it.

    sds (k,): of an epoch. The course is a cubic on either side of the bend. A heater is switched
    anywhere between two epochs: if the step is between them too, one hides a part of the other.
    """
    rows = np.arange(max(row - SIDE, 0), min(row + SIDE, len(trajectory)))
    t, y = (rows - row) / SIDE, trajectory[rows] / sds
    at = np.arange(-_BESIDE, _BESIDE, 0.1)
    after = np.clip(t - at[:, None] / SIDE, 0.0, None)
    cubic = np.broadcast_to(np.vander(t, 4), (len(at), len(t), 4))
    bends = np.concatenate([np.stack([after, after**2, after**3], axis=-1), cubic], axis=-1)
    beyond = np.eye(len(t)) - bends @ np.linalg.pinv(bends)
    spans = [(row + k, 0) for k in range(-_BESIDE, _BESIDE + 1)]
    brief = range(1, _BRIEF + 1)
    spans += [(row, row + m) for m in brief] + [(row - m, row) for m in brief]
    steps = np.array([(rows >= a) & ~((rows >= b) & (b > 0)) for a, b in spans]).T.astype(float)
    left, free = beyond @ y, beyond @ steps
    least = (left**2).sum(axis=(1, 2))
    gain = ((np.swapaxes(free, 1, 2) @ left) ** 2).sum(axis=2)
    gain /= np.maximum((free**2).sum(axis=1), 1e-9)  # (bends, steps)
    bend, k = np.unravel_index(int((least[:, None] - gain).argmin()), gain.shape)
    if least.min() - least[bend] + gain[bend, k] < _CERTAIN_CHI2:
        return None
    first, last = spans[k]
    apart = at - (first - row - 0.5)
    together = abs(apart[bend]) < 0.7
    model = np.column_stack([steps[:, k], bends[np.abs(apart).argmin() if together else bend]])
    estimator = np.linalg.pinv(model)
    step, rate = (estimator @ trajectory[rows])[:2]
    variance = np.diag(estimator[0] @ estimator[0] * sds**2)
    variance += together * np.outer(rate, rate) / (12.0 * SIDE**2)
    return first, last, step, variance


def _returns(trajectory: Array, row: int, last: int, step: Array) -> bool:
    """Test whether a trajectory (E, k) is where it was before a brief step (k,) from `row` on."""
    t = np.r_[max(row - SIDE, 0) : row, last : min(last + SIDE, len(trajectory))] - last
    shapes = np.column_stack([np.ones(len(t)), t, t**2, t >= 0])
    stays = np.linalg.pinv(shapes)[3] @ trajectory[last + t]
    return bool(np.linalg.norm(stays) < _LASTING * np.linalg.norm(step))


def _find_mover(row: int, step: Array, variance: Array, M: Array, g: Array) -> Step | None:
    """Return what is known of a jump of the pose; None if the camera jumped.

    step (k,), variance (k, k): of the trajectory. If the perspective excludes neither that the
    mount jumped nor that the camera did, it alone shows how far.
    """
    ((moved, V),) = estimate_steps(M, g, {row: (step, np.zeros_like(variance))})
    if _chi2(moved, V) > _EXCLUDED:
        return step, np.asarray(np.linalg.inv(variance), dtype=np.float64)
    if _chi2(step - moved, V + variance) > _EXCLUDED:
        return None
    return np.zeros_like(step), _loose(step)


def _loose(step: Array) -> Array:
    """Return the weights (k, k) of a step that is hardly larger than this change of the image."""
    return np.eye(len(step)) / max(_LOOSE * float(step @ step), 1e-12)


def _chi2(difference: Array, covariance: Array) -> float:
    return float(difference @ np.linalg.pinv(covariance, hermitian=True) @ difference)
