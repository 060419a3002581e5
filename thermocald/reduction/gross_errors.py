"""Gross errors of a series, found in time: a target that leaps out of its own neighbours.

All is done in parts of the series, so that a long one needs no more memory than its points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import MAD_TO_SD

if TYPE_CHECKING:
    from collections.abc import Iterator

    from thermocald.arrays import Array, Mask

__all__ = ["outlying", "spikes"]

_GROSS = 4.5  # standard deviations beyond which a point is a gross error
_SPIKE = 7.0
_HALF = 2  # neighbours on either side
_PART = 2048  # epochs at a time


def _parts(epochs: int) -> Iterator[slice]:
    return (slice(k, min(k + _PART, epochs)) for k in range(0, epochs, _PART))


def _running_median(
    values: Array, part: slice, mask: Mask | None = None, *, itself: bool = True
) -> Array:
    """Median over time of up to five neighbours (e, T, 2) in a part of a series, NaN ignored.

    mask (E, T): points that do not count; itself: whether an epoch is among its neighbours.
    """
    first, last = max(part.start - _HALF, 0), min(part.stop + _HALF, len(values))
    near = values[first:last]
    if mask is not None:
        near = np.where(mask[first:last, :, None], np.nan, near)
    before, after = part.start - first, last - part.stop
    padded = np.pad(near, ((_HALF - before, _HALF - after), (0, 0), (0, 0)),
                    constant_values=np.nan)  # fmt: skip
    width, n = 2 * _HALF + 1, part.stop - part.start
    stack = np.stack([padded[k : k + n] for k in range(width) if itself or k != _HALF])
    width = len(stack)
    stack.sort(axis=0)  # NaN go to the end
    count = np.isfinite(stack).sum(axis=0)
    low = np.maximum(count - 1, 0) // 2
    high = np.minimum(count // 2, width - 1)
    pick = np.take_along_axis
    middle: Array = 0.5 * (pick(stack, low[None], 0)[0] + pick(stack, high[None], 0)[0])
    return middle


def _medians(values: Array) -> Array:
    """Median of each row (e, n), NaN ignored; NaN where there is nothing else."""
    ordered = np.sort(values, axis=1)  # NaN go to the end
    count = np.isfinite(ordered).sum(axis=1)
    rows = np.arange(len(ordered))
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, ordered.shape[1] - 1)
    return np.asarray(0.5 * (ordered[rows, low] + ordered[rows, high]))


def spikes(misclosure: Array, seen: Mask) -> Mask:
    """Points (E, T) that leap out of their own neighbours in time while the others do not.

    Found before any adjustment, where a gross error of many pixels would hide itself and others.
    """
    size, own = np.zeros(seen.shape), np.zeros(len(seen))
    for part in _parts(len(seen)):
        # Without the epoch itself: where all move one way it would be its own median, and what
        # is usual would be nothing.
        d = misclosure[part] - _running_median(misclosure, part, itself=False)
        for k in range(2):
            d[..., k] -= _medians(d[..., k])[:, None]  # the whole image may move
        own[part] = MAD_TO_SD * _medians(np.abs(d).reshape(len(d), -1))
        size[part] = np.max(np.abs(np.nan_to_num(d)), axis=2)
    finite = own[np.isfinite(own)]
    level = float(np.median(finite)) if len(finite) else 0.0
    limit = _SPIKE * np.fmax(np.nan_to_num(own), level)
    return np.asarray(seen & (size > limit[:, None]))


def outlying(v: Array, weights: Array, seen: Mask, bad: Mask) -> Mask:
    """Points (E, T) whose residuals v (E, T, 2) px are gross against their neighbours in time.

    bad: those that were so far, which do not count. Noise may grow with heat: each epoch is
    assessed by its own spread, or the series' where that is larger.
    """
    size, own = np.zeros(seen.shape), np.zeros(len(seen))
    good = seen & ~bad
    normal = []
    for part in _parts(len(seen)):
        root = np.sqrt(weights[part, :, :2])
        kept = np.where(good[part, :, None], np.abs(np.nan_to_num(v[part])) * root, np.nan)
        own[part] = MAD_TO_SD * _medians(kept.reshape(len(kept), -1))
        normal.append(kept[np.isfinite(kept)])
        local = np.abs(np.nan_to_num(v[part] - _running_median(v, part, bad)))
        size[part] = np.max(local * root, axis=2)
    level = MAD_TO_SD * float(np.median(np.concatenate(normal)))
    limit = _GROSS * np.fmax(np.nan_to_num(own), level)
    return np.asarray(seen & (size > limit[:, None]))
