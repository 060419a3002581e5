"""The circles of a test field in a frame whose orientation is known about: predicted, then fitted.

Every circle that faces the camera has a predicted outline, coded or plain. The fits improve the
orientation; where that changes the outlines, they are fitted once more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.field.planes import field_normals
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.orientation.identification import Orientation, refine
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.outline import LocalMap, local_maps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Image
    from thermocald.photogrammetry.camera.camera_model import InteriorOrientation
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.targets.circle import CircleFit

__all__ = ["circle_observations", "measure_circles", "predicted_maps"]

_FEWEST = 4
_LARGEST_TILT_COSINE = 0.2  # 78°: beyond, a sheet is seen edge-on
_GROSS_SD = 8.0
_GROSS_PX = 3.0
_USUAL_BLUR_PX = 0.9
_WIDE_BLUR_PX = 1.1
_SETTLED_PX = 0.002


def predicted_maps(
    testfield: TestField, orientation: Orientation, eccentricity: bool = True
) -> tuple[NDArray[np.int64], LocalMap]:
    """Rows and outlines of the field's circles that face the camera and lie in the image.

    A circle whose plane is not known is taken as facing the camera, and has no eccentricity.
    """
    circles = np.array([kind == "circle" for kind in testfield.kinds], dtype=bool)
    rows = np.nonzero(circles & np.isfinite(testfield.diameters))[0]
    X = testfield.points[rows]
    normals = field_normals(testfield)[rows]
    view = orientation.exterior.centre - X
    view = view / np.linalg.norm(view, axis=1, keepdims=True)
    unknown = ~np.isfinite(normals[:, 0])
    normals = np.where(unknown[:, None], view, normals)
    cosine = np.abs(np.sum(view * normals, axis=1))
    maps = local_maps(
        orientation.camera.sensor, orientation.camera.interior.as_array(),
        orientation.exterior.as_array(), X, normals, testfield.diameters[rows] / 2,
    )  # fmt: skip
    visible = (
        np.isfinite(maps.second).all(axis=(1, 2))
        & np.isfinite(maps.linear).all(axis=(1, 2))
        & orientation.camera.sensor.contains(np.nan_to_num(maps.centre, nan=-1e9))
        & (cosine > _LARGEST_TILT_COSINE)
    )
    maps = maps if eccentricity else maps.without_eccentricity()
    return rows[visible], maps.select(visible)


def measure_circles(
    image: Image,
    testfield: TestField,
    orientation: Orientation,
    corners: Observations,
    interior: InteriorOrientation | None,
    eccentricity: bool,
) -> tuple[Observations, dict[int, str], Orientation]:
    """Fit every circle in view, improve the orientation with them, and fit once more if needed.

    corners: what was measured before; interior: the camera's, where it is known. Returns the
    observations, {row: reason} for circles that were not measured, and the orientation.
    """
    rows, maps = predicted_maps(testfield, orientation, eccentricity)
    coded = np.array([ring_code.is_ring(testfield.codes[r]) for r in rows], dtype=bool)
    fit = fit_circles(image, maps, coded, _USUAL_BLUR_PX)
    blur = float(np.median(fit.parameters[:, 5])) if len(rows) else _USUAL_BLUR_PX
    if blur > _WIDE_BLUR_PX:
        # The windows were too narrow for this frame.
        fit = fit_circles(image, maps, coded, blur)
    good = fit.good
    if good.sum() + len(corners) < _FEWEST:
        return Observations.none(), dict(zip(rows.tolist(), fit.reasons, strict=True)), orientation
    pairs = np.concatenate([corners.targets, rows[good]])
    better = refine(
        orientation.camera.sensor, orientation.camera.interior, orientation.exterior,
        testfield.points[pairs], np.concatenate([corners.points, fit.points[good]]),
        known=interior is not None,
    )  # fmt: skip
    new_rows, new_maps = predicted_maps(testfield, better, eccentricity)
    same = len(new_rows) == len(rows) and bool(np.all(new_rows == rows))
    # The outlines' asymmetry decides about the centres, the rest is estimated anyway.
    settled = (
        same
        and bool(good.all())
        and float(np.abs(new_maps.second - maps.second).max(initial=0.0)) < _SETTLED_PX
    )
    if not settled:
        start = None
        if same:
            new_maps = new_maps.at(np.where(good[:, None], fit.points, new_maps.centre))
            start = fit.parameters if good.all() else None
        rows, maps = new_rows, new_maps
        coded = np.array([ring_code.is_ring(testfield.codes[r]) for r in rows], dtype=bool)
        fit = fit_circles(image, maps, coded, blur, None, start)
    return (*_observations(rows, fit, testfield, better), better)


def _observations(
    rows: NDArray[np.int64], fit: CircleFit, testfield: TestField, orientation: Orientation
) -> tuple[Observations, dict[int, str]]:
    """The good fits; a circle far from where its target must be is another circle."""
    reasons = list(fit.reasons)
    predicted = orientation.camera.project(orientation.exterior, testfield.points[rows])
    off = np.abs(fit.points - predicted).max(axis=1, initial=0.0)
    limit = max(_GROSS_PX, _GROSS_SD * min(orientation.scatter, 1.0))
    for i in np.nonzero(off > limit)[0]:
        reasons[i] = reasons[i] or "not where the target must be"
    good = np.array([not reason for reason in reasons], dtype=bool)
    observations = circle_observations(rows, fit, good)
    return observations, {int(r): why for r, why in zip(rows, reasons, strict=True) if why}


def circle_observations(
    rows: NDArray[np.int64], fit: CircleFit, good: NDArray[np.bool_]
) -> Observations:
    """Some of the fits (mask) as observations of the test field's rows (n,)."""
    c, p = fit.covariances[good], fit.parameters[good]
    return Observations(
        rows[good].astype(np.int64),
        p[:, :2],
        np.sqrt(np.stack([c[:, 0, 0], c[:, 1, 1]], axis=-1)),
        c[:, 0, 1],
        {
            "blur": p[:, 5],
            "contrast": p[:, 7],
            "grey": p[:, 6],
            "noise": np.sqrt(fit.noise.variance(p[:, 6])).astype(float),
            "saturation": fit.saturation[good],
            "misfit": fit.misfit[good],
        },
    )
