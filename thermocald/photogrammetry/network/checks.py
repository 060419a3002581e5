"""What a network of photographs must have to carry the coordinates that are asked of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.network.snooping import MIN_RAYS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.network.bundle import ImageRays
    from thermocald.photogrammetry.network.datum import Distance
    from thermocald.photogrammetry.network.result import Network

__all__ = ["advice", "refuse_before", "refuse_narrow", "refuse_weak"]

MIN_PHOTOS = 3
MIN_TARGETS = 8
MIN_ANGLE = np.radians(20.0)
MAX_RELATIVE_SD_C = 0.005
MAX_RELATIVE_SD = 1 / 1000
MAX_SIGMA0 = 5.0
MIN_ROLL = np.radians(60.0)


def _refuse(reasons: list[str]) -> None:
    if reasons:
        raise GeometryError("the network cannot carry a survey: " + "; ".join(reasons))


def refuse_before(
    photos: int, rays: ImageRays, distances: Sequence[Distance], names: Sequence[str]
) -> None:
    """Refuse what no adjustment can mend: photographs, targets, or the scale are missing."""
    reasons = []
    targets = len(np.unique(rays.target))
    if photos < MIN_PHOTOS:
        _refuse(
            [f"{photos} photographs show targets, {MIN_PHOTOS} are the least and 8 to 12 are good"]
        )
    if targets < MIN_TARGETS:
        reasons.append(f"{targets} targets are seen {MIN_RAYS} times, {MIN_TARGETS} are the least")
    if not distances:
        reasons.append("no distance gives the scale: --scale A B MM")
    seen = {names[t] for t in np.unique(rays.target)}
    for d in distances:
        missing = [name for name in (d.a, d.b) if name not in seen]
        if missing:
            reasons.append(
                f"the scale needs target {' and '.join(missing)} in at least {MIN_RAYS} photographs"
            )
        if not d.length > 0:
            reasons.append(f"the distance {d.a}–{d.b} is {d.length:g} mm, it must be positive")
    _refuse(reasons)


def refuse_narrow(angles: Array) -> None:
    """Refuse rays that hardly intersect, given the largest angle at each target (m,) rad."""
    angle = float(np.median(angles)) if len(angles) else 0.0
    if angle < MIN_ANGLE:
        reason = (
            f"the rays meet at {np.degrees(angle):.0f}° (median), {np.degrees(MIN_ANGLE):.0f}° are "
            "the least: take photographs from further to the left, right, above, and below"
        )
        _refuse([reason])


def refuse_weak(network: Network, weakest: tuple[float, tuple[str, ...]]) -> None:
    """Refuse a result whose geometry or residuals say that it is not worth its digits."""
    reasons = []
    if len(network.stations) < MIN_PHOTOS:
        reasons.append(
            f"only {len(network.stations)} photographs could be oriented, {MIN_PHOTOS} are needed"
        )
    if network.redundancy < 10:
        reasons.append(f"{network.redundancy} redundant observations control nothing")
    c, sd_c = network.camera.interior.c, float(np.sqrt(network.interior_covariance[0, 0]))
    if "c" in network.free and sd_c > MAX_RELATIVE_SD_C * c:
        reasons.append(
            f"the principal distance is uncertain by {100 * sd_c / c:.1f} % (weakest: "
            f"{', '.join(weakest[1])}): photograph obliquely, turn the camera, bring depth into "
            "the field, or give a calibrated camera and hold it"
        )
    if network.relative_accuracy > MAX_RELATIVE_SD:
        reasons.append(
            f"the coordinates' standard deviations are 1:{1 / network.relative_accuracy:.0f} "
            f"of the field, 1:{1 / MAX_RELATIVE_SD:.0f} is the least"
        )
    if network.sigma0 > MAX_SIGMA0:
        reasons.append(
            f"residuals are {network.sigma0:.1f} times their stated sigmas: another camera or "
            "focus among the photographs, a field that moved, or wrong identifications"
        )
    _refuse(reasons)


def advice(network: Network) -> list[str]:
    """What would make an accepted network better, as sentences."""
    notes = []
    three = [name for name, n in zip(network.names, network.n_rays, strict=True) if n == MIN_RAYS]
    if three:
        shown = ", ".join(three[:8]) + (", …" if len(three) > 8 else "")
        notes.append(f"{len(three)} targets have {MIN_RAYS} rays only, the least: {shown}")
    if _roll_span(network) < MIN_ROLL:
        notes.append(
            "the camera was never turned about its axis: turn it by 90° in some photographs, which "
            "separates the principal point from the decentering distortion and the orientation"
        )
    low = np.degrees(network.angles) < 30
    if low.any():
        notes.append(f"{int(low.sum())} targets are intersected under less than 30°")
    return notes


def _roll_span(network: Network) -> float:
    """The largest difference of roll between two stations, rad, about the mean view."""
    R = np.array([s.exterior.rotation for s in network.stations])
    up = R[:, :, 1]
    axis = -R[:, :, 2].mean(axis=0)
    axis /= np.linalg.norm(axis)
    flat = up - (up @ axis)[:, None] * axis
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    return float(np.arccos(np.clip((flat @ flat.T).min(), -1.0, 1.0)))
