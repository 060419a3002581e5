"""The adjustment of a network of photographs: result, checks, data snooping.

A self-calibrating bundle adjustment without control points: the interior orientation is common to
all photographs, inner constraints over the targets give the datum, measured distances the scale.
The test of a point is vᵀ Qvv⁻¹ v, χ² with two degrees of freedom, which does not depend on the
image's axes; its limit holds for all points of the network together. A network that is too weak is
refused with its reasons.

Inner constraints over all targets give position and orientation (the mean standard deviation is
smallest, and no target is privileged). The targets coincide in the mean with the nominal field if
there is one; otherwise the origin is the centroid and Z the normal of the best plane, towards the
cameras. The scale follows from the distances, with their standard deviations, in a rigorous
sequential adjustment.

Source: Luhmann, T. et al. (2014): Close-Range Photogrammetry and 3D Imaging, 2nd ed., sections
4.4 and 7.3; Baarda, W. (1968): A testing procedure for use in geodetic networks; Förstner, W.,
Wrobel, B. (2016): Photogrammetric Computer Vision, section 4.6.4 (test of a point).
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from thermocald.errors import GeometryError
from thermocald.numbers import counted
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.linalg import median_variance
from thermocald.photogrammetry.network.bundle import (
    Bundle,
    BundleAdjustment,
    Cofactors,
    ImageRays,
    inner_constraints,
    point_tests,
)
from thermocald.photogrammetry.network.shared_errors import estimate_shared_errors
from thermocald.photogrammetry.network.start import approximate

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import Distance, Observations


@dataclass(frozen=True, slots=True)
class Station:
    """The pose of a photograph, with the sd of the projection centre, (3,) mm."""

    photo: str
    exterior: ExteriorOrientation
    n_targets: int
    sd_centre: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Rejection:
    """A rejected image point, with its residual in px and its test value over the limit."""

    JSON: ClassVar = {"residual": "residual_px"}

    photo: str
    target: str
    residual: float
    test: float


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """The adjusted network.

    names: of the m targets; points (m, 3) mm with covariance (3m, 3m) mm²; n_rays (m,); angles (m,)
    rad: largest angle of intersection of each target; interior_covariance (10, 10): zero for held
    parameters; free: names of the estimated ones; unused: targets and photographs left out, with
    reasons; sd_scale: relative; disagreement: of the photographs (`SharedErrors`), which
    the covariances include.
    """

    names: tuple[str, ...]
    points: Array
    covariance: Array
    n_rays: Index
    angles: Array
    camera: CameraModel
    interior_covariance: Array
    free: tuple[str, ...]
    stations: tuple[Station, ...]
    sigma0: float
    redundancy: int
    rejected: tuple[Rejection, ...]
    unused: dict[str, str]
    datum: str
    sd_scale: float
    disagreement: float

    @property
    def sigmas(self) -> Array:
        """Standard deviations (m, 3) mm of the targets."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 3)

    @property
    def extent(self) -> float:
        """Diagonal of the targets' bounding box, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def relative_accuracy(self) -> float:
        """Mean standard deviation of a coordinate over the extent, without that of the scale."""
        return float(np.sqrt(np.mean(self.shape_and_scale()[0] ** 2)) / self.extent)

    def shape_and_scale(self) -> tuple[Array, Array]:
        """Return the standard deviations (m, 3) mm of the shape alone, and what one standard
        deviation of the scale adds to the coordinates (m, 3) mm.

        Source: S-transformation to a datum with the scale among its inner constraints (Baarda
        1973).
        """
        along = (self.points - self.points.mean(axis=0)).ravel()
        along /= np.linalg.norm(along)
        Qu = self.covariance @ along
        of_scale = float(along @ Qu)
        shape = np.diag(self.covariance) - 2.0 * along * Qu + along**2 * of_scale
        scale = along * np.sqrt(of_scale)
        return np.sqrt(shape.clip(0.0)).reshape(-1, 3), scale.reshape(-1, 3)


MIN_PHOTOS = 3
GOOD_PHOTOS = 8
MIN_TARGETS = 8
MIN_ANGLE = np.radians(20.0)
MAX_RELATIVE_SD_C = 0.005
MAX_RELATIVE_SD = 1 / 1000
MAX_SIGMA0 = 5.0
MIN_ROLL = np.radians(60.0)


def _refuse(reasons: list[str]) -> None:
    if reasons:
        raise GeometryError("the network is too weak for a survey: " + "; ".join(reasons))


def refuse_before(
    photos: int, rays: ImageRays, distances: Sequence[Distance], names: Sequence[str]
) -> None:
    """Refuse a network without enough photographs or targets, or without a scale."""
    reasons = []
    targets = len(np.unique(rays.target))
    if photos < MIN_PHOTOS:
        shown = counted(photos, "photograph")
        _refuse([f"{shown} with targets; take at least {MIN_PHOTOS}, better 8 to 12"])
    if targets < MIN_TARGETS:
        reasons.append(
            f"{targets} targets are in at least {MIN_RAYS} photographs, {MIN_TARGETS} are needed"
        )
    if not distances:
        reasons.append("no distance gives the scale: measure one and give --scale A B MM")
    _refuse(reasons + _missing_ends(distances, {names[t] for t in np.unique(rays.target)}))


def _missing_ends(distances: Sequence[Distance], seen: Container[str]) -> list[str]:
    """Return a reason for each distance whose targets are not both determined."""
    ends = (" and ".join(name for name in (d.a, d.b) if name not in seen) for d in distances)
    least = f"in at least {MIN_RAYS} photographs that agree"
    return [f"the scale needs target {missing} {least}" for missing in ends if missing]


def refuse_weak(network: Network, found: Cofactors) -> None:
    """Refuse a result with weak geometry or large residuals."""
    reasons = []
    if network.redundancy < 10:
        reasons.append(f"a redundancy of {network.redundancy} is too small for any check")
    # how weak the geometry is, whatever the photographs disagree in
    sds = dict(zip(network.free, network.sigma0 * np.sqrt(found.cameras.diagonal()), strict=False))
    sd_c = float(sds.get("c", 0.0)) / network.camera.interior.c
    if sd_c > MAX_RELATIVE_SD_C:
        reasons.append(
            f"the principal distance is uncertain by {100 * sd_c:.1f} % (weakest: "
            f"{', '.join(found.weakest)}): photograph obliquely, turn the camera, bring depth into "
            "the field, or give a calibrated camera and hold it"
        )
    if network.relative_accuracy > MAX_RELATIVE_SD:
        reasons.append(
            f"the coordinates' standard deviations are 1:{1 / network.relative_accuracy:.0f} "
            f"of the field, at most 1:{1 / MAX_RELATIVE_SD:.0f} is accepted"
        )
    if network.sigma0 > MAX_SIGMA0:
        reasons.append(
            f"residuals are {network.sigma0:.1f} times their stated sigmas: another camera or "
            "focus among the photographs, a field that moved, or wrong identifications"
        )
    _refuse(reasons)


def advice(network: Network) -> list[str]:
    """Return sentences on what would improve an accepted network."""
    notes = []
    three = [name for name, n in zip(network.names, network.n_rays, strict=True) if n == MIN_RAYS]
    if three:
        shown = ", ".join(three[:8]) + (", …" if len(three) > 8 else "")
        notes.append(f"{len(three)} targets have only {MIN_RAYS} rays, the minimum: {shown}")
    if _roll_span(network) < MIN_ROLL:
        notes.append(
            "the camera was never turned about its axis: turn it by 90° in some photographs, which "
            "separates the principal point from the decentering distortion and the orientation"
        )
    low = np.degrees(network.angles) < 30
    if low.any():
        notes.append(f"{int(low.sum())} targets have rays that intersect at less than 30°")
    if len(network.stations) < GOOD_PHOTOS:
        notes.append(
            f"take {GOOD_PHOTOS} photographs or more: in {len(network.stations)}, a focus or a "
            "stabiliser that moves is often not noticed, and no standard deviation includes it then"
        )
    if network.disagreement > 1:
        notes.append(
            "the photographs disagree: what the image points of one photograph have in common is "
            f"{network.disagreement:.1f} times as large as their noise explains (another focus or "
            "zoom, a field that bends, a rolling shutter?); the standard deviations include this: "
            "hold the focus, or take more photographs"
        )
    return notes


def _roll_span(network: Network) -> float:
    """Return the largest difference of roll between two stations about the mean axis, rad."""
    R = np.array([s.exterior.rotation for s in network.stations])
    up = R[:, :, 1]
    axis = -R[:, :, 2].mean(axis=0)
    axis /= np.linalg.norm(axis)
    flat = up - (up @ axis)[:, None] * axis
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    return float(np.arccos(np.clip((flat @ flat.T).min(), -1.0, 1.0)))


MIN_RAYS = 3
"""Rays that a target needs: with two, a wrong one cannot be identified or is not even noticed."""
MIN_PHOTO_RAYS = 6
"""Rays that a photograph needs for its orientation and some redundancy."""

_FAMILY_ERROR = 0.05
_COARSE = 10.0  # times the limit, beyond which a ray is rejected at once
_ROUNDS = 30


def snoop(
    sensor: Sensor, bundle: Bundle, rays: ImageRays, free: Index
) -> tuple[Bundle, Mask, Array]:
    """Adjust a bundle and reject gross errors, some per round, until none is left.

    A target or a photograph with too few rays left is rejected with them. Returns the bundle, the
    mask of rejected rays, and the tests of all rays over the limit.
    """
    whole = BundleAdjustment(sensor, rays, free)
    bundle = whole.solve(bundle, robust=True)
    limit = -2.0 * np.log(_FAMILY_ERROR / len(rays))  # χ² with 2 degrees of freedom
    v2 = np.sum(whole.residuals(bundle) ** 2, axis=1)
    rejected = v2 > _COARSE * limit * median_variance(v2)
    tests = np.zeros(len(rays))
    for _round in range(_ROUNDS):
        _drop_uncontrolled(rejected, rays)
        part, used, photos, targets = _in_use(bundle, rays, ~rejected)
        adjustment = BundleAdjustment(sensor, used, free)
        part = adjustment.solve(part)
        bundle = deepcopy(bundle)
        bundle.interior[:], bundle.points[targets] = part.interior, part.points
        bundle.rotations[photos], bundle.centres[photos] = part.rotations, part.centres
        v = whole.residuals(bundle)
        explained = adjustment.explained(part, adjustment.cofactors(part))
        tests = np.sum(v * v, axis=1)
        tests[~rejected] = point_tests(v[~rejected], np.eye(2) - explained)
        tests /= limit * median_variance(tests[~rejected])
        candidates = ~rejected & (tests > 1)
        if not candidates.any():
            break
        # one per target, and only the largest: a gross error distorts its neighbours' tests
        worst = np.zeros(int(rays.target.max()) + 1)
        np.maximum.at(worst, rays.target[candidates], tests[candidates])
        rejected |= (
            candidates & (tests >= worst[rays.target]) & (tests > 0.3 * tests[candidates].max())
        )
    return bundle, rejected, tests


def _drop_uncontrolled(rejected: Mask, rays: ImageRays) -> None:
    """Reject all rays of targets and photographs with too few rays left, in place."""
    shown = np.bincount(rays.photo)
    before = -1
    while rejected.sum() > before:
        before = int(rejected.sum())
        left = np.bincount(rays.target[~rejected], minlength=int(rays.target.max()) + 1)
        rejected |= left[rays.target] < MIN_RAYS
        left = np.bincount(rays.photo[~rejected], minlength=len(shown))
        # a fit of half of a photograph's rays may be chance and proves nothing
        rejected |= (left < np.maximum(MIN_PHOTO_RAYS, shown / 2))[rays.photo]
    if rejected.all():
        raise GeometryError(
            "the photographs contradict each other: no part of them fits together; is it one "
            "field that did not move, and one camera with one focus?"
        )


def _in_use(bundle: Bundle, rays: ImageRays, good: Mask) -> tuple[Bundle, ImageRays, Index, Index]:
    """Return the photographs and targets of good rays, renumbered, and their rows before."""
    photos, photo = np.unique(rays.photo[good], return_inverse=True)
    targets, target = np.unique(rays.target[good], return_inverse=True)
    part = Bundle(
        bundle.interior, bundle.rotations[photos], bundle.centres[photos], bundle.points[targets]
    )
    return part, replace(rays.select(good), photo=photo, target=target), photos, targets


def adjust_network(
    sensor: Sensor,
    photos: Mapping[str, Observations],
    names: Sequence[str],
    distances: Sequence[Distance],
    *,
    interior: InteriorOrientation | None = None,
    nominal: Array | None = None,
    free: Sequence[str] = IOP_NAMES,
    places: Array | None = None,
) -> Network:
    """Adjust a free network of photographs taken by one camera with unchanged focus.

    photos: observations by photograph; names: of the m targets, in the order of their rows;
    distances: measured between targets, they give the scale; interior: approximate values, searched
    for if None; nominal: approximate coordinates (m, 3) mm, NaN if unknown; free: the interior
    parameters to estimate; places: better approximate coordinates than the nominal ones (m, 3) mm.
    Raises GeometryError with the reasons if the network is too weak.
    """
    rays, shown = ImageRays.collect(list(photos.values())), list(photos)
    seen = np.bincount(rays.target, minlength=len(names))
    left_out = {
        names[int(t)]: "fewer than three photographs show it"
        for t in np.flatnonzero((seen > 0) & (seen < MIN_RAYS))
    }
    rays = rays.select(seen[rays.target] >= MIN_RAYS)
    refuse_before(len(photos), rays, distances, names)
    free_rows = np.array([IOP_NAMES.index(name) for name in free], dtype=int)
    approximately = nominal if places is None else places
    bundle, kept, used = approximate(sensor, rays, len(names), interior, approximately, free_rows)
    for i in sorted(set(range(len(photos))) - set(kept)):
        left_out[shown[i]] = "could not be oriented: too few targets in common with others"

    whole, rejected, tests = snoop(sensor, bundle, used, free_rows)
    bundle, final, in_use, targets = _in_use(whole, used, ~rejected)
    for i in sorted(set(range(len(kept))) - set(in_use.tolist())):
        left_out[shown[kept[i]]] = "contradicts the others: another focus, or a field that moved"
    for t in np.setdiff1d(rays.target, targets):
        left_out[names[int(t)]] = "fewer than three photographs agree on it"
    kept_names = tuple(names[int(t)] for t in targets)

    angles = _intersection_angles(bundle, final)
    angle = float(np.median(angles))
    if angle < MIN_ANGLE:
        meet, least = f"{np.degrees(angle):.0f}°", f"{np.degrees(MIN_ANGLE):.0f}°"
        where = "take photographs from further to the left, right, above, and below"
        _refuse([f"the rays meet at {meet} (median), at least {least} are needed: {where}"])
    _refuse(_missing_ends(distances, kept_names))
    adjustment = BundleAdjustment(sensor, final, free_rows)
    unknowns = len(free_rows) + 6 * len(in_use) + 3 * len(kept_names) - 7
    redundancy = 2 * len(final) - unknowns
    variance = float(np.sum(adjustment.residuals(bundle) ** 2)) / max(redundancy, 1)
    found = adjustment.cofactors(bundle)
    shared = estimate_shared_errors(adjustment, bundle, found, variance, redundancy)
    of_interior, of_centres, of_points = inner_constraints(bundle, found, free_rows, *shared[1:])
    placed, covariance, to_datum, sd_scale, datum = bring_to_datum(
        bundle,
        of_points,
        distances,
        {name: i for i, name in enumerate(kept_names)},
        None if nominal is None else np.asarray(nominal, dtype=float)[targets],
    )
    stations = []
    for i, row in enumerate(in_use):
        x, y, z = np.sqrt(np.diag(to_datum @ of_centres[i] @ to_datum.T)).tolist()
        exterior = ExteriorOrientation.from_rotation(placed.rotations[i], placed.centres[i])
        n = int(np.count_nonzero(final.photo == i))
        stations.append(Station(shown[kept[int(row)]], exterior, n, (x, y, z)))
    sizes = np.linalg.norm(
        BundleAdjustment(sensor, used.in_pixels(), free_rows).residuals(whole), axis=1
    )
    rejections = [
        Rejection(
            shown[kept[used.photo[i]]], names[used.target[i]],
            float(sizes[i]), float(tests[i]),
        )
        for i in np.flatnonzero(rejected)
    ]  # fmt: skip
    network = Network(
        names=kept_names,
        points=placed.points,
        covariance=covariance,
        n_rays=np.bincount(final.target, minlength=len(kept_names)),
        angles=angles,
        camera=CameraModel(sensor, InteriorOrientation.from_array(bundle.interior)),
        interior_covariance=of_interior,
        free=tuple(free),
        stations=tuple(stations),
        sigma0=float(np.sqrt(variance)),
        redundancy=redundancy,
        rejected=tuple(sorted(rejections, key=lambda r: (r.photo, r.target))),
        unused=left_out,
        datum=datum,
        sd_scale=sd_scale,
        disagreement=shared.disagreement,
    )
    refuse_weak(network, found)
    return network


def _intersection_angles(bundle: Bundle, rays: ImageRays) -> Array:
    """Return the largest angle between two rays of each target, (m,) rad."""
    d = bundle.centres[rays.photo] - bundle.points[rays.target]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    angles = np.zeros(len(bundle.points))
    for t in np.unique(rays.target):
        mine = d[rays.target == t]
        angles[t] = np.arccos(np.clip((mine @ mine.T).min(), -1, 1))
    return angles


def bring_to_datum(
    bundle: Bundle,
    covariance: Array,
    distances: Sequence[Distance],
    index: dict[str, int],
    nominal: Array | None,
) -> tuple[Bundle, Array, Array, float, str]:
    """Scale and place a free network whose covariance (3m, 3m) has inner constraints.

    index: the row of each target by name; nominal (m, 3) mm: NaN if unknown. Returns the bundle in
    its datum, the targets' covariance, scale times rotation (3, 3) into the datum, the scale's
    relative standard deviation, and the datum in words.
    """
    scaled, Q, scale, sd_scale = _scaled(bundle.points, covariance, distances, index)
    turn, shift, where = _placement(scaled, scale * bundle.centres, nominal, distances[0], index)
    m = len(scaled)
    points = scaled @ turn.T + shift
    blocks = Q.reshape(m, 3, m, 3)
    turned = np.einsum("ab,mbnc,dc->mand", turn, blocks, turn, optimize=True).reshape(3 * m, 3 * m)
    placed = Bundle(
        bundle.interior, turn @ bundle.rotations, scale * bundle.centres @ turn.T + shift, points
    )
    by = ", ".join(f"{d.a}–{d.b} = {d.length:g} ± {d.sigma:g} mm" for d in distances)
    statement = f"inner constraints over {m} targets, {where}; scale by {by}"
    return placed, turned, scale * turn, sd_scale, statement


def _scaled(
    points: Array, Q: Array, distances: Sequence[Distance], index: dict[str, int]
) -> tuple[Array, Array, float, float]:
    """Scale points and covariance by the distances; return them, the scale and its relative sd.

    The estimate is linear in the network's points and the measured distances: ln L = ln l + lambda
    with the network's covariance. One distance fixes the scale, further ones also correct the
    shape, according to their weights.
    """
    n, m3 = len(distances), points.size
    H, r, noise = np.zeros((n, m3)), np.zeros(n), np.zeros(n)
    for i, d in enumerate(distances):
        a, b = index[d.a], index[d.b]
        e = points[b] - points[a]
        length = float(np.linalg.norm(e))
        H[i, 3 * b : 3 * b + 3], H[i, 3 * a : 3 * a + 3] = e / length**2, -e / length**2
        r[i], noise[i] = np.log(d.length / length), (d.sigma / d.length) ** 2
    # distances without a standard deviation must not make V singular
    V = H @ Q @ H.T + np.diag(np.maximum(noise, 1e-18))
    P = np.linalg.inv(V)
    ones = np.ones(n)
    weight = float(ones @ P @ ones)
    a_row = ones @ P / weight
    lam = float(a_row @ r)
    M = P - np.outer(P @ ones, a_row)
    centred = (points - points.mean(axis=0)).ravel()
    gain = Q @ H.T @ M
    shape = points + (gain @ r).reshape(-1, 3)
    scale = float(np.exp(lam))
    F = gain + np.outer(centred, a_row)
    T = np.eye(m3) - F @ H
    Qs = scale**2 * (T @ Q @ T.T + (F * noise) @ F.T)
    return scale * shape, Qs, scale, float(np.sqrt(1.0 / weight))


def _placement(
    points: Array, centres: Array, nominal: Array | None, first: Distance, index: dict[str, int]
) -> tuple[Array, Array, str]:
    """Return the rotation (3, 3) and shift (3,) into the datum, and the datum in words."""
    if nominal is not None:
        known = np.isfinite(nominal).all(axis=1)
        if known.sum() >= 3:
            turn, shift = _rigid(points[known], nominal[known])
            return turn, shift, f"in the mean on the nominal coordinates of {known.sum()} targets"
    centroid = points.mean(axis=0)
    _, _, Vt = np.linalg.svd(points - centroid)
    z = Vt[2] * (1.0 if (centres.mean(axis=0) - centroid) @ Vt[2] > 0 else -1.0)
    along = points[index[first.b]] - points[index[first.a]]
    along = along - (along @ z) * z
    # a distance along the normal gives no direction: take the field's longest one
    if np.linalg.norm(along) < 1e-3 * np.linalg.norm(np.ptp(points, axis=0)):
        along = Vt[0]
    x = along / np.linalg.norm(along)
    turn = np.array([x, np.cross(z, x), z])
    where = f"origin at their centroid, Z normal to their plane, X along {first.a}–{first.b}"
    return turn, -turn @ centroid, where


def _rigid(points: Array, onto: Array) -> tuple[Array, Array]:
    """Fit a rotation and shift, without reflection, by least squares (Arun et al. 1987)."""
    p, q = points.mean(axis=0), onto.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - p).T @ (onto - q))
    turn = Vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
    return turn, q - turn @ p
