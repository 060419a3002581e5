"""Check of a planned test field: the precision that a camera at a given station would reach.

Reports which targets the camera sees and how large, how the image is filled, how deep the field is,
and the standard deviations of the interior orientation from one image and in a series: the inverse
of the normal equations of a planned network (Grafarend's first-order design), without any image. It
also proposes what to add or change; the effect of every proposal is computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import GeometryError
from thermocald.numbers import parameter_label, percent
from thermocald.photogrammetry.camera.camera_model import (
    DEFAULT_FREE,
    EOP,
    EOP_NAMES,
    IOP,
    PARAMETER_NAMES,
    CameraModel,
    ExteriorOrientation,
    partials,
)
from thermocald.photogrammetry.epoch.adjustment import image_coverage, weaknesses
from thermocald.photogrammetry.field.planes import field_normals, plane_fit
from thermocald.photogrammetry.linalg import scaled_inverse, unit_diagonal
from thermocald.photogrammetry.targets.outline import facing, local_maps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField

_USED = [PARAMETER_NAMES.index(name) for name in (*DEFAULT_FREE, *EOP_NAMES)]
_COLUMNS, _ROWS = ("left", "centre left", "centre right", "right"), ("upper", "middle", "lower")
CELLS = (4, 3)
"""Columns and rows of the parts of the image that are checked for targets."""
MIN_SIZE_PX = 8.0
MAX_TILT_COSINE = 0.2
_FILL = 0.92
_NONE = 1e300  # a standard deviation from here on is infinite
_WORTH = 0.85  # a proposal must reduce a standard deviation below this fraction
_RAISED = 0.25  # distance of proposed targets in front of the field, over its distance
_GOOD_SIZE_PX = 12.0
_FEW = 40
_FLAT = 0.02  # depth over distance below which a field is a plane
_ONE_PLANE = (
    "the field is one plane: no single image separates c, x0 and y0 from the camera's "
    "position. For a series of a fixed camera print the corner (thermocald testfield print). A "
    "flat sheet also gives a drift: photograph it in ten poses with the cold camera and in ten "
    "with the warm one, run `thermocald calibrate` on each, and take the difference"
)


@dataclass(frozen=True, eq=False, repr=False)
class FieldCheck:
    """The result of the check of a test field.

    sigma_px: of an image coordinate; visible: rows of the targets; hidden: {target: reason}; sizes:
    smaller diameter of each visible circle, px; cells: targets per part of the image (rows,
    columns); coverage: fraction of the image inside the targets' hull; depth_relief: range of depth
    over mean depth; distance: mean depth mm; flatness: extent of the targets across their best
    plane, over `distance`; precision: as `precision` returns; weak: why an image would be too weak.
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
    precision: dict[str, Array]
    weak: tuple[str, ...]

    @property
    def sds_px(self) -> dict[str, tuple[float, float, float]]:
        """Standard deviations of c, x0, y0 in px: (epoch, series, level) by name."""
        rows = np.stack([*self.precision.values()], axis=1)[:3] / self.camera.sensor.pixel_pitch
        return {name: tuple(row) for name, row in zip(DEFAULT_FREE, rows.tolist(), strict=False)}

    @cached_property
    def advice(self) -> list[str]:
        """Sentences on improvements, the most effective first.

        Proposals that reduce no standard deviation by a seventh are left out. That a field is one
        plane comes first: targets in front of it cannot be printed on a sheet.
        """
        points, sigmas = self.field.points[self.visible], self.field.shape_sigmas[self.visible]
        typical = np.broadcast_to(np.median(sigmas, axis=0), (1, 3))
        now, pitch = self.precision["epoch"], self.camera.sensor.pixel_pitch
        proposals: list[tuple[float, str]] = []

        def propose(added: Array, what: str) -> None:
            both = np.concatenate([points, added])
            spread = np.concatenate([sigmas, np.repeat(typical, len(added), axis=0)])
            then = precision(self.camera, self.station, both, spread, self.sigma_px)["epoch"]
            with np.errstate(invalid="ignore"):  # determining a parameter is the largest gain
                gain = np.where(np.isfinite(now), then / now, 0.0)[:3]
            gain = np.where(np.isfinite(then[:3]), gain, 1.0)
            best = int(np.argmin(gain))
            if gain[best] < _WORTH and np.all(np.isfinite(then[:3])):
                before = (
                    f"{now[best] / pitch:.2g} px" if np.isfinite(now[best]) else "not determined"
                )
                name = parameter_label(DEFAULT_FREE[best])
                change = f"sd({name}) of one image {before} → {then[best] / pitch:.2g} px"
                proposals.append((float(gain[best]), f"{what}: {change}"))

        near = self.distance * (1 - _RAISED)
        propose(
            _place_in_parts(
                self, np.array([(c, r) for r in range(2) for c in range(4)]), (4, 2), near
            ),
            f"8 targets standing {self.distance * _RAISED:.0f} mm in front of the field, spread "
            "over the image",
        )
        empty = np.argwhere(self.cells == 0)[:, ::-1]
        if len(empty):
            words = [f"{_ROWS[r]} {_COLUMNS[c]}" for c, r in empty]
            where = ", ".join(words[:4]) + (f" and {len(words) - 4} more" if len(words) > 4 else "")
            propose(
                _extend_field(self, empty, points),
                f"{len(empty)} targets in the empty parts of the image ({where})",
            )
        if len(points) < _FEW:
            propose(points, f"twice as many targets ({len(points)} are visible)")
        sentences = [text for _, text in sorted(proposals)]
        plane = [_ONE_PLANE] if self.flatness < _FLAT else []
        return [*plane, *sentences, *_remarks(self)]

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald testfield check --json` writes."""
        sds = {}
        for kind, values in self.precision.items():
            named = zip(DEFAULT_FREE, values, strict=True)
            sds[kind] = {f"sd_{n}": float(v) if v < _NONE else None for n, v in named}
        sizes = sorted(self.sizes)
        return {
            "format": "thermocald-testfield-check/1",
            "targets": len(self.field),
            "visible": [self.field.names[i] for i in self.visible],
            "hidden": self.hidden,
            "station": dict(zip(EOP_NAMES, self.station.as_array().tolist(), strict=True)),
            "distance": self.distance,
            "depth_relief": self.depth_relief,
            "coverage": self.coverage,
            "cells": self.cells.tolist(),
            "median_size_px": float(sizes[len(sizes) // 2]) if sizes else None,
            "sigma_px": self.sigma_px,
            "pixel_pitch": self.camera.sensor.pixel_pitch,
            **sds,
            "calibrates": not self.weak,
            "weak": list(self.weak),
            "advice": self.advice,
        }

    def lines(self) -> list[str]:
        """Return what `thermocald testfield check` prints."""
        X, Y, Z = self.station.centre
        reasons = list(self.hidden.values())
        lines = ["good: every image from there can be calibrated by itself"]
        if self.weak:
            lines = ["NOT ENOUGH: a series of a fixed camera gets no result from there"]
            lines += [f"  because: {reason}" for reason in self.weak]
        lines.append(
            f"{len(self.visible)} of {len(self.field)} targets visible from ({X:.0f}, {Y:.0f}, "
            f"{Z:.0f}) mm, {self.distance:.0f} mm away; they cover {percent(self.coverage)} of the "
            f"image, depth relief {percent(self.depth_relief)} of the distance"
        )
        lines += [f"  {reasons.count(reason)} {reason}" for reason in sorted(set(reasons))]
        lines.append(
            "  standard deviations in px    one image    in a series    with the field's own"
        )
        for name, row in self.sds_px.items():
            cells = [f"{v:.3g}" if v < _NONE else "none" for v in row]
            lines.append(f"    {name:<24} {cells[0]:>12} {cells[1]:>14} {cells[2]:>20}")
        return lines + [f"  better: {note}" for note in self.advice]


def usual_station(camera: CameraModel, field: TestField) -> ExteriorOrientation:
    """Return the usual station: in front of a field that just fills the image.

    That is in front of a plane, or on the diagonal of a corner; upright if Z is up, or else Y.
    """
    centre = (field.points.min(axis=0) + field.points.max(axis=0)) / 2
    towards = _front(field)
    low, high = 1e-3 * _extent(field), 1e3 * _extent(field)
    # without distortion, whose polynomial folds back far outside the image
    pinhole = CameraModel(camera.sensor, type(camera.interior)(c=camera.interior.c))
    middle_px = camera.sensor.centre
    for _ in range(60):
        middle = np.sqrt(low * high)
        image = pinhole.project(station_at(centre + middle * towards, centre), field.points)
        # NaN (behind the camera) compares as outside
        inside = np.all(np.abs(image - middle_px) < middle_px * _FILL)
        low, high = (low, middle) if inside else (middle, high)
    return station_at(centre + high * towards, centre)


def station_at(place: Array, target: Array, roll: float = 0.0) -> ExteriorOrientation:
    """Return the orientation of a camera at `place` looking at `target` (3,) mm, rolled by rad."""
    backward = np.asarray(place, dtype=float) - target
    length = float(np.linalg.norm(backward))
    if not length > 0:
        raise GeometryError("the camera's place is the point it looks at: give another place")
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
    """Return the direction (3,) that the field faces: its mean normal, towards its inside."""
    normals = field_normals(field)
    known = np.isfinite(normals[:, 0])
    if not known.any():
        normal = plane_fit(field.points)[1][2]
        normals, known = np.broadcast_to(normal, field.points.shape), np.ones(len(field), bool)
    n, p = normals[known], field.points[known]
    side = np.sum((field.points.mean(axis=0) - p) * n, axis=1)
    flat = np.abs(side) < 0.02 * _extent(field)
    # a single plane has no such side; printed sheets are seen from the positive one
    largest = n[np.arange(len(n)), np.argmax(np.abs(n), axis=1)]
    sign = np.where(flat, np.sign(largest), np.sign(side))
    mean = (n * sign[:, None]).mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 1e-6 else np.asarray(n[0] * sign[0])


def check_field(
    camera: CameraModel, field: TestField, station: ExteriorOrientation, sigma_px: float = 0.03
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
    points, sigmas = field.points[rows], field.shape_sigmas[rows]
    image = camera.project(station, points)
    # the reasons for which `adjust` would give an image of these points no result
    values = np.concatenate([camera.interior.as_array(), station.as_array()])
    A = partials(camera.sensor, values[IOP], values[EOP], points)[1][:, :, _USED]
    covariance = np.zeros((len(PARAMETER_NAMES),) * 2)
    # undetermined parameters get large variances, and correlations of 1
    covariance[np.ix_(_USED, _USED)] = scaled_inverse(
        _normal_matrix(A, np.eye(2) * sigma_px**2), 1e-13
    )
    weak = weaknesses(camera.sensor, points, image, values, covariance)
    depth = -((points - station.centre) @ station.rotation)[:, 2]
    _, axes, _ = plane_fit(points)
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
        flatness=float(np.ptp(points @ axes[2])) / float(depth.mean()),
        precision=precision(camera, station, points, sigmas, sigma_px),
        weak=tuple(weak),
    )


def _visible(
    camera: CameraModel, field: TestField, station: ExteriorOrientation
) -> tuple[NDArray[np.int64], dict[str, str], Array]:
    """Return the visible targets' rows, why others are hidden, and the smaller diameters px."""
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
    reasons = {
        "behind the camera": ~np.isfinite(image).all(axis=1),
        "outside of the image": ~inside,
        "seen edge-on": round_ & (cosine < MAX_TILT_COSINE),
        f"smaller than {MIN_SIZE_PX:g} px": round_ & (minor < MIN_SIZE_PX),
    }
    found = np.select([*reasons.values()], [*reasons], "")
    hidden = {name: str(why) for name, why in zip(field.names, found, strict=True) if why}
    rows = np.flatnonzero(found == "")
    return rows, hidden, minor[rows][round_[rows]]


def precision(
    camera: CameraModel, station: ExteriorOrientation, points: Array, sigmas: Array, sigma_px: float
) -> dict[str, Array]:
    """Return standard deviations of `DEFAULT_FREE` from targets at points (n, 3) mm with sigmas mm.

    epoch: one image with free exterior orientation, image noise only; series: an epoch relative to
    the others in a long series of a fixed camera; level: one image, including the test field's
    uncertainty, which is common to all epochs. c, x0, y0 in mm; inf for an undetermined parameter.
    """
    interior, exterior = camera.interior.as_array(), station.as_array()
    _, by_parameter, by_point = partials(camera.sensor, interior, exterior, points)
    A = by_parameter[:, :, _USED]
    k, noise = len(DEFAULT_FREE), np.eye(2) * sigma_px**2
    of_field = (by_point * sigmas[:, None, :] ** 2) @ np.swapaxes(by_point, 1, 2)
    N = _normal_matrix(A, noise)
    return {
        "epoch": _sds(N)[:k],
        "series": _sds(N[:k, :k]),
        "level": _sds(_normal_matrix(A, noise + of_field))[:k],
    }


def _normal_matrix(A: Array, covariance: Array) -> Array:
    N: Array = np.sum(np.swapaxes(A, -1, -2) @ np.linalg.inv(covariance) @ A, axis=0)
    return N


def _sds(N: Array) -> Array:
    """Return the square roots of the diagonal of N⁻¹; inf for an undetermined parameter."""
    scaled, scale = unit_diagonal(N)
    values, vectors = np.linalg.eigh(scaled)
    undetermined = values < 1e-12 * values.max()
    parts = vectors**2 / np.where(undetermined, 1.0, values)
    variance = parts[:, ~undetermined].sum(axis=1)
    lost = (vectors[:, undetermined] ** 2).sum(axis=1) > 1e-6
    return np.where(lost, np.inf, np.sqrt(variance) * scale)


def assess_field(
    field: TestField,
    camera: CameraModel,
    place: tuple[float, float, float] | None,
    look_at: tuple[float, float, float] | None,
    roll: float,
    sigma_px: float,
) -> FieldCheck:
    """Assess a test field for a camera at a place X, Y, Z mm; roll: degrees about its axis.

    Without a place the camera is where the field just fills its image; it looks at the field's
    centre unless at another point. Raises GeometryError if fewer than four targets are visible.
    """
    middle = (field.points.min(axis=0) + field.points.max(axis=0)) / 2
    target = middle if look_at is None else np.array(look_at)
    if place is not None:
        station = station_at(np.array(place), target, np.radians(roll))
    else:
        station = usual_station(camera, field)
        if look_at is not None or roll:
            station = station_at(station.centre, target, np.radians(roll))
    return check_field(camera, field, station, sigma_px)


def _remarks(check: FieldCheck) -> list[str]:
    """List what is wrong with the targets themselves."""
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
    level, epoch = check.precision["level"][:3], check.precision["epoch"][:3]
    if np.all(np.isfinite(level)) and np.any(level > 2 * epoch):
        sd = np.median(check.field.shape_sigmas[check.visible])
        notes.append(
            f"the coordinates of the targets, ± {sd:.2g} mm, limit the precision of one image (not "
            "that of changes in a series): survey the field (thermocald testfield survey), or a "
            "surveyed one again with more photographs and more accurate distances"
        )
    return notes


def _place_in_parts(
    check: FieldCheck, parts: NDArray[np.int64], counts: tuple[int, int], depth: float
) -> Array:
    """Return points (n, 3) mm at a depth in the centres of image parts (column, row)."""
    sensor = check.camera.sensor
    middles = (parts + 0.5) / counts * (sensor.width, sensor.height) - 0.5
    rays = check.camera.rays(middles)
    placed: Array = (
        check.station.centre + (rays * (depth / -rays[:, 2:])) @ check.station.rotation.T
    )
    return placed


def _extend_field(check: FieldCheck, parts: NDArray[np.int64], points: Array) -> Array:
    """Return points (n, 3) mm in parts of the image: on a plane field in view, or at mean depth."""
    placed = _place_in_parts(check, parts, CELLS, check.distance)
    if check.flatness >= _FLAT:
        return placed
    centre, axes, _ = plane_fit(points)
    rays = placed - check.station.centre
    with np.errstate(divide="ignore"):
        reach = ((centre - check.station.centre) @ axes[2]) / (rays @ axes[2])
    sensible = (reach > 0.4) & (reach < 2.5)
    return check.station.centre + rays * np.where(sensible, reach, 1.0)[:, None]
