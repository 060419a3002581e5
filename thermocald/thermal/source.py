"""The arrays for a reduction, read from a recording or a store; long series are condensed.

A long series is condensed while it is read: its rows are means of epochs, over shorter times where
the camera moves fast.

Heat is slow. Over a year, means over about an hour represent the camera's trajectories. Faster
movement is searched in the image: in its shift and scale, epoch by epoch, minus a straight line in
the temperature. Short means remain in the few windows (of about a day) in which most is left, or in
which the temperature itself changes fastest. A mean of image points has the sum of their weights,
so that the normal equations lose nothing if the camera does not move within a row.

Limit: outside these windows, movement faster than a row is averaged out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermocald.acquisition.calibrator import Calibrator, calibrated_epochs
from thermocald.errors import DataError
from thermocald.photogrammetry.linalg import mad_sd, median_known
from thermocald.photogrammetry.series.normals import ObservationBlocks, ObservationGrid, recut
from thermocald.store.recording.reader import Recording
from thermocald.thermal import criteria
from thermocald.thermal.series import SeriesInput
from thermocald.thermal.thermometer import estimate_reading_noise

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.store.recording.head import Head
    from thermocald.store.sources import StoredRecording

_POINTS = 1_300_000  # image points of all rows: 300 MB while they are reduced
_FEWEST, _MOST = 2_000, 10_000  # rows
_COARSE = 0.8  # share of the rows that are long means
_SHORTEST, _LONGEST = 4, 24  # long means per window
_FINER = 12  # short means per long mean
_NEIGHBOURS = 5  # epochs, at least, for the detection of gross errors
_AT_ONCE = 4_000  # epochs
_MEMORY_S = 3600.0  # before the first frame, for lags
_READINGS_A_FRAME = 10


def limit_rows(targets: int) -> int:
    """Return the largest number of epochs with some targets that are reduced one by one."""
    return min(max(_POINTS // max(targets, 1), _FEWEST), _MOST)


class _Rows(NamedTuple):
    """The rows of a condensed series: their first epochs and epoch counts (R,), and their points.

    points (R, T, 2) px, weights (R, T, 3) px⁻².
    """

    first: Index
    counts: Index
    points: Array
    weights: Array


def condensed(
    series: SeriesInput, source: ObservationBlocks, most: int | None = None
) -> SeriesInput:
    """Condense a series to at most `most` rows.

    series: all epochs (its grid is not used); source: their observations. The memory needed is that
    of the rows and one block.
    """
    E, T = len(source), len(series.field)
    most = most or limit_rows(T)
    size = int(np.ceil(E / (_COARSE * most)))
    fine = max(size // _FINER, 1)
    size = fine * int(np.ceil(size / fine))
    rows, trajectory = _average_epochs(source.blocks(), 0, E, T, size, fine)
    if size > 1:
        spare = (1.0 - _COARSE) * most * fine  # epochs that may be in short means
        length = size * int(np.clip(0.5 * spare / size, _SHORTEST, _LONGEST))
        count = max(int(spare / length), 1)
        chosen = _choose_fast_windows(
            trajectory, _average_temperature(series, fine), length // fine, count
        )
        windows = [slice(k * length, min((k + 1) * length, E)) for k in chosen]
        inside = [(rows.first >= w.start) & (rows.first < w.stop) for w in windows]
        parts = [_Rows._make(column[~np.any(inside, axis=0)] for column in rows)]
        parts += [
            _average_epochs(source.blocks([w]), w.start, w.stop - w.start, T, fine)[0]
            for w in windows
        ]
        rows = _Rows._make(map(np.concatenate, zip(*parts, strict=True)))
        order = np.argsort(rows.first, kind="stable")
        rows = _Rows._make(column[order] for column in rows)
    return _put_on_rows(series, rows)


def _put_on_rows(series: SeriesInput, rows: _Rows) -> SeriesInput:
    """Return the series with times, readings and columns averaged over rows, and their noise."""

    def mean(values: Array) -> Array:
        there = np.isfinite(values)
        n = np.add.reduceat(there.astype(float), rows.first)
        total = np.add.reduceat(np.where(there, values, 0.0), rows.first)
        return np.asarray(np.where(n > 0, total / np.maximum(n, 1.0), np.nan))

    noises = {}
    for name, readings in series.readings.items():
        values = np.asarray(readings, dtype=float)
        resolution = series.resolutions.get(name)
        one = estimate_reading_noise(series.reading_times, values, resolution)
        n = np.add.reduceat(np.isfinite(values).astype(float), rows.first)
        # errors due to the resolution do not average out
        floor = (resolution or 0.0) / np.sqrt(12.0) / 3.0
        noises[name] = np.maximum(one / np.sqrt(np.maximum(n, 1.0)), floor)
    return replace(
        series,
        frame_times=mean(series.frame_times),
        reading_times=mean(series.reading_times),
        readings={n: mean(np.asarray(r, dtype=float)) for n, r in series.readings.items()},
        grid=ObservationGrid(rows.points, rows.weights),
        numbers=series.numbers[rows.first],
        columns={n: mean(c) for n, c in (series.columns or {}).items()},
        counts=rows.counts,
        noises=noises,
    )


def _average_temperature(series: SeriesInput, size: int) -> Array:
    """Return averages (⌈E / size⌉,) of the reference temperature, interpolated across gaps."""
    E = len(series.frame_times)
    readings = next(iter(series.readings.values()), np.zeros(E))
    there = np.flatnonzero(np.isfinite(readings))
    values = np.interp(np.arange(E), there, readings[there]) if len(there) else np.zeros(E)
    starts = np.arange(0, len(values), size)
    total = np.add.reduceat(values, starts)
    return np.asarray(total / np.diff(np.append(starts, len(values))))


def _average_epochs(
    blocks: Iterable[tuple[int, ObservationGrid]], start: int, epochs: int, targets: int,
    size: int, fine: int = 0,
) -> tuple[_Rows, Array]:  # fmt: skip
    """Average `size` epochs per row from epoch `start` on, without gross errors.

    Returns the rows, and shift and scale (F, 3) px of means over `fine` epochs.
    """
    R = -(-epochs // size)
    normal, right = np.zeros((R, targets, 3)), np.zeros((R, targets, 2))
    short = fine or size
    sums = np.zeros((-(-epochs // short), 4))
    middle: Array | None = None
    for first, grid in recut(blocks, size * max(_AT_ONCE // size, 1)):
        w = grid.weights
        if middle is None:
            with np.errstate(invalid="ignore"):
                middle = _locate_targets(grid)
        p = np.nan_to_num(grid.points - middle)
        w = np.where(_find_gross(p, w[..., 0] > 0, short)[..., None], 0.0, w)
        at = np.arange(len(grid)) + first - start
        runs = np.flatnonzero(np.diff(at // size, prepend=-1))
        rows = at[runs] // size
        normal[rows] += np.add.reduceat(w, runs, axis=0)
        weighted = np.stack(
            [w[..., 0] * p[..., 0] + w[..., 2] * p[..., 1],
             w[..., 2] * p[..., 0] + w[..., 1] * p[..., 1]], axis=-1,
        )  # fmt: skip
        right[rows] += np.add.reduceat(weighted, runs, axis=0)
        if fine:
            runs = np.flatnonzero(np.diff(at // fine, prepend=-1))
            sums[at[runs] // fine] += np.add.reduceat(_shift_and_scale(p, w, middle), runs, axis=0)
    assert middle is not None  # there are epochs
    determinant = normal[..., 0] * normal[..., 1] - normal[..., 2] ** 2
    there = determinant > 0
    d = np.where(there, determinant, 1.0)
    points = np.stack(
        [(normal[..., 1] * right[..., 0] - normal[..., 2] * right[..., 1]) / d,
         (normal[..., 0] * right[..., 1] - normal[..., 2] * right[..., 0]) / d], axis=-1,
    )  # fmt: skip
    points = np.where(there[..., None], points + middle, np.nan)
    begin = start + np.arange(R) * size
    count = np.minimum(begin + size, start + epochs) - begin
    means = _Rows(begin, count, points, np.where(there[..., None], normal, 0.0))
    return means, sums[:, :3] / np.maximum(sums[:, 3:], 1e-300)


def _locate_targets(grid: ObservationGrid) -> Array:
    """Return each target's mean position (T, 2); that of all targets for those not seen."""
    there = grid.observed[..., None]
    n = there.sum(axis=0)
    total = np.where(there, grid.points, 0.0).sum(axis=0)
    middle = total / np.maximum(n, 1)
    seen = n[:, 0] > 0
    middle[~seen] = middle[seen].mean(axis=0) if seen.any() else 0.0
    return np.asarray(middle)


def _find_gross(p: Array, seen: NDArray[np.bool_], short: int) -> NDArray[np.bool_]:
    """Find points (E, T) far from the median over their short mean."""
    out = np.zeros(seen.shape, dtype=bool)
    short = max(short, _NEIGHBOURS)
    n = len(p) // short * short
    if not n:
        return out
    if n < len(p):  # the last epochs, with their neighbours
        out[-short:] = _find_gross(p[-short:], seen[-short:], short)
    values = np.where(seen[..., None], p, np.nan)[:n]
    runs = values.reshape(-1, short, *p.shape[1:])
    off = (runs - median_known(runs, 1)[:, None]).reshape(n, *p.shape[1:])
    # the whole image may move within a short mean
    off = np.abs(off - median_known(off, 1)[:, None])
    known = np.isfinite(off)
    scale = float(mad_sd(off[known])) if known.any() else 0.0
    out[:n] |= (np.where(known, off, 0.0) > criteria.GROSS_OF_MEAN * max(scale, 1e-6)).any(axis=-1)
    return out


def _shift_and_scale(p: Array, w: Array, middle: Array) -> Array:
    """Return each epoch's weighted sums (E, 4): shift in x and y, stretch px, and weights."""
    centre = middle.mean(axis=0)
    arm = middle - centre
    arm = arm / max(float(np.sqrt((arm**2).sum(axis=1).mean())), 1e-9)
    u = w[..., 0]
    x, y = u * p[..., 0], u * p[..., 1]
    return np.stack([x.sum(1), y.sum(1), x @ arm[:, 0] + y @ arm[:, 1], u.sum(1)], axis=1)


def _choose_fast_windows(
    trajectory: Array, temperature: Array, length: int, count: int
) -> list[int]:
    """Choose `count` windows of `length` short means with most fast movement, in order of time.

    trajectory (F, 3) px, temperature (F,) °C: of short means. Half of the windows are chosen for
    movement that is not linear in the temperature, half for changes of the temperature.
    """
    n = min(len(trajectory), len(temperature))
    T = temperature[:n] - temperature[:n].mean()
    z = trajectory[:n] - trajectory[:n].mean(axis=0)
    if (T @ T) > 0:
        z = z - np.outer(T, T @ z / (T @ T))
    parts = [slice(start, min(start + length, n)) for start in range(0, n, length)]
    odd = np.array([_roughness(z[part]) for part in parts])
    warm = np.array([_roughness(temperature[part, None]) for part in parts])
    first = np.argsort(-odd, kind="stable")[: -(-count // 2)].tolist()
    rest = [int(k) for k in np.argsort(-warm, kind="stable") if k not in first]
    return sorted({int(k) for k in first} | set(rest[: count - len(first)]))


def _roughness(values: Array) -> float:
    """Return the sum of squares about a straight line, minus the noise of the differences."""
    if len(values) < 8:
        return 0.0
    t = np.linspace(-1.0, 1.0, len(values))
    z = values - values.mean(axis=0)
    z = z - np.outer(t, t @ z / (t @ t))
    noise = 0.5 * np.sum(np.diff(values, axis=0) ** 2) * len(values) / (len(values) - 1)
    return float(np.sum(z**2) - noise)


def epochs_input(head: Head, field: TestField, epochs: Sequence[Epoch], name: str) -> SeriesInput:
    """Return the arrays of some epochs; name: of their recording or store, for messages."""
    readings = {
        channel: np.array([e.temperatures.get(channel, np.nan) for e in epochs], dtype=float)
        for channel in head.channels
    }
    camera = head.camera
    return SeriesInput(
        name=name, camera=camera.name, sensor=camera.sensor, field=field,
        principal_distance=camera.principal_distance,
        frame_times=np.array([e.frame_time for e in epochs], dtype=float),
        reading_times=np.array([e.temperature_time for e in epochs], dtype=float),
        readings=readings, resolutions={n: c.resolution for n, c in head.channels.items()},
        grid=ObservationGrid.from_observations(field, [e.observations for e in epochs]),
        numbers=np.array([e.number for e in epochs], dtype=np.int64), series=head.series,
        interior=camera.interior,
    )  # fmt: skip


_COPY = (
    "holds the same observations as {}; give a separate measurement (if simulated, with another "
    "--seed)"
)


def refuse_copies(
    series: Sequence[tuple[str, Array]], fault: str = _COPY, rtol: float = 0.0, atol: float = 1e-4
) -> None:
    """Raise DataError if two series, (name, numbers), are equal but for a store's rounding."""
    for k, (name, numbers) in enumerate(series):
        for before, others in series[:k]:
            if others.shape == numbers.shape and np.allclose(
                others, numbers, rtol, atol, equal_nan=True
            ):
                raise DataError(f"{name} {fault.format(before)}")


def series_input(
    source: Recording | StoredRecording,
    say: Callable[[str], None] | None = None,
    advance: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> SeriesInput:
    """Read the arrays of a recording, or of a series in a store.

    Frames without observations are measured in `jobs` processes, with the same bits for any number.
    A long series with observations is condensed while it is read.
    """
    source.head.require_calibrated(source.title)
    if source.has_observations and len(source) > limit_rows(len(source.testfield)):
        every = source.columns
        whole = replace(
            epochs_input(source.head, source.testfield, (), source.title), numbers=every.numbers,
            frame_times=every.frame_time, reading_times=every.temperature_time,
            readings=every.temperatures, columns=source.further_columns(),
        )  # fmt: skip
        return condensed(whole, source)
    if isinstance(source, Recording) and not source.has_observations:
        if say is not None:
            say(f"measuring the {len(source)} frames of {source.title}")
        epochs = []
        for done in calibrated_epochs(Calibrator.of_recording(source), source.iter_epochs(), jobs):
            epochs.append(done.epoch)
            if advance is not None:
                advance(1)
    else:
        epochs = list(source.epochs)
    found = epochs_input(source.head, source.testfield, epochs, source.title)
    log = source.columns.readings
    if log is not None:  # from one hour before the series on, and some readings per frame
        begin, end = float(found.frame_times[0]), float(found.frame_times[-1])
        rows = np.flatnonzero((log.times >= begin - _MEMORY_S) & (log.times <= end + log.step))
        rows = rows[:: max(1, len(rows) // (_READINGS_A_FRAME * len(found.frame_times)))]
        channels = {name: values[rows] for name, values in log.channels.items()}
        found = replace(found, reading_times=log.times[rows], readings=channels)
    return replace(found, columns=source.further_columns())
