"""A measured series as the study reads it: columns of calibrated values, from any source.

Only epochs with a result are rows; the others are counted by reason. Standard deviations are those
of an epoch within its series: errors that all epochs share (exterior orientation, test field)
cancel in every comparison between epochs.

All epochs are adjusted together from their observations, unless `exterior="per_epoch"`. Then a
store's series is read as stored, column by column, with a sample of its covariance matrices.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.arrays import spread_rows
from thermocald.errors import DataError
from thermocald.names import checked
from thermocald.numbers import counted
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.linalg import correlations
from thermocald.photogrammetry.series.covariances import count_moved
from thermocald.store.recording.reader import interpolate_readings
from thermocald.store.sources import StoredRecording
from thermocald.thermal.thermometer import estimate_reading_noise

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.series.field_motion import FieldMovement
    from thermocald.store.recording.reader import Recording


@checked
@dataclass(frozen=True)
class StudySettings:
    """The options of a study; lengths in mm, temperatures in K.

    window, alpha: of the F-test; sets, seed, distance_mm, grid, clusters_mm: of the Monte-Carlo
    simulation; focus_mm, f_number, confusion_mm (None: 1/2000 of the image diagonal): of the depth
    of field; thermometer_sd: None estimates it from the readings; jobs: processes that adjust
    the presets.
    """

    window: int = 31
    alpha: float = 0.05
    sets: int = 50_000
    seed: int = 0
    distance_mm: float = 10_000.0
    grid: int = 3
    clusters_mm: tuple[float, ...] = (15.0, 50.0, 100.0)
    focus_mm: float = 1000.0
    f_number: float = 2.0
    confusion_mm: float | None = None
    thermometer_sd: float | None = None
    jobs: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class Thermometer:
    """A channel at the frames' times: values (E,) °C, NaN if missing; sd: noise K."""

    name: str
    values: Array
    sd: float


@dataclass(frozen=True, eq=False)
class MeasuredSeries:
    """The epochs with a result of one series of one camera.

    label: what the study treats as one camera; name: of the series; time_s (E,): s since the first
    epoch of the series; thermometers: the first is the reference; values (E, 10): IOP; sds (E, 10):
    NaN if held fixed; sigma0, redundancy (E,); correlations (m, 10, 10): of the IOP in the epochs'
    adjustments, a sample if the series is long; exterior: how the exterior
    orientation was estimated; choice: why; without_result: {reason: epochs}; start_utc: s UTC of
    the first epoch, 0 if it has no date; image_noise_ratio: estimated over stated noise of the
    image points, NaN if epochs were adjusted one by one; field_movements: boards and targets that
    moved, for which the observations are corrected; doubts: implausible recorded data; slow
    (10, 10): covariance of last minus first by which slow errors exceed independent ones;
    c_known_to: relative sd of the level of c, 0 if unknown.
    """

    label: str
    name: str
    camera: str
    sensor: Sensor
    source: str
    time_s: Array
    thermometers: tuple[Thermometer, ...]
    values: Array
    sds: Array
    sigma0: Array
    redundancy: Array
    correlations: Array
    exterior: str
    without_result: Mapping[str, int] = field(default_factory=dict)
    start_utc: float = 0.0
    choice: str = ""
    image_noise_ratio: float = float("nan")
    field_movements: tuple[FieldMovement, ...] = ()
    doubts: tuple[str, ...] = ()
    slow: Array = field(default_factory=lambda: np.zeros((10, 10)))
    c_known_to: float = 0.0

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """The IOP that were estimated, in the order of `IOP_NAMES`."""
        return tuple(n for n in IOP_NAMES if bool(np.any(self.column(n)[1] > 0)))

    @cached_property
    def mean(self) -> Array:
        """The mean interior orientation (10,) of the epochs."""
        return np.array([np.mean(self.column(name)[0]) for name in IOP_NAMES])

    @property
    def rms_sigma0(self) -> float:
        """The root mean square of the epochs' sigma0."""
        return float(np.sqrt(np.mean(np.square(self.sigma0))))

    def column(self, name: str) -> tuple[Array, Array]:
        """Return the values and standard deviations (E,) of one IOP; do not write to them."""
        k = IOP_NAMES.index(name)
        return np.ascontiguousarray(self.values[:, k]), np.ascontiguousarray(self.sds[:, k])

    @property
    def path_px(self) -> Array:
        """The principal point (E, 2) from its first position, px, right and up."""
        return np.asarray((self.values[:, 1:3] - self.values[0, 1:3]) / self.sensor.pixel_pitch)

    @cached_property
    def columns(self) -> dict[str, tuple[Array, Array]]:
        """{name: values and sds (E,)} of the estimated IOP, of sigma0, and of the thermometers."""
        sd_sigma0 = self.sigma0 / np.sqrt(2 * np.maximum(self.redundancy, 1.0))
        return {
            **{name: self.column(name) for name in self.free},
            "sigma0": (self.sigma0, sd_sigma0),
            **{t.name: (t.values, np.full(len(self), t.sd)) for t in self.thermometers},
        }

    @property
    def reference(self) -> Thermometer | None:
        """The reference thermometer, or None."""
        return self.thermometers[0] if self.thermometers else None

    @property
    def interval_s(self) -> float:
        """Median time between epochs, s; NaN for a single epoch."""
        return float(np.median(np.diff(self.time_s))) if len(self) > 1 else float("nan")


_MOST_MATRICES = 5000


def measured_series(
    source: Recording | StoredRecording,
    table: Epochs,
    label: str,
    thermometer_sd: float | None = None,
) -> MeasuredSeries:
    """Return calibrated epochs as the study reads them.

    table: the series, adjusted together or as stored; label: what the study treats as one camera;
    thermometer_sd K: by default estimated from the readings. Raises DataError if no epoch has a
    result.
    """
    lost = sorted((word, n) for word, n in Counter(table.status).items() if word != "ok")
    without_result = {word.replace("_", " "): n for word, n in lost}
    # only complete results: a nearly singular covariance matrix can have negative variances, which
    # have no square root
    ok = table.ok & np.isfinite(table.values[:, :10]).all(axis=1)
    known = np.isfinite(table.sd[:, :10])
    ok &= known[:, known[table.ok].any(axis=0)].all(axis=1)
    if missing := int(np.count_nonzero(table.ok & ~ok)):
        without_result["no standard deviation"] = missing
    if not ok.any():
        why = ", ".join(f"{n} × {reason}" for reason, n in without_result.items())
        raise DataError(f"{source.title}: no epoch has a result ({why or 'it has no epochs'})")
    adjustment = table.adjustment
    if isinstance(source, StoredRecording) and adjustment is None:
        redundancy = source.store.series_columns(source.series, ["redundancy"])["redundancy"]
        exterior = str(source.series.settings.get("exterior", table.exterior))
        rows = spread_rows(int(ok.sum()), _MOST_MATRICES)
        numbers = table.number[ok][rows].tolist()
        covariances = source.store.covariances(source.series, numbers)[:, :10, :10]
        covariances = covariances[np.isfinite(covariances).all(axis=(1, 2))]
    else:
        assert adjustment is not None  # a table with a result has one
        redundancy, exterior = table.redundancy, table.exterior
        of = np.arange(len(ok)) if table.sampled is None else table.sampled
        some = np.flatnonzero(ok[of] & adjustment.ok)
        some = some[spread_rows(len(some), _MOST_MATRICES)]
        covariances = adjustment.covariance[some][:, :10, :10]
    choice, moved = "" if adjustment is None else adjustment.choice, count_moved(table.stillness)[0]
    if moved:
        choice += f"; but the camera did not stand still in {counted(moved, 'epoch')}"
    time_s, thermometers = table.frame_time[ok], []
    for name, channel in source.head.channels.items():
        read, readings = source.columns.readings_of(name)
        noise = thermometer_sd
        if noise is None:
            noise = estimate_reading_noise(read, readings, channel.resolution)
        at_frames = interpolate_readings(time_s, read, readings)
        thermometers.append(Thermometer(name, at_frames, noise))
    return MeasuredSeries(
        label, source.head.series, source.head.camera.name, source.head.camera.sensor, source.title,
        time_s - time_s[0], tuple(thermometers),
        table.values[ok, :10], table.sd[ok, :10], table.sigma0[ok], redundancy[: len(ok)][ok],
        correlations(covariances), exterior, without_result, float(time_s[0]),
        choice,
        float("nan") if adjustment is None else adjustment.noise_ratio, table.field_movements,
        slow=table.slow_between_ends[:10, :10],
        c_known_to=float(np.nan_to_num(table.level_sd[0]) / np.median(table.values[ok, 0])),
    )  # fmt: skip
