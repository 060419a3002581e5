"""The test of a thermal model on a series that it was not fitted to.

Only what is specific to the series is estimated: its level (one exterior orientation, and a
constant offset per target, since a field's coordinates are not perfect) and what its effects
declare as fresh (a phase; an event, which no model can foresee). All drifts are the model's. The
residuals of the image points are compared with the noise floor: image noise, and the error of the
prediction from the thermometer's noise and reading times. The 95 % bands also include the model's
own uncertainty; for a model that misses an effect no band is stated.

The level of a model, the interior orientation at T₀ and the exterior orientation of each series,
does not follow from drifts. Each target's mean over a series, compared with the model's projection,
determines the interior orientation that all series share and one exterior orientation per series.
The affinity is the stated one, or none, unless the targets contradict it; its uncertainty is in the
covariance. If the user names targets that have moved, the time and the vector of their movement are
estimated, relative to the camera that the other targets determine.

The 22 parameters of an epoch are those of `modelled_camera.COLUMNS`. An amplitude keeps its size,
an event its own height and time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.modelled_camera import (
    effect_weights,
    reading_operators,
    shared_errors,
)
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.errors import ConfigurationError, DataError
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.photogrammetry.series.normals import linearise
from thermocald.physics import catalogue
from thermocald.physics.model import ModelEffect
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term, coefficients_of, targets_of
from thermocald.thermal.reduce import running_median, without_targets
from thermocald.thermal.scan import event_threshold, make_term, without_chance_events
from thermocald.thermal.series import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index
    from thermocald.physics.effect import Prediction
    from thermocald.physics.model import ThermalModel
    from thermocald.thermal.series import ReducedSeries


AFFINITY_SD = 3e-3  # of C1 and C2: fx and fy of phones differ by 1e-4 to 3e-3
_AFFINITY = [IOP_NAMES.index("C1"), IOP_NAMES.index("C2")]
_SHOWN = 13.8  # χ² with two degrees of freedom, 0.1 %: below it C1 and C2 keep the stated values
_ITERATIONS = 8


def average_residuals(
    series: ReducedSeries, prediction: Prediction
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return measured minus predicted image points (E, T, 2) px, and their weighted mean (T, 2).

    Also returns the mean's weights (T, 2), and which targets (T,) the model moves; of these only
    the epochs before their movement count.
    """
    moved = np.zeros(len(series.source.field), dtype=bool)
    use = series.weights[..., :2]
    for rows, _, active in prediction.displacements:
        moved[rows] = True
        if active.any():
            use = use.copy()
            use[np.ix_(active, rows)] = 0.0
    points = series.source.field.points
    if prediction.moves_points:
        points = prediction.points(points, slice(None))
    seen = project(series.source.sensor, prediction.iop, prediction.eop, points)
    left = series.source.grid.points - seen
    total = np.einsum("etc,etc->tc", use, np.where(use > 0, left, 0.0))
    weight = use.sum(axis=0)
    return left, total / np.where(weight > 0, weight, 1.0), weight, moved


def estimate_level(
    series: Sequence[ReducedSeries], models: Sequence[ThermalModel], interior: bool = True
) -> tuple[tuple[ThermalModel, ...], Array]:
    """Estimate the level from the targets' means, by Gauss-Newton.

    models: one per series, with initial values; interior: estimate the interior orientation too,
    not only the series' exterior orientations. Returns the models with both, and the covariance
    (10, 10) that the test field's coordinates add to the interior orientation.
    """
    n = len(IOP_NAMES) if interior else 0
    shared = models[0].interior.as_array()
    eops = []
    for m in models:
        assert m.exterior is not None
        eops.append(m.exterior.as_array())
    size = n + 6 * len(series)
    field = series[0].source.field
    inverse, lever = np.zeros((size, size)), np.zeros((size, field.points.size))

    def placed(model: ThermalModel, k: int) -> ThermalModel:
        return replace(
            model,
            interior=InteriorOrientation.from_array(shared),
            exterior=ExteriorOrientation.from_array(eops[k]),
        )

    for _ in range(_ITERATIONS):
        M, g = np.zeros((size, size)), np.zeros(size)
        lever[:] = 0.0
        for k, (s, m) in enumerate(zip(series, models, strict=True)):
            now = placed(m, k)
            prediction = now.predict(s.history, s.source.field)
            _, mean, weight, _ = average_residuals(s, prediction)
            at = linearise(s.source.sensor, s.source.field, prediction.iop.mean(axis=0), eops[k])
            columns = np.concatenate([np.arange(n), n + 6 * k + np.arange(6)])
            A = at.A[:, :, 10 - n :]
            PA = A * weight[..., None]
            M[np.ix_(columns, columns)] += np.einsum("tci,tcj->ij", PA, A)
            g[columns] += np.einsum("tci,tc->i", PA, mean)
            lever[columns] += np.einsum("tci,tcx->itx", PA, at.B).reshape(len(columns), -1)
        if interior:
            M[_AFFINITY, _AFFINITY] += AFFINITY_SD**-2
            g[_AFFINITY] -= shared[_AFFINITY] / AFFINITY_SD**2
        inverse = inverse_of_determined(M)
        step = inverse @ g
        shared[:n] += step[:n]
        eops = [e + d for e, d in zip(eops, step[n:].reshape(-1, 6), strict=True)]
        if step @ M @ step < 1e-4:  # a hundredth of a standard deviation
            break
    moved = inverse[:n] @ (lever * field.shape_sigmas.ravel())
    of_field = moved @ moved.T
    if interior:
        stated = series[0].source.interior or replace(models[0].interior, C1=0.0, C2=0.0)
        off = shared[_AFFINITY] - stated.as_array()[_AFFINITY]
        noise = inverse[np.ix_(_AFFINITY, _AFFINITY)]
        if off @ np.linalg.solve(noise + of_field[np.ix_(_AFFINITY, _AFFINITY)], off) < _SHOWN:
            step = -inverse[:, _AFFINITY] @ np.linalg.solve(noise, off)
            shared[:n] += step[:n]
            shared[_AFFINITY] = stated.as_array()[_AFFINITY]  # exactly
            eops = [e + d for e, d in zip(eops, step[n:].reshape(-1, 6), strict=True)]
    return tuple(placed(m, k) for k, m in enumerate(models)), of_field


_GROSS = 6.0  # standard deviations from the neighbours in time
_NEIGHBOURS = 4  # epochs on either side


@dataclass(frozen=True, eq=False)
class Moved:
    """A step of targets: time s; vector (3,) mm with covariance, zeros if none was found."""

    time: float
    vector: Array
    covariance: Array

    def effect(self, listed: ModelEffect) -> ModelEffect:
        """Return the effect that names the targets, with the time and vector of their movement."""
        kind = catalogue.get(listed.name)
        time = {n: self.time for n, p in kind.nonlinear.items() if p.role == "event"}
        vector = dict(zip(kind.linear, self.vector.tolist(), strict=True))
        return ModelEffect(listed.name, {**listed.values, **vector, **time})


def estimate_step(others: ReducedSeries, rows: NDArray[np.int64]) -> Moved:
    """Estimate the step of some targets by one vector; others: the series reduced without them.

    A direction that the rays do not determine stays 0 and has no variance.
    """
    left = others.left_by_cameras(rows)
    seen = (others.source.grid.weights[:, rows, 0] > 0) & (others.n > 0)[:, None]
    left[~seen] = np.nan
    sd = others.sigma_px
    near = np.nan_to_num(running_median(left, _NEIGHBOURS))
    seen &= (np.abs(np.nan_to_num(left - near)) < _GROSS * sd).all(axis=2)
    v = np.where(seen[..., None], left, 0.0)
    before = np.cumsum(seen, axis=0)[:-1].astype(float)
    after = seen.sum(axis=0) - before
    sums = np.cumsum(v, axis=0)
    step = (sums[-1] - sums[:-1]) / np.maximum(after, 1)[..., None]
    step = step - sums[:-1] / np.maximum(before, 1)[..., None]
    weight = before * after / np.maximum(before + after, 1) / sd**2
    B = others.at.B[rows]
    N = np.einsum("et,tci,tcj->eij", weight, B, B)
    g = np.einsum("et,tci,etc->ei", weight, B, step)
    vectors = np.einsum("eij,ej->ei", np.linalg.pinv(N, rcond=1e-9, hermitian=True), g)
    gain = np.einsum("ei,ei->e", g, vectors)
    best = int(np.argmax(gain))
    _, time, _ = others.locate(float(others.times[best + 1]))
    if gain[best] < event_threshold(others, 3):
        return Moved(time, np.zeros(3), np.zeros((3, 3)))
    return Moved(time, vectors[best], inverse_of_determined(N[best]))


def fit_own_effects(model: ThermalModel, series: ReducedSeries) -> ThermalModel:
    """Return the model with the phases and events of a series with the model's T₀ and reference."""
    listed = [e for e in model.effects if catalogue.get(e.name).seen_in == "trajectory"]
    if not any(Term(e.name).is_separate for e in listed):
        return model
    fitter = HypothesisFitter([series])
    terms: tuple[Term, ...] = ()
    # events last: what another effect moves would be taken for their step
    for effect in sorted(listed, key=lambda e: catalogue.get(e.name).is_event):
        terms = (*terms, make_term(fitter, terms, effect, search=False))
    fit = fitter.fit(without_chance_events(fitter, fitter.fit(terms)))
    own: dict[str, dict[str, float]] = {}
    for number, term in enumerate(fit.terms):
        if not term.is_separate:
            continue
        kind = term.kind
        found = coefficients_of(fit, [b for b in fit.blocks if b.term == number], series.scale)
        columns = {n: kind.column(n) for n in kind.linear if kind.column(n) in found}
        if kind.is_periodic:
            # the phase alone, opposite if the fitted amplitude is
            size = {
                n: found[c][0] * series.scale[COLUMNS.index(c)] ** 2 for n, c in columns.items()
            }
            along = sum(v * model.value(f"{term.effect}.{n}") for n, v in size.items())
            (key,) = kind.fresh
            own[term.effect] = {key: found["phase"][0] + (0.0 if along > 0.0 else float(np.pi))}
        else:
            # an event's time and height, 0 if there is none
            height = {n: found[column][0] for n, column in columns.items()}
            times = dict(term.fresh[0] or ())
            middle = {n: series.locate(float(time))[1] for n, time in times.items()}
            own[term.effect] = {**dict.fromkeys(kind.linear, 0.0), **height, **middle}
    effects = (replace(e, values={**e.values, **own.get(e.name, {})}) for e in model.effects)
    return replace(model, effects=tuple(effects))


NORMAL_95 = 1.959964  # standard deviations of a 95 % band


@dataclass(frozen=True, slots=True)
class PredictedError:
    """The errors of the prediction of one series.

    rms_px: of measured minus predicted image points; floor_px: expected from noise alone; coverage:
    fraction of coordinates in their 95 % bands, NaN if none is stated; object_mm: RMS at 10 m.
    """

    name: str
    rms_px: float
    floor_px: float
    coverage: float
    object_mm: float


def predicted_error(
    model: ThermalModel, series: ReducedSeries, thermometer_sd: float
) -> PredictedError:
    """Predict a series and compare it with the measured points; thermometer_sd K: of a reading.

    Raises ConfigurationError for another camera, DataError without its reference thermometer.
    """
    source = series.source
    if source.sensor != model.sensor or source.camera != model.camera:
        raise ConfigurationError(
            f"the model is of camera {model.camera} ({model.sensor}), {source.name} of "
            f"{source.camera} ({source.sensor}): a thermal model belongs to one camera"
        )
    # the model's T₀ and reference, whichever column comes first
    history = series.history
    reference = next(iter(model.validity), history.reference)
    if reference not in history.readings:
        raise DataError(
            f"{source.name}: has no temperature column {reference!r}, which the model was fitted "
            f"on; there are: {', '.join(history.readings)}"
        )
    series = series.in_basis(model.distortion)
    series = replace(series, history=replace(history, T0=model.T0, reference=reference))
    index = source.field.index
    rows = np.array([index[t] for t in targets_of(model.effects) if t in index], dtype=np.int64)
    model = _of_series(model, series, rows)
    history = series.readings_history
    prediction = model.predict(history, source.field)
    residuals, mean, _, _ = average_residuals(series, prediction)
    used = series.weights[..., :2] > 0
    if len(rows):
        # the step of a moved target is no gross error
        near = np.abs(np.nan_to_num(residuals[:, rows] - mean[rows])) < 1.0
        used[:, rows] = (source.grid.weights[:, rows, :2] > 0) & near
    residuals = np.where(used, residuals, 0.0)
    residuals = residuals - residuals.sum(axis=0) / np.maximum(used.sum(axis=0), 1)
    A = image_partials(series, rows)
    floor = (model.image_sigma * prediction.noise_factor[:, None, None]) ** 2
    for share, variance in chain(*thermometer_noise(series, model, A, thermometer_sd)):
        floor = floor + share[:, None, None] * variance
    rms = float(np.sqrt(np.mean(residuals[used] ** 2)))
    coverage = float("nan")
    if not model.misses_an_effect:
        own = _parameters(series, model)
        bands = floor + np.einsum("tcp,epq,tcq->etc", A, own, A, optimize=True)
        coverage = float(np.mean(np.abs(residuals[used]) <= NORMAL_95 * np.sqrt(bands[used])))
    scale = source.sensor.pixel_pitch / model.interior.c * 10_000.0
    floor_px = float(np.sqrt(np.mean(floor[used])))
    return PredictedError(source.series or source.name, rms, floor_px, coverage, rms * scale)


def _of_series(model: ThermalModel, series: ReducedSeries, rows: NDArray[np.int64]) -> ThermalModel:
    """Return the model with the series' exterior orientation, phases and events."""
    others = without_targets(series, rows) if len(rows) else series
    model = fit_own_effects(model, others)
    if len(rows):
        moved = estimate_step(others, rows)
        effects = tuple(
            moved.effect(e) if catalogue.get(e.name).seen_in == "targets" else e
            for e in model.effects
        )
        model = replace(model, effects=effects)
    start = replace(model, exterior=ExteriorOrientation.from_array(series.at.eop))
    ((placed,), _) = estimate_level([others], [start], interior=False)
    return placed


def image_partials(series: ReducedSeries, rows: Index) -> Array:
    """Return ∂ image points / ∂ parameters (T, 2, 22) px; rows: targets that a step displaces."""
    at, moving = series.at, np.zeros((len(series.at.B), 2, 3))
    moving[rows] = at.B[rows]
    scales = at.B * series.source.field.points[:, None, :]
    return np.concatenate([at.A, scales, moving], axis=2)


def thermometer_noise(
    series: ReducedSeries, model: ThermalModel, A: Array, thermometer_sd: float
) -> tuple[list[tuple[Array, Array]], list[tuple[Array, Array]]]:
    """Return the image points' variances from the thermometers, relative to the series' mean.

    First from the readings' errors, propagated through each effect's operator, then what the times
    of the readings leave unresolved at most. Both are terms of a sum: a factor (E,) for each epoch
    and a variance (T, 2) px² for each target. A (T, 2, 22): from `image_partials`; thermometer_sd
    K: of a reading of the reference.
    """
    history = series.readings_history
    operators = reading_operators(model, history)
    means = [np.asarray(S.mean(axis=0)).ravel() for _, _, S in operators]
    terms = []
    for channel, shared, c, d in shared_errors(operators, means):
        known = series.thermometers[channel].noise
        sd = thermometer_sd if channel == history.reference else known
        terms.append((sd**2 * shared, (A @ c) * (A @ d)))
    jump = series.thermometers[history.reference].slope_jump(history.times)
    unresolved = []
    for effect in model.effects:
        kind = catalogue.get(effect.name)
        if kind.seen_in == "noise" or kind.kind == "image":
            continue
        nonlinear, coefficients = kind.split(effect.values)
        weights = effect_weights(model, effect.name, None if kind.is_drive else coefficients)
        left = kind.unresolved(history, jump, **nonlinear)
        if np.any(left) and np.any(weights):
            unresolved.append((left**2, (A @ weights) ** 2))
    return terms, unresolved


def _parameters(series: ReducedSeries, model: ThermalModel) -> Array:
    """Return the covariance (E, 22, 22) from the model's drift; the level is the series' own.

    The derivatives by the model's parameters are central differences.
    """
    history, camera = series.readings_history, ThermalCamera(model)
    own = set()  # parameters that every series has of its own
    for e in model.effects:
        kind = catalogue.get(e.name)
        own |= {f"{e.name}.{n}" for n in (*kind.fresh, *(kind.linear if kind.is_event else ()))}
    levels = ("exterior.", "interior.")
    names = [n for n in camera.parameters if not n.startswith(levels) and n not in own]
    rows = [camera.parameters.index(n) for n in names]
    Q = camera.covariance[np.ix_(rows, rows)]
    J = np.zeros((len(history.times), 22, len(names)))
    for i, name in enumerate(names):
        group, key = name.rsplit(".", 1)
        value = model.value(name)
        step = 1e-3 * max(abs(value), 1e-6)
        if group != "rates" and (searched := catalogue.get(group).nonlinear.get(key)):
            step = searched.difference_step(value)
        for side in (step, -step):
            p = model.with_values({name: value + side}).predict(history, series.source.field)
            J[:, :, i] += np.concatenate([p.iop, p.eop, p.scale, np.zeros((len(J), 3))], 1) / side
            for _, vector, active in p.displacements:
                J[:, 19:22, i] += active[:, None] * vector / side
    drift = 0.5 * (J - J.mean(axis=0))
    found: Array = np.einsum("epi,ij,eqj->epq", drift, Q, drift, optimize=True)
    return found
