"""A test field surveyed from photographs: what they show, their network, coordinates with sds.

codes and markers in every photograph ─► network of them ─► where the plain circles must be ─►
    everything measured once more with known orientations (eccentricity) ─► network of everything

What the nominal field says is used for names, diameters, and as a first guess only: sheets that
bend by millimetres or were put up askew are what a survey is for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import GeometryError, ImageError
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.field.planes import target_normals
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.frame.measurement import circle_observations
from thermocald.photogrammetry.network.adjustment import Network, Photo, adjust_network, advice
from thermocald.photogrammetry.network.datum import Distance
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.frame_status import inspect_frame
from thermocald.photogrammetry.targets.image_file import decode_grey
from thermocald.photogrammetry.targets.markers import locate_markers, measure_corners, to_8_bit
from thermocald.photogrammetry.targets.outline import LocalMap, find_circles, local_maps
from thermocald.photogrammetry.targets.ring_code import read_codes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image


# Scale and polarity (-1 dark on light) in which codes are looked for, until so many are found.
_SEARCHES = ((2, -1), (2, 1), (1, -1), (1, 1))
_ENOUGH_CODES = 12
_LARGEST_TILT_COSINE = 0.2
_GROSS_PX = 8.0


@dataclass(slots=True)
class Codes:
    """Codes as they turn up: names and rows, fixed from the beginning where a field is given."""

    rows: dict[tuple[int, int], int]
    names: list[str]
    grows: bool

    @property
    def known(self) -> frozenset[tuple[int, int]] | None:
        """The codes that may occur, None for all."""
        return None if self.grows else frozenset(self.rows)

    def by_name(self) -> dict[str, str]:
        """The codes of the targets that have one."""
        return {self.names[row]: ring_code.write(*key) for key, row in self.rows.items()}

    def row(self, bits: int, number: int) -> int | None:
        """The row of a code, a new one if the field is not given; None for a foreign one."""
        key = (bits, number)
        if key not in self.rows and self.grows:
            self.rows[key] = len(self.names)
            self.names.append(f"R{number}" if bits == 12 else f"R14-{number}")
        return self.rows.get(key)


def known_codes(nominal: TestField | None) -> Codes:
    """The codes of a field, or none yet if there is no field."""
    if nominal is None:
        return Codes({}, [], grows=True)
    rows = {
        ring_code.parse(code): row
        for row, code in enumerate(nominal.codes)
        if ring_code.is_ring(code)
    }
    return Codes(rows, list(nominal.names), grows=False)


def codes_in(image: Image, codes: Codes) -> tuple[Observations, dict[int, float]]:
    """The ring-coded targets of an image, measured as ellipses, and their semi-major axes in px."""
    grey = to_8_bit(image)
    best = None
    for scale, polarity in _SEARCHES if codes.grows or codes.rows else ():
        candidates = find_circles(grey, scale, polarity)
        found = read_codes(grey, candidates, codes.known)
        if best is None or len(found) > len(best[1]):
            best = candidates.maps, found
        if len(found) >= _ENOUGH_CODES:
            break
    kept: list[tuple[int, int]] = []
    maps = LocalMap(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2, 3)))
    if best is not None:
        maps, found = best
        numbered = [
            (codes.row(int(bits), int(number)), int(place))
            for bits, number, place in zip(found.bits, found.numbers, found.rows, strict=True)
        ]
        kept = [(row, place) for row, place in numbered if row is not None]
        maps = maps.select(np.array([place for _, place in kept], dtype=np.int64))
    rows = np.array([row for row, _ in kept], dtype=np.int64)
    fit = fit_circles(image, maps, np.ones(len(rows), dtype=bool))
    # the fit says how the outline that it began with is to be stretched
    m11, m12, m22 = fit.parameters[:, 2:5].T
    stretch = np.stack([1 + m11, m12, m12, 1 + m22], axis=-1).reshape(-1, 2, 2)
    outlines = LocalMap(maps.centre, maps.linear @ np.linalg.inv(stretch), maps.second)
    axes = outlines.semi_axes[:, 0] if len(rows) else np.zeros(0)
    return (
        circle_observations(rows, fit, fit.good),
        {int(r): float(a) for r, a, good in zip(rows, axes, fit.good, strict=True) if good},
    )


def targets_in(
    image: Image,
    field: TestField,
    normals: Array,
    camera: CameraModel,
    exterior: ExteriorOrientation,
) -> Observations:
    """Every target of a field in a photograph of known orientation, eccentricity included.

    normals (n, 3), NaN where unknown: such a circle is taken as facing the camera. A circle that is
    not within some pixels of its place is another one and is left out.
    """
    corners = measure_corners(image, locate_markers(image, field))
    rows = np.flatnonzero(field.circles & np.isfinite(field.diameters))
    points = field.points[rows]
    view = exterior.centre - points
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    n = np.where(np.isfinite(normals[rows]), normals[rows], view)
    maps = local_maps(
        camera.sensor, camera.interior.as_array(), exterior.as_array(), points, n,
        field.diameters[rows] / 2,
    )  # fmt: skip
    seen = (
        np.isfinite(maps.linear).all(axis=(1, 2))
        & np.isfinite(maps.second).all(axis=(1, 2))
        & camera.sensor.contains(np.nan_to_num(maps.centre, nan=-1e9))
        & (np.abs(np.sum(view * n, axis=1)) > _LARGEST_TILT_COSINE)
    )
    rows, maps = rows[seen], maps.select(seen)
    coded = ring_code.have_rings(field, rows)
    fit = fit_circles(image, maps, coded)
    off = np.linalg.norm(fit.points - maps.centre, axis=1)
    return corners.joined(circle_observations(rows, fit, fit.good & (off < _GROSS_PX)))


_ONE_SIZE = 0.15
_NEIGHBOURS = 8
_SAME_SHEET_COSINE = 0.97  # between the normals of neighbours on one sheet, which may be bent
_SAME_SHEET_STEP = 0.1  # of their distance: how far one may lie off the other's plane


def sheet_labels(points: Array) -> NDArray[np.int64]:
    """The sheet (n,) that each target at points (n, 3) mm belongs to, -1 for none.

    Sheets grow from neighbour to neighbour, so one may be bent, and two may meet in a corner.
    """
    normals = target_normals(points)
    labels = np.full(len(points), -1)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = np.argsort(distance, axis=1)[:, 1 : _NEIGHBOURS + 1]
    step = np.abs(np.einsum("njk,nk->nj", points[near] - points[:, None], normals))
    alike = np.abs(np.einsum("njk,nk->nj", normals[near], normals)) > _SAME_SHEET_COSINE
    linked = alike & (step < _SAME_SHEET_STEP * np.take_along_axis(distance, near, axis=1))
    for first in range(len(points)):
        if labels[first] >= 0 or not np.isfinite(normals[first, 0]):
            continue
        labels[first] = labels.max() + 1
        waiting = [first]
        while waiting:
            row = waiting.pop()
            for other in near[row, linked[row]]:
                if labels[other] < 0:
                    labels[other] = labels[first]
                    waiting.append(int(other))
    # what has found no plane of its own belongs to its nearest neighbour's, if it lies in it
    placed = labels >= 0
    for lost in np.flatnonzero(~placed) if placed.any() else ():
        nearest = int(np.argmin(np.where(placed, distance[lost], np.inf)))
        off = abs(float((points[lost] - points[nearest]) @ normals[nearest]))
        if off < _SAME_SHEET_STEP * distance[lost, nearest]:
            labels[lost] = labels[nearest]
    return labels


def sheet_normals(points: Array, labels: NDArray[np.int64]) -> Array:
    """Unit normals (n, 3), of either sign, of targets by their nearest on the same sheet; NaN for
    those on none.
    """
    normals = np.full((len(points), 3), np.nan)
    for label in np.unique(labels[labels >= 0]):
        rows = np.flatnonzero(labels == label)
        if len(rows) < 4:
            continue
        whole = np.linalg.svd(points[rows] - points[rows].mean(axis=0))[2][2]
        for row in rows:
            order = np.argsort(np.linalg.norm(points[rows] - points[row], axis=1))
            near = points[rows[order[: _NEIGHBOURS + 1]]]
            _, size, axes = np.linalg.svd(near - near.mean(axis=0))
            # a single line of targets does not say how the paper is turned about it
            normals[row] = axes[2] if size[1] > 0.1 * size[0] else whole
    return normals


def expected_field(network: Network, nominal: TestField, *, trusted_only: bool) -> TestField:
    """The nominal field where the network has put it: surveyed coordinates, and for all others the
    nominal ones, moved as their surveyed neighbours were.

    trusted_only leaves out what an earlier pass should have found and did not.
    """
    rows = np.array([nominal.index[name] for name in network.names])
    points = nominal.points.copy()
    others = np.setdiff1d(np.arange(len(nominal)), rows)
    if len(others):
        points[others] += _neighbours_shift(
            nominal.points[rows], network.points - nominal.points[rows], nominal.points[others]
        )
    points[rows] = network.points
    moved = TestField.build(
        nominal.names, points, nominal.sigmas, nominal.diameters, nominal.kinds, nominal.codes
    )
    return moved.subset(np.sort(rows)) if trusted_only else moved


def _neighbours_shift(known: Array, shifts: Array, wanted: Array) -> Array:
    """The shifts (n, 3) mm at points between known ones: a local plane through the nearest.

    Weighted by the inverse square of the distance, so that a fold in the paper stays one.
    """
    result = np.empty((len(wanted), 3))
    for i, x in enumerate(wanted):
        d = np.linalg.norm(known - x, axis=1)
        near = np.argsort(d)[:12]
        weight = 1.0 / (d[near] + 1e-3 * d[near].max()) ** 2
        A = np.column_stack([np.ones(len(near)), known[near] - x])
        # the ridge keeps slopes that the neighbours do not show (across a plane) at zero
        AtW = A.T * weight
        ridge = 1e-3 * np.trace(AtW @ A) / 4 * np.diag([0.0, 1, 1, 1])
        result[i] = np.linalg.solve(AtW @ A + ridge, AtW @ shifts[near])[0]
    return result


def field_of_codes(
    network: Network, codes: Mapping[str, str], radii: Mapping[tuple[str, str], float]
) -> TestField:
    """The coded targets of a network as a field.

    codes: by target; radii: semi-major axes px by photograph and target, from which the diameters
    are found: what a disc of 1 mm would measure there, lying as its neighbours do.
    """
    normals = sheet_normals(network.points, sheet_labels(network.points))
    ratios: dict[str, list[float]] = {name: [] for name in network.names}
    interior = network.camera.interior.as_array()
    for s in network.stations:
        unit = local_maps(
            network.camera.sensor, interior, s.exterior.as_array(), network.points, normals,
            np.full(len(network.names), 0.5),
        )  # fmt: skip
        known = np.asarray(np.isfinite(unit.linear).all(axis=(1, 2)), dtype=bool)
        for i, name in enumerate(network.names):
            if (s.photo, name) in radii and known[i]:
                axis = float(np.linalg.svd(unit.linear[i], compute_uv=False)[0])
                ratios[name].append(radii[s.photo, name] / axis)
    diameters = np.array([np.median(r) if r else np.nan for r in ratios.values()])
    together = float(np.nanmedian(diameters)) if np.isfinite(diameters).any() else float("nan")
    # one size for all where all agree, which is as they are printed
    if np.nanmax(np.abs(diameters / together - 1), initial=0.0) < _ONE_SIZE:
        diameters[:] = together
    return TestField.build(
        network.names, network.points, network.sigmas, diameters,
        codes=[codes[name] for name in network.names],
    )  # fmt: skip


def surveyed_field(network: Network, template: TestField) -> TestField:
    """The field of the network's targets: coordinates and sigmas surveyed, the rest as it was."""
    order = np.argsort([template.index[name] for name in network.names])
    rows = [template.index[network.names[i]] for i in order]
    part = template.subset(rows)
    return TestField.build(
        part.names, network.points[order], network.sigmas[order], part.diameters, part.kinds,
        part.codes,
    )  # fmt: skip


_PASSES = 2


@dataclass(frozen=True, slots=True)
class Picture:
    """A photograph that can be loaded: `load()` gives its grey values (H, W), 8 or 16 bit."""

    name: str
    load: Callable[[], Image]


def picture_of(path: Path) -> Picture:
    """Return a picture that is read when it is needed, as the sensor saw it."""
    return Picture(str(path), lambda: decode_grey(path))


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """A surveyed field: the network, the field with the surveyed coordinates and sigmas, and per
    photograph what was measured in it or why nothing was.
    """

    network: Network
    field: TestField
    measured: dict[str, str]

    def as_dict(self) -> dict[str, Any]:
        """Return the document that `testfield survey` writes with `--json`."""
        n = self.network
        targets = []
        for i, name in enumerate(n.names):
            row: dict[str, Any] = {"target": name}
            for axis, letter in enumerate("XYZ"):
                row[letter] = float(n.points[i, axis])
                row[f"sd_{letter}"] = float(n.sigmas[i, axis])
            row |= {
                "covariance": n.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3],
                "rays": int(n.n_rays[i]),
                "angle_deg": float(np.degrees(n.angles[i])),
            }
            targets.append(row)
        interior: dict[str, float] = {}
        for k, name in enumerate(IOP_NAMES):
            interior[name] = float(getattr(n.camera.interior, name))
            interior[f"sd_{name}"] = float(n.interior_covariance[k, k] ** 0.5)
        stations = [
            {
                "photo": s.photo,
                "targets": s.n_targets,
                **{k: float(v) for k, v in zip(EOP_NAMES, s.exterior.as_array(), strict=True)},
                **{f"sd_{k}": v for k, v in zip(EOP_NAMES[3:], s.sd_centre, strict=True)},
            }
            for s in n.stations
        ]
        sensor = n.camera.sensor
        return {
            "format": "thermocald-survey/1",
            "datum": n.datum,
            "sigma0": n.sigma0,
            "redundancy": n.redundancy,
            "relative_accuracy": n.relative_accuracy,
            "sd_scale": n.sd_scale,
            "camera": {
                "width": sensor.width, "height": sensor.height, "pixel_pitch": sensor.pixel_pitch,
                "free": list(n.free), **interior,
            },
            "targets": targets,
            "stations": stations,
            "rejected": [
                {"photo": r.photo, "target": r.target, "residual_px": r.residual, "test": r.test}
                for r in n.rejected
            ],
            "unused": n.unused,
            "measured": self.measured,
            "advice": advice(n),
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return the lines that `testfield survey` prints."""
        n = self.network
        mean = (n.sigmas**2).mean(axis=0) ** 0.5
        return [
            (
                f"{len(n.names)} targets from {len(n.stations)} photographs, sigma0 "
                f"{n.sigma0:.2f}, redundancy {n.redundancy}, {len(n.rejected)} image points "
                "rejected"
            ),
            (
                f"  mean standard deviations {mean[0]:.4f}, {mean[1]:.4f}, {mean[2]:.4f} mm in X, "
                f"Y, Z; the scale alone makes {n.sd_scale * n.extent / 2:.4f} mm at the edge, the "
                f"shape is good to 1:{1 / n.relative_accuracy:.0f} of the field"
            ),
            f"  datum: {n.datum}",
            *(f"  left out: {name}: {reason}" for name, reason in n.unused.items()),
            *(f"  better: {note}" for note in advice(n)),
        ]


def survey(
    pictures: Sequence[Picture],
    distances: Sequence[Distance],
    pixel_pitch: float,
    *,
    nominal: TestField | None = None,
    interior: InteriorOrientation | None = None,
    free: Sequence[str] = IOP_NAMES,
    progress: Callable[[str], None] = lambda _: None,
) -> Survey:
    """Survey a field of coded targets, and of the plain ones of its nominal field.

    distances: measured ones, they give the scale; pixel_pitch mm; nominal: the field as printed;
    without it the coded targets alone are surveyed; interior: approximate values, or those of a
    calibrated camera if `free` leaves them out; progress: told what is being done.
    Raises GeometryError if the photographs cannot carry it, ImageError if they are unusable.
    """
    codes = known_codes(nominal)
    sensor, photos, sizes, said = _first_look(pictures, pixel_pitch, nominal, codes, progress)
    progress("first adjustment")
    names = tuple(codes.names)
    known = None if nominal is None else nominal.points
    scale = _provisional(distances, photos, names, nominal)
    network = adjust_network(
        sensor, photos, names, scale, interior=interior, nominal=known, free=free
    )
    for number in range(_PASSES):
        # with the nominal field the plain circles come in the first pass, and take part in the
        # second with outlines that know how their neighbours lie
        if nominal is None:
            expected = field_of_codes(network, codes.by_name(), sizes)
        else:
            expected = expected_field(network, nominal, trusted_only=number > 0)
        normals = sheet_normals(expected.points, _sheets(expected, nominal))
        photos = _look_again(pictures, network, expected, normals, said, progress)
        progress(f"adjustment {number + 2} of {_PASSES + 1}")
        network = adjust_network(
            sensor, photos, expected.names, distances, free=free, start=_renamed(network, expected),
            nominal=None if nominal is None else _nominal_points(expected, nominal),
        )  # fmt: skip
    template = expected if nominal is None else nominal
    return Survey(network, surveyed_field(network, template), said)


def _nominal_points(field: TestField, nominal: TestField) -> Array:
    points: Array = nominal.points[[nominal.index[name] for name in field.names]]
    return points


def _sheets(field: TestField, nominal: TestField | None) -> NDArray[np.int64]:
    """On which sheet each target is; the nominal field knows best, its sheets are still plane."""
    if nominal is None:
        return sheet_labels(field.points)
    return sheet_labels(nominal.points)[[nominal.index[name] for name in field.names]]


def _provisional(
    distances: Sequence[Distance],
    photos: Sequence[Photo],
    names: Sequence[str],
    nominal: TestField | None,
) -> Sequence[Distance]:
    """The distances whose ends have been found so far; if none, one of the nominal field's.

    A plain circle or a code that was not read turns up only when it is known where to look.
    """
    seen = np.zeros(len(names), dtype=int)
    for photo in photos:
        seen[photo.observations.targets] += 1
    often = {names[int(row)] for row in np.flatnonzero(seen > 2)}
    found = [d for d in distances if d.a in often and d.b in often]
    if found or nominal is None or len(often) < 2 or not distances:
        return found or distances
    unknown = {name for d in distances for name in (d.a, d.b)} - set(names)
    if unknown:
        raise GeometryError(f"the test field has no target {' and '.join(sorted(unknown))}")
    rows = [nominal.index[name] for name in sorted(often)]
    first = rows[0]
    reach = np.linalg.norm(nominal.points[rows] - nominal.points[first], axis=1)
    last = rows[int(np.argmax(reach))]
    length = float(reach.max())
    return [Distance(names[first], names[last], length, 0.01 * length)]


def _first_look(
    pictures: Sequence[Picture],
    pixel_pitch: float,
    nominal: TestField | None,
    codes: Codes,
    progress: Callable[[str], None],
) -> tuple[Sensor, list[Photo], dict[tuple[str, str], float], dict[str, str]]:
    """Codes and markers in every photograph, the targets' sizes in px, and what went wrong."""
    sensor: Sensor | None = None
    photos: list[Photo] = []
    sizes: dict[tuple[str, str], float] = {}
    said: dict[str, str] = {}
    for picture in pictures:
        progress(f"codes in {picture.name}")
        image = picture.load()
        expected = None if sensor is None else (sensor.width, sensor.height)
        status = inspect_frame(image, expected)
        if status.word in ("wrong_size", "not_grey", "no_image"):
            raise ImageError(f"{picture.name}: {status.reason}")
        if not status.ok:
            said[picture.name] = status.reason
            continue
        sensor = sensor or Sensor(image.shape[1], image.shape[0], pixel_pitch)
        seen, radii = codes_in(image, codes)
        if nominal is not None:
            seen = measure_corners(image, locate_markers(image, nominal)).joined(seen)
        sizes.update({(picture.name, codes.names[row]): radii[row] for row in radii})
        said[picture.name] = f"{len(seen)} coded targets"
        if len(seen):
            photos.append(Photo(picture.name, seen))
    if sensor is None or not photos:
        raise ImageError(
            "no photograph shows a coded target: "
            + "; ".join(f"{name}: {words}" for name, words in said.items())
        )
    return sensor, photos, sizes, said


def _look_again(
    pictures: Sequence[Picture],
    network: Network,
    expected: TestField,
    normals: Array,
    said: dict[str, str],
    progress: Callable[[str], None],
) -> list[Photo]:
    """Every oriented photograph measured with what is known of it."""
    stations = {s.photo: s for s in network.stations}
    photos = []
    for picture in pictures:
        if picture.name not in stations:
            continue
        progress(f"targets in {picture.name}")
        seen = targets_in(
            picture.load(), expected, normals, network.camera, stations[picture.name].exterior
        )
        said[picture.name] = f"{len(seen)} targets"
        if len(seen):
            photos.append(Photo(picture.name, seen))
    return photos


def _renamed(network: Network, expected: TestField) -> Network:
    """The network as a start for photographs whose targets count the rows of another field.

    Targets that it does not have begin where they are expected.
    """
    return replace(network, names=expected.names, points=expected.points)
