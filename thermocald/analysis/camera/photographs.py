"""Photographs of a test field: measured, and calibrated together or oriented one by one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError, ImageError
from thermocald.photogrammetry.epoch.cold_start import cold_start, pose_only
from thermocald.photogrammetry.epoch.common_interior import CommonInterior, adjust_common_interior
from thermocald.photogrammetry.frame.measurement import Prior, measure
from thermocald.photogrammetry.orientation.approximate import approximate_orientation
from thermocald.photogrammetry.targets.image_file import decode_grey

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.epoch.adjustment import Adjustment, AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations, TestField

__all__ = ["PhotographResult", "Photographs", "calibrate_observations", "calibrate_photographs"]


@dataclass(frozen=True, eq=False)
class PhotographResult:
    """One photograph: status `ok` where it has a pose, and the reason where it has none.

    points (n, 2) px: its image points; residuals (n, 2) px, measured minus adjusted; used (n,):
    which took part. Empty where there is no pose.
    """

    path: Path | str
    status: str
    reason: str
    n_targets: int
    rejected: tuple[str, ...] = ()
    rms_px: float = float("nan")
    exterior: ExteriorOrientation | None = None
    exterior_sd: Array = field(default_factory=lambda: np.full(6, np.nan))
    points: Array = field(default_factory=lambda: np.empty((0, 2)))
    residuals: Array = field(default_factory=lambda: np.empty((0, 2)))
    used: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))


@dataclass(frozen=True, eq=False)
class Photographs:
    """The camera and its photographs.

    status `ok` where the interior orientation was estimated; estimated: False where `interior` is
    what was given and held; covariance (16, 16).
    """

    status: str
    reason: str
    interior: InteriorOrientation | None
    estimated: bool
    covariance: Array
    sigma0: float
    redundancy: int
    photographs: tuple[PhotographResult, ...]


def calibrate_photographs(
    paths: Sequence[Path],
    testfield: TestField,
    sensor: Sensor,
    settings: AdjustmentSettings,
    nominal_c: float | None = None,
    interior: InteriorOrientation | None = None,
    advance: Callable[[int], None] | None = None,
) -> Photographs:
    """Measure and calibrate photographs; a file that is not an image has a status and a reason."""
    measured: list[Observations | None] = []
    failures: dict[int, tuple[str, str]] = {}
    prior = Prior(sensor, interior=interior, principal_distance=nominal_c)
    for k, path in enumerate(paths):
        try:
            found = measure(decode_grey(path), testfield, prior)
        except ImageError as error:
            failures[k] = ("bad_image", str(error))
            measured.append(None)
        else:
            measured.append(found.observations)
            if not found.status.ok:
                failures[k] = (found.status.word, found.status.reason)
        if advance is not None:
            advance(1)
    return calibrate_observations(
        [str(p) for p in paths],
        measured,
        failures,
        testfield,
        sensor,
        settings,
        nominal_c,
        interior,
    )


def calibrate_observations(
    names: Sequence[str],
    measured: Sequence[Observations | None],
    failures: dict[int, tuple[str, str]],
    testfield: TestField,
    sensor: Sensor,
    settings: AdjustmentSettings,
    nominal_c: float | None = None,
    interior: InteriorOrientation | None = None,
) -> Photographs:
    """The same from image points; failures: {position: (status, reason)} known beforehand."""
    good = [k for k, o in enumerate(measured) if o is not None and k not in failures]
    together: CommonInterior | None = None
    reason = "no photograph shows enough targets"
    if settings.free and good:
        rows, starts = _starts(sensor, testfield, measured, good, settings, nominal_c, interior)
        if starts:
            try:
                together = adjust_common_interior(
                    sensor,
                    testfield,
                    [o for k in rows if (o := measured[k]) is not None],
                    starts[0][0],
                    [exterior for _, exterior in starts],
                    settings,
                )
                reason = "; ".join(together.reasons)
            except GeometryError as error:
                reason = str(error)
        if together is not None and not together.reasons:
            return _estimated(names, measured, failures, testfield, rows, together)
    elif not settings.free:
        reason = "the interior orientation is held (--free none)"
    results = []
    for k, name in enumerate(names):
        o = measured[k]
        n = 0 if o is None else len(o)
        if k in failures or o is None:
            results.append(PhotographResult(name, *failures[k], n))
        elif interior is None:
            why = f"without an interior orientation there is no pose: {reason}"
            results.append(PhotographResult(name, "weak_geometry", why, n))
        else:
            pose = pose_only(sensor, testfield, o, interior, settings)
            results.append(_posed(name, pose, testfield, o))
    return Photographs(
        "held" if not settings.free else "weak_geometry",
        reason,
        interior,
        False,
        np.zeros((16, 16)),
        float("nan"),
        0,
        tuple(results),
    )


def _starts(
    sensor: Sensor,
    testfield: TestField,
    measured: Sequence[Observations | None],
    good: Sequence[int],
    settings: AdjustmentSettings,
    nominal_c: float | None,
    interior: InteriorOrientation | None,
) -> tuple[list[int], list[tuple[InteriorOrientation, ExteriorOrientation]]]:
    """Start values: the camera of the best photograph, and with it the pose of each."""
    best = max(good, key=lambda k: 0 if (o := measured[k]) is None else len(o))
    o = measured[best]
    assert o is not None
    first = cold_start(sensor, testfield, o, settings, nominal_c, interior)
    start = first.interior or interior
    if start is None:
        try:
            start, _, _ = approximate_orientation(
                sensor, testfield.points[o.targets], o.points, nominal_c
            )
        except GeometryError:
            return [], []
    if not first.ok and interior is None:
        # Distortion from a weak photograph would only mislead the others.
        start = start.with_values(A1=0.0, A2=0.0, A3=0.0, B1=0.0, B2=0.0, x0=0.0, y0=0.0)
    rows, found = [], []
    for k in good:
        obs = measured[k]
        if obs is None:
            continue
        try:
            _, exterior, _ = approximate_orientation(
                sensor, testfield.points[obs.targets], obs.points, interior=start
            )
        except GeometryError:
            continue
        rows.append(k)
        found.append((start, exterior))
    return rows, found


def _estimated(
    names: Sequence[str],
    measured: Sequence[Observations | None],
    failures: dict[int, tuple[str, str]],
    testfield: TestField,
    rows: Sequence[int],
    together: CommonInterior,
) -> Photographs:
    results = []
    position = {k: i for i, k in enumerate(rows)}
    for k, name in enumerate(names):
        o = measured[k]
        n = 0 if o is None else len(o)
        if k in failures or o is None or k not in position:
            why = failures.get(k, ("no_orientation", "no pose explains its targets"))
            results.append(PhotographResult(name, *why, n))
            continue
        i = position[k]
        used, residuals = together.used[i], together.residuals[i]
        results.append(
            PhotographResult(
                name,
                "ok",
                "",
                n,
                tuple(testfield.names[t] for t in o.targets[~used]),
                float(np.sqrt(np.mean(residuals[used] ** 2))),
                together.exteriors[i],
                np.sqrt(np.diag(together.exterior_covariances[i])),
                o.points,
                residuals,
                used,
            )
        )
    return Photographs(
        "ok",
        "",
        together.interior,
        True,
        together.covariance,
        together.sigma0,
        together.redundancy,
        tuple(results),
    )


def _posed(
    name: str, pose: Adjustment, testfield: TestField, observations: Observations
) -> PhotographResult:
    if not pose.ok:
        return PhotographResult(name, pose.status, pose.reason, pose.n_observations)
    kept = ~np.isin(pose.targets, pose.rejected)
    return PhotographResult(
        name,
        "ok",
        "",
        pose.n_observations,
        tuple(testfield.names[t] for t in pose.rejected),
        float(np.sqrt(np.mean(pose.residuals[kept] ** 2))),
        pose.exterior,
        pose.sd[10:],
        observations.points,
        pose.residuals,
        kept,
    )
