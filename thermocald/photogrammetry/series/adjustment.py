"""Adjustment of a whole series, with parameters per epoch and parameters common to all epochs.

Parameters are per epoch (`free`, and the EOP with `exterior="per_epoch"`), common to the series
(the EOP with `exterior="series"`, and a constant offset per target), or held. Each epoch
contributes normal equations of the common unknowns, with its own parameters eliminated.

All epochs are in memory here; `long_series` adjusts a series of any length in blocks. `result`
defines the results. A target that is hidden now and then shifts single epochs by its coordinate
error; with `target_offsets` that error is an unknown with the test field's sigma as its prior.

The exterior orientation is estimated as set by the user, or as chosen by the data.

Source: DESIGN idea 3; the test of stillness is Rao's score test (1948).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.numbers import counted, percent
from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    EOP_COLUMNS,
    IOP,
    PRINCIPAL_POINT,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    free_columns,
)
from thermocald.photogrammetry.epoch.adjustment import (
    MAX_RELATIVE_SD_C,
    MAX_SD_POINT_PX,
    weaknesses,
)
from thermocald.photogrammetry.epoch.gauss_markov import (
    TRUSTED_REDUNDANCY,
    fails_global_test,
    most_rejected,
)
from thermocald.photogrammetry.series.covariances import (
    all_cofactors,
    correlated_error_cofactors,
    estimate_held_affinity,
    level_errors,
    line_weights,
    perspective_cofactor_roots,
    scaled_covariances,
    shown_movement,
    slow_target_covariance,
    stillness,
    typical_sensitivity,
    with_excess,
)
from thermocald.photogrammetry.series.estimator import NOISE_SHOWN, Estimate, SeriesEstimator
from thermocald.photogrammetry.series.mount import (
    FEWEST_EPOCHS,
    Movement,
    estimate_movement,
    image_px,
)
from thermocald.photogrammetry.series.normals import ObservationGrid, among_all, linearise
from thermocald.photogrammetry.series.result import (
    Exterior,
    SeriesAdjustment,
    SeriesSettings,
    enough_targets,
)
from thermocald.photogrammetry.series.system import State, point_tests
from thermocald.photogrammetry.series.target_noise import (
    FEW_EPOCHS,
    excess_scatter,
    neighbours_variance,
    noise_by_radius,
    slow_course,
    slow_errors,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.field.testfield import Observations, TestField


_LOOSE_PX = 3.0  # far beyond the tremble of a mount, and beyond the noise of an epoch's perspective
_QUIETEST = 0.1  # variance of unit weight of an epoch, over that of the series
_MENTIONED = 0.05  # share of the movement's variance
_HIDABLE = 3.0  # times the mean noise, a movement beyond which that noise cannot hide


def choose_exterior(
    series: SeriesEstimator, asked: Exterior, good: int, estimate: Estimate | None = None
) -> SeriesEstimator:
    """Choose how the exterior orientation is estimated, from the good epochs and an estimate."""
    if estimate is None or good < FEWEST_EPOCHS:
        why = f"too few epochs ({good} of {FEWEST_EPOCHS}) to show how the mount moves"
        s = replace(series.s, exterior="per_epoch")
        return replace(series, s=s, bound=None, choice=why)
    movement, A = estimate_mount_movement(series, estimate), estimate.system.design.at.A
    if asked == "auto" and not movement.still and not movement.jumps:
        # The noise of a camera that warms up and defocuses changes. Only the choice depends on it.
        unit = series.noise(estimate)[0] / series.variance(estimate)
        mean = float(neighbours_variance(unit, estimate.solved)[estimate.system.good].mean())
        if movement.over_noise < _HIDABLE * mean:
            noisier = estimate_mount_movement(series, estimate, mean)
            movement = noisier if noisier.still else movement
    px = image_px(movement.covariance, A)
    doubt = ""
    if movement.hidden.any():
        hidden = 2.0 * image_px(movement.hidden, A)
        where = "between the sampled epochs" if series.windows else "in a gap"
        doubt = f"; {where} it may have moved by up to {hidden:.1g} px unnoticed"
    if (drift := image_px(movement.drift, A)) > 2.0 * px:
        doubt += (
            f"; but over the series the perspective changes as if it drifted by {drift:.1g} px, "
            "which counts as the camera's: compare --exterior per_epoch"
        )
    if movement.still and asked == "auto":
        noise = image_px(movement.noise, A)
        why = f"no movement of the mount beyond the noise of an epoch ({noise:.3f} px){doubt}"
        return replace(series, s=replace(series.s, exterior="series"), bound=None, choice=why)
    how = ""
    part = (image_px(movement.slow, A) / max(px, 1e-12)) ** 2
    if part > _MENTIONED:
        slowly = f"over about {counted(round(movement.memory), 'epoch')}"
        how = f", {percent(part)} of it {slowly if movement.memory < good / 3 else 'slowly'}"
    if movement.jumps:
        at = f"at row {', '.join(map(str, movement.jumps))}"
        how += f", with jumps {'in a sample of the epochs' if series.windows else at}"
    if movement.touched and not series.windows:
        rows = ", ".join(map(str, movement.touched))
        how += f", and briefly by more (touched?) at row {rows}"
    why = f"the mount moves by {px:.3f} px about its mean pose{how}{doubt}"
    return replace(series, bound=movement.precision(), movement=movement, choice=why)


def estimate_mount_movement(
    series: SeriesEstimator, estimate: Estimate, noisier: float = 1.0
) -> Movement:
    """Estimate the variance components of the mount's movements from an estimate of the series.

    noisier: factor of the series' variance of unit weight.
    """
    system, variance = estimate.system, noisier * series.variance(estimate)
    at, N = system.design.at, system.N
    before = np.concatenate([at.iop, at.eop])
    b = system.gradient(estimate.residuals)
    b = b + np.einsum("eij,ej->ei", N, estimate.values - before)
    correlated = None
    if series.s.target_noise and len(pairs := series.pairs(estimate)):
        typical = (series.grid.weights * system.use[..., None])[system.good].mean(axis=0)
        extra = pairs.normal_matrices(typical[None], at.A[..., EOP])[0]
        correlated = extra / variance**2
    free = np.array(free_columns(series.s.free), dtype=np.int64)
    good = system.good & np.isfinite(b).all(axis=1)  # epochs that diverged are left out
    gaps = [*series.s.gaps, *(part.start for part in series.windows[1:])]
    unit, _, redundancy = series.noise(estimate)
    shown = estimate.solved & (redundancy >= TRUSTED_REDUNDANCY)
    scale = np.sqrt(neighbours_variance(unit / variance, shown, _QUIETEST))
    found = estimate_movement(
        N / variance, b / variance, free, good, scale, series.s.drift_period, correlated, gaps
    )
    if not series.windows:
        return found
    if found.jumps:  # where between the parts of a long series the mount moved is not known
        memory = max(found.memory, len(N) / 2.0)
        found = replace(found, slow=found.slow + found.of_jumps, memory=memory)
    return replace(found, steps=())


def adjust_series(
    sensor: Sensor,
    testfield: TestField,
    epochs: Sequence[Observations | None] | ObservationGrid,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    settings: SeriesSettings | None = None,
) -> SeriesAdjustment:
    """Adjust all epochs of a camera, from start values good to a few per cent.

    epochs: the observations, None for an epoch without any, or their grid. Never raises because of
    the data: an epoch without a result has a status and a reason.
    """
    s = settings or SeriesSettings()
    if not isinstance(epochs, ObservationGrid):
        epochs = ObservationGrid.from_observations(testfield, epochs)
    # Targets that are never seen would add unknowns without observations.
    seen = np.flatnonzero(epochs.observed.any(axis=0))
    start = np.concatenate([interior.as_array(), exterior.as_array()])
    found = adjusted(sensor, testfield.subset(seen), epochs.targets(seen), start, s)
    return result(*found).spread(seen, len(testfield))


def adjusted(
    sensor: Sensor,
    testfield: TestField,
    grid: ObservationGrid,
    start: Array,
    s: SeriesSettings,
    windows: tuple[slice, ...] = (),
    field_variance: float = 1.0,
) -> tuple[SeriesEstimator, Estimate]:
    """Estimate a series on a grid of epochs × all targets of its field, from values (16,).

    Returns the final estimator and the estimate. windows: runs of consecutive epochs, if the series
    is a sample of a longer one; field_variance: first factor of the field's stated covariance.
    """
    use = grid.observed & enough_targets(grid, s)[:, None]
    first = State(np.tile(start, (len(use), 1)), np.zeros((len(testfield), 2)), start[EOP])
    series = SeriesEstimator(
        sensor, testfield, grid, s, windows=windows, field_variance=field_variance
    )
    if s.exterior in ("mount", "auto") and len(use) < FEWEST_EPOCHS:
        series = choose_exterior(series, s.exterior, len(use))
    elif s.exterior in ("mount", "auto"):
        # The mount is loose at first, so that movements do not look like gross errors.
        A = linearise(sensor, testfield, start[IOP], start[EOP]).A[..., EOP]
        bound = np.diag((A**2).sum(axis=1).mean(axis=0)) / _LOOSE_PX**2
        loose = replace(series, s=replace(s, exterior="mount"), bound=bound)
        loose, estimate = loose.adjusted(first, use)
        if not estimate.settled:
            return loose, estimate
        use = estimate.system.use
        series = choose_exterior(loose, s.exterior, int(estimate.system.good.sum()), estimate)
        if series.s.exterior != "series" and np.isfinite(estimate.values).all():
            first = estimate
    return series.adjusted(first, use)


def result(
    series: SeriesEstimator, estimate: Estimate, *, affinity: bool = True
) -> SeriesAdjustment:
    """Give the epochs a status and scale the covariances.

    affinity: whether to estimate the effect of a held affinity on the level.
    """
    finite = np.isfinite(estimate.values).all(axis=1)
    system = replace(estimate.system, good=estimate.system.good & finite)
    estimate, s, use = replace(estimate, system=system), series.s, system.use
    unit, sigma0, redundancy = series.noise(estimate)
    pooled = series.variance(estimate)
    noise_shown = series.shown_share(estimate) >= NOISE_SHOWN
    if not noise_shown:
        unit, sigma0 = np.maximum(unit, pooled), np.maximum(sigma0, np.sqrt(pooled))
    relative, level, trend = all_cofactors(system)
    excess, own, sound = np.zeros(16), system.design.own, system.good
    held = s.exterior == "series"
    few = series.has_offsets and len(use) < FEW_EPOCHS
    # in few epochs the offsets absorb the common part of the image points' errors
    least = np.maximum(unit, 1.0) if few else unit
    many = s.target_noise and len(use) >= FEW_EPOCHS
    pairs = series.pairs(estimate) if many else None
    if pairs:
        relative += correlated_error_cofactors(system, pairs, pooled)
    each = epoch_variance(least, redundancy, pooled)
    relative = scaled_covariances(relative, system, each, pooled)
    level *= pooled
    trend *= pooled
    movement = series.movement
    if held and sound.sum() >= FEWEST_EPOCHS:
        movement = estimate_mount_movement(series, estimate)
    elif held:
        movement = replace(movement, white=shown_movement(system, estimate.residuals, unit))
    seen = series.sensor, series.testfield, system, estimate.values
    combination, mean, turned = level_errors(*seen, level)
    slow = [(np.where(sound, estimate.values @ combination - mean, 0.0), turned)]
    line, step = line_weights(sound), 0
    if movement.covariance.any() and sound.any():
        if held:
            follow = system.Q @ system.N[:, own[:, None], EOP_COLUMNS]
            relative += follow @ movement.swaying @ np.swapaxes(follow, 1, 2)
        G = typical_sensitivity(system)
        trend[own[:, None], own] += G @ movement.tilt(line) @ G.T
        follows = G if held else np.eye(len(own))[:, -6:] - G
        for course, jump, V in movement.steps:
            changes = np.zeros((16, 16))
            of_step = V + np.outer(jump, jump) if held else V
            changes[EOP, EOP] = of_step
            changes[own[:, None], own] = follows @ of_step @ follows.T
            slow.append((course, changes))
    if many and estimate.solved.any():
        # only of few targets is it unknown which have moved
        targets = np.median(use[estimate.solved].sum(axis=1))
        few = bool(2 * targets - s.carried < TRUSTED_REDUNDANCY)
        changes, step = slow_errors(
            estimate.residuals, use & estimate.solved[:, None], few and not series.windows
        )
        of_targets = slow_target_covariance(system, changes, series.testfield.groups, few)
        slow.append((slow_course(len(use), step), of_targets))
    if s.target_noise:
        variances = np.diagonal(relative, axis1=1, axis2=2)
        inner = len(free_columns(s.free))
        left_alone = sound & ~np.isin(np.arange(len(sound)), movement.touched)
        values = estimate.values[:, own[:inner]]
        found = _excess(series, values, variances[:, :inner], left_alone)
        # the pose moves itself; its scatter beyond the noise is as large as the interior's
        usual = variances[sound].mean(axis=0) if sound.any() else np.ones(len(own))
        ratio = np.median(found / usual[:inner]) if inner else 0.0
        excess[own] = np.append(found, ratio * usual[inner:])
        relative = with_excess(relative, excess[own])
    covariance = among_all(relative, own)
    if held:  # the pose is that of the series, about which the mount moves
        covariance[:, EOP, EOP] += movement.swaying
    for course, changes in slow:
        covariance += course[:, None, None] ** 2 * changes
        trend += (line @ course) ** 2 * changes
    covariance[~sound] = 0.0
    known = sigma0[sound & np.isfinite(sigma0)]
    held_affinity = None
    if affinity and sound.any():
        held_affinity = estimate_held_affinity(
            series.sensor, series.testfield, system, estimate, estimate.residuals,
            series.field_variance,
        )  # fmt: skip
    return replace(
        judge_epochs(series, estimate, covariance, unit, pooled, sigma0, redundancy),
        level_covariance=level,
        excess_sd=np.sqrt(excess),
        trend_sd=np.sqrt(np.diag(trend).clip(0.0)),
        perspective_sd=np.sqrt(pooled) * perspective_cofactor_roots(system),
        field_ratio=float(np.sqrt(series.field_variance)),
        outer_noise=_outer_noise(series, estimate),
        noise_shown=noise_shown,
        noise_ratio=float(np.median(known)) if len(known) else 1.0,
        affinity=held_affinity,
        movement=movement,
        choice=series.choice,
        slow=tuple(slow),
        step=step,
        pairs=pairs or None,
    )


def _outer_noise(series: SeriesEstimator, estimate: Estimate) -> tuple[float, float]:
    """Return the noise of the outermost target over that in the image's middle, and its sd.

    NaN if the weights do not follow the targets' own noise.
    """
    system = estimate.system
    if series.freedom is None:
        return float("nan"), float("nan")
    radius = np.linalg.norm(system.design.at.predicted - series.sensor.centre, axis=1)
    tests = point_tests(system, estimate.residuals)
    tests *= np.broadcast_to(series.ratios, (len(radius), 3))[:, 0]
    # with rejected points, as the noise would be too small without its largest values
    offered = series.grid.observed & system.good[:, None]
    return noise_by_radius(tests, offered, radius)


def _excess(series: SeriesEstimator, values: Array, variances: Array, sound: Mask) -> Array:
    """Return the excess variances (p,) of neighbouring epochs, averaged over the windows."""
    kinks, drift = series.s.exterior != "per_epoch", series.s.drift_period > 0
    parts = [
        excess_scatter(values[w][sound[w]], variances[w][sound[w]], kinks, drift)
        for w in series.windows or (slice(0, len(values)),)
        if sound[w].any() or not series.windows
    ]
    return np.mean(parts, axis=0) if parts else np.zeros(values.shape[1])


def epoch_variance(unit: Array, redundancy: Array, pooled: float) -> Array:
    """Return the variances of unit weight (E,) that scale the epochs' covariances.

    The epoch's own, but at least the series' if its few residuals may be small by chance.
    """
    few = redundancy < TRUSTED_REDUNDANCY
    own: Array = np.where(few, np.maximum(unit, pooled), unit)
    return np.where(redundancy > 0, own, pooled)


_FEW = 0.6  # share of a series' targets below which an epoch's geometry is tested by itself


def judge_epochs(
    series: SeriesEstimator,
    estimate: Estimate,
    covariance: Array,
    unit: Array,
    pooled: float,
    sigma0: Array,
    redundancy: Array,
) -> SeriesAdjustment:
    """Give each epoch its status and reason; return a result without the series' own figures.

    covariance (E, 16, 16); unit (E,), pooled: variance of unit weight of the epochs and of the
    series; sigma0, redundancy (E,).
    """
    sensor, testfield, grid, s = series.sensor, series.testfield, series.grid, series.s
    values, use = estimate.values.copy(), estimate.system.use
    observed = grid.observed
    offered, used = observed.sum(axis=1), use.sum(axis=1)
    status, reasons = ["ok"] * len(use), [""] * len(use)

    def fail(rows: Mask, word: str, sentence: str) -> None:
        for row in np.flatnonzero(rows):
            if status[row] == "ok":
                status[row] = word
                reasons[row] = sentence.format(n=offered[row], bad=offered[row] - used[row])

    few = 2 * offered - s.carried < TRUSTED_REDUNDANCY
    most = np.where(few, most_rejected(s.max_rejected, 0), s.max_rejected)
    if not offered.all():
        again = "it repeats the image points of an earlier epoch, and is no new observation"
        fail((offered == 0) & grid.repeated, "repeated_frame", again)
    fail(offered == 0, "no_observations", "no target was measured")
    fail(
        ~enough_targets(grid, s),
        "too_few_targets",
        f"{{n}} targets for {s.carried} unknowns of the epoch leave too little "
        "redundancy: show more targets or hold parameters fixed",
    )
    fail(
        used < (1 - most) * offered,
        "too_many_rejected",
        "{bad} of {n} targets contradict the others: a moved test field, a wrong one, or a "
        "blurred image",
    )
    fail(~estimate.solved, "weak_geometry", "these targets do not determine the parameters")
    failing = fails_global_test(unit / pooled, redundancy)
    if failing.any():
        about = neighbours_variance(unit / pooled, estimate.solved)
        failing = fails_global_test(unit / pooled / about, redundancy)
    fail(
        failing,
        "global_test",
        "the residuals are larger than the noise of the epochs around it allows, and too few to "
        "show which target is wrong: show more targets",
    )
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    c, pitch = values[:, 0], sensor.pixel_pitch
    fail(
        np.sqrt(np.maximum(variance[:, 0], 0.0)) > MAX_RELATIVE_SD_C * c,
        "weak_geometry",
        f"the principal distance is known to worse than {percent(MAX_RELATIVE_SD_C, 1)}",
    )
    fail(
        np.sqrt(variance[:, PRINCIPAL_POINT].max(axis=1).clip(0.0)) > MAX_SD_POINT_PX * pitch,
        "weak_geometry",
        f"the principal point is known to worse than {MAX_SD_POINT_PX:.0f} px",
    )
    # The best epoch's geometry stands for all; only epochs with few targets are tested one by one.
    ever = use.any(axis=0).sum()
    few = (used < _FEW * ever) & (np.array(status) == "ok")
    typical = int(np.argmax(used))
    for row in {typical, *map(int, np.flatnonzero(few))}:
        if status[row] != "ok":
            continue
        seen = use[row]
        weak = weaknesses(
            sensor, testfield.points[seen], grid.points[row, seen], values[row], covariance[row],
            s.free, s.correlation_bound,
        )  # fmt: skip
        if weak:
            rows = np.full(len(use), row == typical)
            rows[row] = True
            fail(rows, "weak_geometry", "; ".join(weak))
    values[[word != "ok" for word in status]] = np.nan
    still = np.full(len(use), np.nan)
    if s.exterior == "series":
        score = stillness(estimate.system, estimate.residuals)[0]
        still = score / np.where(redundancy > 0, unit, 1.0)
    return SeriesAdjustment(
        s, values, covariance, np.zeros((16, 16)), sigma0, redundancy, use, observed & ~use,
        estimate.residuals, estimate.offsets if series.has_offsets else estimate.offsets * np.nan,
        tuple(status), tuple(reasons), still,
    )  # fmt: skip
