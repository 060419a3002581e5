"""The study of cameras and their series: section 4 of Elias et al. 2020 for the user's own.

Series with the same label are one camera: their correlations are pooled for a single Monte-Carlo
simulation. The reference treats a cold- and a warm-started camera as two; use two labels for that.

A result that cannot be computed is None, and `notes` gives the reason.

Deviations are last minus first of every parameter, the path of the principal point, and the
displacement of the image points of a static scene (Elias et al. 2020, Table 2 and Figures 3 to 6).

Depth of field by the exact formulas of the thin lens (Luhmann et al. 2014, section 3.1.2): with the
hyperfocal distance H = f²/(N u) + f, focused at s, sharp from s (H - f)/(H + s - 2f) to
s (H - f)/(H - s). The reference quotes changes of 2 to 5 mm at 1 m but neither f-number nor circle
of confusion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from thermocald.analysis.camera.undistortion import directions, image_grid
from thermocald.analysis.series.course import carried_by_c, say_carried
from thermocald.analysis.statistics.dependence import (
    Dependence,
    IopCorrelations,
    dependence,
    holm,
    median_correlations,
    moving_f_test,
    pearson_matrix,
    unbroken_windows,
)
from thermocald.analysis.statistics.noise_models import DriftTest, drift_test
from thermocald.analysis.study.measured import StudySettings
from thermocald.analysis.study.montecarlo import (
    MonteCarlo,
    Trajectory,
    correlations_over_time,
    draw_root,
    plane_covariance,
    simulate_errors,
    trajectories,
)
from thermocald.errors import GeometryError, UsageError
from thermocald.names import tell_apart
from thermocald.numbers import counted, enumerated, parameter_label, percent
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, partials, project

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from thermocald.analysis.study.measured import MeasuredSeries, Thermometer
    from thermocald.arrays import Array

    _Test = TypeVar("_Test", Dependence, DriftTest)


@dataclass(frozen=True, slots=True)
class Deviation:
    """The change of a parameter over a series.

    change: last minus first value; largest: signed, from the first value; range: largest minus
    smallest value. The latter two, some sds from noise alone, reveal a camera that returned.
    """

    first: float
    last: float
    change: float
    sd_change: float
    largest: float
    range: float
    sd_over_time: float

    @property
    def returned(self) -> bool:
        """True if the parameter changed by much more than `change`, which would hide it."""
        return abs(self.largest) > max(1.5 * abs(self.change), 6 * self.sd_change)


def deviation(values: Array, sds: Array, slow: float = 0.0) -> Deviation | None:
    """Return the deviation of a column (n,) with standard deviations (n,); NaN epochs are left out.

    slow: variance of last minus first beyond that of independent epochs, by errors that change
    slowly within the series. Returns None for fewer than two values.
    """
    have = np.flatnonzero(np.isfinite(values))
    if len(have) < 2:
        return None
    first, last = int(have[0]), int(have[-1])
    difference = values[have] - values[first]
    return Deviation(
        float(values[first]),
        float(values[last]),
        float(difference[-1]),
        float(np.sqrt(sds[first] ** 2 + sds[last] ** 2 + slow)),
        float(difference[np.argmax(np.abs(difference))]),
        float(np.ptp(difference)),
        float(np.std(values[have], ddof=1)),
    )


def image_displacement(series: MeasuredSeries, points: Array) -> tuple[Array, Array | None]:
    """Return the displacement (k, 2) px of a static scene's image points, from first to last epoch.

    points (k, 2) px, y down. Also returns its covariance (k, 2, 2) px², None, unknown, if the
    series has no correlations. Raises GeometryError if the first IOP have no ray for a point.
    """
    sensor, last = series.sensor, series.values[-1]
    scene = directions(sensor, series.values[0], points)
    moved = project(sensor, last, np.zeros(6), scene) - points
    if not len(series.correlations):
        return moved, None
    J = partials(sensor, last, np.zeros(6), scene)[1][..., :10]
    sds = np.nan_to_num(series.sds[[0, -1]])
    covariance = series.correlations[[0, -1]] * sds[:, :, None] * sds[:, None, :]
    return moved, np.asarray(J @ (covariance.sum(axis=0) + series.slow) @ np.swapaxes(J, 1, 2))


def depth_of_field(
    principal_distance: float, focus_distance: float, f_number: float, confusion: float
) -> tuple[float, float]:
    """Return the near and far limits between which a lens focused at `focus_distance` is sharp, mm.

    A lens focused beyond the hyperfocal distance is sharp to infinity. The principal distance is
    used as the focal length, which it exceeds by f²/s: 0.4 % at 1 m for these lenses. Raises
    ValueError for lengths that are not positive.
    """
    f, s = principal_distance, focus_distance
    if min(f, f_number, confusion) <= 0 or s <= f:
        raise ValueError(
            f"no depth of field for c {f} mm focused at {s} mm, f/{f_number}, circle {confusion} mm"
        )
    hyperfocal = f * f / (f_number * confusion) + f
    near = s * (hyperfocal - f) / (hyperfocal + s - 2 * f)
    far = s * (hyperfocal - f) / (hyperfocal - s) if hyperfocal > s else float("inf")
    return near, far


_COURSE = 500
_GAP_IN_INTERVALS = 1.5
_LEAST_DEPENDENCE = 4
_PRINCIPAL = IOP_NAMES[:3]


@dataclass(frozen=True, eq=False)
class Significance:
    """The moving F-test of one parameter in summary, and the drift test of the whole series.

    success_ratio: over `tests` epochs; left_out: epochs without a window; degrees of freedom of the
    variance and (median) of the mean squared sd; critical: median; course (k, 2): time s and ratio
    of the variances, thinned for drawing; drift: None if it cannot be tested.
    """

    JSON: ClassVar = {"critical": "critical_ratio", "course": "", "drift": "drift_test"}

    success_ratio: float
    tests: int
    left_out: int
    degrees_variance: int
    degrees_sd: float
    critical: float
    median_ratio: float
    course: Array
    drift: DriftTest | None


@dataclass(frozen=True, eq=False)
class ChannelStudy:
    """The dependence of free parameters and sigma0 on a thermometer, or the `reason` for none."""

    thermometer: Thermometer
    dependences: Mapping[str, Dependence]
    reason: str = ""


@dataclass(frozen=True, slots=True)
class FocusChange:
    """The depth of field at the first and the last epoch, mm, and its change with sd."""

    JSON: ClassVar = {
        "change": "change_mm", "sd_change": "sd_change_mm", "confusion": "confusion_mm",
    }  # fmt: skip

    near_first_mm: float
    far_first_mm: float
    near_last_mm: float
    far_last_mm: float
    change: float
    sd_change: float
    confusion: float


@dataclass(frozen=True, eq=False)
class SeriesStudy:
    """The study of one series.

    deviations: of the IOP, `sigma0` and the thermometers; grid, displacement (k, 2) px: image
    points of a static scene and their shifts from the first to the last epoch, y down;
    displacement_covariance (k, 2, 2) px²: of the shifts, None if unknown; columns,
    matrix (n, n): Pearson's r among free IOP, sigma0 and thermometers; noise_ratio: scatter between
    neighbouring epochs over the stated standard deviations, NaN if it could not be estimated.
    """

    series: MeasuredSeries
    deviations: Mapping[str, Deviation]
    focus: FocusChange | None
    grid: Array
    displacement: Array | None
    displacement_covariance: Array | None
    significance: Mapping[str, Significance]
    channels: tuple[ChannelStudy, ...]
    columns: tuple[str, ...]
    matrix: Array
    notes: tuple[str, ...]
    noise_ratio: float


def study_series(series: MeasuredSeries, settings: StudySettings) -> SeriesStudy:
    """Study one series. Never raises because of data; `notes` states what they do not allow."""
    notes = _circumstances(series)
    slow = dict(zip(IOP_NAMES, np.diagonal(series.slow).tolist(), strict=True))
    deviations = {
        name: d
        for name, column in series.columns.items()
        if (d := deviation(*column, slow.get(name, 0.0))) is not None
    }
    significance = _significance(series, settings, notes)
    channels = tuple(_channel(series, t) for t in series.thermometers)
    notes += [c.reason for c in channels if c.reason]
    changes = {n: (d.change, d.sd_change) for n, d in deviations.items() if n in _PRINCIPAL}
    for one in channels:
        slopes = {n: d for n, d in one.dependences.items() if n in _PRINCIPAL}
        changes |= {f"{n}/{one.thermometer.name}": (d.slope, d.sd_slope) for n, d in slopes.items()}
    if carried := carried_by_c(series.c_known_to, changes):
        said = say_carried(series.c_known_to, max(carried.values()))
        notes.append(f"{said[0].upper()}{said[1:]}.")
    short = {
        parameter_label(c.thermometer.name): enumerated(
            [parameter_label(n) for n, d in c.dependences.items() if d.too_short]
        )
        for c in channels
    }
    notes += [
        f"Slopes of {of} on {enumerated([name for name in short if short[name] == of])}: the noise "
        "is correlated over more than a seventh of the series, which is too short for their "
        "standard deviations; take those as an order of magnitude."
        for of in dict.fromkeys(short.values())
        if of
    ]
    grid = image_grid(series.sensor)
    displacement = covariance = None
    if len(series) > 1 and series.free:
        try:
            displacement, covariance = image_displacement(series, grid)
        except GeometryError as error:
            notes.append(f"The displacement of the image cannot be computed: {error}.")
    focus = _focus(series, settings, deviations, notes)
    # root mean square over all parameters
    ratios = [one.drift.noise_ratio for one in significance.values() if one.drift is not None]
    noise_ratio = float(np.sqrt(np.mean(np.square(ratios)))) if ratios else float("nan")
    return SeriesStudy(
        series, deviations, focus, grid, displacement, covariance, significance, channels,
        tuple(series.columns), pearson_matrix([v for v, _ in series.columns.values()]),
        tuple(notes), noise_ratio,
    )  # fmt: skip


def _circumstances(series: MeasuredSeries) -> list[str]:
    """Return notes on the series that a reader needs before its results."""
    notes = []
    lost = sum(series.without_result.values())
    if lost:
        reasons = ", ".join(f"{n} × {reason}" for reason, n in series.without_result.items())
        notes.append(f"{lost} of {lost + len(series)} epochs have no result ({reasons}).")
    if len(series) == 1:
        notes.append("The series has a single epoch: nothing can be said about change.")
    elif len(series) > 1:
        steps = np.diff(series.time_s)
        gaps = steps > _GAP_IN_INTERVALS * series.interval_s
        if gaps.any():
            notes.append(
                f"The series has {counted(int(gaps.sum()), 'gap')}, the longest of "
                f"{float(steps.max()):.3g} s at an interval of {series.interval_s:.3g} s. Windows "
                "across gaps are not tested; the noise decorrelates in a gap as between epochs."
            )
    held = [name for name in IOP_NAMES if name not in series.free]
    if not series.free:
        notes.append("All parameters were held fixed: whether they change was not examined.")
    elif held:
        notes.append(
            f"{', '.join(map(parameter_label, held))} {'was' if len(held) == 1 else 'were'} held "
            "fixed in the adjustment: not tested, not correlated, not varied in the simulation."
        )
    if series.exterior == "per_epoch":
        notes.append(
            "Every epoch has an exterior orientation of its own"
            f"{f' ({series.choice})' if series.choice else ''}: its movements and those of the "
            "principal point are weakly separated, which the standard deviations include."
        )
    # of one that stood still, only what may have been missed, which follows a semicolon
    elif series.choice and (series.exterior != "series" or ";" in series.choice):
        notes.append(f"Exterior orientation: {series.exterior} ({series.choice}).")
    notes += [f"The test field moved: {m.sentence}; corrected." for m in series.field_movements]
    if not series.thermometers:
        notes.append("The series has no temperature: no dependence on it can be computed.")
    return notes


def _significance(
    series: MeasuredSeries, settings: StudySettings, notes: list[str]
) -> dict[str, Significance]:
    starts = unbroken_windows(series.time_s, settings.window)
    if not len(starts):
        notes.append(
            f"The F-test needs {settings.window} consecutive epochs; the series has {len(series)}"
            f"{' but too many gaps' if len(series) >= settings.window else ''}: not tested."
        )
        return {}
    window, time = settings.window, series.time_s
    drifts = {
        name: drift
        for name in series.free
        if (drift := drift_test(*series.column(name), series.redundancy, window, time)) is not None
    }
    tested = _corrected(drifts, p_holm="p_value", p_excess_holm="p_excess")
    result = {}
    for name in series.free:
        values, sds = series.column(name)
        index, ratio, critical, degrees_sd = moving_f_test(
            values, sds, series.redundancy, time, window, settings.alpha
        )
        some = slice(None, None, max(1, -(-len(ratio) // _COURSE)))
        result[name] = Significance(
            float(np.mean(ratio > critical)), len(ratio), len(values) - len(ratio),
            window - 1, float(np.median(degrees_sd)), float(np.median(critical)),
            float(np.median(ratio)), np.column_stack([time[index[some]], ratio[some]]),
            tested.get(name),
        )  # fmt: skip
    return result


def _corrected(tests: dict[str, _Test], **names: str) -> dict[str, _Test]:
    """Correct p-values for the number of tests (Holm); names: {corrected p-value: p-value}."""
    for name, of in names.items():
        p: list[Any] = holm([getattr(test, of) for test in tests.values()])
        tests = {
            key: replace(test, **{name: value})
            for (key, test), value in zip(tests.items(), p, strict=True)
        }
    return tests


def _channel(series: MeasuredSeries, thermometer: Thermometer) -> ChannelStudy:
    """Return the dependence of all parameters on one thermometer, or why there is none."""
    name, sd = parameter_label(thermometer.name), thermometer.sd
    known = np.isfinite(thermometer.values)
    have = slice(None) if known.all() else known  # no copies of a long series
    t = thermometer.values[have]
    reason = ""
    if len(t) < _LEAST_DEPENDENCE:
        reason = (
            f"{name} is known in {counted(len(t), 'epoch')}: a dependence on it "
            f"needs {_LEAST_DEPENDENCE}."
        )
    elif not np.ptp(t) > 0:
        reason = f"{name} stayed at {t[0]:.2f} °C: no dependence on it can be computed."
    elif float(np.var(t, ddof=1)) < 2 * sd**2:
        reason = (
            f"{name} varied by {np.std(t, ddof=1):.3f} K, which its noise of {sd:.3f} K explains: "
            "no dependence on it can be computed."
        )
    if reason:
        return ChannelStudy(thermometer, {}, reason)
    found = {}
    for column in (*series.free, "sigma0"):
        values, sds = series.columns[column]
        if np.ptp(values[have]) > 0:
            found[column] = dependence(values[have], sds[have], t, sd, series.time_s[have])
    return ChannelStudy(thermometer, _corrected(found, p_naive_holm="p_naive", p_holm="p_value"))


def _focus(
    series: MeasuredSeries,
    settings: StudySettings,
    deviations: Mapping[str, Deviation],
    notes: list[str],
) -> FocusChange | None:
    if "c" not in deviations:
        return None
    sensor = series.sensor
    # the largest blur that counts as sharp: 2 to 3 px
    diagonal = float(np.hypot(sensor.width, sensor.height)) * sensor.pixel_pitch
    confusion = settings.confusion_mm or diagonal / 2000
    c = deviations["c"]
    try:
        ends = [
            depth_of_field(value, settings.focus_mm, settings.f_number, confusion)
            for value in (c.first, c.last, c.first * (1 + 1e-6))
        ]
    except ValueError as error:
        notes.append(f"The depth of field cannot be computed: {error}.")
        return None
    first, last, nudged = (far - near for near, far in ends)
    change = last - first
    if not np.isfinite(change):
        notes.append(
            f"Focused at {settings.focus_mm / 1000:g} m, everything up to infinity is sharp: the "
            "depth of field has no far limit that could change."
        )
        return None
    slope = (nudged - first) / (c.first * 1e-6)
    return FocusChange(*ends[0], *ends[1], change, abs(slope) * c.sd_change, confusion)


@dataclass(frozen=True, eq=False)
class CameraStudy:
    """The study of one camera (label) from its series.

    iop (10,): mean over the series; sds (10,): standard deviations over time, pooled over the
    series that estimate a parameter, 0 if none does; correlations: within the adjustments, None if
    no epoch has a covariance matrix; over_time (10, 10): correlations of the parameters over the
    epochs; trajectories: the camera's own drift in object space, empty if it cannot be computed.
    """

    label: str
    series: tuple[SeriesStudy, ...]
    iop: Array
    sds: Array
    correlations: IopCorrelations | None
    montecarlo: MonteCarlo | None
    over_time: Array
    trajectories: tuple[Trajectory, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Study:
    """The studies of all cameras."""

    settings: StudySettings
    cameras: tuple[CameraStudy, ...]


def study(
    series: Sequence[MeasuredSeries],
    settings: StudySettings | None = None,
    progress: Callable[[int], None] | None = None,
) -> Study:
    """Study every camera; `progress` receives the number of IOP sets simulated."""
    settings = settings or StudySettings()
    labels = dict.fromkeys(one.label for one in series)
    cameras = []
    for label in labels:
        own = [one for one in series if one.label == label]
        sensors = {one.sensor: one.source for one in own}
        if len(sensors) > 1:
            each = [
                f"{s.width} × {s.height} px of {1000 * s.pixel_pitch:g} µm in {source}"
                for s, source in sensors.items()
            ]
            raise UsageError(
                f"{label}: its series have different sensors ({', '.join(each)}); a label is one "
                "camera: give the others labels of their own, LABEL=RECORDING"
            )
        names = tell_apart([one.name for one in own], [one.source for one in own])
        own = [replace(one, name=name) for one, name in zip(own, names, strict=True)]
        cameras.append(study_camera(label, own, settings, progress))
    return Study(settings, tuple(cameras))


def study_camera(
    label: str,
    series: Sequence[MeasuredSeries],
    settings: StudySettings,
    progress: Callable[[int], None] | None = None,
) -> CameraStudy:
    """Study the series of one camera together."""
    notes: list[str] = []
    studies = tuple(study_series(one, settings) for one in series)
    iop = np.mean([one.mean for one in series], axis=0)
    sds, noise = _pooled_sds(series)
    correlations = median_correlations([one.correlations for one in series])
    if correlations is None:
        notes.append(
            "No epoch has a covariance matrix: correlations within the adjustments are unknown."
        )
    montecarlo = None
    if correlations is None or not (sds > 0).any():
        notes.append(
            "No Monte-Carlo: it needs a parameter that varies over two epochs or more, and the "
            "correlations."
        )
    else:
        try:
            montecarlo = simulate_errors(
                series[0].sensor, iop, sds, correlations.median, settings, progress
            )
        except GeometryError as error:
            notes.append(f"No Monte-Carlo: {error}.")
        else:
            notes += _simulation_notes(montecarlo, sds, noise, correlations.median)
    try:
        paths = trajectories(series, settings.distance_mm, settings.grid, settings.clusters_mm)
    except GeometryError as error:
        paths = ()
        notes.append(f"The camera's drift cannot be projected onto the plane: {error}.")
    return CameraStudy(
        label, studies, iop, sds, correlations, montecarlo, correlations_over_time(series), paths,
        tuple(notes),
    )  # fmt: skip


def _simulation_notes(simulated: MonteCarlo, sds: Array, noise: Array, r: Array) -> list[str]:
    """State what limits a simulation.

    sds, noise (10,): standard deviations over time and of an epoch; r (10, 10): correlations.
    """
    notes = []
    by_noise, by_drift = (
        np.trace(plane_covariance(simulated.jacobian, draw_root(each, r)).sum(axis=0))
        for each in (noise, np.sqrt(np.maximum(sds**2 - noise**2, 0.0)))
    )
    if by_noise > by_drift:
        notes.append(
            "The errors on the plane are mostly the noise of an epoch's calibration "
            f"({percent(by_noise / (by_noise + by_drift))} of their variance), not changes of the "
            "camera."
        )
    if simulated.folded:
        notes.append(
            f"{simulated.folded} of {simulated.sets} drawn interior orientations fold the image "
            "over itself and were left out."
        )
    return notes


def _pooled_sds(series: Sequence[MeasuredSeries]) -> tuple[Array, Array]:
    """Return the sds (10,) of the IOP over time and those of an epoch, 0 if held in all series."""
    squares, noise, degrees = np.zeros(10), np.zeros(10), np.zeros(10)
    for one in series:
        for name in one.free:
            k = IOP_NAMES.index(name)
            values, sds = one.column(name)
            squares[k] += np.var(values) * len(one)
            noise[k] += np.mean(sds**2) * (len(one) - 1)
            degrees[k] += len(one) - 1
    return np.sqrt(squares / np.maximum(degrees, 1)), np.sqrt(noise / np.maximum(degrees, 1))
