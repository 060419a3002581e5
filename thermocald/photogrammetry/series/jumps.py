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
    from collections.abc import Iterator, Mapping, Sequence

    from thermocald.arrays import Array, Index, Mask

    Step = tuple[Array, Array]
    """A step (k,) of the pose and the weights (k, k) of what is known of it."""


_LARGE = 5.0  # robust standard deviations of the change between neighbours; noise reaches 4
_CERTAIN = 30.0  # χ² with 6 degrees of freedom of a displacement
_SHOWN = 22.5  # χ² with 6 degrees of freedom, exceeded by chance in one of a thousand gaps
_RETURNS = 5.0  # χ² by which a return must explain the epochs better than a step that stays
_SWAYS = 40.0  # χ² of a return, as a mount that sways returns, too
_COLUMN = 10.0  # χ² that each column of a course must explain
_FURTHER = 15.0  # χ² that each epoch must explain that is displaced by an amount of its own
_FREEDOM = (3, 4, 6)  # epochs beyond a bend that its columns need
_SEEN = 3  # epochs on either side that show that something else remains
_BESIDE = 5  # epochs around a change in which a step may be instead
_TOGETHER = 0.7  # epochs between a bend and a step that may be between the same two epochs
SIDE = 8  # epochs before and after a gap that give its step
_WINDOW = SIDE + 2  # epochs before and after a change that show what happened
_FEW_MISSING = 12  # epochs, for which the drift around them predicts it to a noise of the pose
_PREDICTED = 0.03  # variance of the slope around them, a third of it noise, the rest curvature
_BRIEF = SIDE - 1  # most epochs for which a mount is touched
_MOST = 8  # jumps examined
_MOST_TOUCHED = 2 * _BRIEF  # epochs, or an eighth of them
_ABRUPT = 0.5  # of the larger change next to it, by which a jump differs from both
_LOOSE = 9.0  # times the square of the image's change: variance of a step in any direction
_EXCLUDED = 29.0  # χ² with 6 degrees of freedom by which the perspective must exclude a step
_DRIFTS = 39.1  # χ² with 12 degrees of freedom, exceeded by chance in one of 10,000 series
_NEIGHBOURS = 5  # epochs on one side that predict an epoch


def find_jumps(
    trajectory: Array, M: Array, g: Array, scale: Array, numbers: Index, gaps: Sequence[int]
) -> tuple[Array, dict[int, Step], Array, dict[int, tuple[Array, float]]]:
    """Find the mount's jumps in a trajectory (E, k), in units of its noise.

    M (E, k, k), g (E, k): normal equations of the pose with the interior orientation free; scale
    (E,): noise of an epoch over the typical one, as a camera may defocus; numbers (E,): of the
    epochs; gaps: the first epoch after each gap. Returns the trajectory without any jumps and
    touches, and without what it drifts while a few epochs are missing; what is known of the mount's
    jumps by their epochs, the covariance (k, k) of a step in a gap that shows none, and the
    displacement (k,) of each epoch in which the mount was elsewhere, as if touched, with its
    variance over an epoch's; M and g of these are then 0.
    """
    jumps: dict[int, Step]
    left, jumps, hidden = trajectory.copy(), {}, np.zeros(M.shape[1:])
    # in a gap the camera drifts, too: only the perspective shows how far the mount moved
    for row in gaps:
        _, step = _line(left, numbers, row)
        left[row:] -= step
        jumps[row] = np.zeros_like(step), _loose(step)
    for row, (moved, V) in zip(gaps, estimate_steps(M, g, jumps), strict=True):
        if _chi2(moved, V) < _SHOWN:
            del jumps[row]
            hidden = max(hidden, V, key=np.trace)
    missing = np.diff(numbers, prepend=numbers[0] - 1) - 1
    for row in np.flatnonzero((missing > 0) & (missing <= _FEW_MISSING)).tolist():
        if row not in gaps:  # else a steep drift would be a jump
            left[row:] -= missing[row] * _line(trajectory, numbers, row)[0]
    pair = np.hypot(scale[1:], scale[:-1])[:, None]
    change = _without_drift(np.diff(left, axis=0)) / pair
    noise = pair * np.maximum(mad_sd(change, axis=0), 1.0)
    touches: dict[int, tuple[Array, float]] = {}
    examined, untouched = {*gaps}, (left.copy(), dict(jumps))
    all_M, all_g, M, g = M, g, M.copy(), g.copy()
    while len(examined) < _MOST + len(gaps):
        every = np.diff(left, axis=0)
        size = np.where(_is_abrupt(every), np.abs(_without_drift(every)) / noise, 0.0)
        for row in examined:
            size[row - 1] = 0.0
        worst = int(size.max(axis=1).argmax())
        if size[worst].max() < _LARGE:
            break
        examined.add(worst + 1)
        sds = noise[worst] / np.sqrt(2.0)
        found = _find_displacement(left, worst + 1, sds)
        if found is None:
            continue
        away, there, variances, row, step, variance = found
        for each, course, of_course in zip(away, there, variances, strict=True):
            touches[each] = left[each] - course, 1.0 + float(of_course)
            left[each] = course
        M[away], g[away] = 0.0, 0.0
        if row and row not in jumps:
            left[row:] -= step
            variance = variance + np.eye(len(step)) * _PREDICTED * missing[row] ** 2
            if jump := _find_mover(row, step, variance, M, g):
                jumps[row] = jump
    if len(touches) > max(_MOST_TOUCHED, len(left) // 8):
        return *untouched, hidden, {}  # a few epochs that hardly differ seem to show the noise
    all_M[:], all_g[:] = M, g
    return left, dict(sorted(jumps.items())), hidden, touches


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
    n = _NEIGHBOURS
    predict = np.linalg.pinv(np.vander(np.arange(1.0, n + 1), 3))[-1]  # at 0
    windows = np.lib.stride_tricks.sliding_window_view(trajectory, n, axis=0)
    predicted = np.full((2, *trajectory.shape), np.nan)
    predicted[0, n:] = windows[:-1] @ predict[::-1]
    predicted[1, :-n] = windows[1:] @ predict
    return np.asarray(np.nanmin(np.abs(trajectory - predicted), axis=0))


def _without_drift(change: Array) -> Array:
    """Return changes (E - 1, k) between neighbours less the median of those around."""
    padded = np.pad(change, ((SIDE, SIDE), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * SIDE + 1, axis=0)
    return change - np.median(windows, axis=-1)


def _is_abrupt(change: Array) -> Mask:
    """Return whether changes (E - 1, k) between neighbours stand out from those next to them.

    Where a camera warms up steeply, each change is large, but a little smaller than the last.
    """
    size, usual = np.abs(change), (change[:-2] + change[2:]) / 2
    inner = np.abs(change[1:-1] - usual) > _ABRUPT * np.maximum(size[:-2], size[2:])
    abrupt = np.pad(inner, ((1, 1), (0, 0)))
    # near an end it must exceed the next ones, as a camera that begins to warm up is slower there
    for near, found in ((size, abrupt), (size[::-1], abrupt[::-1])):
        for k in range(_SEEN + 1):
            found[k] = near[k] > (1.0 + _ABRUPT) * near[k + 1 : k + 1 + SIDE].max(axis=0)
    return abrupt


def _line(trajectory: Array, numbers: Index, row: int) -> Array:
    """Return the slope and the step (2, k) of a straight line at an epoch."""
    near = slice(max(row - SIDE, 0), row + SIDE)
    t = numbers[near] - numbers[row]
    line = np.column_stack([np.ones(len(t)), t, t >= 0])
    return np.asarray(np.linalg.pinv(line)[1:] @ trajectory[near])


def _find_displacement(
    trajectory: Array, row: int, sds: Array
) -> tuple[range, Array, Array, int, Array, Array] | None:
    """Find how a trajectory (E, k) is displaced at about `row`: for some epochs, to stay, or both.

    sds (k,): of an epoch. Returns the m epochs in which it was elsewhere, none if it stays; where
    they would be without that (m, k), and its variances (m,) over an epoch's; the epoch from which
    on it stays displaced, 0 if it returns; that step (k,) and its covariance (k, k). None if the
    course alone explains it.
    """
    rows = np.arange(max(row - _WINDOW, 0), min(row + _WINDOW, len(trajectory)))
    at, courses, price = _courses(rows)
    beyond = np.eye(len(rows)) - courses @ np.linalg.pinv(courses)
    left = beyond @ (trajectory[rows] / sds)
    least = (left**2).sum(axis=(1, 2)) + price
    best, found = least.min() - _CERTAIN, None
    for away, stays, shapes, cost in _displacements(rows, row):
        misfit = least + cost - _explained(beyond, left, shapes)
        if misfit.min() < best:
            best, bend, found = misfit.min(), int(misfit.argmin()), (away, stays, shapes)
    if found is None:
        return None
    away, stays, shapes = found
    if not stays and least.min() - best < _SWAYS:
        return None
    # a heater is switched between two epochs: a step between them, too, hides a part of it
    apart = np.abs(at - np.array([[away.start or stays], [stays]]) + 0.5)
    edge = int(apart[:, bend].argmin())
    together = bool(courses[bend, :, 0].any()) and apart[edge, bend] < _TOGETHER
    course = courses[apart[edge].argmin() if together else bend]
    estimator, k = np.linalg.pinv(np.column_stack([*shapes, course])), len(shapes)
    hat = course[np.isin(rows, away)] @ estimator[k:]
    step, rate = (estimator @ trajectory[rows])[k - 1 : k + 1]
    variance = np.diag(estimator[k - 1] @ estimator[k - 1] * sds**2)
    variance += together * np.outer(rate, rate) / (12.0 * SIDE**2)
    return away, hat @ trajectory[rows], (hat**2).sum(axis=1), stays, step, variance


def _displacements(rows: Index, row: int) -> Iterator[tuple[range, int, list[Array], float]]:
    """Yield the displacements of some epochs (n,) at about `row`.

    Each has the epochs elsewhere, the first that stays so or 0, the shapes (n,), and the χ² that it
    must explain beyond that of a step.
    """
    first, last = rows[0], rows[-1] + 1
    for stays in range(max(row - _BESIDE, first + 1), min(row + _BESIDE + 1, last)):
        few = min(stays - first, last - stays) == 2  # which may be elsewhere each
        yield range(0), stays, [(rows >= stays).astype(float)], _FURTHER * few
    for m in range(1, _BRIEF + 1):
        for start in range(max(row - m, first), min(row, last - m) + 1):
            away = range(start, start + m)
            each = [(rows == k).astype(float) for k in away]
            cost = _FURTHER * (m - 1)
            beside = min(start - first, last - away.stop)
            if not beside:  # whether it returns is beyond the series
                yield away, 0, each, cost
                continue
            for shapes, more in (([np.sum(each, axis=0)], 0.0), (each, cost)):
                yield away, 0, shapes, more + _RETURNS
                if beside >= _SEEN:
                    after = (rows >= away.stop).astype(float)
                    yield away, away.stop, [*shapes, after], more + _SHOWN


def _courses(rows: Index) -> tuple[Array, Array, Array]:
    """Return where the course of some epochs (n,) may bend (b,), its columns (b, n, 7), and the χ²
    (b,) that these must explain beyond a straight line.

    The course is a cubic on either side, with less freedom beside few epochs; the last but one has
    no bend, and the last is a straight line.
    """
    at = np.append(np.arange(rows[0], rows[-1], 0.1), [rows[-1]] * 2)
    beyond = (rows - at[:, None]) / SIDE
    beyond *= np.where(at < rows.mean(), -1.0, 1.0)[:, None]
    free = (beyond > 0).sum(axis=1)[:, None] > _FREEDOM
    powers = np.clip(beyond, 0.0, None)[..., None] ** [1, 2, 3] * free[:, None]
    cubic = np.tile(np.vander((rows - rows.mean()) / SIDE, 4), (len(at), 1, 1))
    cubic[-1, :, :2] = 0.0
    price = _COLUMN * (free.sum(axis=1) + 2.0)
    price[-1] = 0.0
    return at, np.concatenate([powers, cubic], axis=-1), price


def _explained(beyond: Array, left: Array, shapes: list[Array]) -> Array:
    """Return the squares (b,) of what is `left` (b, n, k) beyond some courses that shapes explain.

    beyond (b, n, n): projectors; shapes (n,): columns.
    """
    total: Array = np.zeros(len(left))
    before: list[Array] = []
    for shape in shapes:
        free = beyond @ shape
        for other in before:
            free -= other * (other * free).sum(axis=1)[:, None]
        free /= np.sqrt(np.maximum((free**2).sum(axis=1), 1e-9))[:, None]
        before.append(free)
        total += (np.einsum("bn,bnk->bk", free, left) ** 2).sum(axis=1)
    return total


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
