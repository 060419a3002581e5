"""Plausibility of recorded values: well-formed values that cannot have been meant.

A value that no camera or thermometer can give is refused when it is read. One that is only unlikely
is a doubt, a sentence that `check`, `replay` and `import` print.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermocald.numbers import counted, listed
from thermocald.photogrammetry.field.testfield import ELSEWHERE, find_misplaced

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.store.recording.head import CameraSpec

_LATEST_S = 7.26e9  # the year 2200
_LONGEST_PAUSE_S = 3.2e8  # ten years
_SERIAL_DAY, _SERIAL_DAYS = 5.5e4, 2.5e4  # of a spreadsheet, since 1899: 1982 to 2119
_SHORTEST_STEP_S = 0.05  # median, of times in s; of days it is more than an hour
_UNITS = {1e3: "ms", 1e6: "µs", 1e9: "ns"}  # of times, by their number per second
_NOT_MEASURED = (85.0, 127.9375, 127.94, 0.0, -40.0, -45.0, -46.85, 125.0, 130.0, 150.0, -0.0625)
"""°C that thermometers give without measuring: at power-on, unplugged, all zeros or ones."""
_LEAP_K = 5.0  # more than a camera warms in one interval
_LONGEST_SPIKE = 3  # readings
_LEAP_OF_RUN_K = 15.0  # a processor stays at 85 °C, melting snow at 0 °C
_AROUND = 3  # readings before and after a change of the unit
_FEWEST = 20  # image points for a judgement on all
_MOST_OUTSIDE = 0.02  # of the image points: gross errors are rarer
_SMALLEST_EXTENT = 0.02  # of the image: smaller coordinates are in mm, not px
_FARTHEST_PX = 1e6
_SIGMAS_PX = (1e-6, 1e4)
_RHYTHM = 5.0  # largest ratio of the frames' interval to the stated one, or its inverse
_APART, _APART_S = 5.0, 60.0  # largest offset of a reading from its frame: intervals, s
_HOT_C = 65.0  # no lens is made for more
TOO_HOT_C = 45.0  # °F of rooms and cameras, or °C of a hot camera
PAUSE = 5.0  # of the usual interval: a longer one is a pause
_DISTANCES = (0.8, 1.25)  # ratio of principal distances, estimated to stated, or of pitches
_CENTRE = 0.1  # of the image's diagonal: largest offset of the principal point
_MOST_NAMED = 6  # targets in a message
_PITCH_OPTION = "--pixel-pitch, or pixel_pitch in recording.yaml or the camera file"


def time_fault(times: Array) -> tuple[int, str] | None:
    """Return the first row of times (n,) that cannot be seconds since 1970, and a message.

    The row after a jump of years is found as well: a clock that was not set shows 1970.
    """
    known = times[np.isfinite(times)]
    step = np.median(np.abs(np.diff(known))) if len(known) > 1 else math.inf
    if 0 < step < _SHORTEST_STEP_S and (np.abs(known - _SERIAL_DAY) < _SERIAL_DAYS).all():
        return 0, (
            f"{known[0]:.8g} looks like a spreadsheet's date (days since 1900): write it as "
            "2026-06-14 12:00:00 in a log, as seconds since 1970 in a recording"
        )
    late = times > _LATEST_S
    if late.any():
        row = int(np.argmax(late))
        year = 1970 + times[row] / 31_556_952
        unit = next((u for n, u in _UNITS.items() if 3e8 < times[row] / n < _LATEST_S), None)
        hint = f": are they {unit}? " if unit else ": "
        return row, f"{times[row]:.15g} s is the year {year:.0f}{hint}Write seconds since 1970"
    pauses = np.diff(times, prepend=math.nan)
    leaps = np.isfinite(pauses) & (pauses > _LONGEST_PAUSE_S)
    if leaps.any():
        row = int(np.argmax(leaps))
        years = pauses[row] / 31_556_952
        return row, (
            f"is {years:.0f} years after the row before: a clock that was not set? Correct the "
            "times, or leave the rows out"
        )
    return None


def point_fault(points: Array, sigmas: Array) -> tuple[int, str, str] | None:
    """Return the first row of impossible points or sigmas (n, 2) px, its column, a message."""
    low, high = _SIGMAS_PX
    wrong = np.hstack([np.abs(points) > _FARTHEST_PX, (sigmas < low) | (sigmas > high)])
    if not wrong.any():
        return None
    row, column = (int(i) for i in np.argwhere(wrong)[0])
    if column < 2:
        return row, "xy"[column], f"{points[row, column]:g} px is on no image; leave the row out"
    return row, ("sx", "sy")[column - 2], (
        f"a standard deviation of {sigmas[row, column - 2]:g} px is impossible; it must be "
        f"between {low:g} and {high:g} px"
    )  # fmt: skip


def frame_fault(points: Array, sensor: Sensor) -> tuple[int, str] | None:
    """Return the first image point (n, 2) px off the image and a message, if too many are off."""
    n, size = len(points), np.array([sensor.width, sensor.height], dtype=float)
    if n < _FEWEST:
        return None
    most = np.abs(points).max(axis=0)
    if (most < _SMALLEST_EXTENT * size).all():
        return 0, (
            f"all image points lie within {most[0]:.3g} × {most[1]:.3g} px of {sensor.width} × "
            f"{sensor.height}: are they in mm? Write px from the centre of the top-left pixel"
        )
    outside = ((points < -1.0) | (points > size)).any(axis=1)
    count = int(outside.sum())
    if count <= _MOST_OUTSIDE * n:
        return None

    def within(other: Array, shift: Array | float = 0.0) -> bool:
        moved = points + shift
        return bool(np.mean((moved >= -1.0) & (moved <= other)) > 1.0 - _MOST_OUTSIDE)

    if within(size, size / 2.0):
        hint = "are they counted from the centre of the image? (0, 0) is the top-left pixel"
    elif within(size[::-1]):
        hint = "are width and height (or x and y) exchanged?"
    else:
        hint = "is the size that of another camera, mode, or crop?"
    return int(np.argmax(outside)), (
        f"{count} of {n} image points lie outside the {sensor.width} × {sensor.height} px of "
        f"recording.yaml: {hint}"
    )


class Spike(NamedTuple):
    """Readings `first` to `stop` (exclusive) that leap away and back.

    measured: False for values that a thermometer gives without a measurement.
    """

    first: int
    stop: int
    measured: bool


def find_spikes(values: Array) -> list[Spike]:
    """Return the spikes in readings (n,) °C, NaN for none: those that leap away and come back.

    A leap is more than `_LEAP_K` and ten times the median step. At either end of the series, only
    values that a thermometer gives without a measurement are a spike.
    """
    known = np.flatnonzero(np.isfinite(values))
    v = values[known]
    if len(v) < _AROUND + 1:
        return []
    sham = np.isin(np.round(v, 2), np.round(_NOT_MEASURED, 2))
    steps = np.diff(v)
    usual = np.abs(np.diff(v[~sham])) if (~sham).sum() > 1 else np.zeros(1)
    good = np.append(np.flatnonzero(~sham), len(v))
    jumps = np.concatenate([[np.inf], np.abs(steps), [np.inf]])  # before each reading
    leap = max(_LEAP_K, 10.0 * float(np.median(usual)))
    found: list[Spike] = []
    # a spike begins where a leap ends, or with the first reading
    for first in [0, *(np.flatnonzero(np.abs(steps) > leap) + 1).tolist()]:
        if found and known[first] < found[-1].stop:
            continue
        # a value given without a measurement may be repeated for any time
        longest = max(int(good[np.searchsorted(good, first)]) - first, _LONGEST_SPIKE)
        ends = np.flatnonzero(np.abs(steps[first : first + longest]) > leap)
        if len(ends) == 0 and first + longest < len(v):
            continue
        stop = first + (int(ends[0]) + 1 if len(ends) else len(v) - first)
        measured = not sham[first:stop].all()
        inner = first > 0 and stop < len(v)
        if stop - first > min(longest, len(v) - 1) or (measured and not inner):
            continue
        away = min(jumps[first], jumps[stop])
        if stop - first > _LONGEST_SPIKE and away < _LEAP_OF_RUN_K:
            continue
        if inner:
            if measured and sham[[first - 1, stop]].all():
                continue
            if abs(v[stop] - v[first - 1]) > 0.5 * away:
                continue
        found.append(Spike(int(known[first]), int(known[stop - 1]) + 1, measured))
    return found


def find_unit_change(times: Array, values: Array) -> tuple[int, str] | None:
    """Return the first of readings (n,) °C at times (n,) s in another unit, and its phrase.

    The unit has changed if the readings leap to the value that those before have in another unit.
    In a pause the temperature may have changed as well, so that °F must then be too hot for °C.
    Tenths are whole numbers, what they are tenths of is not. Spikes are ignored.
    """
    values = values.copy()
    for spike in find_spikes(values):
        values[spike.first : spike.stop] = np.nan
    known = np.flatnonzero(np.isfinite(values))
    v, pauses = values[known], np.abs(np.diff(times[known]))
    steps = np.abs(np.diff(v))
    usual = float(np.median(steps)) if len(steps) else 0.0
    leaps = (np.flatnonzero(steps > max(_LEAP_K, 10.0 * usual)) + 1).tolist()
    for begin, i, end in zip([0, *leaps], leaps, [*leaps[1:], len(v)], strict=False):
        around, leap = (v[max(i - _AROUND, 0) : i], v[i : i + _AROUND]), float(steps[i - 1])
        drift = max(map(np.ptp, around))
        if min(map(len, around)) < _AROUND or drift > 0.25 * leap:
            continue
        before, after = v[begin:i], v[i:end]
        paused = pauses[i - 1] > PAUSE * np.median(pauses)
        far = 1.0 + 4.0 * usual + (0.1 if paused else 0.05) * leap
        near = min(far, 1.0 + 4.0 * max(usual, drift))
        for words, factor, zero, low, high in (
            ("from °C to °F", 1.8, 32.0, before, after),
            ("from °F to °C", 1 / 1.8, -32.0 / 1.8, after, before),
            ("from °C to K", 1.0, 273.15, before, after),
            ("from K to °C", 1.0, -273.15, after, before),
            ("to tenths", 10.0, 0.0, before, after),
            ("from tenths", 0.1, 0.0, after, before),
        ):
            allowed, possible = far, True
            if "F" in words:
                allowed = far if paused else near
                possible = not paused or bool(high.min() > TOO_HOT_C)
            elif "tenths" in words:
                possible = bool(np.any(low % 1) and not np.any(high % 1))
            if possible and abs(after[0] - factor * before[-1] - zero) < allowed:
                return int(known[i]), words
    return None


def reading_doubts(times: Array, values: Array, label: str) -> Iterator[str]:
    """Yield doubts about a thermometer's readings (n,) °C at times (n,) s."""
    if changed := find_unit_change(times, values):
        row, words = changed
        yield (
            f"{label}: the unit seems to change {words} at reading {row + 1}: "
            f"{values[:row][np.isfinite(values[:row])][-1]:g}, then {values[row]:g}"
        )
    yield from stuck_doubts(values, label)
    known = values[np.isfinite(values)]
    if len(known) and known.min() > _HOT_C:
        yield (
            f"{label}: all readings lie between {known.min():g} and {known.max():g} °C, too hot "
            "for a camera: are they °F?"
        )
    if spikes := find_spikes(values):
        first = spikes[0]
        why = "leaping away and back" if first.measured else "given without a measurement"
        yield (
            f"{label}: {counted(sum(s.stop - s.first for s in spikes), 'reading')} {why}, the "
            f"first {values[first.first]:g} °C at reading {first.first + 1}; leave them empty"
        )


def stuck_doubts(values: Array, label: str) -> Iterator[str]:
    """Yield a doubt if all readings (n,) °C are one value given without a measurement."""
    known = values[np.isfinite(values)]
    if len(known) < _AROUND or np.ptp(known) > 0:
        return
    if np.isclose(known[0], _NOT_MEASURED, atol=0.006).any():
        yield (
            f"{label}: all {len(known)} readings are {known[0]:g} °C, which a thermometer gives "
            "without a measurement"
        )


def time_doubts(numbers: NDArray[np.int64], times: Array, interval: float) -> Iterator[str]:
    """Yield doubts about the times (E,) s of epochs with numbers (E,)."""
    if len(times) < 2:
        return
    steps = np.diff(times)
    if (steps == 0).any():
        row = int(np.argmax(steps == 0))
        shared = np.append(steps == 0, False) | np.insert(steps == 0, 0, False)
        yield (
            f"{int(shared.sum())} epochs have the time of another one, the first "
            f"{numbers[row]} and {numbers[row + 1]}"
        )
    # a missing epoch lengthens a step, but not the time per epoch number
    rhythm = float(np.median(steps / np.diff(numbers)))
    if rhythm > 0 and not 1.0 / _RHYTHM < rhythm / interval < _RHYTHM:
        yield (
            f"frames come every {rhythm:.3g} s, but the interval in recording.yaml is "
            f"{interval:.4g} s: is frame_time in seconds?"
        )


def pairing_doubts(frames: Array, readings: Array, interval: float) -> Iterator[str]:
    """Yield a doubt if readings (E,) s, NaN for none, are far from their frames (E,) s."""
    apart = (readings - frames)[np.isfinite(readings)]
    if len(apart) == 0:
        return
    usual = float(np.median(apart))
    if abs(usual) > max(_APART * interval, _APART_S):
        yield (
            f"temperatures were read {abs(usual):.0f} s {'after' if usual > 0 else 'before'} their "
            "frames (median): is one of the clocks in another time zone, or not set?"
        )


def interior_doubts(camera: CameraSpec, c: float, x0: float, y0: float) -> list[str]:
    """Return doubts about the interior orientation, mm, estimated for a camera."""
    sensor, found = camera.sensor, []
    stated = camera.principal_distance
    if stated is not None and not _DISTANCES[0] < c / stated < _DISTANCES[1]:
        found.append(
            f"the principal distance is {c:.3f} mm, {c / stated:.3g} times the stated {stated:g} "
            "mm: is the principal distance, pixel pitch or image size that of another camera?"
            f" Pixels of {camera.sensor.pixel_pitch * stated / c:.3g} mm would fit "
            f"({_PITCH_OPTION})"
        )
    pitch, W, H = sensor.pixel_pitch, sensor.width, sensor.height
    if math.hypot(x0, y0) > _CENTRE * math.hypot(W, H) * pitch:
        exchanged = (W - H) / 2.0
        near = abs(x0 / pitch + exchanged) + abs(y0 / pitch + exchanged) < _CENTRE * abs(W - H)
        why = "width and height look exchanged" if near and W != H else (
            "is the image size that of another camera, mode, or crop?"
        )  # fmt: skip
        found.append(
            f"the principal point lies {x0 / pitch:+.0f}, {-y0 / pitch:+.0f} px".replace("-", "−")
            + f" off the centre of {W} × {H} px: {why}"
        )
    return found


def target_doubts(
    names: Sequence[str], offsets: Array, c_px: float, least: float = ELSEWHERE
) -> list[str]:
    """Return doubts about the places of targets; the arguments are those of `find_misplaced`."""
    rows = np.flatnonzero(find_misplaced(offsets, c_px, least)).tolist()
    if not rows:
        return []
    size = np.hypot(*np.asarray(offsets)[rows].T)
    each = [f"{names[r]} {s:.0f} px" for r, s in zip(rows, size, strict=True)]
    shown = listed(each, _MOST_NAMED)
    opposite = len(rows) == 2 and bool(np.hypot(*offsets[rows].sum(axis=0)) < 0.1 * size.sum())
    why = "their names look exchanged" if opposite else "are names exchanged, or coordinates wrong?"
    return [f"targets are not where the test field has them: {shown} off; {why}"]


def pitch_doubts(pitch: float, known: float | None) -> list[str]:
    """Return doubts about a pixel pitch, mm, if the photographs' EXIF gives another, `known`."""
    if known is None or _DISTANCES[0] < pitch / known < _DISTANCES[1]:
        return []
    doubt = (
        f"a pixel pitch of {pitch:.4g} mm is {pitch / known:.2f} of the {known:.4g} mm that follow "
        "from the EXIF of the photographs: the pixels of a binned or scaled-down image are larger "
        f"than the sensor's ({_PITCH_OPTION})"
    )
    return [doubt]


def doubt_lines(doubts: Sequence[str], series: str = "") -> list[str]:
    """Return doubts as lines to print; series: the name, if there are several series."""
    of = f", {series}" if series else ""
    return [f"doubtful{of}: {text}" for text in doubts]
