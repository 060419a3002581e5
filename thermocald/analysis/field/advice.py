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
from thermocald.numbers import parameter_label
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import CameraModel
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

    advice: sentences, the most helpful first.
    """

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
            "targets": len(check.field),
            "visible": [check.field.names[i] for i in check.visible],
            "hidden": check.hidden,
            "station": dict(zip(EOP_NAMES, check.station.as_array().tolist(), strict=True)),
            "distance": check.distance,
            "depth_relief": check.depth_relief,
            "coverage": check.coverage,
            "cells": check.cells.tolist(),
            "median_size_px": float(sizes[len(sizes) // 2]) if sizes else None,
            "sigma_px": check.sigma_px,
            "pixel_pitch": check.camera.sensor.pixel_pitch,
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
            f"{len(check.visible)} of {len(check.field)} targets visible from ({X:.0f}, {Y:.0f}, "
            f"{Z:.0f}) mm, {check.distance:.0f} mm away; they cover {check.coverage:.0%} of the "
            f"image, depth relief {check.depth_relief:.0%} of the distance"
        )
        lines += [f"  {reasons.count(reason)} {reason}" for reason in sorted(set(reasons))]
        lines.append(
            "  standard deviations in px    one image    in a series    with the field's own"
        )
        for name, row in check.precision.pixels(check.camera.sensor.pixel_pitch).items():
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
    return FieldAssessment(check, advise(check))


def advise(check: FieldCheck) -> list[str]:
    """Return sentences, the most helpful first; none if nothing would help by a seventh.

    That a field is one plane comes before all else: more targets in front of it are no print.
    """
    points, sigmas = check.field.points[check.visible], check.field.sigmas[check.visible]
    typical = np.broadcast_to(np.median(sigmas, axis=0), (1, 3))
    now = check.precision.epoch
    proposals: list[tuple[float, str]] = []

    def propose(added: Array, what: str) -> None:
        both = np.concatenate([points, added])
        spread = np.concatenate([sigmas, np.repeat(typical, len(added), axis=0)])
        then = precision(check.camera, check.station, both, spread, check.sigma_px).epoch
        with np.errstate(invalid="ignore"):  # what is not determined now is worth everything
            gain = np.where(np.isfinite(now), then / now, 0.0)[:3]
        gain = np.where(np.isfinite(then[:3]), gain, 1.0)
        best = int(np.argmin(gain))
        if gain[best] < _WORTH and np.all(np.isfinite(then[:3])):
            proposals.append((float(gain[best]), f"{what}: {_change(check, best, now, then)}"))

    near = check.distance * (1 - _RAISED)
    propose(
        _along(check, np.array([(c, r) for r in range(2) for c in range(4)]), (4, 2), near),
        f"8 targets standing {check.distance * _RAISED:.0f} mm in front of the field, spread over "
        "the image",
    )
    empty = np.argwhere(check.cells == 0)[:, ::-1]
    if len(empty):
        propose(
            _beside(check, empty, points),
            f"{len(empty)} targets in the empty parts of the image ({_where(empty)})",
        )
    if len(points) < _FEW:
        propose(points, f"twice as many targets ({len(points)} are visible)")
    sentences = [text for _, text in sorted(proposals)]
    return [*_of_a_plane(check), *sentences, *_remarks(check)]


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


def _change(check: FieldCheck, which: int, now: Array, then: Array) -> str:
    pitch = check.camera.sensor.pixel_pitch
    before = f"{now[which] / pitch:.2g} px" if np.isfinite(now[which]) else "not determined"
    name = parameter_label(FREE[which])
    return f"sd({name}) of one image {before} → {then[which] / pitch:.2g} px"


def _along(
    check: FieldCheck, parts: NDArray[np.int64], counts: tuple[int, int], depth: float
) -> Array:
    """Object points (n, 3) mm in some depth that appear in the middles of parts (column, row) of
    the image, of which there are so many columns and rows.
    """
    sensor = check.camera.sensor
    middles = (parts + 0.5) / counts * (sensor.width, sensor.height) - 0.5
    rays = check.camera.rays(middles)
    placed: Array = (
        check.station.centre + (rays * (depth / -rays[:, 2:])) @ check.station.rotation.T
    )
    return placed


def _beside(check: FieldCheck, parts: NDArray[np.int64], points: Array) -> Array:
    """Object points (n, 3) mm that appear in parts of the image: on the field's plane if it is one
    (and is in view there), else in its mean depth.
    """
    placed = _along(check, parts, CELLS, check.distance)
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


def _where(empty: NDArray[np.int64]) -> str:
    """Parts of the image in words."""
    rows = ("upper", "middle", "lower")
    columns = ("left", "centre left", "centre right", "right")
    words = [f"{rows[r]} {columns[c]}" for c, r in empty]
    return ", ".join(words[:4]) + (f" and {len(words) - 4} more" if len(words) > 4 else "")
