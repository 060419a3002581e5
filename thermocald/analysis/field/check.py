"""What a camera at a given place would get out of a test field, before anything is put up.

Which targets it sees and how large, how the image is filled, how deep the field is, and the
standard deviations of the interior orientation that one image and a series would reach: the inverse
of the normal equations of a planned network (Grafarend's first-order design), no image needed.
What would help most is for `advice` to say.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    PARAMETER_NAMES,
    CameraModel,
    ExteriorOrientation,
    partials,
)
from thermocald.photogrammetry.epoch.geometry import (
    GeometryBounds,
    image_coverage,
    weaknesses,
)
from thermocald.photogrammetry.field.planes import field_normals
from thermocald.photogrammetry.linalg import scaled_inverse, unit_diagonal
from thermocald.photogrammetry.targets.outline import facing, local_maps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField

FREE = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
"""The interior parameters whose standard deviations are predicted."""
_USED = [PARAMETER_NAMES.index(name) for name in (*FREE, *EOP_NAMES)]
CELLS = (4, 3)
"""The image is divided into so many columns and rows to see whether it is filled."""
MIN_SIZE_PX = 8.0
MAX_TILT_COSINE = 0.2
_FILL = 0.92


@dataclass(frozen=True, slots=True, eq=False)
class Precision:
    """Standard deviations that a station reaches, in the order of `FREE`; c, x0, y0 … in mm etc.

    epoch: one image, its orientation free, image noise alone; series: of one epoch relative to the
    others where the camera stands still, many epochs; level: one image, the test field's own
    uncertainty included: what is common to all epochs. inf where nothing determines a parameter.
    """

    epoch: Array
    series: Array
    level: Array

    def pixels(self, sensor_pitch: float) -> dict[str, tuple[float, float, float]]:
        """Sd of c, x0, y0 in px: (epoch, series, level) by name."""
        rows = np.stack([self.epoch, self.series, self.level], axis=1)[:3] / sensor_pitch
        return {name: tuple(row) for name, row in zip(FREE, rows.tolist(), strict=False)}


@dataclass(frozen=True, slots=True, eq=False)
class FieldCheck:
    """The result: rows of visible targets, why the others are not, how they fill image and depth.

    sigma_px: of an image coordinate; sizes: smaller diameter in px of each visible circle; cells:
    targets per part of the image (rows, columns); coverage: share of the image inside the targets'
    hull; depth_relief: range of depth over mean depth; distance: mean depth mm; flatness: how far
    the targets lie off their best plane, over that distance; weak: why the program would call an
    image of it too weak for a result, empty if it would not.
    """

    camera: CameraModel
    field: TestField
    station: ExteriorOrientation
    sigma_px: float
    visible: NDArray[np.int64]
    hidden: dict[str, str]
    sizes: Array
    cells: NDArray[np.int64]
    coverage: float
    depth_relief: float
    distance: float
    flatness: float
    precision: Precision
    weak: tuple[str, ...]


def usual_station(camera: CameraModel, field: TestField) -> ExteriorOrientation:
    """Where one would put the camera: in front of the field, which just fills the image.

    In front of a plane, on the diagonal of a corner; upright if Z is up, else Y.
    """
    centre = (field.points.min(axis=0) + field.points.max(axis=0)) / 2
    towards = _front(field)
    low, high = 1e-3 * _extent(field), 1e3 * _extent(field)
    for _ in range(60):
        middle = np.sqrt(low * high)
        inside = _fits(camera, field, station_at(centre + middle * towards, centre))
        low, high = (low, middle) if inside else (middle, high)
    return station_at(centre + high * towards, centre)


def station_at(place: Array, target: Array, roll: float = 0.0) -> ExteriorOrientation:
    """The orientation of a camera at `place` that looks at `target` (3,) mm, rolled by rad."""
    backward = np.asarray(place, dtype=float) - target
    length = float(np.linalg.norm(backward))
    if not length > 0:
        raise GeometryError("the camera stands where it looks at: give another place")
    backward = backward / length
    up = np.array([0.0, 0.0, 1.0])
    if abs(backward @ up) > 0.9:  # looks along Z: Y is up
        up = np.array([0.0, 1.0, 0.0])
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    up = np.cross(backward, right)
    a, b = np.cos(roll), np.sin(roll)
    columns = [a * right + b * up, -b * right + a * up, backward]
    return ExteriorOrientation.from_rotation(np.stack(columns, axis=1), place)


def _extent(field: TestField) -> float:
    return float(np.linalg.norm(np.ptp(field.points, axis=0)))


def _front(field: TestField) -> Array:
    """The direction (3,) from which most of the field is seen best: the mean of its normals, each
    towards the side on which the rest of the field lies.
    """
    normals = field_normals(field)
    known = np.isfinite(normals[:, 0])
    if not known.any():
        _, _, Vt = np.linalg.svd(field.points - field.points.mean(axis=0))
        normals, known = np.broadcast_to(Vt[2], field.points.shape), np.ones(len(field), bool)
    n, p = normals[known], field.points[known]
    side = np.sum((field.points.mean(axis=0) - p) * n, axis=1)
    flat = np.abs(side) < 0.02 * _extent(field)
    # a plane alone tells no side; printed sheets are seen from the positive one
    largest = n[np.arange(len(n)), np.argmax(np.abs(n), axis=1)]
    sign = np.where(flat, np.sign(largest), np.sign(side))
    mean = (n * sign[:, None]).mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 1e-6 else np.asarray(n[0] * sign[0])


def _fits(camera: CameraModel, field: TestField, station: ExteriorOrientation) -> bool:
    # the pinhole decides: a distortion polynomial folds back far outside of the image
    pinhole = CameraModel(camera.sensor, type(camera.interior)(c=camera.interior.c))
    image = pinhole.project(station, field.points)
    if not np.all(np.isfinite(image)):
        return False
    half = camera.sensor.centre * _FILL
    return bool(np.all(np.abs(image - camera.sensor.centre) < half))


def check_field(
    camera: CameraModel,
    field: TestField,
    station: ExteriorOrientation,
    sigma_px: float = 0.03,
) -> FieldCheck:
    """Check a field for a camera at a station; sigma_px: of an image coordinate.

    Raises GeometryError if fewer than four targets are visible.
    """
    rows, hidden, sizes = _visible(camera, field, station)
    if len(rows) < 4:
        reasons = sorted(set(hidden.values()), key=lambda r: -list(hidden.values()).count(r))
        raise GeometryError(
            f"{len(rows)} of {len(field)} targets are visible from there: {'; '.join(reasons)}"
        )
    points, sigmas = field.points[rows], field.sigmas[rows]
    image = camera.project(station, points)
    depth = -((points - station.centre) @ station.rotation)[:, 2]
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    w, h = camera.sensor.width, camera.sensor.height
    cells, _, _ = np.histogram2d(
        image[:, 1], image[:, 0], bins=(CELLS[1], CELLS[0]),
        range=((-0.5, h - 0.5), (-0.5, w - 0.5)),
    )  # fmt: skip
    return FieldCheck(
        camera,
        field,
        station,
        sigma_px,
        visible=rows,
        hidden=hidden,
        sizes=sizes,
        cells=cells.astype(np.int64),
        coverage=image_coverage(camera.sensor, image),
        depth_relief=float(np.ptp(depth) / depth.mean()),
        distance=float(depth.mean()),
        flatness=float(np.ptp(centred @ normal)) / float(depth.mean()),
        precision=precision(camera, station, points, sigmas, sigma_px),
        weak=tuple(_weak(camera, station, points, image, sigma_px)),
    )


def _weak(
    camera: CameraModel, station: ExteriorOrientation, points: Array, image: Array, sigma_px: float
) -> list[str]:
    """The reasons for which `adjust` would give an image of these points no result."""
    A, _ = _partials(camera, station, points)
    N = _normal_matrix(A, _noise(points, sigma_px))
    covariance = np.zeros((len(PARAMETER_NAMES),) * 2)
    # what nothing determines gets a variance that is large, and correlations that are 1
    covariance[np.ix_(_USED, _USED)] = scaled_inverse(N, 1e-13)
    values = np.concatenate([camera.interior.as_array(), station.as_array()])
    return weaknesses(camera.sensor, points, image, values, covariance, FREE, GeometryBounds())


def _visible(
    camera: CameraModel, field: TestField, station: ExteriorOrientation
) -> tuple[NDArray[np.int64], dict[str, str], Array]:
    """Rows that can be measured, reasons for the others, smaller diameters in px of the former."""
    image = camera.project(station, field.points)
    normals, cosine = facing(station.centre, field.points, field_normals(field))
    round_ = np.isfinite(field.diameters)
    radii = np.where(round_, field.diameters, 1.0) / 2
    maps = local_maps(
        camera.sensor, camera.interior.as_array(), station.as_array(), field.points, normals, radii
    )
    good = np.asarray(np.isfinite(maps.linear).all(axis=(1, 2)), dtype=bool)
    minor = np.full(len(field), np.nan)
    minor[good] = 2 * maps.select(good).semi_axes[:, 1]
    reach = np.where(round_[:, None] & good[:, None], maps.half_extent, 0.0)
    half = np.array([camera.sensor.width, camera.sensor.height]) / 2
    inside = np.all(np.abs(image - camera.sensor.centre) + reach < half, axis=1)
    hidden = {}
    for i, name in enumerate(field.names):
        if not np.isfinite(image[i]).all():
            hidden[name] = "behind the camera"
        elif not inside[i]:
            hidden[name] = "outside of the image"
        elif round_[i] and cosine[i] < MAX_TILT_COSINE:
            hidden[name] = "seen edge-on"
        elif round_[i] and minor[i] < MIN_SIZE_PX:
            hidden[name] = f"smaller than {MIN_SIZE_PX:g} px"
    rows = np.array([i for i, name in enumerate(field.names) if name not in hidden], dtype=int)
    return rows, hidden, minor[rows][round_[rows]]


def precision(
    camera: CameraModel,
    station: ExteriorOrientation,
    points: Array,
    sigmas: Array,
    sigma_px: float,
) -> Precision:
    """The standard deviations that targets at points (n, 3) mm with sigmas (n, 3) mm give."""
    A, by_point = _partials(camera, station, points)
    k, noise = len(FREE), _noise(points, sigma_px)
    of_field = (by_point * sigmas[:, None, :] ** 2) @ np.swapaxes(by_point, 1, 2)
    N = _normal_matrix(A, noise)
    return Precision(
        epoch=_sds(N)[:k],
        series=_sds(N[:k, :k]),
        level=_sds(_normal_matrix(A, noise + of_field))[:k],
    )


def _partials(
    camera: CameraModel, station: ExteriorOrientation, points: Array
) -> tuple[Array, Array]:
    """Partials of the image points (n, 2, …) by what is estimated, and by the targets."""
    interior, exterior = camera.interior.as_array(), station.as_array()
    _, by_parameter, by_point = partials(camera.sensor, interior, exterior, points)
    return by_parameter[:, :, _USED], by_point


def _noise(points: Array, sigma_px: float) -> Array:
    return np.broadcast_to(np.eye(2) * sigma_px**2, (len(points), 2, 2))


def _normal_matrix(A: Array, covariance: Array) -> Array:
    N: Array = np.einsum("nia,nij,njb->ab", A, np.linalg.inv(covariance), A)
    return N


def _sds(N: Array) -> Array:
    """Square roots of the diagonal of N⁻¹; inf for parameters in an undetermined direction."""
    scaled, scale = unit_diagonal(N)
    values, vectors = np.linalg.eigh(scaled)
    undetermined = values < 1e-12 * values.max()
    parts = vectors**2 / np.where(undetermined, 1.0, values)
    variance = parts[:, ~undetermined].sum(axis=1)
    lost = (vectors[:, undetermined] ** 2).sum(axis=1) > 1e-6
    result: Array = np.where(lost, np.inf, np.sqrt(variance) * scale)
    return result
