"""Several photographs of one camera: one interior orientation, an exterior one per photograph.

A bundle adjustment with known targets: their coordinates are unknowns with the test field's sigmas
as prior, and are the same in all photographs. The weights of the image points do not depend on the
unknowns, so that the iteration ends at the minimum of the sum of squares. A photograph too poor for
an interior orientation of its own is used as well.

Source: Luhmann et al. (2014), section 7.3 (test-field calibration); the elimination of points as
Brown, D. C. (1976): The bundle adjustment - progress and prospects.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.numbers import counted
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    free_columns,
    turning_axes,
)
from thermocald.photogrammetry.epoch.adjustment import (
    AdjustmentSettings,
    little_covered,
    obliqueness_deg,
    uncertain,
)
from thermocald.photogrammetry.epoch.gauss_markov import TRUSTED_REDUNDANCY, settle
from thermocald.photogrammetry.field.planes import plane_fit
from thermocald.photogrammetry.linalg import median_variance
from thermocald.photogrammetry.network.bundle import (
    BEHIND,
    Bundle,
    BundleAdjustment,
    Cofactors,
    ImageRays,
    KnownTargets,
    point_tests,
)
from thermocald.photogrammetry.network.shared_errors import estimate_shared_errors
from thermocald.photogrammetry.orientation import resection

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_ITERATIONS = 200
_ROUNDS = 10  # of data snooping, beyond the rays of one target, which go one at a time
_GROSS = 20.0  # times the usual residual; an image point beyond it is left out at first
_GROSS_OF_FEW = 5.0  # the same with the targets held
_POOR = 4.0  # times the residuals of a typical photograph
_MIRRORED = 0.5  # times its residuals, below which another pose of a photograph is tried
_FEWEST_TO_COMPARE = 4  # photographs
_ENOUGH_TARGETS = 20  # for residuals that the photograph's own pose does not absorb
_LARGEST_OBLIQUENESS_NEEDED_DEG = 20.0
_LEAST_SIGMA_MM = 1e-6  # of a coordinate without a sigma in a target that has others


@dataclass(frozen=True, eq=False)
class CommonInterior:
    """One camera calibrated from several photographs.

    interior; covariance (16, 16): its EOP block is zero; exteriors, exterior_covariances (n, 6, 6);
    sigma0; redundancy; used: mask of the observations by photograph; residuals (n, 2) px: by
    photograph; reasons: why the geometry is weak, empty if it is not; disagreement: of the
    photographs (`SharedErrors`), which the covariances include; left_out: {position: reason} of
    photographs that contradict the others, which the n do not include.
    """

    interior: InteriorOrientation
    covariance: Array
    exteriors: tuple[ExteriorOrientation, ...]
    exterior_covariances: Array
    sigma0: float
    redundancy: int
    used: tuple[Mask, ...]
    residuals: tuple[Array, ...]
    reasons: tuple[str, ...]
    disagreement: float
    left_out: dict[int, str]


def adjust_common_interior(
    sensor: Sensor,
    testfield: TestField,
    photographs: Sequence[Observations],
    interior: InteriorOrientation,
    exteriors: Sequence[ExteriorOrientation],
    settings: AdjustmentSettings | None = None,
) -> CommonInterior:
    """Adjust photographs that share an interior orientation, from start values.

    A robust adjustment comes first, which photographs of another camera and gross errors do not
    distort. Raises GeometryError if the adjustment does not converge or is singular.
    """
    s = settings or AdjustmentSettings()
    free = np.array(free_columns(s.free), dtype=np.int64)
    seen = np.unique(np.concatenate([o.targets for o in photographs]))
    rays = ImageRays.collect(photographs)
    rays = replace(rays, target=np.searchsorted(seen, rays.target))
    places, sigmas = testfield.points[seen], testfield.shape_sigmas[seen]
    uncertain = (sigmas > 0).any(axis=1)
    weights = np.where(uncertain[:, None], np.maximum(sigmas, _LEAST_SIGMA_MM) ** -2, 1.0)
    known = KnownTargets(places, weights, uncertain)
    rotations, centres = zip(*((e.rotation, e.centre) for e in exteriors), strict=True)
    bundle = Bundle(interior.as_array(), np.array(rotations), np.array(centres), places)
    every = BundleAdjustment(sensor, rays, free, known)
    in_pixels = replace(every, rays=rays.in_pixels())
    used, left_out = np.ones(len(rays), dtype=bool), dict[int, str]()
    # what the image points show of their noise; targets with sigmas absorb residuals
    shown = 2 * len(rays) - len(free) - 6 * len(photographs) - 3 * int(uncertain.sum())
    few = shown < TRUSTED_REDUNDANCY
    robust = every.with_held_targets(bundle) if few else every
    with suppress(GeometryError):
        bundle = robust.approach(bundle, _ITERATIONS)
        size = np.linalg.norm(robust.residuals(bundle), axis=1)
        left_out = _contradicting(in_pixels.residuals(bundle), size, rays.photo)
        if s.snooping_alpha > 0:
            used = size <= (_GROSS_OF_FEW if few else _GROSS) * max(float(np.median(size)), 1.0)
    if left_out:
        # a photograph of a plane may have begun with the plane's second, mirrored pose
        model = InteriorOrientation.from_array(bundle.interior)
        exteriors = [ExteriorOrientation.from_array(e) for e in bundle.exteriors()]
        turned = False
        for i in left_out:
            o = photographs[i]
            own = float(np.sqrt(np.mean(in_pixels.residuals(bundle)[rays.photo == i] ** 2)))
            for rms, pose in resection(sensor, model, testfield.points[o.targets], o.points)[:1]:
                if rms < _MIRRORED * own:
                    exteriors[i], turned = pose, True
        if turned:
            return adjust_common_interior(sensor, testfield, photographs, model, exteriors, s)
        others = [i for i in range(len(photographs)) if i not in left_out]
        starts = [exteriors[i] for i in others]
        chosen = [photographs[i] for i in others]
        rest = adjust_common_interior(sensor, testfield, chosen, model, starts, s)
        more = {others[i]: reason for i, reason in rest.left_out.items()}
        return replace(rest, left_out=left_out | more)
    bundle, part, found, used, redundancy = _snooped(every, bundle, used, few, s)
    variance = part.cost(bundle, part.residuals(bundle), np.ones(len(part.rays))) / redundancy
    # redundancy of the image points alone: targets that are better than stated lower the variance
    own = 2 * len(part.rays) - float(np.einsum("nii->", part.explained(bundle, found)))
    noise: tuple[float, float] = variance, redundancy
    if own >= TRUSTED_REDUNDANCY:
        noise = max(noise, (float(np.sum(part.residuals(bundle) ** 2)) / own, own))
    f, eops = len(free), bundle.exteriors()
    # how weak the geometry is, whatever the photographs disagree in
    weak = _weaknesses(bundle, part, found.cameras[:f, :f] * noise[0], s)
    shared = estimate_shared_errors(part, bundle, found, *noise)
    Q = found.cameras * shared.noise + shared.cameras.T @ shared.cameras
    covariance = np.zeros((16, 16))
    covariance[np.ix_(free, free)] = Q[:f, :f]
    ends = np.cumsum([len(o) for o in photographs])[:-1]
    return CommonInterior(
        InteriorOrientation.from_array(bundle.interior),
        covariance,
        tuple(ExteriorOrientation.from_array(e) for e in eops),
        _of_angles(Q[f:, f:], bundle, eops),
        float(np.sqrt(variance)),
        redundancy,
        tuple(np.split(used, ends)),
        tuple(np.split(in_pixels.residuals(bundle), ends)),
        tuple(weak),
        shared.disagreement,
        {},
    )


def _snooped(
    every: BundleAdjustment, bundle: Bundle, used: Mask, few: bool, s: AdjustmentSettings
) -> tuple[Bundle, BundleAdjustment, Cofactors, Mask, int]:
    """Adjust by turns with data snooping, first with the image points `used` (n,).

    few: see `snoop_rays`. Returns the bundle, its adjustment with cofactors, the mask of image
    points and the redundancy.
    """
    rays = every.rays
    history = np.zeros(len(rays), dtype=np.int8)
    for _ in range(_ROUNDS + int(np.bincount(rays.target).max())):
        if np.abs(every.residuals(bundle)[used]).max(initial=0.0) >= BEHIND:
            raise GeometryError("targets came to lie behind the camera during the iteration")
        part = BundleAdjustment(every.sensor, rays.select(used), every.free, every.known)
        n = len(part.rays)
        redundancy = 2 * n - len(every.free) - 6 * len(bundle.rotations)
        if redundancy < s.minimum_redundancy:
            raise GeometryError(
                f"{n} image points in {counted(len(bundle.rotations), 'photograph')} leave a "
                f"redundancy of {redundancy}; at least {s.minimum_redundancy} is needed"
            )
        bundle = part.solve(bundle, iterations=_ITERATIONS)
        found = part.cofactors(bundle)
        v = every.residuals(bundle)
        # variance of a residual: less than the noise's if the ray was used, more if it was not
        signs = np.where(used, -1.0, 1.0)[:, None, None]
        tests = point_tests(v, np.eye(2) + signs * every.explained(bundle, found))
        kept = settle(history, used, snoop_rays(tests, rays.target, used, s.snooping_alpha, few))
        if kept is used:
            break
        used = kept
    return bundle, part, found, used, redundancy


def _contradicting(residuals: Array, size: Array, photo: Index) -> dict[int, str]:
    """Return {position: reason} of photographs with too large residuals (n, 2) px, after a robust
    adjustment; size (n,): in standard deviations.
    """
    median = {
        i: float(np.median(size[photo == i]))
        for i, n in enumerate(np.bincount(photo))
        if n >= _ENOUGH_TARGETS
    }
    if len(median) < _FEWEST_TO_COMPARE:
        return {}
    usual = max(float(np.median(list(median.values()))), 1.0)
    return {
        i: f"residuals of {np.sqrt(np.mean(residuals[photo == i] ** 2)):.2f} px, {own / usual:.0f} "
        "times those of the other photographs: another camera, zoom or focus, the camera moved "
        "during the exposure, or the board was bent; left out"
        for i, own in median.items()
        if own > _POOR * usual
    }


def _of_angles(Q: Array, bundle: Bundle, eops: Array) -> Array:
    """Return the covariances (k, 6, 6) of exterior orientations, from the covariance (6k, 6k) of
    rotations about the object's axes and projection centres.
    """
    k = len(eops)
    J = np.broadcast_to(np.eye(6), (k, 6, 6)).copy()
    axes = bundle.rotations @ np.swapaxes(turning_axes(eops, bundle.rotations), 1, 2)
    J[:, :3, :3] = np.linalg.inv(axes)
    blocks = np.einsum("kikj->kij", Q.reshape(k, 6, k, 6))
    result: Array = J @ blocks @ np.swapaxes(J, 1, 2)
    return result


def snoop_rays(tests: Array, target: Index, used: Mask, alpha: float, few: bool) -> Mask:
    """Return the mask of image points to keep; only the worst ray of a target goes at a time.

    few: if the residuals cannot show the noise, the stated sigmas are the scale, and of all rays
    only the worst goes, as a gross error distorts its neighbours.
    """
    if alpha <= 0:
        return used
    # χ² with 2 degrees of freedom
    limit = -2.0 * np.log(alpha) * max(median_variance(tests[used]), float(few))
    worst = np.zeros(1 + int(target.max(initial=0)))
    np.maximum.at(worst, target[used], tests[used])
    if few:
        worst[:] = worst.max()
    kept: Mask = (tests <= limit) | (used & (tests < worst[target]))
    return kept


def _weaknesses(
    bundle: Bundle, adjustment: BundleAdjustment, Q: Array, s: AdjustmentSettings
) -> list[str]:
    """Return the reasons why the photographs do not determine the free parameters.

    Q: covariance of the free parameters from the noise of the image points.
    """
    reasons: list[str] = []
    assert adjustment.known is not None
    # as it is given, since adjusted targets may leave its plane as far as their sigmas allow
    _, axes, flat = plane_fit(adjustment.known.places)
    if flat and "c" in s.free:
        angles = [obliqueness_deg(eop, axes[2]) for eop in bundle.exteriors()]
        if max(angles) < _LARGEST_OBLIQUENESS_NEEDED_DEG:
            reasons.append(
                f"one plane, in all {len(angles)} photographs within {max(angles):.0f}° of frontal "
                f"(some at {_LARGEST_OBLIQUENESS_NEEDED_DEG:.0f}° and more are needed): principal "
                "distance and distance to the field cannot be separated, however small the "
                "residuals are"
            )
    sentence = "the targets cover {} of the image in all photographs together"
    reasons += little_covered(adjustment.sensor, adjustment.rays.points, sentence)
    sd = np.zeros(16)
    sd[adjustment.free] = np.sqrt(np.diag(Q))
    return reasons + uncertain(adjustment.sensor, bundle.interior, sd, s.free)
