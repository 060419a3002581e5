"""The survey of a test field: from photographs of it to its coordinates.

    codes and markers in every photograph ─► network of them ─► where the plain circles must be ─►
    everything measured once more with known orientations (eccentricity) ─► network of everything

What the nominal field says is used for names, diameters, and as a first guess only: sheets that
bend by millimetres or were put up askew are what a survey is for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError, ImageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.photogrammetry.network.adjustment import Distance, Network, Photo, adjust_network
from thermocald.photogrammetry.survey.field import (
    expected_field,
    field_of_codes,
    sheet_labels,
    sheet_normals,
    surveyed_field,
)
from thermocald.photogrammetry.survey.look import Codes, codes_in, known_codes, targets_in
from thermocald.photogrammetry.targets.frame_status import inspect_frame
from thermocald.photogrammetry.targets.markers import locate_markers, measure_corners

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image
    from thermocald.photogrammetry.camera.camera_model import InteriorOrientation
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["Picture", "Survey", "survey"]

_PASSES = 2


@dataclass(frozen=True, slots=True)
class Picture:
    """A photograph that can be loaded: `load()` gives its grey values (H, W), 8 or 16 bit."""

    name: str
    load: Callable[[], Image]


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """A surveyed field: the network, the field with the surveyed coordinates and sigmas, and per
    photograph what was measured in it or why nothing was.
    """

    network: Network
    field: TestField
    measured: dict[str, str]


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
