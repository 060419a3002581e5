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
from thermocald.photogrammetry import ring_code
from thermocald.photogrammetry.camera_model import IOP_NAMES, Sensor
from thermocald.photogrammetry.circle import fit_circles
from thermocald.photogrammetry.detection import find_circles
from thermocald.photogrammetry.frame_status import inspect_frame
from thermocald.photogrammetry.markers import locate_markers, measure_corners, to_8_bit
from thermocald.photogrammetry.measurement import Prior, circle_observations, join, measure
from thermocald.photogrammetry.network import Distance, Network, Photo, adjust_network
from thermocald.photogrammetry.outline import LocalMap
from thermocald.photogrammetry.ring_reading import read_codes
from thermocald.photogrammetry.survey_field import expected_field, field_of_codes, surveyed_field

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera_model import InteriorOrientation
    from thermocald.photogrammetry.testfield import Observations, TestField

    Array = NDArray[np.float64]
    Image = NDArray[np.uint8] | NDArray[np.uint16]

__all__ = ["Picture", "Survey", "survey"]

# Scale and ink (-1 dark on light) in which codes are looked for, until so many are found.
_SEARCHES = ((2, -1), (2, 1), (1, -1), (1, 1))
_ENOUGH_CODES = 12
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


@dataclass(slots=True)
class _Codes:
    """Codes as they turn up: names and rows, fixed from the beginning where a field is given."""

    rows: dict[tuple[int, int], int]
    names: list[str]
    grows: bool

    def families(self) -> tuple[int, ...]:
        """The numbers of bits that occur."""
        return ring_code.BITS if self.grows else tuple(sorted({bits for bits, _ in self.rows}))

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
    codes = _known_codes(nominal)
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
        photos = _look_again(pictures, network, expected, said, progress)
        progress(f"adjustment {number + 2} of {_PASSES + 1}")
        network = adjust_network(
            sensor, photos, expected.names, distances, free=free, start=_renamed(network, expected),
            nominal=None if nominal is None else nominal.points,
        )  # fmt: skip
    template = expected if nominal is None else nominal
    return Survey(network, surveyed_field(network, template), said)


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


def _known_codes(nominal: TestField | None) -> _Codes:
    if nominal is None:
        return _Codes({}, [], grows=True)
    rows = {
        ring_code.parse(code): row
        for row, code in enumerate(nominal.codes)
        if ring_code.is_ring(code)
    }
    return _Codes(rows, list(nominal.names), grows=False)


def _first_look(
    pictures: Sequence[Picture],
    pixel_pitch: float,
    nominal: TestField | None,
    codes: _Codes,
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
        seen, radii = _codes_in(image, codes)
        if nominal is not None:
            seen = join(measure_corners(image, locate_markers(image, nominal)), seen)
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


def _codes_in(image: Image, codes: _Codes) -> tuple[Observations, dict[int, float]]:
    """The ring-coded targets of an image, measured as ellipses, and their semi-major axes in px."""
    grey = to_8_bit(image)
    best = None
    for scale, ink in _SEARCHES:
        candidates = find_circles(grey, scale, ink)
        found = read_codes(grey, candidates, codes.families(), codes.known())
        if codes.grows and len(found):
            # some codes of few segments can be read in both families: the others tell which it is
            family = int(np.bincount(found.bits).argmax())
            if np.mean(found.bits == family) > 0.8:
                found = read_codes(grey, candidates, (family,))
        if best is None or len(found) > len(best[1]):
            best = candidates.maps, found
        if len(found) >= _ENOUGH_CODES:
            break
    assert best is not None
    maps, found = best
    numbered = [
        (codes.row(int(bits), int(number)), int(place))
        for bits, number, place in zip(found.bits, found.numbers, found.rows, strict=True)
    ]
    kept = [(row, place) for row, place in numbered if row is not None]
    rows = np.array([row for row, _ in kept], dtype=np.int64)
    maps = maps.select(np.array([place for _, place in kept], dtype=np.int64))
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


def _look_again(
    pictures: Sequence[Picture],
    network: Network,
    expected: TestField,
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
        camera = network.camera
        prior = Prior(camera.sensor, camera.interior, stations[picture.name].exterior)
        result = measure(picture.load(), expected, prior)
        if len(result.observations):
            said[picture.name] = f"{len(result.observations)} targets"
            photos.append(Photo(picture.name, result.observations))
        else:
            said[picture.name] = result.status.reason or "nothing measured"
    return photos


def _renamed(network: Network, expected: TestField) -> Network:
    """The network as a start for photographs whose targets count the rows of another field.

    Targets that it does not have begin where they are expected.
    """
    return replace(network, names=expected.names, points=expected.points)
