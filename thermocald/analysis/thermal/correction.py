"""Correction of image points and images to what one steady camera would have seen.

A point that was measured at some time becomes the point that the camera would have measured at the
model's reference temperature (or another): through its ray, with the interior orientation that the
temperature log gives for that time. The remaining error comes from the model's parameters, as far
as they do not cancel between both temperatures, and from the thermometer. Tables of points are read
from a file or from standard input.

Frames of a camera in use are resampled to what it would have seen at T₀, so that a program with a
single calibration processes those of a cold morning and of a hot day alike. The JPEG has EXIF; its
comment holds, as JSON, the camera at T₀ in OpenCV's terms and the pose, with standard deviations.
The camera's are those of the frame's own camera, whose errors enter the resampled frame unchanged.
"""

from __future__ import annotations

import csv
import json
import math
import sys
import warnings
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np

from thermocald.analysis.camera.undistortion import Maps
from thermocald.analysis.thermal.thermal_camera import steady_camera
from thermocald.arrays import eight_bit, full_scale
from thermocald.errors import DataError, ImageError
from thermocald.numbers import listed
from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    EOP_NAMES,
    IOP,
    partials,
    project,
    rays,
)
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.photogrammetry.targets.image_file import EncodedImage, with_comment, with_metadata
from thermocald.result import jsonable, with_sds
from thermocald.store.logger.clock import ORDERS, DeviceClock, date_orders, parse_moment

if TYPE_CHECKING:
    import io
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.thermal.modelled_camera import Along
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array
    from thermocald.store.logger.temperatures import TemperatureLog


_SAMPLE = 997  # points of an image at which the size of the correction is computed


def correct_points(
    camera: ThermalCamera,
    log: TemperatureLog,
    times: Array,
    points: Array,
    to: float | None = None,
    temperature_sd: float = 0.0,
    extrapolate: bool = False,
) -> tuple[Array, Array, Array, Array]:
    """Correct image points (n, 2) px measured at times (n,) s to a temperature `to` (default T₀).

    temperature_sd K: of a reading of the log. Returns the points, their sds (n, 2) px, temperatures
    (n,) °C and by how many kelvin these are beyond the fit. Raises DataError for times outside the
    log.
    """
    unique, place = np.unique(times, return_inverse=True)
    steady, along = _predict(camera, log, unique, to, temperature_sd, extrapolate)
    sensor = camera.model.sensor
    r = rays(sensor, along.values[place], points[:, None, :])
    direction = (r / -r[..., 2:])[:, 0]
    corrected = project(sensor, steady.values, np.zeros(6), direction)
    J = partials(sensor, steady.values, np.zeros(6), direction)[1][..., IOP]
    sds = np.sqrt(np.einsum("ncp,npq,ncq->nc", J, along.covariance[place], J, optimize=True))
    return corrected, sds, along.temperatures[place], along.extrapolated[place]


def image_corrections(
    camera: ThermalCamera,
    log: TemperatureLog,
    times: Array,
    to: float | None,
    temperature_sd: float,
    extrapolate: bool,
) -> tuple[Maps, Array, list[dict[str, float]]]:
    """Return maps, the values (n, 10) of the images' cameras to resample them with, and a summary.

    The summary of an image holds the RMS shift and RMS sd of a sample of points, px per coordinate,
    and the largest shift. Arguments and errors as in `correct_points`.
    """
    steady, along = _predict(camera, log, times, to, temperature_sd, extrapolate)
    sensor = camera.model.sensor
    pixels = np.linspace(0, sensor.width * sensor.height - 1, _SAMPLE).astype(int)
    points = np.stack([pixels % sensor.width, pixels // sensor.width], axis=1).astype(float)
    found = []
    for i in range(len(along)):
        now = along[i]
        moved = steady.as_seen_by(points, now.interior) - points
        variance = replace(steady, covariance=now.covariance).point_covariance(points)
        found.append({
            "temperature": now.temperature,
            "rms_correction_px": float(np.sqrt(np.mean(moved**2))),
            "largest_correction_px": float(np.linalg.norm(moved, axis=1).max()),
            "rms_left_over_px": float(np.sqrt(np.mean(variance.diagonal(axis1=1, axis2=2)))),
            "extrapolated_K": now.extrapolated,
        })  # fmt: skip
    return Maps(sensor, steady.values, steady.temperature), along.values, found


def _predict(
    camera: ThermalCamera, log: TemperatureLog, times: Array, to: float | None,
    temperature_sd: float, extrapolate: bool,
) -> tuple[Camera, Along]:  # fmt: skip
    """Return the steady camera at a temperature, and the camera at times relative to it."""
    target = camera.model.T0 if to is None else to
    along = camera.along(
        log.times, log.channels, times, extrapolate, relative_to=target,
        temperature_sd=temperature_sd,
    )  # fmt: skip
    return steady_camera(camera, target), along


_QUALITY = 95  # of a JPEG: its losses are below the noise of a camera


class FrameCorrector:
    """A corrector of one camera's frames.

    camera: its name; origin (3,) mm: of the pose's coordinates.
    """

    def __init__(self, thermal: ThermalCamera, camera: str, origin: Sequence[float]) -> None:
        self.sensor, self.to = thermal.model.sensor, thermal.model.T0
        self._camera, self._origin = camera, list(origin)
        self._steady = steady_camera(thermal, self.to)
        self._maps = Maps(self._steady.sensor, self._steady.values, self.to)

    def correct(self, encoded: bytes, calibrated: CalibratedEpoch) -> bytes:
        """Return a frame as the steady camera would have seen it, as a JPEG.

        encoded: a JPEG or PNG. Raises ImageError if it cannot be decoded or has another size, or if
        the epoch has no camera.
        """
        result = calibrated.adjustment
        if result.interior is None:
            raise ImageError(f"{result.status}: {result.reason}")
        whole = EncodedImage(encoded).as_it_is()
        image = eight_bit(whole, full_scale(whole))
        sensor = self.sensor
        if image.shape[:2] != (sensor.height, sensor.width):
            raise ImageError(
                f"the frame has {image.shape[1]}×{image.shape[0]} px, the model's camera "
                f"{sensor.width}×{sensor.height}"
            )
        resampled = self._maps.resample(image, result.interior.as_array())
        _, data = cv2.imencode(".jpg", resampled, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        jpeg = with_metadata(data.tobytes(), encoded)
        epoch, pose = calibrated.epoch, None
        if result.exterior is not None:
            sd = np.sqrt(np.diag(result.covariance)[EOP])
            six = with_sds(EOP_NAMES, result.exterior.as_array(), sd)
            pose = {**six, "origin_mm": self._origin}
        document = {
            "format": "thermocald-frame/1",
            "camera": self._camera,
            "epoch": epoch.number,
            "time": epoch.frame_time,
            "temperature": next(iter(epoch.temperatures.values()), None),
            "corrected_to": self.to,
            "status": result.status,
            "reason": result.reason,
            "opencv": opencv_terms(sensor, self._steady.values, result.covariance[IOP, IOP]),
            "pose": pose,
        }
        return with_comment(jpeg, json.dumps(jsonable(document), allow_nan=False))


STANDARD_INPUT = Path("-")
_HEAD = 100_000  # characters of a header
_CHUNK = 1 << 22  # bytes read at once: a year of rows need not fit into memory


@dataclass(frozen=True, slots=True, eq=False)
class RowBlock:
    """A block of rows of a CSV.

    lines (n): numbers, the header's is 1; rows: fields as text; times (n,) s UTC; values (n, k):
    the other requested columns; refused: (line, reason) of unusable rows; order: of the dates.
    """

    header: list[str]
    lines: list[int]
    rows: list[dict[str, str]]
    times: Array
    values: Array
    refused: list[tuple[int, str]]
    order: str = ""

    def kept(self, wanted: NDArray[np.bool_], reason: str) -> RowBlock:
        """Return the block with the wanted (n,) rows only; the others are refused for a reason."""
        where = np.flatnonzero(wanted).tolist()
        refused = [(line, reason) for line, ok in zip(self.lines, wanted, strict=True) if not ok]
        return RowBlock(
            self.header, [self.lines[i] for i in where], [self.rows[i] for i in where],
            self.times[wanted], self.values[wanted], sorted([*self.refused, *refused]),
        )  # fmt: skip


def row_blocks(
    path: Path, columns: tuple[str, ...], clock: DeviceClock, order: str | None = None,
    log: TemperatureLog | None = None,
) -> Iterator[RowBlock]:  # fmt: skip
    """Read a CSV with a column `time` and others, a block at a time; `-` is standard input.

    A block of standard input is what has arrived. clock: for times without a zone; order, log: of
    the dates, None to find it as `find_order` does. Raises DataError for a missing column and for
    times whose zone or order is not known; a row that cannot be read is refused on its own, as is
    one without a zone if others have one.
    """
    header: list[str] = []
    line = empty = 0
    zoned = False
    for lines in _lines(path):
        if not header:
            names = next(csv.reader([text[:_HEAD] for text in lines[:1]]), [])
            header = [name.strip() for name in names]
            lines, line = lines[1:], 1
            for name in ("time", *columns):
                if name not in header:
                    hint = "; separate the columns with commas and write decimals with a point"
                    there = listed([n[:40] for n in header], 20)
                    raise DataError(
                        f"{path}: there is no column {name!r}; there are {there}"
                        + (hint if len(header) == 1 else "")
                    )
        if lines:
            block = _block(path, header, columns, lines, line, clock, order, log, zoned=zoned)
            order = block.order if block.order in ORDERS else None
            zoned = zoned or len(block.times) > 0
            yield block
        line, empty = line + len(lines), empty + len(lines)
    if not empty:
        raise DataError(f"{path}: holds no rows")


def first_times(
    path: Path, clock: DeviceClock, order: str | None
) -> tuple[list[str], tuple[float, float] | None]:
    """Return the columns of a CSV and the time span, s UTC, of its first rows, None if not known.

    Returns [] and None for standard input, which can be read only once.
    """
    if path == STANDARD_INPUT:
        return [], None
    block = next(row_blocks(path, (), clock, order))
    times, known = block.times, block.order and len(block.times)
    return block.header, (float(times.min()), float(times.max())) if known else None


def seconds_of(text: str, clock: DeviceClock, order: str | None, log: TemperatureLog) -> float:
    """Return a time that a user wrote, s UTC; order, log: as in `row_blocks`.

    Raises DataError if it is not a time.
    """
    where = f"the time {text!r}"
    try:
        moment = _moment(text, order or find_order([text], where, clock, log))
    except ValueError:
        raise DataError(f"{text!r} is not a time: write 2026-05-04T09:00:00Z, or seconds") from None
    if isinstance(moment, datetime):
        return float(clock.utc([moment], lambda _: where)[0])
    return moment


def find_order(
    texts: Sequence[str], where: str, clock: DeviceClock, log: TemperatureLog | None
) -> str:
    """Return the order of day, month and year in which times are written; "any" if none needs one.

    Of several that fit it is the one in which the log knows a temperature, with a warning; without
    a log it is "", not known. Raises DataError if none fits, or if the log does not decide.
    """
    dates: dict[str, dict[str, float | datetime]] = {}
    for text in texts:
        if text[:10] not in dates and (orders := date_orders(text)):
            with suppress(ValueError):  # such a row is refused on its own
                dates[text[:10]] = {order: _moment(text, order) for order in orders}
    if not dates:
        return "any"
    first = next(iter(dates)).split()[0]
    fitting: dict[str, list[float | datetime]] = {}
    for order in ORDERS:
        if all(order in found for found in dates.values()):
            moments = [found[order] for found in dates.values()]
            if moments not in fitting.values():
                fitting[order] = moments
    if not fitting:
        raise DataError(
            f"{where}: {first} and later dates have no order of day and month in common"
        )
    if len(fitting) == 1 or log is None:
        return next(iter(fitting)) if len(fitting) == 1 else ""
    inside = []
    for order, moments in fitting.items():
        times = clock.utc([m for m in moments if isinstance(m, datetime)], lambda _: where)
        if log.known_at(times).any():
            inside.append(order)
    if len(inside) != 1:
        raise DataError(
            f"{where}: {first} may be {' or '.join(ORDERS[o] for o in fitting)}: give "
            f"--date-order {' or '.join(fitting)}"
        )
    text = f"{where}: {first} is {ORDERS[inside[0]]}: this puts it into the temperature log"
    warnings.warn(text, stacklevel=3)
    return inside[0]


def _lines(path: Path) -> Iterator[list[str]]:
    """Yield lists of whole lines: what has arrived on standard input, or megabytes of a file."""
    standard = path == STANDARD_INPUT
    errors = "replace" if standard else "strict"
    rest = b""
    try:
        with nullcontext(sys.stdin.buffer) if standard else path.open("rb") as file:
            stream = cast("io.BufferedReader", file)
            while chunk := stream.read1(_CHUNK):
                whole, mark, rest = (rest + chunk).rpartition(b"\n")
                if mark:
                    yield whole.decode("utf-8-sig", errors).splitlines()
            if rest:
                yield rest.decode("utf-8-sig", errors).splitlines()
    except (OSError, UnicodeDecodeError) as cause:
        what = cause.strerror if isinstance(cause, OSError) else "is not UTF-8 text"
        raise DataError(f"{path}: cannot be read: {what}") from cause


def _block(
    path: Path, header: list[str], columns: tuple[str, ...], lines: list[str], line: int,
    clock: DeviceClock, order: str | None, log: TemperatureLog | None, *, zoned: bool,
) -> RowBlock:  # fmt: skip
    """Return a block; zoned: whether times before it had a zone."""
    kept: list[tuple[int, dict[str, str], float | datetime, list[float]]] = []
    refused: list[tuple[int, str]] = []
    numbered = []
    for number, text in enumerate(lines, line + 1):  # an open quote must not swallow rows
        try:
            numbered += [(number, row) for row in csv.reader([text], strict=True) if row]
        except csv.Error:
            refused.append((number, "has a quote that is not closed, or a field without end"))
    if order is None:
        place = header.index("time")
        texts = [row[place].strip() for _, row in numbered if len(row) == len(header)]
        order = find_order(texts, f"{path}, column time", clock, log)
    for number, row in numbered:
        if len(row) != len(header):
            refused.append((number, f"has {len(row)} fields, the header {len(header)}"))
            continue
        fields = dict(zip(header, map(str.strip, row), strict=True))
        try:
            values = [_number(name, fields[name]) for name in columns]
            kept.append((number, fields, _moment(fields["time"], order), values))
        except ValueError as cause:
            refused.append((number, str(cause)))
    bare = [isinstance(m, datetime) and m.tzinfo is None for _, _, m, _ in kept]
    if clock.zone is None and (zoned or not all(bare)):
        why = f"has no time zone: add one, or set {clock.option}"
        refused += [
            (number, f"column time: {fields['time']!r} {why}")
            for (number, fields, _, _), without in zip(kept, bare, strict=True)
            if without
        ]
        kept = [row for row, without in zip(kept, bare, strict=True) if not without]
    dated = [(i, m) for i, (_, _, m, _) in enumerate(kept) if isinstance(m, datetime)]
    times = np.array([np.nan if isinstance(m, datetime) else m for _, _, m, _ in kept])
    times[[i for i, _ in dated]] = clock.utc(
        [m for _, m in dated], lambda k: f"{path}, line {kept[dated[k][0]][0]}, column time"
    )
    found = np.array([values for *_, values in kept], dtype=float)
    return RowBlock(
        header, [n for n, *_ in kept], [fields for _, fields, _, _ in kept], times,
        found.reshape(len(kept), len(columns)), sorted(refused), order,
    )  # fmt: skip


def _moment(text: str, order: str) -> float | datetime:
    with suppress(ValueError):
        if math.isfinite(seconds := float(text)):
            return seconds
    with suppress(ValueError):
        if isinstance(moment := parse_moment(text, order), datetime):
            return moment
    raise ValueError(f"column time: {text!r} is not a time")


def _number(column: str, text: str) -> float:
    value = math.nan
    with suppress(ValueError):
        value = float(text)
    # float() accepts 2_5.0 and digits of any script
    if not math.isfinite(value) or "_" in text or not text.isascii():
        raise ValueError(f"column {column}: {text!r} is not a number")
    if column in ("sx", "sy") and value <= 0:
        raise ValueError(f"column {column}: a standard deviation must be above 0")
    return value
