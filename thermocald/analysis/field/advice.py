"""What to add to a test field, or what to change; every proposal is computed before it is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.field.check import (
    CELLS,
    FREE,
    MIN_SIZE_PX,
    FieldCheck,
    check_field,
    precision,
    station_at,
    usual_station,
)
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    CameraModel,
    ExteriorOrientation,
)

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField

_NONE = 1e300  # a standard deviation that does not exist
_WORTH = 0.85  # a proposal must bring a standard deviation below this share of what it is
_RAISED = 0.25  # of the distance: how far in front of the field proposed targets stand
_GOOD_SIZE_PX = 12.0
_FEW = 40
_FLAT = 0.02  # depth of a field over its distance below which it is a plane


@dataclass(frozen=True, eq=False)
class FieldAssessment:
    """What a camera gets out of a field from one place, and what would be better.

    sigma_px: of an image coordinate; advice: sentences, the most helpful first.
    """

    field: TestField
    camera: CameraModel
    sigma_px: float
    check: FieldCheck
    advice: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return the document that `testfield check` writes with `--json`."""
        check = self.check
        sds = {}
        for kind in ("epoch", "series", "level"):
            values = getattr(check.precision, kind)
            named = zip(FREE, values, strict=True)
            sds[kind] = {f"sd_{n}": float(v) if v < _NONE else None for n, v in named}
        sizes = sorted(check.sizes)
        return {
            "format": "thermocald-testfield-check/1",
            "targets": len(self.field),
            "visible": [self.field.names[i] for i in check.visible],
            "hidden": check.hidden,
            "station": dict(zip(EOP_NAMES, check.station.as_array().tolist(), strict=True)),
            "distance": check.distance,
            "depth_relief": check.depth_relief,
            "coverage": check.coverage,
            "cells": check.cells.tolist(),
            "median_size_px": float(sizes[len(sizes) // 2]) if sizes else None,
            "sigma_px": self.sigma_px,
            "pixel_pitch": self.camera.sensor.pixel_pitch,
            **sds,
            "calibrates": not check.weak,
            "weak": list(check.weak),
            "advice": self.advice,
        }

    def lines(self) -> list[str]:
        """Return the lines that `testfield check` prints."""
        check = self.check
        X, Y, Z = check.station.centre
        reasons = list(check.hidden.values())
        lines = ["good: every image from there can be calibrated by itself"]
        if check.weak:
            lines = ["NOT ENOUGH: a series of a fixed camera gets no result from there"]
            lines += [f"  because: {reason}" for reason in check.weak]
        lines.append(
            f"{len(check.visible)} of {len(self.field)} targets visible from ({X:.0f}, {Y:.0f}, "
            f"{Z:.0f}) mm, {check.distance:.0f} mm away; they cover {check.coverage:.0%} of the "
            f"image, depth relief {check.depth_relief:.0%} of the distance"
        )
        lines += [f"  {reasons.count(reason)} {reason}" for reason in sorted(set(reasons))]
        lines.append(
            "  standard deviations in px    one image    in a series    with the field's own"
        )
        for name, row in check.precision.pixels(self.camera.sensor.pixel_pitch).items():
            cells = [f"{v:.3g}" if v < _NONE else "none" for v in row]
            lines.append(f"    {name:<24} {cells[0]:>12} {cells[1]:>14} {cells[2]:>20}")
        return lines + [f"  better: {note}" for note in self.advice]


def assess_field(
    field: TestField,
    camera: CameraModel,
    place: tuple[float, float, float] | None = None,
    look_at: tuple[float, float, float] | None = None,
    roll: float = 0.0,
    sigma_px: float = 0.03,
) -> FieldAssessment:
    """Assess a test field for a camera at a place X, Y, Z mm, roll degrees about its axis.

    Without a place it stands where the field just fills its image, without a point to look at it
    looks at the field's middle.
    """
    middle = (field.points.min(axis=0) + field.points.max(axis=0)) / 2
    target = middle if look_at is None else np.array(look_at)
    if place is not None:
        station = station_at(np.array(place), target, np.radians(roll))
    else:
        station = usual_station(camera, field)
        if look_at is not None or roll:
            station = station_at(station.centre, target, np.radians(roll))
    check = check_field(camera, field, station, sigma_px)
    return FieldAssessment(field, camera, sigma_px, check, advise(camera, field, check, sigma_px))


def advise(
    camera: CameraModel, field: TestField, check: FieldCheck, sigma_px: float = 0.03
) -> list[str]:
    """Sentences, the most helpful first; none if nothing would help by a seventh.

    That a field is one plane comes before all else: more targets in front of it are no print.
    """
    points, sigmas = field.points[check.visible], field.sigmas[check.visible]
    typical = np.broadcast_to(np.median(sigmas, axis=0), (1, 3))
    now = check.precision.epoch
    proposals: list[tuple[float, str]] = []

    def propose(added: Array, what: str) -> None:
        both = np.concatenate([points, added])
        spread = np.concatenate([sigmas, np.repeat(typical, len(added), axis=0)])
        then = precision(camera, check.station, both, spread, sigma_px).epoch
        gain = _compare(now, then)
        best = int(np.argmin(gain))
        if gain[best] < _WORTH and np.all(np.isfinite(then[:3])):
            proposals.append((float(gain[best]), f"{what}: {_change(camera, best, now, then)}"))

    near = check.distance * (1 - _RAISED)
    propose(
        _along(camera, check.station, _spread(camera, 4, 2), near),
        f"8 targets standing {check.distance * _RAISED:.0f} mm in front of the field, spread over "
        "the image",
    )
    empty = [
        (column, row)
        for row in range(CELLS[1])
        for column in range(CELLS[0])
        if check.cells[row, column] == 0
    ]
    if empty:
        middles = np.array([((c + 0.5) / CELLS[0], (r + 0.5) / CELLS[1]) for c, r in empty])
        size = np.array([camera.sensor.width, camera.sensor.height])
        propose(
            _beside(camera, check, middles * size - 0.5, points),
            f"{len(empty)} targets in the empty parts of the image ({_where(empty)})",
        )
    if len(points) < _FEW:
        propose(points, f"twice as many targets ({len(points)} are visible)")
    sentences = [text for _, text in sorted(proposals)]
    return [*_of_a_plane(check), *sentences, *_remarks(check)]


def _compare(now: Array, then: Array) -> Array:
    """What standard deviations of c, x0, y0 become, as shares (3,) of what they are."""
    gain = np.ones(3)
    for i in range(3):
        if np.isfinite(then[i]):
            gain[i] = then[i] / now[i] if np.isfinite(now[i]) else 0.0
    return gain


def _of_a_plane(check: FieldCheck) -> list[str]:
    """What one flat sheet is good for."""
    if check.flatness >= _FLAT:
        return []
    text = (
        "the field is one plane: no single image separates c, x0 and y0 from where the camera "
        "stands. For a series of a fixed camera print the corner (thermocald testfield print). A "
        "flat sheet gives a drift too: photograph it in ten poses with the cold camera and in ten "
        "with the warm one, run `thermocald calibrate` on each, and take the difference"
    )
    return [text]


def _remarks(check: FieldCheck) -> list[str]:
    """What is wrong with the targets themselves."""
    notes = []
    too_small = sum("smaller" in reason for reason in check.hidden.values())
    if too_small:
        notes.append(
            f"{too_small} targets are smaller than {MIN_SIZE_PX:g} px: come nearer or print larger"
        )
    elif len(check.sizes) and np.median(check.sizes) < _GOOD_SIZE_PX:
        notes.append(
            f"targets are {np.median(check.sizes):.0f} px across (median), {_GOOD_SIZE_PX:.0f} to "
            "40 px are measured best: come nearer or print larger"
        )
    outside = sum("outside" in reason for reason in check.hidden.values())
    if outside:
        notes.append(f"{outside} targets are outside of the image: step back, or look elsewhere")
    level, epoch = check.precision.level[:3], check.precision.epoch[:3]
    if np.all(np.isfinite(level)) and np.any(level > 2 * epoch):
        notes.append(
            "the test field's own uncertainty is larger than what the image could give: survey it "
            "(thermocald testfield survey)"
        )
    return notes


def _change(camera: CameraModel, which: int, now: Array, then: Array) -> str:
    name = ("c", "x0", "y0")[which]
    pitch = camera.sensor.pixel_pitch
    before = f"{now[which] / pitch:.2g} px" if np.isfinite(now[which]) else "not determined"
    return f"sd({name}) of one image {before} → {then[which] / pitch:.2g} px"


def _spread(camera: CameraModel, columns: int, rows: int) -> Array:
    """Image points (n, 2) px in the middles of so many parts of the image."""
    x = (np.arange(columns) + 0.5) / columns * camera.sensor.width - 0.5
    y = (np.arange(rows) + 0.5) / rows * camera.sensor.height - 0.5
    u, v = np.meshgrid(x, y)
    return np.column_stack([u.ravel(), v.ravel()])


def _along(
    camera: CameraModel, station: ExteriorOrientation, image_points: Array, depth: float
) -> Array:
    """Object points (n, 3) mm that appear at image points in some depth."""
    rays = camera.rays(image_points)
    placed: Array = station.centre + (rays * (depth / -rays[:, 2:])) @ station.rotation.T
    return placed


def _beside(camera: CameraModel, check: FieldCheck, image_points: Array, points: Array) -> Array:
    """Object points (n, 3) mm that appear at image points: on the field's plane if it is one (and
    is in view there), else in its mean depth.
    """
    placed = _along(camera, check.station, image_points, check.distance)
    if check.flatness >= _FLAT:
        return placed
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    rays = placed - check.station.centre
    with np.errstate(divide="ignore"):
        reach = ((centre - check.station.centre) @ normal) / (rays @ normal)
    sensible = (reach > 0.4) & (reach < 2.5)
    result: Array = check.station.centre + rays * np.where(sensible, reach, 1.0)[:, None]
    return result


def _where(empty: list[tuple[int, int]]) -> str:
    """Parts of the image in words."""
    rows = ("upper", "middle", "lower")
    columns = ("left", "centre left", "centre right", "right")
    words = [f"{rows[r]} {columns[c]}" for c, r in empty]
    return ", ".join(words[:4]) + (f" and {len(words) - 4} more" if len(words) > 4 else "")
