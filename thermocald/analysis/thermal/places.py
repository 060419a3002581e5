"""Places in metres from image points of a camera that warms and cools: the purpose of a gauge.

Control points that were seen once give the pose. At every other time the camera is that of its
thermal model, corrected by what the control points determine; the mount is assumed not to move.
Each place has the covariance of its image point, of camera and pose jointly, of the thermometer and
of the plane. It is listed beside the place that the camera at the time of the control points would
have given, without the thermal model. Places on staffs and profiles at one time are where the water
touches them: together they give its level.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc

from thermocald.analysis.thermal.control_points import UNITS
from thermocald.arrays import spread_rows
from thermocald.errors import ConfigurationError, DataError
from thermocald.figures import BAND
from thermocald.files import QuantityReader, read_yaml
from thermocald.photogrammetry.camera.camera_model import EOP, IOP, partials, project, rotation
from thermocald.photogrammetry.epoch.measuring import Line, Plane, Profile, place_on
from thermocald.result import Result, jsonable, new_figure, with_sds
from thermocald.store.recording.sense import doubt_lines

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.thermal.control_points import ControlPoints
    from thermocald.analysis.thermal.correction import RowBlock
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.store.logger.temperatures import TemperatureLog


_FARTHEST = 100.0  # largest distance of the surface, in extents of the control points
_MISSED = 19.7  # noncentral χ² of a gross error that the test (0.1 %) misses one time in five
_UNCHECKED = 6.0  # standard deviations by which such an error may move a place
_SOME = 50  # places for which this is computed
_NONE = 1e-6  # share of a variance, or mm, that is rounding
_TOO_GOOD = 0.1  # sigma0 below which standard deviations are not those of these points
_CONTRADICTED = 1e-3  # heights whose differences are less probable contradict each other
_DOUBTED = 0.05  # residuals that are less probable may hide an error that nothing checks
_UPSIDE_DOWN = -0.3  # upward part of the image's y axis; a camera that looks down has about 0
_BESIDE_MM = 300.0  # a staff's width: an image point further from it may be of something else


def read_surface(path: Path, control: ControlPoints) -> Plane | Line | Profile:
    """Read the surface of the points: the water's `level` (and `sd`), `plane`, `line` or `profile`.

    It is given in the unit and the coordinates of the control points. Raises ConfigurationError.
    """
    surface = _read_surface(path, control)
    points = control.field.points
    middle, extent = points.mean(axis=0), np.linalg.norm(np.ptp(points, axis=0))
    places = surface.points if isinstance(surface, Profile) else surface.point
    away = float(np.linalg.norm(places - middle, axis=-1).min())
    unit = UNITS[control.unit]
    where = (
        f"is {away / unit:.0f} {control.unit} away from control points that extend over "
        f"{extent / unit:.0f} {control.unit}"
    )
    if away > _FARTHEST * extent > 0:
        raise ConfigurationError(f"{path}: {where}: both need the same coordinates and unit")
    if away > extent > 0:
        warnings.warn(
            f"{path}: {where}: are both in the same coordinates and heights?", stacklevel=3
        )
    return surface


def _read_surface(path: Path, control: ControlPoints) -> Plane | Line | Profile:
    top = QuantityReader(path, read_yaml(path))
    kinds = [k for k in ("level", "plane", "line", "profile") if k in top.mapping]
    if len(kinds) != 1 or set(top.mapping) - {*kinds, "sd", "sd_tilt_deg"}:
        raise ConfigurationError(
            f"{path}: one of level, plane, line, profile is needed, optionally with sd and "
            f"sd_tilt_deg; found: {', '.join(map(str, top.mapping))}"
        )
    (kind,), scale = kinds, UNITS[control.unit]
    sd = scale * top.number("sd", control.unit, 0.0, low=0.0)
    tilt = np.radians(top.number("sd_tilt_deg", "deg", 0.0, low=0.0))
    if kind == "level":
        level, own_sd = top.quantity("level", control.unit)
        middle = control.field.points[:, :2].mean(axis=0)
        point = np.array([*middle, scale * level - control.origin[2]])
        sd = sd if own_sd is None else scale * own_sd
        return Plane(point, np.array([0.0, 0.0, 1.0]), sd, tilt)
    if kind == "profile":
        given = top.mapping["profile"]
        if not isinstance(given, list) or len(given) < 2:
            raise top.fail("profile", "needs at least two points [X, Y, Z], in order")
        points = np.array([_vector(top, "profile", point) for point in given])
        if not np.linalg.norm(np.diff(points, axis=0), axis=1).all():
            raise top.fail("profile", "the same point is given twice in a row")
        return Profile(scale * points - control.origin, sd)
    way = "normal" if kind == "plane" else "direction"
    parts = top.inner(kind)
    parts.only(("point", way))
    point = scale * _vector(parts, "point", parts.mapping.get("point")) - control.origin
    along = _vector(parts, way, parts.mapping.get(way))
    size = float(np.linalg.norm(along))
    if not size > 0:
        raise parts.fail(way, "must not be zero")
    if kind == "line":
        return Line(point, along / size, sd)
    return Plane(point, along / size, sd, tilt)


def _vector(reader: QuantityReader, key: str, value: Any) -> Array:
    if not isinstance(value, list) or len(value) != 3:
        raise reader.fail(key, f"must be three numbers, not {value!r}")
    return np.array([reader.finite(key, v) for v in value])


@dataclass(frozen=True)
class Level:
    """The water level at a time (s UTC): the weighted mean of `places` heights, with its sd.

    sigma0: scatter of the heights over their standard deviations; 0 for a single place.
    """

    time: float
    level: float
    sd: float
    places: int
    sigma0: float

    @property
    def contradicted(self) -> bool:
        """True if the heights differ by more than their standard deviations explain."""
        freedom = self.places - 1
        return freedom > 0 and float(chdtrc(freedom, freedom * self.sigma0**2)) < _CONTRADICTED


@dataclass(frozen=True, eq=False)
class Places(Result):
    """Places of image points.

    names (n); points (n, 3) in the unit and the coordinates of the control points, with their joint
    covariance (3n, 3n); without (n, 3): without thermal correction, from the camera at the control
    points' time; pose: the resection; rejected: control points left out; temperatures (n,) °C, NaN
    if unknown; times (n,) s UTC; levels: of the water, if the places are on a staff or a profile;
    unchecked: control points that the others hardly check; unnoticed_mm: by how much a gross error
    of theirs may move a place unnoticed; refused: (line, reason) of the rows left out; centre (3,):
    of the camera, in unit and coordinates of the control points; doubts: a sentence each.
    """

    names: list[str]
    points: Array
    covariance: Array
    without: Array
    unit: str
    pose: Adjustment
    rejected: tuple[str, ...]
    temperatures: Array
    times: Array
    levels: tuple[Level, ...] = ()
    unchecked: tuple[str, ...] = ()
    unnoticed_mm: float = 0.0
    refused: tuple[tuple[int, str], ...] = ()
    centre: Array = field(default_factory=lambda: np.full(3, np.nan))
    doubts: tuple[str, ...] = ()

    @cached_property
    def sd(self) -> Array:
        """Standard deviations (n, 3)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 3)

    @property
    def shift_mm(self) -> Array:
        """Distances (n,) mm by which the thermal correction moves the places."""
        shift: Array = np.linalg.norm(self.points - self.without, axis=1) * UNITS[self.unit]
        return shift

    def as_dict(self) -> dict[str, Any]:
        shifts = self.shift_mm
        places = [
            {
                "name": name, "time": self.times[k], "temperature": self.temperatures[k],
                **with_sds("XYZ", self.points[k], self.sd[k]),
                "without_correction": dict(zip("XYZ", self.without[k], strict=True)),
                "correction_mm": shifts[k],
            }
            for k, name in enumerate(self.names)
        ]  # fmt: skip
        pose = {
            "sigma0": self.pose.sigma0, "redundancy": self.pose.redundancy,
            "control_points": self.pose.n_observations, "rejected": self.rejected,
            "sd_angles_deg": np.degrees(self.pose.sd[EOP][:3]), "centre": self.centre,
            "sd_centre_mm": self.pose.sd[EOP][3:],
            "unchecked": self.unchecked, "unnoticed_mm": self.unnoticed_mm,
        }  # fmt: skip
        document: dict[str, Any] = jsonable({
            "format": "thermocald-places/1", "unit": self.unit, "places": places,
            "covariance": self.covariance, "levels": self.levels, "pose": pose,
            "refused": [{"line": line, "reason": why} for line, why in self.refused],
            "doubts": self.doubts,
        })  # fmt: skip
        return document

    def lines(self) -> list[str]:
        digits = 1 if self.unit == "mm" else 4
        count = len(self.names)
        pose = (
            f"{count} place{'s' if count > 1 else ''}; pose from {self.pose.n_observations} "
            f"control points, sigma0 {self.pose.sigma0:.2f}"
        )
        if self.rejected:
            single = len(self.rejected) == 1
            words = "contradicts the others and is" if single else "contradict the others and are"
            pose += f", {', '.join(self.rejected)} {words} left out"
        if self.pose.redundancy > 4 and self.pose.sigma0 < _TOO_GOOD:
            pose += (
                "; they fit far better than their standard deviations say: are sX, sY, sZ in "
                f"{self.unit}, and sx, sy in px?"
            )
        if self.unchecked:
            pose += (
                f"; the others hardly check {', '.join(self.unchecked)}: a gross error there could "
                f"move a place by {self.unnoticed_mm:.0f} mm unnoticed; add control points"
            )
            f, s0 = self.pose.redundancy, self.pose.sigma0
            if f > 0 and chdtrc(f, f * s0**2) < _DOUBTED:
                pose += (
                    f"; there may be one, as sigma0 is {s0:.2f}: check before you use the places"
                )
        names = list(self.names)
        if np.ptp(self.times):
            moments = [datetime.fromtimestamp(time, UTC) for time in self.times]
            form = "%H:%M:%S" if len({m.date() for m in moments}) == 1 else "%Y-%m-%d %H:%M:%S"
            names = [f"{n} {moment:{form}}" for n, moment in zip(names, moments, strict=True)]
        wide = max(map(len, names), default=4)
        at = ", ".join(
            f"{v:.{digits}f} ± {sd / UNITS[self.unit]:.{digits}f}"
            for v, sd in zip(self.centre, self.pose.sd[EOP][3:], strict=True)
        )
        lines = [pose, *doubt_lines(self.doubts), f"the camera is at {at} {self.unit}"]
        lines.append(f"{'':{wide}}  X ± sd, Y ± sd, Z ± sd in {self.unit}; thermal correction mm")
        for name, p, sd, shift in zip(names, self.points, self.sd, self.shift_mm, strict=True):
            at = ", ".join(f"{v:.{digits}f} ± {s:.{digits}f}" for v, s in zip(p, sd, strict=True))
            lines.append(f"{name:{wide}}  {at}; {shift:.1f}")
        for one in self.levels:
            said = f"level of {one.places} places: {one.level:.{digits}f} ± {one.sd:.{digits}f}"
            lines.append(
                f"{datetime.fromtimestamp(one.time, UTC):%Y-%m-%d %H:%M:%S} UTC, {said} {self.unit}"
                + (f", sigma0 {one.sigma0:.2f}" if one.places > 1 else "")
                + (": the places contradict each other" if one.contradicted else "")
            )
        return lines

    def plot(self) -> Figure:
        figure, axes = new_figure(1, panel=(5.0, 3.4))
        ax = axes[0, 0]
        x, y = self.points.T[:2]
        ax.errorbar(x, y, BAND * self.sd[:, 1], BAND * self.sd[:, 0], "o")
        ax.plot(self.without[:, 0], self.without[:, 1], "x", label="without thermal correction")
        ax.set(xlabel=f"X / {self.unit}", ylabel=f"Y / {self.unit}", aspect="equal")
        ax.legend()
        return figure


def measure_places(
    camera: ThermalCamera,
    log: TemperatureLog,
    control: ControlPoints,
    when: float,
    surface: Plane | Line | Profile,
    rows: Sequence[RowBlock],
    extrapolate: bool = False,
) -> Places:
    """Measure the places of image points on a surface, each at its own time.

    when: s UTC, the control points' time; rows: the image points, with values (n, 4) x, y and their
    sds, px. Raises DataError without a pose or temperature, GeometryError for rays that miss.
    """
    observed = np.concatenate([b.values for b in rows])
    times = np.concatenate([b.times for b in rows])
    names = [r.get("name") or str(n) for b in rows for n, r in zip(b.lines, b.rows, strict=True)]
    if not len(observed):
        raise DataError("there is no image point to measure")
    if not len(control.seen):
        raise DataError("the control points have no x, y, sx, sy: add their image points, px")
    noise = camera.reading_sd
    then = camera.along(log.times, log.channels, [when], extrapolate, temperature_sd=noise)
    moments, member = np.unique(times, return_inverse=True)
    now = camera.along(log.times, log.channels, moments, extrapolate, None, noise, when)
    sensor = camera.model.sensor
    pose = control.pose(then[0])
    image, sigmas = observed[:, :2], observed[:, 2:]
    without, _ = then[0].on_plane(image, pose, surface, sigmas)
    states = pose.values + np.pad(now.values - then.values, ((0, 0), (0, 6)))
    points, covariance = place_on(
        sensor, states[member], pose.covariance, image, sigmas, surface, now.covariance, member
    )
    exact: Plane | Line | Profile = replace(surface, sd_mm=0.0)
    if isinstance(exact, Plane):
        exact = replace(exact, sd_tilt=0.0)
    unchecked, unnoticed = _reliability(sensor, control, pose, image, exact, covariance)
    if not isinstance(surface, Plane):
        _warn_of_points_beside(sensor, states[member], points, image, names)
    scale = UNITS[control.unit]
    points, covariance = (points + control.origin) / scale, covariance / scale**2
    levels: tuple[Level, ...] = ()
    if not isinstance(surface, Plane):
        _, seen = place_on(sensor, states[member], pose.covariance, image, sigmas, exact)
        steep = seen.diagonal()[2::3] > 0  # a place on a horizontal line determines no height
        levels = _levels(points, covariance, moments, np.where(steep, member, -1))
    return Places(
        names, points, covariance, (without + control.origin) / scale, control.unit, pose,
        tuple(control.field.names[r] for r in pose.rejected), now.temperatures[member], times,
        levels, unchecked, unnoticed,
        tuple(refused for block in rows for refused in block.refused),
        control.centre(pose),
        _doubt_pose(control, then[0], pose, surface),
    )  # fmt: skip


def _warn_of_points_beside(
    sensor: Sensor, states: Array, points: Array, image: Array, names: Sequence[str]
) -> None:
    """Warn of the image point (n, 2) px that is furthest beside the line of its place (n, 3) mm.

    states (n, 16): camera and pose of each point.
    """
    eop = states[0, EOP]
    on = project(sensor, states[:, IOP], eop, points[:, None])[:, 0]
    scale = sensor.pixel_pitch / states[:, 0] * np.linalg.norm(points - eop[3:], axis=1)
    beside = np.linalg.norm(on - image, axis=1) * scale
    if beside.max() > _BESIDE_MM:
        row = int(np.argmax(beside))
        warnings.warn(
            f"image point {names[row]} is {beside[row] / 1000:.1f} m beside the line that its "
            "height is read on: is it a point of the staff or profile?",
            stacklevel=4,
        )


def _doubt_pose(
    control: ControlPoints, camera: Camera, pose: Adjustment, surface: Plane | Line | Profile
) -> tuple[str, ...]:
    """Return the doubts of the control points, and one of a camera upside down or under water."""
    doubts = control.find_doubts(camera, pose)
    eop = pose.values[EOP]
    places = surface.points if isinstance(surface, Profile) else surface.point
    vertical = not isinstance(surface, Plane) or surface.normal.tolist() == [0.0, 0.0, 1.0]
    if vertical and eop[5] < places[..., 2].min():  # points on one plane fit mirrored at it, too
        doubts.append(
            "the camera is under water in this pose: are X and Y, or x and y, exchanged, or is a "
            "sign wrong?"
        )
    elif vertical and rotation(eop[:3])[2, 1] < _UPSIDE_DOWN:
        doubts.append(
            "the camera hangs upside down in this pose: does it, or were x, y of the control "
            "points read in an image turned by 180°?"
        )
    return tuple(doubts)


def _reliability(
    sensor: Sensor,
    control: ControlPoints,
    pose: Adjustment,
    image: Array,
    exact: Plane | Line | Profile,
    covariance: Array,
) -> tuple[tuple[str, ...], float]:
    """Return the control points that the others hardly check, and what they may do, mm.

    exact: the surface without sds; covariance (3n, 3n) mm²: of the places. It is the external
    reliability: the largest movement of a place by a gross error that data snooping misses. Source:
    Baarda (1968).
    """
    seen = control.seen.select(~np.isin(control.seen.targets, pose.rejected))
    some = spread_rows(len(image), _SOME)
    sd = np.sqrt(covariance.diagonal()).reshape(-1, 3)[some].ravel()
    Q = pose.covariance / max(1.0, pose.sigma0**2)
    names, worst = [], 0.0
    for target, sigma in zip(seen.targets, seen.sigmas, strict=True):
        at = control.field.points[target]
        _, (A,), (B,) = partials(sensor, pose.values[IOP], pose.values[EOP], at[None])
        noise = np.diag(sigma**2) + B * control.field.sigmas[target] ** 2 @ B.T
        variance, axes = np.linalg.eigh(noise - A @ Q @ A.T)  # of the residuals
        lever = Q @ A.T @ axes / np.sqrt(np.maximum(variance, _NONE * noise.trace()))
        _, moved = place_on(sensor, pose.values, _MISSED * lever @ lever.T, image[some], 0.0, exact)
        largest = np.sqrt(np.maximum(moved.diagonal(), 0.0))
        if (largest > np.maximum(_UNCHECKED * sd, _NONE)).any():
            names.append(control.field.names[target])
            worst = max(worst, float(largest.max()))
    return tuple(names), worst


def _levels(
    points: Array, covariance: Array, moments: Array, member: NDArray[np.int64]
) -> tuple[Level, ...]:
    """Average the heights of each time, weighted by their joint covariance."""
    found = []
    for k, time in enumerate(moments.tolist()):
        rows = np.flatnonzero(member == k)
        if not len(rows):
            continue
        Z, C = points[rows, 2], covariance[np.ix_(3 * rows + 2, 3 * rows + 2)]
        weights = np.linalg.pinv(C, hermitian=True)
        variance = 1.0 / float(weights.sum())
        level = variance * float((weights @ Z).sum())
        left, freedom = Z - level, len(rows) - 1
        squares = max(float(left @ weights @ left), 0.0)  # rounding may make it negative
        sigma0 = math.sqrt(squares / freedom) if freedom else 0.0
        found.append(Level(time, level, math.sqrt(variance), len(rows), sigma0))
    return tuple(found)
