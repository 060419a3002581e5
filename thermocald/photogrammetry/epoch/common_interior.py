"""Several photographs of one camera: one interior orientation, an exterior one per photograph.

Each photograph contributes its normal equations with its exterior orientation reduced. A
photograph too poor to carry an interior orientation of its own takes part all the same.

Source: Luhmann et al. (2014), section 7.3 (test-field calibration).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    partials,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.epoch.gauss_markov import chi2_2d, cofactor_root, point_covariances
from thermocald.photogrammetry.epoch.geometry import image_coverage, obliqueness_deg
from thermocald.photogrammetry.orientation.approximate import plane_fit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import Observations, TestField

    Array = NDArray[np.float64]
    Mask = NDArray[np.bool_]

__all__ = ["CommonInterior", "adjust_common_interior"]

_ITERATIONS = 60
_CONVERGED = 1e-3
_ROUNDS = 6
_LARGEST_OBLIQUENESS_NEEDED_DEG = 20.0


@dataclass(frozen=True, eq=False)
class CommonInterior:
    """One camera from several photographs.

    interior; covariance (16, 16), its EOP block zero; exteriors, exterior_covariances (n, 6, 6);
    sigma0; redundancy; used: masks of the observations per photograph; residuals per photograph
    (n, 2) px; reasons: why the geometry is weak, empty where it is not.
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


@dataclass(frozen=True, eq=False)
class _Block:
    """Normal equations of one photograph: interior (q), coupling, exterior (6), and its cost."""

    N: Array
    C: Array
    E: Array
    b: Array
    e: Array
    cost: float
    residuals: Array
    tests: Array


def adjust_common_interior(
    sensor: Sensor,
    testfield: TestField,
    photographs: Sequence[Observations],
    interior: InteriorOrientation,
    exteriors: Sequence[ExteriorOrientation],
    settings: AdjustmentSettings | None = None,
) -> CommonInterior:
    """Adjust photographs that share an interior orientation, from start values.

    Raises GeometryError where the adjustment does not converge or is singular.
    """
    s = settings or AdjustmentSettings()
    free = np.array([i for i in AdjustmentSettings(free=s.free).unknowns if i < 10], dtype=np.int64)
    values = interior.as_array()
    eops = np.array([e.as_array() for e in exteriors])
    used = [np.ones(len(o), dtype=bool) for o in photographs]
    for _ in range(_ROUNDS):
        values, eops, blocks, root = _solve(
            sensor, testfield, photographs, values, eops, used, free
        )
        kept = _snoop(blocks, used, s.snooping_alpha)
        if all(np.array_equal(a, b) for a, b in zip(kept, used, strict=True)):
            break
        used = kept
    n = sum(int(m.sum()) for m in used)
    redundancy = 2 * n - len(free) - 6 * len(photographs)
    if redundancy < s.bounds.minimum_redundancy:
        raise GeometryError(
            f"{n} image points in {len(photographs)} photographs leave a redundancy of "
            f"{redundancy}; at least {s.bounds.minimum_redundancy} is needed"
        )
    variance = sum(b.cost for b in blocks) / redundancy
    factor = variance if s.scale == "posterior" else 1.0
    Q = root @ root.T
    covariance = np.zeros((16, 16))
    covariance[np.ix_(free, free)] = Q * factor
    exterior_covariances = np.empty((len(photographs), 6, 6))
    for k, block in enumerate(blocks):
        own = np.linalg.inv(block.E)
        G = own @ block.C.T
        exterior_covariances[k] = (own + G @ Q @ G.T) * factor
    result_eops = tuple(ExteriorOrientation.from_array(e) for e in eops)
    reasons = _weaknesses(sensor, testfield, photographs, used, values, eops, covariance, s)
    return CommonInterior(
        InteriorOrientation.from_array(values),
        covariance,
        result_eops,
        exterior_covariances,
        float(np.sqrt(variance)),
        redundancy,
        tuple(used),
        tuple(b.residuals for b in blocks),
        tuple(reasons),
    )


def _block(
    sensor: Sensor,
    testfield: TestField,
    obs: Observations,
    iop: Array,
    eop: Array,
    used: Mask,
    free: NDArray[np.int64],
) -> _Block:
    predicted, A, B = partials(sensor, iop, eop, testfield.points[obs.targets])
    if not np.isfinite(predicted[used]).all():
        raise GeometryError("targets came to lie behind the camera during the iteration")
    residuals = obs.points - predicted
    variances = testfield.sigmas[obs.targets] ** 2
    cov = point_covariances(obs, B, variances if variances.any() else None)
    det = cov[:, 0] * cov[:, 1] - cov[:, 2] ** 2
    P = np.empty((len(obs), 2, 2))
    P[:, 0, 0], P[:, 1, 1] = cov[:, 1] / det, cov[:, 0] / det
    P[:, 0, 1] = P[:, 1, 0] = -cov[:, 2] / det
    tests = np.einsum("ni,nij,nj->n", residuals, P, residuals)
    Au, Pu, ru = A[used], P[used], residuals[used]
    PA = Pu @ Au
    full = np.einsum("nik,nil->kl", Au, PA)
    right = np.einsum("nik,ni->k", PA, ru)
    e = np.arange(10, 16)
    return _Block(
        full[np.ix_(free, free)],
        full[np.ix_(free, e)],
        full[np.ix_(e, e)],
        right[free],
        right[e],
        float(tests[used].sum()),
        residuals,
        tests,
    )


def _solve(
    sensor: Sensor,
    testfield: TestField,
    photographs: Sequence[Observations],
    values: Array,
    eops: Array,
    used: Sequence[Mask],
    free: NDArray[np.int64],
) -> tuple[Array, Array, list[_Block], Array]:
    def blocks_at(v: Array, e: Array) -> list[_Block]:
        return [
            _block(sensor, testfield, o, v, eop, m, free)
            for o, eop, m in zip(photographs, e, used, strict=True)
        ]

    blocks = blocks_at(values, eops)
    for _ in range(_ITERATIONS):
        N, b = np.zeros((len(free), len(free))), np.zeros(len(free))
        own = [np.linalg.pinv(block.E, hermitian=True) for block in blocks]
        for block, inverse in zip(blocks, own, strict=True):
            N += block.N - block.C @ inverse @ block.C.T
            b += block.b - block.C @ inverse @ block.e
        root = cofactor_root(N, free) if len(free) else np.zeros((0, 0))
        d = root @ (root.T @ b)
        de = np.array([i @ (block.e - block.C.T @ d) for i, block in zip(own, blocks, strict=True)])
        gain = float(b @ d) + sum(
            float(block.e @ i @ block.e) for i, block in zip(own, blocks, strict=True)
        )
        cost = sum(block.cost for block in blocks)
        for share in (1.0, 0.5, 0.25, 0.1, 0.03, 0.01):
            trial, trial_eops = values.copy(), eops + share * de
            trial[free] += share * d
            try:
                new = blocks_at(trial, trial_eops)
            except GeometryError:
                continue
            if sum(block.cost for block in new) <= cost * (1 + 1e-9):
                break
        else:
            raise GeometryError("the adjustment does not converge from its start values")
        values, eops, blocks = trial, trial_eops, new
        if share == 1.0 and gain < _CONVERGED**2:
            return values, eops, blocks, root
        if share == 1.0 and cost - sum(block.cost for block in new) < 1e-8 * cost:
            return values, eops, blocks, root
    raise GeometryError(f"the adjustment did not converge in {_ITERATIONS} iterations")


def _snoop(blocks: Sequence[_Block], used: Sequence[Mask], alpha: float) -> list[Mask]:
    """Which image points stay; their own leverage is neglected, as hundreds share few unknowns."""
    if alpha <= 0:
        return list(used)
    tests = np.concatenate([block.tests[m] for block, m in zip(blocks, used, strict=True)])
    limit = chi2_2d(alpha) * max(float(np.median(tests)) / (2 * np.log(2)), 1e-12)
    return [block.tests <= limit for block in blocks]


def _weaknesses(
    sensor: Sensor,
    testfield: TestField,
    photographs: Sequence[Observations],
    used: Sequence[Mask],
    values: Array,
    eops: Array,
    covariance: Array,
    s: AdjustmentSettings,
) -> list[str]:
    """Why the photographs do not carry the free parameters."""
    reasons: list[str] = []
    if not s.free:
        return reasons
    seen = np.unique(np.concatenate([o.targets[m] for o, m in zip(photographs, used, strict=True)]))
    _, axes, flat = plane_fit(testfield.points[seen])
    if flat and "c" in s.free:
        angles = [obliqueness_deg(eop, axes[2]) for eop in eops]
        if max(angles) < _LARGEST_OBLIQUENESS_NEEDED_DEG:
            reasons.append(
                f"one plane, in all {len(eops)} photographs within {max(angles):.0f}° of frontal "
                f"(some at {_LARGEST_OBLIQUENESS_NEEDED_DEG:.0f}° and more are needed): principal "
                "distance and distance to the field cannot be told apart, however small the "
                "residuals are"
            )
    points = np.concatenate([o.points[m] for o, m in zip(photographs, used, strict=True)])
    coverage = image_coverage(sensor, points)
    if coverage < s.bounds.coverage:
        reasons.append(
            f"the targets cover {coverage:.1%} of the image in all photographs together (at least "
            f"{s.bounds.coverage:.0%} are needed)"
        )
    sd = np.sqrt(np.diag(covariance))
    if "c" in s.free and sd[0] > s.bounds.relative_sd_c * values[0]:
        reasons.append(
            f"the principal distance is known to {sd[0] / values[0]:.1%} only "
            f"(bound {s.bounds.relative_sd_c:.1%})"
        )
    for name, column in (("x0", 1), ("y0", 2)):
        if name in s.free and sd[column] / sensor.pixel_pitch > s.bounds.sd_point_px:
            reasons.append(
                f"{name} is known to {sd[column] / sensor.pixel_pitch:.0f} px only "
                f"(bound {s.bounds.sd_point_px:.0f} px)"
            )
    return reasons
