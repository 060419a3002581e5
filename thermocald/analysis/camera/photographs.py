"""Photographs of a test field: measured, and calibrated together or oriented one by one."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError, ImageError, UsageError
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.camera_files import CameraFile
from thermocald.photogrammetry.epoch.adjustment import (
    Adjustment,
    AdjustmentSettings,
    cold_start,
    pose_only,
)
from thermocald.photogrammetry.frame.measurement import Prior, measure
from thermocald.photogrammetry.network.common_interior import CommonInterior, adjust_common_interior
from thermocald.photogrammetry.orientation import approximate_orientation
from thermocald.photogrammetry.targets.image_file import decode_grey

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff", ".webp"})
_ASSUMED_PITCH = 0.001

_POOR = 4.0  # times the residuals of the usual photograph
_FEWEST_TO_COMPARE = 4  # photographs
_ENOUGH_TARGETS = 20  # for residuals that a pose of its own does not take up


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
        except (ImageError, GeometryError) as error:
            word = "bad_image" if isinstance(error, ImageError) else "no_orientation"
            failures[k] = (word, str(error))
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
    failures = dict(failures)
    good = [k for k, o in enumerate(measured) if o is not None and k not in failures]
    reason = "no photograph shows enough targets"
    if settings.free and good:
        try:
            start = _first_camera(sensor, testfield, measured, good, settings, nominal_c, interior)
            rows, together = _together(sensor, testfield, measured, good, settings, start)
            if poor := _poor(measured, rows, together):
                failures |= poor
                good = [k for k in good if k not in poor]
                start = together.interior
                rows, together = _together(sensor, testfield, measured, good, settings, start)
        except GeometryError as error:
            reason = str(error)
        else:
            reason = "; ".join(together.reasons)
            if not reason:
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


def _first_camera(
    sensor: Sensor,
    testfield: TestField,
    measured: Sequence[Observations | None],
    good: Sequence[int],
    settings: AdjustmentSettings,
    nominal_c: float | None,
    interior: InteriorOrientation | None,
) -> InteriorOrientation:
    """Return the camera of the photograph with most targets, to start from."""
    o = max((o for k in good if (o := measured[k]) is not None), key=len)
    first = cold_start(sensor, testfield, o, settings, nominal_c, interior)
    start = first.interior or interior
    if start is None:
        points = testfield.points[o.targets]
        start = approximate_orientation(sensor, points, o.points, nominal_c)[0]
    if not first.ok and interior is None:
        # Distortion from a weak photograph would only mislead the others.
        start = start.with_values(A1=0.0, A2=0.0, A3=0.0, B1=0.0, B2=0.0, x0=0.0, y0=0.0)
    return start


def _together(
    sensor: Sensor,
    testfield: TestField,
    measured: Sequence[Observations | None],
    good: Sequence[int],
    settings: AdjustmentSettings,
    interior: InteriorOrientation,
) -> tuple[list[int], CommonInterior]:
    """Adjust the photographs whose targets a pose explains; returns which, and the result."""
    poses: dict[int, ExteriorOrientation] = {}
    chosen, fitting = [], []
    for k in good:
        if (o := measured[k]) is None:
            continue
        with suppress(GeometryError):
            points = testfield.points[o.targets]
            _, poses[k], fits = approximate_orientation(sensor, points, o.points, interior=interior)
            chosen.append(o)
            fitting.append(fits)
    if not chosen:
        raise GeometryError("no pose explains the targets of any photograph")
    start = list(poses.values())
    return list(poses), adjust_common_interior(
        sensor, testfield, chosen, interior, start, settings, fitting
    )


def _poor(
    measured: Sequence[Observations | None],
    rows: Sequence[int],
    together: CommonInterior,
) -> dict[int, tuple[str, str]]:
    """Return {position: (status, reason)} of photographs whose residuals are not the others'."""
    size = {
        k: float(np.sqrt(np.median(np.sum((r / o.sigmas) ** 2, axis=1))))
        for k, r in zip(rows, together.residuals, strict=True)
        if (o := measured[k]) is not None and len(o) >= _ENOUGH_TARGETS
    }
    if together.reasons or len(size) < _FEWEST_TO_COMPARE:
        return {}
    usual = max(float(np.median(list(size.values()))), 1.0)
    poor = {}
    for k, r in zip(rows, together.residuals, strict=True):
        if (ratio := size.get(k, 0.0) / usual) > _POOR:
            why = (
                f"residuals of {np.sqrt(np.mean(r**2)):.2f} px, {ratio:.0f} times those of the "
                "other photographs: moved while exposed, or a board that was bent; left out"
            )
            poor[k] = ("large_residuals", why)
    return poor


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


def images_of(given: Sequence[Path]) -> list[Path]:
    """List files as given, folders as the images that they hold, by name.

    Raises UsageError where there is none, for a file that is not there, and for one given twice.
    """
    images: list[Path] = []
    for path in given:
        if path.is_file():
            images.append(path)
            continue
        if not path.is_dir():
            raise UsageError(f"{path}: there is no such file")
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in _IMAGES)
        if not found:
            raise UsageError(f"{path}: the folder holds no image ({', '.join(sorted(_IMAGES))})")
        images += found
    if not images:
        raise UsageError("give at least one photograph")
    if len(set(images)) < len(images):
        raise UsageError("a photograph is given twice")
    return images


def unknown_camera(images: Sequence[Path], pixel_pitch: float | None) -> CameraFile:
    """A camera of which no file says anything, its image size that of most photographs; without
    its pitch a pixel counts as 1 µm.
    """
    first: ImageError | None = None
    sizes: Counter[tuple[int, ...]] = Counter()
    for path in images:
        try:
            sizes[decode_grey(path).shape] += 1
        except ImageError as error:
            first = first or error
    if not sizes:
        assert first is not None
        raise first
    height, width = sizes.most_common(1)[0][0]
    pitch = _ASSUMED_PITCH if pixel_pitch is None else pixel_pitch
    return CameraFile("camera", Sensor(width, height, pitch), None, None)
