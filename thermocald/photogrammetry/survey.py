"""A test field surveyed from photographs: what they show, their network, coordinates with sds.

codes and markers in every photograph ─► network of them ─► where the plain circles must be ─►
    everything measured once more with known orientations (eccentricity) ─► network of everything

What the nominal field says is used for names, diameters, and as a first guess only: sheets that
bend by millimetres or were put up askew are what a survey is for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import GeometryError, ImageError
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.field.testfield import (
    Distance,
    Observations,
    TestField,
    field_sheets,
    sheet_normals,
    target_normals,
)
from thermocald.photogrammetry.frame.measurement import predict_circles
from thermocald.photogrammetry.network.adjustment import Network, adjust_network, advice
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.corner import measure_corners
from thermocald.photogrammetry.targets.frame_status import inspect_frame
from thermocald.photogrammetry.targets.markers import locate_markers, to_8_bit
from thermocald.photogrammetry.targets.outline import LocalMap, find_circles, local_maps
from thermocald.photogrammetry.targets.ring_code import SEARCHES, have_rings, is_ring, read_codes
from thermocald.result import with_sds

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array, Image


_ENOUGH_CODES = 12
_GROSS_PX = 8.0
RingCode = tuple[int, int]
"""Bits and number."""


def codes_in(
    image: Image, rows: dict[RingCode, int], grows: bool
) -> tuple[Observations, dict[int, float]]:
    """Measure the ring-coded targets of an image as ellipses; also their semi-major axes in px.

    rows: of the codes, which gets those that are new if it `grows`; else they are left out.
    """
    grey = to_8_bit(image)
    maps, best = LocalMap.none(), dict[RingCode, int]()
    for scale, polarity in SEARCHES if grows or rows else ():
        candidates = find_circles(grey, scale, polarity)
        found = read_codes(grey, candidates, polarity)
        found = {code: place for code, place in found.items() if grows or code in rows}
        if len(found) > len(best):
            maps, best = candidates.select(np.array(list(found.values()))), found
        if len(found) >= _ENOUGH_CODES:
            break
    targets = np.array([rows.setdefault(code, len(rows)) for code in best], dtype=np.int64)
    fit = fit_circles(image, maps, np.ones(len(targets), dtype=bool))
    # the fit says how the outline that it began with is to be stretched
    m11, m12, m22 = fit.parameters[:, 2:5].T
    stretch = np.stack([1 + m11, m12, m12, 1 + m22], axis=-1).reshape(-1, 2, 2)
    outlines = replace(maps, linear=maps.linear @ np.linalg.inv(stretch))
    axes = outlines.semi_axes[:, 0]
    good = fit.good
    return (
        fit.observations(targets, good),
        dict(zip(targets[good].tolist(), axes[good].tolist(), strict=True)),
    )


_ONE_SIZE = 0.15
_NEAREST = 9  # of a target on its sheet, with itself


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
    moved = replace(nominal, points=points)
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


def field_of_codes(network: Network, radii: Mapping[tuple[str, str], float]) -> TestField:
    """Return the coded targets of a network as a field.

    radii: semi-major axes px by photograph and target, from which the diameters are found: what a
    disc of 1 mm would measure there, lying as its neighbours do.
    """
    normals = target_normals(network.points)
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
    codes = [
        ring_code.write(14 if "-" in name else 12, int(name.rpartition("-")[2].lstrip("R")))
        for name in network.names
    ]
    return TestField.build(network.names, network.points, network.sigmas, diameters, codes=codes)


def surveyed_field(network: Network, template: TestField) -> TestField:
    """The field of the network's targets: coordinates and sigmas surveyed, the rest as it was."""
    order = np.argsort([template.index[name] for name in network.names])
    part = template.subset([template.index[network.names[i]] for i in order])
    return replace(part, points=network.points[order], sigmas=network.sigmas[order])


_PASSES = 2


Pictures = Mapping[str, "Callable[[], Image]"]
"""Photographs by name that can be loaded: grey values (H, W), 8 or 16 bit."""


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
        targets = [
            {
                "target": name,
                **with_sds("XYZ", n.points[i], n.sigmas[i]),
                "covariance": n.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3],
                "rays": int(n.n_rays[i]),
                "angle_deg": float(np.degrees(n.angles[i])),
            }
            for i, name in enumerate(n.names)
        ]
        iop_sd = np.sqrt(n.interior_covariance.diagonal()[: len(IOP_NAMES)])
        interior = with_sds(IOP_NAMES, n.camera.interior.as_array(), iop_sd)
        stations = [
            {
                "photo": s.photo,
                "targets": s.n_targets,
                **asdict(s.exterior),
                **with_sds(EOP_NAMES[3:], s.exterior.centre, s.sd_centre),
            }
            for s in n.stations
        ]
        return {
            "format": "thermocald-survey/1",
            "datum": n.datum,
            "sigma0": n.sigma0,
            "redundancy": n.redundancy,
            "relative_accuracy": n.relative_accuracy,
            "sd_scale": n.sd_scale,
            "camera": {**asdict(n.camera.sensor), "free": list(n.free), **interior},
            "targets": targets,
            "stations": stations,
            "rejected": n.rejected,
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
    pictures: Pictures,
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
    sensor, names, photos, sizes, said = _first_look(pictures, pixel_pitch, nominal, progress)
    progress("first adjustment")
    known = None if nominal is None else nominal.points
    scale = _provisional(distances, photos, names, nominal)
    network = adjust_network(
        sensor, photos, names, scale, interior=interior, nominal=known, free=free
    )
    for number in range(_PASSES):
        # with the nominal field the plain circles come in the first pass, and take part in the
        # second with outlines that know how their neighbours lie
        of_field = None
        if nominal is None:
            expected = field_of_codes(network, sizes)
            normals = target_normals(expected.points)
        else:
            expected = expected_field(network, nominal, trusted_only=number > 0)
            rows = [nominal.index[name] for name in expected.names]
            # the nominal field knows best which sheet a target is on: its sheets are plane
            of_field, labels = nominal.points[rows], field_sheets(nominal)[rows]
            normals = sheet_normals(expected.points, labels, _NEAREST)
        photos = _look_again(pictures, network, expected, normals, said, progress)
        progress(f"adjustment {number + 2} of {_PASSES + 1}")
        # targets that the network does not have begin where they are expected
        start = replace(network, names=expected.names, points=expected.points)
        network = adjust_network(
            sensor, photos, expected.names, distances, free=free, start=start, nominal=of_field
        )
    template = expected if nominal is None else nominal
    return Survey(network, surveyed_field(network, template), said)


def _provisional(
    distances: Sequence[Distance],
    photos: Mapping[str, Observations],
    names: Sequence[str],
    nominal: TestField | None,
) -> Sequence[Distance]:
    """The distances whose ends have been found so far; if none, one of the nominal field's.

    A plain circle or a code that was not read turns up only when it is known where to look.
    """
    seen = np.zeros(len(names), dtype=int)
    for shown in photos.values():
        seen[shown.targets] += 1
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
    pictures: Pictures,
    pixel_pitch: float,
    nominal: TestField | None,
    progress: Callable[[str], None],
) -> tuple[
    Sensor, tuple[str, ...], dict[str, Observations], dict[tuple[str, str], float], dict[str, str]
]:
    """Measure codes and markers in every photograph; return the names that the targets' rows count,
    the targets' sizes in px, and what went wrong.
    """
    sensor: Sensor | None = None
    seen: dict[str, Observations] = {}
    sizes: dict[tuple[str, int], float] = {}
    said: dict[str, str] = {}
    rows: dict[RingCode, int] = {}
    if nominal is not None:
        rows = {ring_code.parse(c): row for row, c in enumerate(nominal.codes) if is_ring(c)}
    for name, load in pictures.items():
        progress(f"codes in {name}")
        image = load()
        expected = None if sensor is None else (sensor.width, sensor.height)
        status = inspect_frame(image, expected)
        if status.word in ("wrong_size", "not_grey", "no_image"):
            raise ImageError(f"{name}: {status.reason}")
        if not status.ok:
            said[name] = status.reason
            continue
        sensor = sensor or Sensor(image.shape[1], image.shape[0], pixel_pitch)
        found, radii = codes_in(image, rows, grows=nominal is None)
        sizes.update({(name, row): radius for row, radius in radii.items()})
        if nominal is not None:
            found = measure_corners(image, locate_markers(image, nominal)).joined(found)
        said[name] = f"{len(found)} coded targets"
        if len(found):
            seen[name] = found
    if sensor is None or not seen:
        raise ImageError(
            "no photograph shows a coded target: "
            + "; ".join(f"{name}: {words}" for name, words in said.items())
        )
    # what `field_of_codes` reads the codes from
    new = (f"R{number}" if bits == 12 else f"R14-{number}" for bits, number in rows)
    names = tuple(new) if nominal is None else nominal.names
    named = {(photo, names[row]): radius for (photo, row), radius in sizes.items()}
    return sensor, names, seen, named, said


def _look_again(
    pictures: Pictures,
    network: Network,
    expected: TestField,
    normals: Array,
    said: dict[str, str],
    progress: Callable[[str], None],
) -> dict[str, Observations]:
    """Measure every target in the oriented photographs, eccentricity included.

    normals (n, 3), NaN where unknown. A circle that is not within some pixels of its place is
    another one and is left out.
    """
    stations, photos = {s.photo: s for s in network.stations}, {}
    for name, load in pictures.items():
        if name not in stations:
            continue
        progress(f"targets in {name}")
        image = load()
        corners = measure_corners(image, locate_markers(image, expected))
        rows, maps = predict_circles(expected, network.camera, stations[name].exterior, normals)
        fit = fit_circles(image, maps, have_rings(expected, rows))
        off = np.linalg.norm(fit.points - maps.centre, axis=1)
        seen = corners.joined(fit.observations(rows, fit.good & (off < _GROSS_PX)))
        said[name] = f"{len(seen)} targets"
        if len(seen):
            photos[name] = seen
    return photos
