"""A camera at one time: interior orientation with covariance, and its use.

Also the difference of two cameras: in their parameters, and in the image, as the shifts of fixed
directions over a grid of the whole image, before and after the rotation that minimises them: the
latter no exterior orientation absorbs (mrcal calls it the projection difference). The cameras count
as independent of each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.camera.undistortion import directions, ideal_points, image_grid
from thermocald.arrays import floats
from thermocald.errors import ConfigurationError, UsageError
from thermocald.numbers import UNITS, celsius, plain, with_sd
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    partials,
    project,
)
from thermocald.photogrammetry.field.testfield import (
    Observations,
    TestField,
    observations_from_lists,
)
from thermocald.physics.effect import PARAMETER_UNITS
from thermocald.result import Result, jsonable, new_figure, with_sds

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.epoch.measuring import Line, Plane, Profile


@dataclass(frozen=True, eq=False, repr=False)
class Camera(Result):
    """A camera at one time: its interior orientation with covariance.

    sensor: size px and pixel pitch mm; temperature °C, NaN if unknown; values (10,), covariance
    (10, 10): c, x0, y0 (mm), A1 … C2; extrapolated: by how many kelvin the temperature is outside
    the range that the model was fitted on, 0 inside.

    >>> camera = tc.load_camera("camera.yaml").at(35.0)
    >>> camera.sd["c"] > 0
    True
    """

    sensor: Sensor
    temperature: float
    values: Array
    covariance: Array
    extrapolated: float = 0.0
    name: str = "camera"

    @property
    def interior(self) -> InteriorOrientation:
        """The interior orientation."""
        return InteriorOrientation.from_array(self.values)

    @property
    def model(self) -> CameraModel:
        """Sensor and interior orientation together."""
        return CameraModel(self.sensor, self.interior)

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations by name, 0 for a parameter that was held."""
        return dict(zip(IOP_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def project(
        self, points: ArrayLike, pose: Adjustment | ExteriorOrientation | ArrayLike
    ) -> Array:
        """Project object points (n, 3) mm to image points (n, 2) px, NaN behind the camera.

        pose: omega, phi, kappa (rad), X0, Y0, Z0 (mm), as an ExteriorOrientation or six numbers, or
        the result of `resect`.

        >>> camera = tc.load_camera("camera.yaml").at(35.0)
        >>> camera.project([[0.0, 0.0, -1000.0]], [0, 0, 0, 0, 0, 0]).shape
        (1, 2)
        """
        points = _numbers(points, 3, "object points")
        return project(self.sensor, self.values, _pose_values(pose), points)

    def rays(self, image_points: ArrayLike) -> Array:
        """Return the unit directions (n, 3) in the camera frame of image points (n, 2) px.

        The camera looks along -Z. Raises GeometryError beyond where the distortion folds back.

        >>> tc.load_camera("camera.yaml").at(35.0).rays([[100.0, 100.0]]).shape
        (1, 3)
        """
        return self.model.rays(_numbers(image_points, 2))

    def undistort(self, image_points: ArrayLike, to: InteriorOrientation | None = None) -> Array:
        """Return image points (n, 2) px as a camera without distortion would have seen them.

        to: principal distance and point of that camera; by default this one's distance, and the
        image centre. Raises GeometryError beyond where the distortion folds back.

        >>> tc.load_camera("camera.yaml").at(35.0).undistort([[100.0, 100.0]]).shape
        (1, 2)
        """
        target = to or InteriorOrientation(self.interior.c)
        (x, y), pitch = self.sensor.centre, self.sensor.pixel_pitch
        scale, shift = target.c / pitch, (x + target.x0 / pitch, y - target.y0 / pitch)
        points = _numbers(image_points, 2)
        return ideal_points(self.sensor, self.values, points, (scale, -scale), shift)

    def as_seen_by(self, image_points: ArrayLike, other: InteriorOrientation) -> Array:
        """Return image points (n, 2) px as this camera would have seen them with another IOP."""
        seen = directions(self.sensor, self.values, _numbers(image_points, 2))
        return project(self.sensor, other.as_array(), np.zeros(6), seen)

    def point_covariance(self, image_points: ArrayLike) -> Array:
        """Return the covariance (n, 2, 2) px² of a fixed direction's image point from the IOP's."""
        seen = directions(self.sensor, self.values, _numbers(image_points, 2))
        J = partials(self.sensor, self.values, np.zeros(6), seen)[1][..., :10]
        return J @ self.covariance @ J.swapaxes(1, 2)

    def object_error(self, distance_mm: float, image_points: ArrayLike | None = None) -> Array:
        """Return the standard deviation (n,) mm of points on a plane at a distance.

        It is that from the interior orientation alone. image_points (n, 2) px: by default corners,
        edge middles and centre, row by row.

        >>> tc.load_camera("camera.yaml").at(35.0).object_error(10_000.0).shape
        (9,)
        """
        if not distance_mm > 0:
            raise UsageError(f"distance_mm is {distance_mm}; it must be above 0")
        points = image_grid(self.sensor) if image_points is None else _numbers(image_points, 2)
        seen = directions(self.sensor, self.values, points)
        _, J, by_place = partials(self.sensor, self.values, np.zeros(6), seen)
        K = np.linalg.solve(by_place[..., :2], J[..., :10])  # of the tangents of the image point
        result: Array = distance_mm * np.sqrt(np.einsum("nkp,pq,nkq->n", K, self.covariance, K))
        return result

    def resect(
        self,
        control: TestField,
        seen: Observations | Mapping[str, ArrayLike],
        snooping_alpha: float = 0.001,
        start: ExteriorOrientation | None = None,
    ) -> Adjustment:
        """Return the pose of this camera from control points, with its covariance as prior.

        seen: the image points, as a table or mapping with target, x, y, sx, sy (px);
        snooping_alpha: error probability of a single test for gross errors, 0 for none; start: an
        earlier pose, with which three points suffice. The covariance (16, 16) of the result is
        joint; its status and reason explain a missing pose, such as that the points fit a second
        one as well or hardly determine the camera's place. If the points lie on each other
        after a turn, exchanged names give another pose, and no residual shows it. Raises
        TestFieldError for a target that the field lacks, UsageError for image points that are no
        numbers.

        >>> camera = tc.load_camera("camera.yaml").at(35.0)
        >>> points = [[0, 0, 0], [800, 0, 0], [800, 600, 0], [0, 600, 100]]
        >>> field = tc.TestField.build(["a", "b", "c", "d"], points, sigmas=1.0)
        >>> x, y = camera.project(points, [0, 0, 0, 300, 300, 900]).T
        >>> seen = {"target": field.names, "x": x, "y": y, "sx": [0.3] * 4, "sy": [0.3] * 4}
        >>> pose = camera.resect(field, seen)
        >>> floor = tc.Plane([0, 0, 0], [0, 0, 1])
        >>> places, covariance = camera.on_plane([[1500, 1000]], pose, floor)
        >>> pose.status, places.shape, covariance.shape
        ('ok', (1, 3), (3, 3))
        """
        from thermocald.photogrammetry.epoch.measuring import resect

        if not 0.0 <= snooping_alpha < 1.0:
            raise UsageError(f"snooping_alpha is {snooping_alpha}; it must be 0 to 1")
        if not isinstance(seen, Observations):
            seen = observations_from_lists(seen, control)
            if len(set(seen.targets.tolist())) < len(seen):
                raise UsageError("a target is given twice")
            if not (np.isfinite(seen.points).all() and (seen.sigmas > 0).all()):
                raise UsageError("x, y (px) must be finite numbers, and sx, sy above 0")
        return resect(
            self.sensor, self.interior, self.covariance, control, seen, start, snooping_alpha
        )

    def on_plane(
        self,
        image_points: ArrayLike,
        pose: Adjustment | ExteriorOrientation | ArrayLike,
        plane: Plane | Line | Profile,
        sigma: ArrayLike = 0.0,
    ) -> tuple[Array, Array]:
        """Return the places (n, 3) mm of image points (n, 2) px on a plane, a line or a profile.

        pose: from `resect`, or one without error, as in `project`; sigma: of the image points, px.
        Also returns their joint covariance (3n, 3n), from image points, camera, pose and plane.
        Raises GeometryError for rays that miss it, and for points outside the image.
        """
        from thermocald.photogrammetry.epoch.adjustment import Adjustment
        from thermocald.photogrammetry.epoch.measuring import Line, Plane, Profile, place_on

        if not isinstance(plane, Plane | Line | Profile):
            raise UsageError(f"plane is {plane!r:.80}; it must be a Plane, a Line or a Profile")
        values = np.concatenate([self.values, _pose_values(pose)])
        covariance = np.pad(self.covariance, (0, 6))
        if isinstance(pose, Adjustment):  # of camera and pose together
            values, covariance = pose.values, pose.covariance
        points = _numbers(image_points, 2)
        try:
            sigmas = _numbers(np.broadcast_to(sigma, points.shape), 2, "sigma")
        except ValueError:
            raise UsageError(f"sigma: give one number, or ({len(points)}, 2), px") from None
        if (sigmas < 0).any():
            raise UsageError("sigma must be 0 or above, px")
        many = [len(v) for v in vars(plane).values() if np.ndim(v) == 2]
        if not isinstance(plane, Profile) and {*many} - {len(points)}:
            raise UsageError(f"plane has {many[0]} rows for {len(points)} image points")
        return place_on(self.sensor, values, covariance, points, sigmas, plane)

    def object_distance(self, other: Camera, distance_mm: float) -> Array:
        """Return the distances (9,) mm on a plane between the image grids of this and another."""
        if self.sensor != other.sensor:
            raise UsageError(f"cameras of {self.sensor} and {other.sensor} cannot be compared")
        grid = image_grid(self.sensor)
        ours, theirs = (ideal_points(s.sensor, s.values, grid) for s in (self, other))
        result: Array = distance_mm * np.linalg.norm(ours - theirs, axis=1)
        return result

    def opencv(self) -> tuple[Array, Array]:
        """Return OpenCV's camera matrix (3, 3) px and distortion (5,): k1, k2, p1, p2, k3.

        Exact unless the model has an affinity C1 or a shear C2: then it is a fit over the image
        area, whose residual the files of `write` state.

        >>> K, distortion = tc.load_camera("camera.yaml").at(35.0).opencv()
        >>> K.shape, distortion.shape
        ((3, 3), (5,))
        """
        from thermocald.photogrammetry.camera.conversions import BROWN, convert, opencv

        family = opencv(5)
        if self.values[8:].any():
            found = convert(self.sensor, BROWN, self.values, family)[0]
        else:  # exact, also if the distortion folds back in the corners of the image
            found = family.from_brown(self.sensor, self.values)
        fx, fy, cx, cy = found[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(found[4:])

    def write(self, path: Path | str, format: str = "", comment: str = "") -> str:  # noqa: A002
        """Write the camera for another program; return how exact the file is.

        format: opencv, ros, colmap, mrcal, kalibr, metashape, aicon, json, yaml; by default the one
        that the file's name tells: `ros.yaml`, or a suffix of a single format (`.xml`, `.json`, …);
        comment: a line for the file's head, by default the temperature. Raises UsageError if the
        name tells no format, or several, GeometryError for a model without rays.

        >>> tc.load_camera("camera.yaml").at(35.0).write("ros.yaml")
        'exact: both models give the same pixels'
        """
        from thermocald.photogrammetry import camera_files

        target = Path(path)
        known, chosen = camera_files.FORMATS, format
        if not chosen:  # the one that the file's name tells
            suffix = target.suffix.lower()
            fitting = [name for name, one in known.items() if one.suffix == suffix]
            fitting = [target.stem] if target.stem in known else fitting
            if len(fitting) != 1:
                there = ", ".join(fitting or known)
                raise UsageError(
                    f"{path}: the name does not tell the format; give format=…: {there}"
                )
            chosen = fitting[0]
        if not comment and not np.isnan(self.temperature):
            comment = f"at {self.temperature:g} degC"
        covariance = self.covariance if self.covariance.any() else None
        return camera_files.write(self.model, target, chosen, covariance, comment, self.name)

    def as_dict(self) -> dict[str, Any]:
        """Return the interior orientation with `sd_` of each parameter, as in JSON documents."""
        found = {
            "camera": self.name,
            "temperature": self.temperature,
            "extrapolated_K": self.extrapolated,
            **with_sds(IOP_NAMES, self.values, self.sd.values()),
            "covariance": self.covariance,
        }
        document: dict[str, Any] = jsonable(found)
        return document

    def lines(self) -> list[str]:
        """Return the camera as readable lines."""
        at = "" if np.isnan(self.temperature) else f" at {celsius(self.temperature)} °C"
        return [self.name + at] + [
            f"  {name:>3} = {with_sd(value, self.sd[name], UNITS.get(name, ''))}"
            for name, value in zip(IOP_NAMES, self.values.tolist(), strict=True)
            if value or self.sd[name]
        ]

    def plot(self) -> Figure:
        """Draw the distortion of a grid of image points, px."""
        points = image_grid(self.sensor, _DRAWN)
        centred = InteriorOrientation(*self.values[:3].tolist())
        distortion = points - self.undistort(points, centred)
        return _draw(self.sensor, points, distortion, self.lines()[0])


def _numbers(given: ArrayLike, columns: int, name: str = "image points") -> Array:
    """Return an array (n, columns) of numbers. Raises UsageError for anything else."""
    try:
        found = floats(given)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    if found.ndim not in (1, 2) or found.shape[-1] != columns:
        raise UsageError(f"{name}: must be an array (n, {columns}) of numbers")
    return np.atleast_2d(found)


def _pose_values(given: Adjustment | ExteriorOrientation | ArrayLike) -> Array:
    """Return a pose as six numbers (6,), rad and mm. Raises UsageError for anything else."""
    from thermocald.photogrammetry.epoch.adjustment import Adjustment

    if isinstance(given, Adjustment):
        if given.exterior is None:
            raise UsageError(f"there is no pose ({given.status}): {given.reason}")
        given = given.exterior
    six = given.as_array() if isinstance(given, ExteriorOrientation) else given
    found = _numbers(six, 6, "the pose")
    if len(found) != 1:
        raise UsageError(f"the pose: give one, not {len(found)}")
    return found.reshape(6)


def _draw(sensor: Sensor, points: Array, vectors: Array, title: str) -> Figure:
    """Draw vectors (n, 2) px at image points (n, 2) px, enlarged."""
    from thermocald.figures import Arrows, draw_arrows

    figure, axes = new_figure(1, panel=(5.0, 3.75))
    axis = axes[0, 0]
    draw_arrows(axis, Arrows(points, vectors, (sensor.width, sensor.height)))
    axis.set(xlabel="x in px", ylabel="y in px, down")
    axis.set_title(title, loc="left", pad=20, wrap=True)  # above the scale arrow
    return figure


_GRID, _DRAWN = 25, 13  # points per side, and those that a drawing shows
_IN_PX = ("c", "x0", "y0")


@dataclass(frozen=True, eq=False, repr=False)
class CameraDifference(Result):
    """The difference of two cameras, second minus first.

    names: of both, as printed; first, second: cameras; covariances: of their interior orientations
    (10, 10), None if unknown.
    """

    names: tuple[str, str]
    first: CameraModel
    second: CameraModel
    covariances: tuple[Array | None, Array | None] = (None, None)

    def __post_init__(self) -> None:
        a, b = self.first.sensor, self.second.sensor
        if (a.width, a.height) != (b.width, b.height):
            raise ConfigurationError(
                f"{self.names[0]} has {a.width} × {a.height} px, {self.names[1]} {b.width} × "
                f"{b.height}: only cameras of one image size can be compared"
            )
        if abs(a.pixel_pitch / b.pixel_pitch - 1.0) > 1e-9:
            raise ConfigurationError(
                f"{self.names[0]} has pixels of {a.pixel_pitch:g} mm, {self.names[1]} of "
                f"{b.pixel_pitch:g} mm: give --pixel-pitch for a file that does not state it"
            )

    @property
    def has_sd(self) -> bool:
        """True if both cameras have a covariance."""
        return all(c is not None for c in self.covariances)

    @cached_property
    def shifts(self) -> Array:
        """The shifts (n, 2) px of the image points of the grid's directions."""
        return self._moved(self._directions)

    @property
    def rms_px(self) -> float:
        """The RMS of the shifts' lengths, px."""
        return _rms(self.shifts)

    @cached_property
    def turned_shifts(self) -> Array:
        """The shifts (n, 2) px after the rotation that minimises them."""
        from scipy.optimize import least_squares  # 20 MB that a live daemon does not need
        from scipy.spatial.transform import Rotation

        def left(angles: Array) -> Array:
            return self._moved(Rotation.from_rotvec(angles).apply(self._directions)).ravel()

        best = least_squares(left, np.zeros(3), x_scale=1e-4, xtol=1e-14, ftol=1e-14)
        return np.asarray(best.fun).reshape(-1, 2)

    def as_dict(self) -> dict[str, Any]:
        """Return what `--json` writes."""
        a, b = self.first.interior.as_array(), self.second.interior.as_array()
        known = [np.diag(c) for c in self.covariances if c is not None]
        sds = np.sqrt(known[0] + known[1]) if self.has_sd else None
        rows = []
        for k, name in enumerate(IOP_NAMES):
            row = {"name": name, "unit": PARAMETER_UNITS[name], "first": a[k], "second": b[k],
                   "difference": b[k] - a[k]}  # fmt: skip
            rows.append(row if sds is None else row | {"sd_difference": sds[k]})
        lengths = np.linalg.norm(self.shifts, axis=1)
        turned = np.linalg.norm(self.turned_shifts, axis=1)
        worst = int(np.argmax(lengths))
        document = {
            "format": "thermocald-camera-difference/1",
            "first": self.names[0],
            "second": self.names[1],
            "parameters": rows,
            "largest_px": lengths[worst],
            "largest_at": self._grid[worst],
            "rms_px": self.rms_px,
            "largest_turned_px": turned.max(),
            "rms_turned_px": _rms(self.turned_shifts),
        }
        if sds is not None:
            for suffix, shifts in (("", self.shifts), ("_turned", self.turned_shifts)):
                largest, rms = self._image_sds(shifts, free_rotation=bool(suffix))
                document |= {f"sd_largest{suffix}_px": largest, f"sd_rms{suffix}_px": rms}
        return document

    def lines(self) -> list[str]:
        """Return the difference as readable lines."""
        found = self.as_dict()
        pitch = self.first.sensor.pixel_pitch
        lines = [f"{self.names[1]} minus {self.names[0]}"]
        for row in found["parameters"]:
            if not row["first"] and not row["second"]:
                continue
            sd = row.get("sd_difference", np.nan)
            text = with_sd(row["difference"], sd, UNITS[row["name"]])
            if row["name"] in _IN_PX:
                text += f"  ({with_sd(row['difference'] / pitch, sd / pitch, 'px')})"
            lines.append(f"  {row['name']:>3}  {text}")

        def px(name: str) -> str:
            sd = found.get(f"sd_{name}")
            return plain(found[name], "px", 3) if sd is None else with_sd(found[name], sd, "px")

        x, y = found["largest_at"]
        lines.append(
            f"in the image: {px('rms_px')} (RMS), {px('largest_px')} at most, at ({x:.0f}, {y:.0f})"
        )
        lines.append(
            f"after the best rotation: {px('rms_turned_px')} (RMS), {px('largest_turned_px')} at "
            "most"
        )
        return lines

    def plot(self) -> Figure:
        """Draw the shifts over the image, enlarged."""
        every = np.arange(_GRID**2).reshape(_GRID, _GRID)[::2, ::2].ravel()
        title = "Shifts, second minus first"
        return _draw(self.first.sensor, self._grid[every], self.shifts[every], title)

    @cached_property
    def _grid(self) -> Array:
        return image_grid(self.first.sensor, _GRID)

    @cached_property
    def _directions(self) -> Array:
        return directions(self.first.sensor, self.first.interior.as_array(), self._grid)

    def _moved(self, seen: Array) -> Array:
        """Return the second camera's image points of directions (n, 3), minus the grid, px."""
        values = self.second.interior.as_array()
        return project(self.second.sensor, values, np.zeros(6), seen) - self._grid

    def _image_sds(self, shifts: Array, *, free_rotation: bool) -> tuple[float, float]:
        """Return the standard deviations px of the largest shift's length and of the RMS.

        free_rotation: whether the shifts are those after the rotation that minimises them.
        """
        lengths = np.linalg.norm(shifts, axis=1)
        worst = int(np.argmax(lengths))
        along_worst = shifts[worst] / max(lengths[worst], 1e-300)
        weights = shifts / (len(shifts) * max(_rms(shifts), 1e-300))
        largest = rms = 0.0
        cameras = (self.first, self.second)
        for camera, covariance in zip(cameras, self.covariances, strict=True):
            assert covariance is not None
            values = camera.interior.as_array()
            by = partials(camera.sensor, values, np.zeros(6), self._directions)[1]
            J, turns = by[..., :10], by[..., 10:13].reshape(-1, 3)
            if free_rotation:
                taken = np.linalg.lstsq(turns, J.reshape(-1, 10), rcond=None)[0]
                J = J - (turns @ taken).reshape(J.shape)
            along = along_worst @ J[worst]
            total = np.einsum("nc,ncp->p", weights, J)
            largest += float(along @ covariance @ along)
            rms += float(total @ covariance @ total)
        return float(np.sqrt(largest)), float(np.sqrt(rms))


def _rms(shifts: Array) -> float:
    """Return the RMS length of shifts (n, 2)."""
    return float(np.sqrt(2 * np.mean(shifts**2)))
