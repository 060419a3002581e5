"""Survey of a test field from photographs: target coordinates with sds from a network.

codes and markers in every photograph ─► their network ─► predicted places of the plain circles ─►
    all targets measured again with known orientations (eccentricity) ─► network of all targets

The nominal field gives names, diameters and approximate coordinates only: a survey is made because
sheets bend by millimetres or were put up askew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.arrays import eight_bit
from thermocald.errors import GeometryError, ImageError
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.field.planes import field_sheets, sheet_normals, target_normals
from thermocald.photogrammetry.field.testfield import Distance, Observations, TestField
from thermocald.photogrammetry.frame.measurement import (
    REPEATED,
    find_repeated,
    predict_circles,
    worth_a_second_look,
)
from thermocald.photogrammetry.network.adjustment import Network, adjust_network, advice
from thermocald.photogrammetry.orientation import Orientation
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.boards import predict_corners
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.corner import measure_corners
from thermocald.photogrammetry.targets.frame_status import inspect_frame
from thermocald.photogrammetry.targets.markers import locate_markers
from thermocald.photogrammetry.targets.outline import LocalMap, find_circles, local_maps
from thermocald.photogrammetry.targets.ring_code import SEARCHES, have_rings, is_ring, read_codes
from thermocald.result import Result, with_sds

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array, Image


_ENOUGH_CODES = 12
_GROSS_PX = 8.0
RingCode = tuple[int, int]
"""Bits and number."""


def measure_codes(image: Image, rows: dict[RingCode, int], grows: bool) -> Observations:
    """Measure the ring-coded targets of an image as ellipses, with the quality `semi_axis` px.

    rows: row of each code; new codes are added if it `grows` and left out otherwise.
    """
    grey = eight_bit(image)
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
    # the fit estimates how the initial outline has to be stretched
    stretch = fit.parameters[:, [[2, 3], [3, 4]]] + np.eye(2)
    outlines = replace(maps, linear=maps.linear @ np.linalg.inv(stretch))
    seen = fit.observations(targets, fit.good)
    order = np.argsort(targets, kind="stable")
    axes = outlines.semi_axes[order, 0][fit.good[order]]
    return replace(seen, quality={**seen.quality, "semi_axis": axes})


_ONE_SIZE = 0.15
_NEAREST = 9  # targets of its sheet, itself included, that give a target's normal


def expected_field(network: Network, nominal: TestField, *, trusted_only: bool) -> TestField:
    """Predict the field: surveyed coordinates, and nominal ones shifted as their neighbours were.

    trusted_only: leave out the targets that the network lacks, which an earlier pass looked for.
    """
    rows = np.array([nominal.index[name] for name in network.names])
    points = nominal.points.copy()
    others = np.setdiff1d(np.arange(len(nominal)), rows)
    known, shifts = nominal.points[rows], network.points - nominal.points[rows]
    # the shifts (n, 3) mm are interpolated by local planes, whose weights are inverse squares of
    # the distance, so that a fold in the paper is preserved
    for row in others:
        x = nominal.points[row]
        d = np.linalg.norm(known - x, axis=1)
        near = np.argsort(d)[:12]
        weight = 1.0 / (d[near] + 1e-3 * d[near].max()) ** 2
        A = np.column_stack([np.ones(len(near)), known[near] - x])
        # the ridge holds slopes at zero that the neighbours do not determine (across a plane)
        AtW = A.T * weight
        ridge = 1e-3 * np.trace(AtW @ A) / 4 * np.diag([0.0, 1, 1, 1])
        points[row] += np.linalg.solve(AtW @ A + ridge, AtW @ shifts[near])[0]
    points[rows] = network.points
    moved = replace(nominal, points=points)
    return moved.subset(np.sort(rows)) if trusted_only else moved


def field_of_codes(
    network: Network, names: Sequence[str], photos: Mapping[str, Observations]
) -> TestField:
    """Return the coded targets of a network as a field.

    photos: as by `measure_codes`, whose targets are rows of `names`. The diameters follow from the
    semi-major axes, by comparison with the image of a disc of 1 mm in the plane of the target's
    neighbours.
    """
    normals = target_normals(network.points)
    ratios: dict[str, list[float]] = {name: [] for name in network.names}
    interior = network.camera.interior.as_array()
    for s in network.stations:
        unit = local_maps(
            network.camera.sensor, interior, s.exterior.as_array(), network.points, normals,
            np.full(len(network.names), 0.5),
        )  # fmt: skip
        of_1_mm = dict(zip(network.names, unit.semi_axes[:, 0].tolist(), strict=True))
        seen = photos[s.photo]
        for row, axis in zip(seen.targets, seen.quality["semi_axis"].tolist(), strict=True):
            if np.isfinite(ratio := axis / of_1_mm.get(names[row], np.nan)):
                ratios[names[row]].append(ratio)
    diameters = np.array([np.median(r) if r else np.nan for r in ratios.values()])
    together = float(np.nanmedian(diameters)) if np.isfinite(diameters).any() else float("nan")
    # sheets are printed with one size: it is assumed where all diameters agree
    if np.nanmax(np.abs(diameters / together - 1), initial=0.0) < _ONE_SIZE:
        diameters[:] = together
    codes = [
        ring_code.write(14 if "-" in name else 12, int(name.rpartition("-")[2].lstrip("R")))
        for name in network.names
    ]
    built = TestField.build(network.names, network.points, 0.0, diameters, codes=codes)
    return surveyed_field(network, built)


def surveyed_field(network: Network, template: TestField) -> TestField:
    """Return the network's targets as a field: the template's with surveyed points and sigmas."""
    order = np.argsort([template.index[name] for name in network.names])
    part = template.subset([template.index[network.names[i]] for i in order])
    shape, scale = network.shape_and_scale()
    sigmas = np.hypot(shape, scale)[order]
    return replace(part, points=network.points[order], sigmas=sigmas, scale=scale[order])


_PASSES = 2


Pictures = Mapping[str, "Callable[[], Image]"]
"""Functions by photograph name that load its grey values (H, W), 8 or 16 bit."""


@dataclass(frozen=True, eq=False, repr=False)
class Survey(Result):
    """The network, the field with surveyed coordinates and sigmas, and for each photograph what was
    measured in it or why nothing was.
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
            "disagreement": n.disagreement,
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
        accuracy = float(f"{1 / n.relative_accuracy:.2g}")
        return [
            (
                f"{len(n.names)} targets from {len(n.stations)} photographs, sigma0 "
                f"{n.sigma0:.2f}, redundancy {n.redundancy}, {len(n.rejected)} image points "
                "rejected"
            ),
            (
                f"  mean standard deviations {mean[0]:.4f}, {mean[1]:.4f}, {mean[2]:.4f} mm in X, "
                f"Y, Z; the scale alone gives {n.sd_scale * n.extent / 2:.4f} mm at the edge, the "
                f"shape is accurate to 1:{accuracy:.0f} of the field"
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
    """Survey a field of coded targets and, given its nominal field, of plain ones.

    distances: measured between targets, they give the scale; pixel_pitch mm; nominal: the field as
    printed, without which only coded targets are surveyed; interior: approximate values, or those
    of a calibrated camera if `free` leaves them out; progress: called with each step's name.
    Raises GeometryError if the photographs do not determine the field, ImageError if they are
    unusable.
    """
    sensor, names, photos, notes = _measure_first(pictures, pixel_pitch, nominal, progress)
    progress("first adjustment")
    of_codes = photos
    known = None if nominal is None else nominal.points
    scale = _first_distances(distances, photos, nominal)
    network = adjust_network(
        sensor, photos, names, scale, interior=interior, nominal=known, free=free
    )
    for number in range(_PASSES):
        # with a nominal field the plain circles are measured in the first pass; the second predicts
        # their outlines from the surveyed planes of their neighbours
        of_field = None
        if nominal is None:
            expected = field_of_codes(network, names, of_codes)
            normals = target_normals(expected.points)
        else:
            expected = expected_field(network, nominal, trusted_only=number > 0)
            rows = [nominal.index[name] for name in expected.names]
            # the nominal field shows best which sheet a target is on, as its sheets are plane
            of_field, labels = nominal.points[rows], field_sheets(nominal)[rows]
            normals = sheet_normals(expected.points, labels, _NEAREST)
            loose = np.isnan(normals[:, 0])
            normals[loose] = target_normals(expected.points)[loose]
        photos = _measure_again(pictures, network, expected, normals, notes, progress)
        if not photos:
            raise GeometryError(
                "no photograph shows the test field in the scale of the measured distances: are "
                "they in mm, and between these targets?"
            )
        progress(f"adjustment {number + 2} of {_PASSES + 1}")
        network = adjust_network(
            sensor, photos, expected.names, distances, interior=network.camera.interior,
            nominal=of_field, free=free, places=expected.points,
        )  # fmt: skip
    stations = {s.photo for s in network.stations}
    left_out = {name: note for name, note in notes.items() if name not in stations}
    network = replace(network, unused=left_out | network.unused)
    return Survey(network, surveyed_field(network, nominal or expected), notes)


def _first_distances(
    distances: Sequence[Distance], photos: Mapping[str, Observations], nominal: TestField | None
) -> Sequence[Distance]:
    """Return a distance of the nominal field, if there is one, for the first adjustment.

    A plain circle, or a code that was not read, is measured only once its place can be predicted,
    which does not depend on the scale.
    """
    if nominal is None or not distances:
        return distances
    unknown = {name for d in distances for name in (d.a, d.b)} - set(nominal.names)
    if unknown:
        raise GeometryError(f"the test field has no target {' and '.join(sorted(unknown))}")
    often = np.flatnonzero(np.bincount(np.concatenate([o.targets for o in photos.values()])) > 2)
    if len(often) < 2:
        return distances
    a, b = int(often[0]), int(often[-1])
    length = float(np.linalg.norm(nominal.points[a] - nominal.points[b]))
    return [Distance(nominal.names[a], nominal.names[b], length, 0.01 * length)]


def _measure_first(
    pictures: Pictures,
    pixel_pitch: float,
    nominal: TestField | None,
    progress: Callable[[str], None],
) -> tuple[Sensor, tuple[str, ...], dict[str, Observations], dict[str, str]]:
    """Measure codes and markers in every photograph.

    Returns the sensor, the names in the order of the observations' target rows, the observations
    by photograph, and a note on each photograph.
    """
    sensor: Sensor | None = None
    seen: dict[str, Observations] = {}
    notes: dict[str, str] = {}
    rows: dict[RingCode, int] = {}
    if nominal is not None:
        rows = {ring_code.parse(c): row for row, c in enumerate(nominal.codes) if is_ring(c)}
    for name, load in pictures.items():
        progress(f"codes in {name}")
        try:
            image = load()
        except ImageError as error:
            notes[name] = str(error).removeprefix(f"{name}: ")
            continue
        expected = None if sensor is None else (sensor.width, sensor.height)
        status = inspect_frame(image, expected)
        if status.word in ("wrong_size", "not_grey", "no_image"):
            raise ImageError(f"{name}: {status.reason}")
        if not status.ok:
            notes[name] = status.reason
            continue
        sensor = sensor or Sensor(image.shape[1], image.shape[0], pixel_pitch)
        found = measure_codes(image, rows, grows=nominal is None)
        if nominal is not None:
            found = measure_corners(image, locate_markers(image, nominal, {}), {}).joined(found)
        notes[name] = f"{len(found)} coded targets"
        if len(found):
            seen[name] = found
    if sensor is None or not seen:
        raise ImageError(
            "no photograph shows a coded target: "
            + "; ".join(f"{name}: {note}" for name, note in notes.items())
        )
    # names from which `field_of_codes` reads the codes
    new = (f"R{number}" if bits == 12 else f"R14-{number}" for bits, number in rows)
    names = tuple(new) if nominal is None else nominal.names
    return sensor, names, seen, notes


def _measure_again(
    pictures: Pictures,
    network: Network,
    expected: TestField,
    normals: Array,
    notes: dict[str, str],
    progress: Callable[[str], None],
) -> dict[str, Observations]:
    """Measure every target in the oriented photographs, corrected for eccentricity.

    normals (n, 3): NaN where unknown. Adds to `notes`. A circle more than some pixels from its
    predicted place is another one and is left out.
    """
    stations, photos = {s.photo: s for s in network.stations}, dict[str, Observations]()
    for name, load in pictures.items():
        if name not in stations:
            continue
        progress(f"targets in {name}")
        image = load()
        camera, exterior, missed = network.camera, stations[name].exterior, dict[int, str]()
        markers = locate_markers(image, expected, missed)
        corners = measure_corners(image, markers, missed)
        off = corners.points - camera.project(exterior, expected.points[corners.targets])
        corners = corners.select(np.linalg.norm(off, axis=1) < _GROSS_PX)
        again = np.setdiff1d(worth_a_second_look(expected, missed), corners.targets)
        there = Orientation(camera, exterior, off)
        places = predict_corners(expected, again.tolist(), there, markers)
        corners = corners.joined(measure_corners(image, places, {}))
        rows, maps = predict_circles(expected, camera, exterior, normals)
        fit = fit_circles(image, maps, have_rings(expected, rows))
        off = np.linalg.norm(fit.points - maps.centre, axis=1)
        seen = corners.joined(fit.observations(rows, fit.good & (off < _GROSS_PX)))
        notes[name] = f"{len(seen)} targets"
        if same := find_repeated(seen, photos):
            notes[name] = REPEATED.format(Path(same).name)
        elif len(seen):
            photos[name] = seen
    return photos
