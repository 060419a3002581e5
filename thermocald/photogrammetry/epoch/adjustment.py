"""Least-squares adjustment of one epoch (Gauss-Markov), with data snooping and diagnosis.

With or without start values. The observations are image points with their a-priori covariance, and
object coordinates: these are eliminated point by point, so that B Σ Bᵀ is added to the covariance
of the image point, which gives the same solution. Gross errors are found by Baarda's data snooping
on the two coordinates of a point together.

An adjustment of a frontal plane, or of targets in one corner of the image, converges with small
residuals; nevertheless its parameters are not those of the camera. Such an epoch is refused, with
the figure and the bound that it exceeds.

The covariance includes the noise of the image points and, epoch by epoch, of the object
coordinates. It does not include errors of the camera model.

Source: Luhmann et al. (2014), section 2.4; Baarda, W. (1968): A testing procedure for use in
geodetic networks; the elimination as Mikhail and Ackermann (1976), chapter 11.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import ConfigurationError, GeometryError
from thermocald.numbers import percent
from thermocald.photogrammetry.camera.camera_model import (
    DEFAULT_FREE,
    EOP,
    EOP_COLUMNS,
    EOP_NAMES,
    IOP,
    IOP_NAMES,
    PARAMETER_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    free_columns,
    rotation,
)
from thermocald.photogrammetry.epoch.gauss_markov import (
    TRUSTED_REDUNDANCY,
    NoConvergenceError,
    Problem,
    Solution,
    fails_global_test,
    most_rejected,
    point_tests,
    resolve,
    settle,
    snoop,
    solve,
)
from thermocald.photogrammetry.field.planes import plane_fit
from thermocald.photogrammetry.orientation import approximate_orientation, resection

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_ROUNDS = 12  # of data snooping; each may reject several targets
_SEVERAL = 10  # targets of a known camera, of which two may be rejected
_MINIMUM_REDUNDANCY = 6
MAX_RELATIVE_SD_C = 0.01
"""Largest sd(c)/c of an epoch with a result."""
MAX_SD_POINT_PX = 25.0
"""Largest sd of x0 and y0."""
MIN_COVERAGE = 0.10
"""Smallest share of the image inside the targets' convex hull."""
_MIN_OBLIQUENESS_DEG = 15.0  # angle between the optical axis and the normal of a plane field


def image_coverage(sensor: Sensor, image_points: Array) -> float:
    """Return the share of the image inside the convex hull of image points (n, 2)."""
    import cv2

    hull = cv2.convexHull(np.ascontiguousarray(image_points, dtype=np.float32))
    return float(cv2.contourArea(hull)) / (sensor.width * sensor.height)


def obliqueness_deg(eop: Array, normal: Array) -> float:
    """Return the angle between the optical axis and a plane's normal; 0 for a frontal view."""
    axis = rotation(eop[:3])[:, 2]
    return float(np.degrees(np.arccos(min(1.0, abs(float(axis @ normal))))))


def weaknesses(
    sensor: Sensor,
    points: Array,
    image_points: Array,
    values: Array,
    covariance: Array,
    free: Collection[str] = DEFAULT_FREE,
    correlation_bound: float | None = 0.9999,
) -> list[str]:
    """Return the reasons why the geometry does not determine the free IOP; empty if it does.

    points (n, 3) mm and image_points (n, 2) px of the targets used; values (16,) and covariance
    (16, 16) of the adjustment; correlation_bound: of an IOP with any parameter. Held parameters are
    not tested: a pose alone needs far less. None: nothing is.
    """
    if correlation_bound is None:
        return []
    variance = covariance.diagonal()  # negative by rounding where nothing determines a parameter
    sd = np.sqrt(np.where(variance >= 0.0, variance, np.inf))
    reasons = uncertain(sensor, values, sd, free)
    if "c" in free and not _has_depth(points):
        _, axes, flat = plane_fit(points)
        angle = obliqueness_deg(values[EOP], axes[2])
        if flat and angle < _MIN_OBLIQUENESS_DEG:
            reasons.append(
                f"one plane seen at {angle:.0f}° from frontal (at least "
                f"{_MIN_OBLIQUENESS_DEG:.0f}° are needed): principal distance and "
                "distance to the field cannot be separated"
            )
    if {"x0", "y0", "A1", "A2", "A3", "B1", "B2"}.intersection(free):
        reasons += little_covered(sensor, image_points, "the targets cover {} of the image")
    # only pairs with an IOP: correlated EOP do no harm to the camera
    scale = 1.0 / np.where(sd > 0, sd, np.inf)
    inner = np.abs(covariance[: len(IOP_NAMES)] * scale) * scale[: len(IOP_NAMES), None]
    inner.flat[:: len(sd) + 1] = 0.0
    i, j = divmod(int(inner.argmax()), len(sd))
    if inner[i, j] > correlation_bound:
        reasons.append(
            f"{PARAMETER_NAMES[i]} and {PARAMETER_NAMES[j]} correlate at {inner[i, j]:.5f} "
            f"(bound {correlation_bound})"
        )
    return reasons


def little_covered(sensor: Sensor, image_points: Array, sentence: str) -> list[str]:
    """Return the sentence, with the share in place of {}, if image points cover too little."""
    coverage = image_coverage(sensor, image_points)
    if coverage >= MIN_COVERAGE:
        return []
    least = f" (at least {percent(MIN_COVERAGE)} are needed)"
    return [sentence.format(percent(coverage, 1)) + least]


def uncertain(sensor: Sensor, values: Array, sd: Array, free: Collection[str]) -> list[str]:
    """Return a reason for each of c, x0 and y0 that is free and has an sd beyond its bound.

    values, sd (16,): of the adjustment.
    """
    reasons = []
    share = sd[0] / values[0]
    if "c" in free and share > MAX_RELATIVE_SD_C:
        known = f"is known to {percent(share, 1)} only" if share < 1 else "is not determined"
        reasons.append(f"the principal distance {known} (bound {percent(MAX_RELATIVE_SD_C, 1)})")
    for name, column in (("x0", 1), ("y0", 2)):
        size = sd[column] / sensor.pixel_pitch
        if name in free and size > MAX_SD_POINT_PX:
            inside = size < max(sensor.width, sensor.height)
            known = f"is known to {size:.0f} px only" if inside else "is not determined"
            reasons.append(f"{name} {known} (bound {MAX_SD_POINT_PX:.0f} px)")
    return reasons


def _has_depth(points: Array) -> bool:
    """Return whether points are certainly not in one plane: a quick test before `plane_fit`."""
    reduced = points - np.full(len(points), 1.0 / len(points)) @ points
    (a, b, c), (_, d, e), (_, _, f) = (points.T @ reduced).tolist()
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return bool(determinant > 1e-4 * (a + d + f) ** 3)


@dataclass(frozen=True, slots=True)
class AdjustmentSettings:
    """Settings of an adjustment: what is estimated and tested.

    free: names of the IOP to estimate, the others keep their start values; priors: {name: (value,
    sd)} in the parameter's unit; snooping_alpha: error probability of a single test, 0 for no
    snooping; max_rejected: share of rejected targets beyond which the epoch fails;
    correlation_bound: of `weaknesses`, None if any geometry will do.
    """

    free: tuple[str, ...] = DEFAULT_FREE
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    snooping_alpha: float = 0.0005
    max_rejected: float = 0.35
    correlation_bound: float | None = 0.9999

    def __post_init__(self) -> None:
        for name in (*self.free, *self.priors):
            if name not in PARAMETER_NAMES:
                raise ConfigurationError(
                    f"{name!r} is not a parameter; choose from {', '.join(PARAMETER_NAMES)}"
                )

    @property
    def minimum_redundancy(self) -> int:
        """Smallest redundancy of a result."""
        return 0 if self.correlation_bound is None else _MINIMUM_REDUNDANCY

    @property
    def unknowns(self) -> Index:
        """Positions of the unknowns in `PARAMETER_NAMES`."""
        return np.array([*free_columns(self.free), *EOP_COLUMNS], dtype=np.int64)


_USUAL = AdjustmentSettings()


@dataclass(frozen=True, eq=False)
class Adjustment:
    """The result of one adjustment.

    status: `ok`, or one word for why there is no result; reason: the same in a sentence; covariance
    (16, 16): in the order of `PARAMETER_NAMES`, zero for held parameters; targets (n,): rows of the
    test field, as in `rejected`; residuals (n, 2) px: measured minus adjusted, of all targets.
    """

    status: str
    reason: str
    interior: InteriorOrientation | None
    exterior: ExteriorOrientation | None
    covariance: Array
    free: tuple[str, ...]
    sigma0: float
    redundancy: int
    targets: Index
    residuals: Array
    rejected: tuple[int, ...]

    @property
    def ok(self) -> bool:
        """Whether there is a usable result."""
        return self.status == "ok"

    @property
    def n_observations(self) -> int:
        """Number of measured targets, the rejected ones included."""
        return len(self.targets)

    @property
    def values(self) -> Array:
        """The 16 parameters; NaN without a result."""
        if self.interior is None or self.exterior is None:
            return np.full(16, np.nan)
        return np.concatenate([self.interior.as_array(), self.exterior.as_array()])

    @property
    def sd(self) -> Array:
        """Standard deviations (16,); NaN for held parameters."""
        variance = np.diag(self.covariance)
        return np.sqrt(np.where(variance > 0, variance, np.nan))


def failed(
    status: str, reason: str, observations: Observations | None = None, free: tuple[str, ...] = ()
) -> Adjustment:
    """Return the result of an epoch that has none, with its status and reason."""
    targets = np.empty(0, dtype=np.int64) if observations is None else observations.targets
    n = len(targets)
    return Adjustment(
        status, reason, None, None, np.zeros((16, 16)), free, float("nan"), 0, targets,
        np.full((n, 2), np.nan), (),
    )  # fmt: skip


def adjust(
    sensor: Sensor,
    testfield: TestField,
    observations: Observations,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    settings: AdjustmentSettings | None = None,
    suspects: Mask | None = None,
    known: Array | None = None,
) -> Adjustment:
    """Adjust one epoch from start values.

    suspects: mask (n,) of observations to leave out at first, which are taken back if they fit;
    known: covariance (10, 10) of `interior`, which then is an observation in place of the priors.
    Never raises because of the data: an epoch without a result has a status and a reason.
    """
    s = settings or _USUAL
    unknowns = s.unknowns
    n = len(observations)
    redundancy = _redundancy(n, s, len(unknowns), known is not None)
    if redundancy < s.minimum_redundancy:
        return _refuse_few(observations, s, redundancy)
    start = np.concatenate([interior.as_array(), exterior.as_array()])
    before, covariance = start.copy(), np.zeros((16, 16))
    covariance[IOP, IOP] = 0.0 if known is None else known
    for name, (value, sd) in s.priors.items() if known is None else ():
        k = PARAMETER_NAMES.index(name)
        before[k], covariance[k, k] = value, sd**2
    problem = Problem.build(sensor, testfield, observations, unknowns, before, covariance)
    use = np.ones(n, dtype=bool) if suspects is None else ~suspects
    most = most_rejected(s.max_rejected, 2 * n - len(unknowns))
    if known is not None and n >= _SEVERAL:  # eight points are left for six unknowns
        most = max(most, min(s.max_rejected, 2.0 / n))
    try:
        solution = solve(problem, start, use)
        tests = point_tests(solution, use)
        history = np.zeros(n, dtype=np.int8)
        for _ in range(_ROUNDS):
            keep = snoop(tests, use, len(unknowns), s.snooping_alpha)
            keep = settle(history, use, keep)
            if keep is use:
                break
            use = keep
            if use.sum() < (1 - most) * n:
                return failed(
                    "too_many_rejected",
                    f"{n - int(use.sum())} of {n} targets contradict the others: a moved test "
                    "field, a wrong one, or a blurred image",
                    observations,
                    s.free,
                )
            solution = resolve(problem, solution, use)
            tests = point_tests(solution, use)
    except (GeometryError, NoConvergenceError) as error:
        word = "weak_geometry" if isinstance(error, GeometryError) else "no_convergence"
        return failed(word, str(error), observations, s.free)
    return _result(problem, solution, s, use, redundancy)


def _redundancy(n: int, s: AdjustmentSettings, unknowns: int, known: bool = False) -> int:
    """Return the redundancy of n targets; known: whether `adjust` is given the covariance."""
    # priors of held parameters are no observations
    priors = len(s.free) if known else len(s.priors.keys() & {*s.free, *EOP_NAMES})
    return 2 * n + priors - unknowns


def _refuse_few(observations: Observations, s: AdjustmentSettings, redundancy: int) -> Adjustment:
    return failed(
        "too_few_targets",
        f"{len(observations)} targets for {len(s.unknowns)} unknowns leave a redundancy of "
        f"{redundancy}; at least {s.minimum_redundancy} is needed: show more targets or "
        "hold parameters fixed",
        observations,
        s.free,
    )


def _result(
    problem: Problem, solution: Solution, s: AdjustmentSettings, use: Mask, redundancy: int
) -> Adjustment:
    """Return the result of a solution; redundancy: of all targets, rejected ones included."""
    u, n = problem.unknowns, int(np.count_nonzero(use))
    redundancy -= 2 * (len(use) - n)
    v, points, observed = solution.whitened[-1], problem.points, problem.observations.points
    rejected: tuple[int, ...] = ()
    if n < len(use):
        v, points, observed = v[:, use], points[use], observed[use]
        rejected = tuple(problem.observations.targets[~use].tolist())
    sigma0 = sqrt(problem.cost(v, solution.values) / redundancy) if redundancy else 0.0
    few = redundancy < TRUSTED_REDUNDANCY
    root = np.zeros((16, len(u)))
    root[u] = solution.root
    covariance = root @ root.T
    covariance *= max(1.0, sigma0**2) if few else sigma0**2  # few may be small by chance
    values = solution.values.tolist()
    result = Adjustment(
        "ok",
        "",
        InteriorOrientation(*values[IOP]),
        ExteriorOrientation(*values[EOP]),
        covariance,
        tuple(name for name in IOP_NAMES if name in s.free),
        sigma0,
        redundancy,
        problem.observations.targets,
        solution.residuals.T,
        rejected,
    )
    if few and s.snooping_alpha > 0 and fails_global_test(sigma0**2, redundancy, n < len(use)):
        why = (
            f"the residuals are {sigma0:.1f} times their stated sigmas, and a redundancy of "
            f"{redundancy} does not show whether a target is wrong or the noise larger than "
            "stated: show more targets, or state larger sigmas"
        )
        return replace(result, status="global_test", reason=why)
    reasons = weaknesses(
        problem.sensor, points, observed, solution.values, covariance, s.free, s.correlation_bound
    )
    if reasons:
        return replace(result, status="weak_geometry", reason="; ".join(reasons))
    return result


_FEWEST_FOR_POSE = 8  # two markers: one alone has two poses and little redundancy
_AMBIGUITY = 2.0  # a second pose is excluded if its residuals are this many times as large
_GROSS = 6.0  # times the median residual; a target beyond it is left out at first


def with_few_free(s: AdjustmentSettings) -> AdjustmentSettings:
    """Return settings for a start: only c and A1, as far as they are free, without any bounds."""
    few = tuple(name for name in ("c", "A1") if name in s.free)
    return replace(s, free=few, correlation_bound=None, priors={})


def cold_start(
    sensor: Sensor,
    testfield: TestField,
    observations: Observations,
    settings: AdjustmentSettings | None = None,
    nominal_c: float | None = None,
    interior: InteriorOrientation | None = None,
) -> Adjustment:
    """Adjust an epoch without start values.

    nominal_c mm: from the data sheet, or None; interior: an earlier calibration to start from.
    The principal distance and A1 are estimated first, as the higher terms follow any gross error.
    Never raises because of the data: an epoch without a result has a status and a reason.
    """
    s = settings or AdjustmentSettings()
    if len(observations) == 0:
        return failed("no_observations", "no target was measured", observations, s.free)
    redundancy = _redundancy(len(observations), s, len(s.unknowns))
    if redundancy < s.minimum_redundancy:  # few targets may have no orientation either
        return _refuse_few(observations, s, redundancy)
    points = testfield.points[observations.targets]
    try:
        start_interior, start_exterior, fits = approximate_orientation(
            sensor, points, observations.points, nominal_c, interior
        )
    except GeometryError as error:
        few = len(observations) < 4
        word = "too_few_targets" if few else "no_orientation"
        return failed(word, str(error), observations, s.free)
    suspects, firm = ~fits, with_few_free(s)
    if len(firm.free) < len(s.free):
        loose = replace(firm, snooping_alpha=0.0)
        rough = adjust(
            sensor, testfield, observations, start_interior, start_exterior, loose, suspects
        )
        if rough.ok and rough.interior is not None and rough.exterior is not None:
            start_interior, start_exterior = rough.interior, rough.exterior
            size = np.linalg.norm(rough.residuals, axis=1)
            suspects = size > _GROSS * max(float(np.median(size)), 0.1)
    result = adjust(sensor, testfield, observations, start_interior, start_exterior, s, suspects)
    if s.snooping_alpha > 0 or not suspects.any() or result.interior is None:
        return result
    # without snooping all targets are used: the suspects were left out of the start only
    assert result.exterior is not None
    return adjust(sensor, testfield, observations, result.interior, result.exterior, s)


def pose_only(
    sensor: Sensor,
    testfield: TestField,
    observations: Observations,
    interior: InteriorOrientation,
    settings: AdjustmentSettings | None = None,
) -> Adjustment:
    """Estimate the exterior orientation alone, with the interior orientation held.

    The targets must exclude the mirrored pose, which a single plane seen from far away has.
    """
    s = replace(settings or AdjustmentSettings(), free=(), priors={})
    n = len(observations)
    if n < _FEWEST_FOR_POSE:
        return failed(
            "too_few_targets",
            f"{n} targets; a pose that can be checked needs at least {_FEWEST_FOR_POSE} (two "
            "markers)",
            observations,
        )
    points = testfield.points[observations.targets]
    try:
        _, exterior, fits = approximate_orientation(
            sensor, points, observations.points, interior=interior
        )
    except GeometryError as error:
        return failed("no_orientation", str(error), observations)
    result = adjust(sensor, testfield, observations, interior, exterior, s, ~fits)
    if not result.ok:
        return result
    # a plane has a second, mirrored pose
    rms = [rms for rms, _ in resection(sensor, interior, points, observations.points)]
    flat = plane_fit(points, 0.005)[2]
    if flat and len(rms) > 1 and rms[1] < _AMBIGUITY * max(rms[0], 1e-9):
        return failed(
            "ambiguous_pose",
            "the targets lie in one plane and a second, mirrored pose fits nearly as well: show "
            "targets of another plane or move closer",
            observations,
        )
    return result
