"""Looking at a photograph: for codes when nothing is known, for targets where they must be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.frame.circles import circle_observations
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.detection import find_circles
from thermocald.photogrammetry.targets.markers import locate_markers, measure_corners, to_8_bit
from thermocald.photogrammetry.targets.outline import LocalMap, local_maps
from thermocald.photogrammetry.targets.ring_reading import read_codes

if TYPE_CHECKING:
    from thermocald.arrays import Array, Image
    from thermocald.photogrammetry.camera.camera_model import CameraModel, ExteriorOrientation
    from thermocald.photogrammetry.field.testfield import Observations, TestField

__all__ = ["Codes", "codes_in", "known_codes", "targets_in"]

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
    round_ = np.array([kind == "circle" for kind in field.kinds]) & np.isfinite(field.diameters)
    rows = np.flatnonzero(round_)
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
    coded = np.array([ring_code.is_ring(field.codes[row]) for row in rows], dtype=bool)
    fit = fit_circles(image, maps, coded)
    off = np.linalg.norm(fit.points - maps.centre, axis=1)
    return corners.joined(circle_observations(rows, fit, fit.good & (off < _GROSS_PX)))
