"""Control points of a gauge: surveyed coordinates and image points.

They are read from a CSV, from the GeoJSON of a GNSS receiver, or from pyorc's camera configuration.
Coordinates of UTM or a national grid have seven digits before the decimal point: an origin is
subtracted before anything is computed, and stored.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DataError, TestFieldError
from thermocald.numbers import counted
from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.field.testfield import KINDS, Observations, TestField
from thermocald.store.recording.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import ArrayLike

    from thermocald.analysis.camera.camera import Camera
    from thermocald.arrays import Array
    from thermocald.photogrammetry.epoch.adjustment import Adjustment

UNITS = {"mm": 1.0, "m": 1000.0}
"""Units of control points and planes, in mm."""

_LEAST_EXTENT_MM = 50.0  # of a gauge's points; it is smaller for metres read as mm, or for degrees
_LEAST_OF_A_GRID_MM = 1000.0  # of points more than a hundred times as far from the origin
_LARGEST_EXTENT_MM = 2e6  # it is larger for mm read as metres
_WIDE_M = 500.0  # few gauges are wider; five metres in cm read as metres are
_FITS = 3.0  # largest sigma0 of a pose that fits after mirroring
_POOR = 15.0  # largest sigma0 that standard deviations of a poor survey explain
_BETTER = 0.5  # largest fraction of sigma0 that a change has to leave
_OTHER_LENSES = (1.0, 1.3, 0.77, 1.7, 0.6)  # principal distances to try, over the model's
_OTHER_LENS = 3.3  # standard deviations of the principal distance that show another lens
_OTHER_SIZES = (2.0, 4.0, 0.5)  # of the camera's images over those of the image points
_EXCHANGED = 20  # points of which each two are exchanged, in search of a mistake
_ON_EACH_OTHER = 0.05  # of the extent: points that an exchange of names may confuse
_ROUND_MM = 1e6  # the origin is rounded to this
_SURVEYED_MM = 20.0  # a GNSS receiver with corrections, if no standard deviation is given
_CLICKED_PX = 1.0
# receivers' names of columns and properties
_NAMES: dict[str, tuple[str, ...]] = {
    "target": ("target", "name", "id", "point", "label"),
    "X": ("X", "easting", "east", "E"),
    "Y": ("Y", "northing", "north", "N"),
    "Z": ("Z", "height", "elevation", "altitude", "H"),
    "sX": ("sX", "sE", "easting_rms", "hrms", "lateral_rms"),
    "sY": ("sY", "sN", "northing_rms", "hrms", "lateral_rms"),
    "sZ": ("sZ", "sH", "elevation_rms", "vrms"),
    "x": ("x",), "y": ("y",), "sx": ("sx",), "sy": ("sy",),
    "diameter": ("diameter",),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Surveyed points and their image points.

    field: coordinates in mm from `origin` (3,) mm; seen: image points px, empty if the file has
    none; unit: of the file; assumed: a sentence on standard deviations that the file lacks.
    """

    field: TestField
    seen: Observations
    origin: Array
    unit: str
    assumed: str = ""

    @classmethod
    def read(cls, path: Path, unit: str) -> ControlPoints:
        """Read control points from a CSV in a unit, mm or m, or from GeoJSON or pyorc's JSON in m.

        The CSV has target, X, Y, Z, sX, sY, sZ, optionally image points x, y, sx, sy (px), and
        kind, code and diameter as in a test field. Raises DataError naming file, line and column.
        """
        if path.suffix.lower() not in (".json", ".geojson"):
            return _from_table(path, unit)
        document = read_document(path)
        try:
            if "gcps" in document:
                return _from_pyorc(document, str(path))
            if document.get("type") == "FeatureCollection":
                return _from_features(document, str(path))
        except DataError:
            raise
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            fault = f"{error} is missing" if isinstance(error, KeyError) else error
            raise DataError(f"{path}: is not valid JSON of control points: {fault}") from error
        raise DataError(f"{path}: is neither pyorc's camera configuration (gcps) nor GeoJSON")

    @classmethod
    def build(
        cls, names: list[str], points: Array, sigmas: ArrayLike, unit: str, where: str,
        seen: tuple[Array, Array] | None = None, assumed: str = "", **looks: Any,
    ) -> ControlPoints:  # fmt: skip
        """Build control points from coordinates (n, 3) in a unit, with standard deviations.

        seen: image points and their standard deviations, (n, 2) px each, NaN for a point not seen.
        """
        scale = UNITS[unit]
        if not names:
            raise DataError(f"{where}: holds no control points")
        if not all((np.asarray(sds) > 0).all() for sds in (sigmas, *(seen or ())[1:])):
            raise DataError(f"{where}: a standard deviation must be above 0")
        for number, name in enumerate(names, 1):
            if not name.strip() or not name.isprintable():
                raise DataError(f"{where}: control point {number} needs a name in one line")
        if not np.isfinite(points).all():
            row = int(np.argmin(np.isfinite(points).all(axis=1)))
            raise DataError(f"{where}, {names[row]}: a control point needs X, Y and Z")
        away = scale * np.abs(points - np.median(points, axis=0)).max(axis=1)
        if (far := away > _LARGEST_EXTENT_MM).any() and far.mean() < 0.5:
            row = int(np.argmax(away))
            raise DataError(
                f"{where}, {names[row]}: is {away[row] / 1000:.0f} m away from the other control "
                f"points: are its coordinates in {unit}?"
            )
        extent = scale * float(np.ptp(points[:, :2], axis=0).max())
        grid = np.abs(scale * points.mean(axis=0)[:2]).max() > 100.0 * extent
        if 0 < extent < (_LEAST_OF_A_GRID_MM if unit == "mm" and grid else _LEAST_EXTENT_MM):
            degrees = (np.abs(points[:, :2]) <= (180, 90)).all()
            raise DataError(
                f"{where}: in {unit}, all control points lie within {extent:.3g} mm: "
                + ("do X and Y hold degrees? " if degrees else "are they in m? ")
                + "Metres of UTM or a national grid are needed"
                + ("" if degrees else ", and the unit m")
            )
        if extent > _LARGEST_EXTENT_MM:
            raise DataError(
                f"{where}: in {unit}, control points extend over {extent / 1000:.0f} m: "
                + ("are they in mm?" if unit == "m" else "which of them is wrong?")
            )
        origin = np.round(scale * points.mean(axis=0) / _ROUND_MM) * _ROUND_MM
        try:
            field = TestField.build(
                names, scale * points - origin, scale * np.asarray(sigmas), **looks
            )
        except TestFieldError as error:
            raise DataError(f"{where}: {error}") from error
        image = Observations.none()
        if seen is not None:
            rows = np.flatnonzero(np.isfinite(seen[0]).all(axis=1))
            image = Observations(rows, seen[0][rows], seen[1][rows])
        return cls(field, image, origin, unit, assumed)

    def pose(self, camera: Camera, snooping_alpha: float = 0.001) -> Adjustment:
        """Resect a camera from the image points. Raises DataError with the reason if it fails."""
        seen, sensor = self.seen, camera.sensor
        pose = camera.resect(self.field, seen, snooping_alpha)
        why = f"the control points give no pose ({pose.status}): {pose.reason}"
        outside = ~sensor.contains(seen.points)
        if outside.any():
            row = int(np.argmax(outside))
            x, y = seen.points[row]
            why = (
                f"control point {self.field.names[seen.targets[row]]} was seen at {x:.0f}, {y:.0f} "
                f"px, outside the camera's {sensor.width} × {sensor.height} px"
            )
        elif pose.ok:
            return pose
        if pose.ok:
            raise DataError(f"{why}; correct the click or leave it out")
        # one that fits nevertheless shows no other mistake
        fits = pose.status in ("ambiguous_pose", "weak_geometry")
        raise DataError(why if fits else why + self._remedy(camera))

    def find_doubts(self, camera: Camera, pose: Adjustment) -> list[str]:
        """Return what is doubtful in a pose although the control points fit, a sentence each."""
        wide = float(np.ptp(self.field.points[:, :2], axis=0).max()) / 1000
        unit = f"the control points extend over {wide:.0f} m: are they in m, not in cm?"
        size = unit * (self.unit == "m" and wide > _WIDE_M)
        return [s for s in (size, self._find_twin(camera, pose), self._doubt_lens(camera)) if s]

    def _find_twin(self, camera: Camera, pose: Adjustment) -> str:
        """Return the exchange of names with which another pose fits, as a sentence; "" without one.

        Points that a turn about their middle puts on each other give a pose with all names
        exchanged too: the camera is turned with them, and no residual shows it.
        """
        from scipy.spatial import KDTree  # 20 MB that a live daemon does not need
        from scipy.spatial.transform import Rotation

        seen = self.seen.select(~np.isin(self.seen.targets, pose.rejected))
        names = [self.field.names[row] for row in seen.targets]
        points = self.field.points[seen.targets]
        beside = points - points.mean(axis=0)
        near = _ON_EACH_OTHER * np.linalg.norm(beside, axis=1).max()
        axes = np.array([[0.0, 0.0, 1.0], *np.linalg.svd(beside)[2]])  # the vertical first
        for axis, quarters in product(axes, (2, 1, 3)):
            turned = Rotation.from_rotvec(axis * quarters * np.pi / 2).apply(beside)
            away, order = KDTree(beside).query(turned)
            moved = np.flatnonzero(order != np.arange(len(order)))
            if not len(moved) or len(set(order)) < len(order) or away.max() > near:
                continue
            twin = camera.resect(self.field, replace(seen, points=seen.points[order]), 0.0)
            if twin.ok and twin.sigma0 < max(_FITS, pose.sigma0):
                old, new = (", ".join(names[k] for k in rows) for rows in (order[moved], moved))
                digits = 0 if self.unit == "mm" else 2
                here, there = (
                    f"{', '.join(f'{v:.{digits}f}' for v in self.centre(p))} {self.unit}"
                    for p in (pose, twin)
                )
                return (
                    f"the control points fit as well with {old} named {new} (sigma0 "
                    f"{twin.sigma0:.2f}, the camera at {there} in place of {here}): no residual "
                    "shows which names are right; add a point that breaks the symmetry"
                )
        return ""

    def _doubt_lens(self, camera: Camera) -> str:
        """Return by how much another principal distance fits better, as a sentence; "" if none.

        Few points let a wrong one pass: the pose follows, and what does not fit is left out.
        """
        trial = _with_free_distance(camera).resect(self.field, self.seen)
        c, sd = trial.values[0], float(np.hypot(trial.sd[0], camera.sd["c"]))
        if not trial.ok or abs(c - camera.values[0]) < _OTHER_LENS * sd:
            return ""
        return (
            f"the control points fit better with a principal distance of {c:.4f} ± {sd:.4f} mm "
            f"than with the model's {camera.values[0]:.4f} mm: is it of this camera and lens?"
        )

    def centre(self, pose: Adjustment) -> Array:
        """Return the projection centre (3,) in the unit and the coordinates of the file."""
        centre: Array = (pose.values[EOP][3:] + self.origin) / UNITS[self.unit]
        return centre

    def _remedy(self, camera: Camera) -> str:
        """Return the change with which the points fit, as the end of a sentence; else ""."""
        field, seen, n = self.field, self.seen, len(self.seen)
        names = [field.names[row] for row in seen.targets]
        mirrored = "mirrored they fit: X and Y, or x and y, are exchanged, or a sign is wrong"
        upright = "turned by 90° they fit: were x, y read in an image that was shown upright?"
        (x, y), size = seen.points.T, (camera.sensor.width, camera.sensor.height)
        turned = (mirrored, y, x), (upright, y, size[1] - 1 - x), (upright, size[0] - 1 - y, x)
        changes = [(mirrored, camera, replace(field, points=field.points[:, [1, 0, 2]]), seen)]
        for text, *at in turned:
            changes.append((text, camera, field, replace(seen, points=np.array(at).T)))
        for factor in _OTHER_SIZES:
            larger, sigmas = (seen.points + 0.5) * factor - 0.5, seen.sigmas * factor
            text = f"times {factor:g} they fit: are x, y of images of {size[0] / factor:g} × "
            text += f"{size[1] / factor:g} px? Give them for {size[0]} × {size[1]} px"
            changes.append((text, camera, field, replace(seen, points=larger, sigmas=sigmas)))
        for i, j in combinations(range(min(n, _EXCHANGED)), 2):
            order = np.arange(n)
            order[[i, j]] = j, i
            text = f"with {names[i]} and {names[j]} exchanged they fit: is a name or a click wrong?"
            changes.append((text, camera, field, replace(seen, points=seen.points[order])))
        for i in range(n):
            text = f"without {names[i]} they fit: has it moved, or is its unit another?"
            changes.append((text, camera, field, seen.select(np.arange(n) != i)))
        text = "with another principal distance they fit: is the model of this camera and lens?"
        others = [_with_free_distance(camera, factor) for factor in _OTHER_LENSES]
        changes += [(text, other, field, seen) for other in others]
        now = camera.resect(field, seen, 0.0)
        least = min(_FITS, _BETTER * now.sigma0) if now.ok else _FITS
        for text, trial, points, image in changes:
            pose = trial.resect(points, image, 0.0)
            spare = 0 if trial is camera else n // 4  # a wrong start misses some points
            if pose.ok and len(pose.rejected) <= spare and pose.sigma0 < least:
                return f"; {text}"
        if now.ok and not now.rejected and now.sigma0 < _POOR:
            return (
                f"; if nothing is wrong, errors are {now.sigma0:.1f} times the standard deviations "
                "given: state larger sX, sY, sZ, or sx, sy"
            )
        return ""


def _with_free_distance(camera: Camera, factor: float = 1.0) -> Camera:
    """Return a camera with a multiple of the principal distance, known to a fifth."""
    values, covariance = camera.values.copy(), camera.covariance.copy()
    values[0] *= factor
    covariance[0, 0] = (0.2 * values[0]) ** 2
    return replace(camera, values=values, covariance=covariance)


def _find_names(given: Iterable[str]) -> dict[str, str]:
    """Return the given names of columns or properties by what they mean.

    Capitals and spaces do not matter, but x is not X.
    """

    def key(name: str) -> str:
        lower = name.lower().replace(" ", "_")
        return name if lower in ("x", "y", "sx", "sy") else lower

    by_key = {key(name): name for name in reversed([*given])}
    found = {w: [by_key[k] for k in map(key, names) if k in by_key] for w, names in _NAMES.items()}
    return {wanted: names[0] for wanted, names in found.items() if names}


def _from_table(path: Path, unit: str) -> ControlPoints:
    table = Table(path, (), DataError)
    there = _find_names(table.columns)
    missing = [w for w in ("target", "X", "Y", "Z", "sX", "sY", "sZ") if w not in there]
    clicked = ["x", "y", "sx", "sy"] if "x" in there else []
    Table(path, (*missing, *clicked), DataError)  # raises the table's error
    texts = {n: n for n in ("kind", "code") if n in table.columns} | {"target": there.pop("target")}
    optional = [n for w, n in there.items() if w in ("x", "y", "diameter")]
    numbers = dict.fromkeys(n for n in there.values() if n not in optional)
    read = table.read(numbers=list(numbers), optional=optional, texts=list(texts.values()))
    if not read:
        raise DataError(f"{path}: holds no control points")
    whole = {wanted: read[n] for wanted, n in there.items()}
    words = {wanted: [word.strip() for word in read[n]] for wanted, n in texts.items()}
    for wanted, values in whole.items():
        if wanted[0] == "s":
            table.check(there[wanted], values <= 0, "a standard deviation must be above 0")
    looks: dict[str, Any] = {}
    if "kind" in words:
        looks["kinds"] = [kind or KINDS[0] for kind in words["kind"]]
        if wrong := set(looks["kinds"]) - set(KINDS):
            raise DataError(f"{path}: kind {min(wrong)!r} is none of {', '.join(KINDS)}")
    if "code" in words:
        looks["codes"] = words["code"]
    if "diameter" in whole:
        looks["diameters"] = UNITS[unit] * whole["diameter"]

    def stacked(*wanted: str) -> Array:
        return np.stack([whole[n] for n in wanted], axis=1)

    seen = (stacked("x", "y"), stacked("sx", "sy")) if clicked else None
    sigmas = stacked("sX", "sY", "sZ")
    return ControlPoints.build(
        words["target"], stacked("X", "Y", "Z"), sigmas, unit, str(path), seen, **looks
    )


def read_document(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, {} for anything else. Raises DataError naming the file."""
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {error}") from error
    return document if isinstance(document, dict) else {}


def _from_pyorc(document: dict[str, Any], where: str) -> ControlPoints:
    gcps = document["gcps"]
    points = np.array(gcps["dst"], dtype=float)
    image = np.array(gcps["src"], dtype=float)
    if points.ndim != 2 or points.shape[1] == 2:  # points on the water, at level z_0
        points = np.column_stack([points, np.full(len(points), float(gcps["z_0"]))])
    if len(image) != len(points):
        raise DataError(
            f"{where}: gcps.src has {len(image)} points and gcps.dst {len(points)}: each needs both"
        )
    names = [f"gcp{i}" for i in range(len(points))]
    assumed = (
        f"{where} has no standard deviations: {_SURVEYED_MM:g} mm for coordinates and "
        f"{_CLICKED_PX:g} px for image points are assumed"
    )
    seen = (image, np.full(image.shape, _CLICKED_PX))
    return ControlPoints.build(names, points, _SURVEYED_MM / 1000, "m", where, seen, assumed)


def _from_features(document: dict[str, Any], where: str) -> ControlPoints:
    names, rows, sigmas, image, clicked, missing = [], [], [], [], [], 0
    for i, feature in enumerate(document["features"]):
        if (feature["geometry"] or {}).get("type") != "Point":  # null: a point without a place
            continue
        properties = {k: v for k, v in (feature.get("properties") or {}).items() if v is not None}
        asked = {wanted: properties[n] for wanted, n in _find_names(properties).items()}
        at = [float(v) for v in feature["geometry"]["coordinates"]]
        if len(at) == 2:
            at.append(float(asked.get("Z", np.nan)))
        names.append(str(asked.get("target", f"p{i + 1}")))
        rows.append(at[:3])
        missing += not {"sX", "sY", "sZ"} <= asked.keys()
        sigmas.append([float(asked.get(w, _SURVEYED_MM / 1000)) for w in ("sX", "sY", "sZ")])
        image.append([float(asked.get(w, np.nan)) for w in ("x", "y")])
        clicked.append([float(asked.get(w, _CLICKED_PX)) for w in ("sx", "sy")])
    points = np.array(rows).reshape(-1, 3)
    if len(points) and (np.abs(points[:, 0]) <= 180).all() and (np.abs(points[:, 1]) <= 90).all():
        crs = str(document.get("crs", "")).upper()
        if not crs or "CRS84" in crs or "4326" in crs:
            raise DataError(
                f"{where}: the coordinates look like degrees; write them in metres: UTM, or a "
                "national grid"
            )
    without = counted(missing, "point")
    assumed = f"{where}: {without} without standard deviations: {_SURVEYED_MM:g} mm assumed"
    seen = np.array(image).reshape(-1, 2), np.array(clicked).reshape(-1, 2)
    return ControlPoints.build(names, points, sigmas, "m", where, seen, assumed if missing else "")
