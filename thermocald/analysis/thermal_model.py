"""Fitting a thermal model: one adjustment over all image points of all series of a camera.

Unknown are the interior orientation at T₀, its rates, the parameters of the effects, and one
exterior orientation per series. The thermometers' errors are unknown too, one per reading, with
their standard deviation as prior: carried through each effect's own operator and eliminated, they
take from the epochs what the thermometer does not know. Their size is estimated with the rest
(variance components), and so is that of the image noise.

The covariance holds image noise, thermometer noise, and the coordinates of the test field. It does
not hold what the model lacks: the test for that is a series that was left out (`predicted_error`).

Source: DESIGN ideas 2, 3 and 5; variance components: Koch, K.-R. (1999): Parameter Estimation and
Hypothesis Testing in Linear Models, 2nd ed., section 3.6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.model_state import FREE_INTERIOR, FitState
from thermocald.analysis.model_system import Share, jacobian, share
from thermocald.errors import DataError
from thermocald.photogrammetry.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.photogrammetry.normals import linearise
from thermocald.simulation import effects
from thermocald.simulation.model import RATED, ModelEffect, ThermalModel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.analysis.model_series import ModelSeries

    Array = NDArray[np.float64]

__all__ = ["FittedModel", "SeriesFit", "fit_thermal_model"]

_ITERATIONS = 30
_CONVERGED = 1e-2  # of a standard deviation
_GRID = 33  # trial values of a non-linear parameter
_SEARCHED = 2  # series in which they are tried
_NOISE_K = 0.05  # of a thermometer with hardly any reading
_PRIOR_SHARE = 0.3  # of the readings: how much their own roughness counts as known


@dataclass(frozen=True, slots=True)
class SeriesFit:
    """How well one series is explained: RMS px of the image points, thermometers' noise K."""

    name: str
    epochs: int
    rms_px: float
    thermometer_sd: float


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model and what the fit says about itself.

    names (p,): of the unknowns, as `ThermalModel.covariance_names` writes them, the exterior
    orientation of series k as `exterior.X0@k`; covariance (p, p); sigma0: of the image points
    against their stated sigmas.
    """

    model: ThermalModel
    names: tuple[str, ...]
    covariance: Array
    sigma0: float
    series: tuple[SeriesFit, ...]

    def sd(self, name: str) -> float:
        """The standard deviation of one unknown."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))


def fit_thermal_model(
    series: Sequence[ModelSeries],
    listed: Sequence[ModelEffect] = (),
    T0: float | None = None,
    search: bool = True,
    fixed: Sequence[str] = (),
) -> FittedModel:
    """Fit the base model and some effects to all series together.

    listed: effects with start values; with `search` their non-linear parameters are looked for over
    their whole range first; fixed: names such as `thermal_lag.tau` that keep their start values;
    T0 °C: by default the mean temperature. Raises DataError for series of different cameras, or of
    one temperature.
    """
    checked = _checked(series, listed)
    temperatures = np.concatenate([s.history.temperature() for s in checked])
    reference = round(float(temperatures.mean()), 1) if T0 is None else T0
    checked = [replace(s, history=replace(s.history, T0=reference)) for s in checked]
    model = ThermalModel(
        checked[0].camera,
        checked[0].sensor,
        reference,
        InteriorOrientation.from_array(checked[0].start[:10]),
        dict.fromkeys(RATED, 0.0),
        name=checked[0].camera,
        version=0,
    )
    state = FitState(model, tuple(s.start[10:].copy() for s in checked), frozenset(fixed))
    fit = _Fit(checked)
    # while something is missing, a free thermometer noise would take the drift for itself
    fit.components = not listed
    state = fit.solve(state)
    for effect in listed:
        begun = replace(state.model, effects=(*state.model.effects, _started(effect)))
        state = replace(state, model=begun)
        if search and effect.name != "defocus":
            state = _searched(checked, state)
    if listed:
        state = fit.solve(state)
    fit.take_off_offsets(state)
    fit.components = fit.correcting = True
    state = fit.solve(state)
    if any(e.name == "defocus" for e in listed):
        for _ in range(3):
            state = fit.defocus(state)
            fit.take_off_offsets(state)
            state = fit.solve(state)
    return fit.result(state)


def _checked(series: Sequence[ModelSeries], listed: Sequence[ModelEffect]) -> list[ModelSeries]:
    if not series:
        raise DataError("there is no series to fit a model to")
    first = series[0]
    for s in series:
        if s.camera != first.camera or s.sensor != first.sensor:
            raise DataError(
                f"series {s.name} is of camera {s.camera}, series {first.name} of {first.camera}: "
                "a thermal model belongs to one camera"
            )
    span = max(float(np.ptp(s.history.temperature())) for s in series)
    if span < 1.0:
        raise DataError(
            f"the temperature changes by {span:.2f} K only: heat the camera by several kelvin"
        )
    moved: tuple[str, ...] = ()
    for effect in listed:
        if effect.name == "target_displacement":
            targets = effect.values["targets"]
            moved = (targets,) if isinstance(targets, str) else tuple(targets)
            if not any(t in first.field.index for t in moved):
                raise DataError(
                    f"target_displacement: none of the targets {', '.join(moved) or '(none)'} is "
                    "in the test field"
                )
    return [s.displacing(moved) if moved else s for s in series]


def _searched(series: list[ModelSeries], state: FitState) -> FitState:
    """The last effect's non-linear parameters where they fit best, in the series that say most."""
    spans = [float(np.ptp(s.history.temperature())) for s in series]
    most = sorted(np.argsort(spans)[::-1][:_SEARCHED].tolist())
    some = _Fit([series[k] for k in most])
    before = replace(state.model, effects=state.model.effects[:-1])
    part = FitState(before, tuple(state.exteriors[k] for k in most), state.fixed)
    part = some.solve(part)
    part = some.search(replace(part, model=replace(part.model, effects=state.model.effects)))
    listed = (*state.model.effects[:-1], part.model.effects[-1])
    return replace(state, model=replace(state.model, effects=listed))


def _started(effect: ModelEffect) -> ModelEffect:
    """An effect with its usual coefficients, small where nothing was given."""
    kind = effects.get(effect.name)
    values = dict(effect.values)
    if kind.linear and not any(values.get(n, 0.0) for n in kind.linear):
        values |= dict.fromkeys(kind.usual, 0.0)
    return replace(effect, values=values)


class _Fit:
    """Gauss-Newton over all series, with variance components that last from step to step."""

    def __init__(self, series: list[ModelSeries]) -> None:
        self.series = series
        self.variance = 1.0
        self.components = False
        self.prior_sds = [_thermometer_noise(s) for s in series]
        self.error_sds = list(self.prior_sds)
        self.noise: list[Array | None] = [None] * len(series)
        self.errors: list[Array | None] = [None] * len(series)
        self.correcting = False
        self.image_points = 2 * sum(int(s.count.sum()) for s in series)
        self.Q = np.zeros((0, 0))
        self.shares: list[Share] = []
        self.cost = np.inf

    def step(self, state: FitState) -> tuple[Array, float]:
        """One step (p,), its largest part in standard deviations; renews the variances."""
        names = state.names
        M, g = np.zeros((len(names), len(names))), np.zeros(len(names))
        self.shares = []
        for k in range(len(self.series)):
            s, model = self._corrected(k), state.of_series(k)
            _, J = jacobian(s, model, FREE_INTERIOR, state.fixed)
            part = share(
                s, model, J, self.variance, self.error_sds[k], self.noise[k], self.errors[k]
            )
            columns = state.columns(k)
            M[np.ix_(columns, columns)] += part.M
            g[columns] += part.g
            self.shares.append(part)
        self.Q = _inverse(M)
        step: Array = self.Q @ g
        sd = np.sqrt(np.maximum(np.diag(self.Q), 1e-300))
        self._renew(state, step)
        return step, float(np.max(np.abs(step) / sd))

    def _corrected(self, k: int) -> ModelSeries:
        """Series k with its readings corrected by their errors as far as they are known."""
        s, errors = self.series[k], self.errors[k]
        if errors is None:
            return s
        parts = np.split(errors, len(s.history.readings))
        readings = {
            name: values + part
            for (name, values), part in zip(s.history.readings.items(), parts, strict=True)
        }
        return replace(s, history=replace(s.history, readings=readings))

    def _renew(self, state: FitState, step: Array) -> None:
        image, used, penalty = 0.0, 0.0, 0.0
        for k, part in enumerate(self.shares):
            columns = state.columns(k)
            cost, errors, redundancy = part.settle(
                step[columns], self.Q[np.ix_(columns, columns)], self.noise[k]
            )
            if self.correcting and len(errors):
                self.errors[k] = errors
            image += cost
            used += redundancy
            penalty += float(errors @ errors) / self.error_sds[k] ** 2
            if self.components and redundancy > 5:
                # what a lag hides of the noise, the readings' own roughness tells
                known = len(errors) * _PRIOR_SHARE
                total = float(errors @ errors) + known * self.prior_sds[k] ** 2
                self.error_sds[k] = float(np.sqrt(total / (redundancy + known)))
        self.cost = image / self.variance + penalty
        self.variance = image / max(self.image_points - len(step) - used, 1.0)

    def take_off_offsets(self, state: FitState) -> None:
        """Leave the constant part of every target's residuals out of what follows."""
        self.series = [
            s.without_offsets(
                state.of_series(k).predict(self._corrected(k).history, s.field), self.noise[k]
            )
            for k, s in enumerate(self.series)
        ]

    def solve(self, state: FitState) -> FitState:
        """Iterate until no unknown moves by more than a hundredth of its standard deviation."""
        still = 0
        for _ in range(_ITERATIONS):
            before = self.variance
            step, size = self.step(state)
            state = state.moved(step)
            change = abs(self.variance / before - 1.0)
            # an unknown at the end of its range wants to move on and on, and changes nothing
            still = still + 1 if change < 1e-6 else 0
            if (size < _CONVERGED and change < 1e-3) or still >= 3:
                break
        return state

    def search(self, state: FitState) -> FitState:
        """Try the last effect's non-linear parameters over their range, keep what fits best."""
        effect = state.model.effects[-1]
        kind = effects.get(effect.name)
        trials = [effect]
        for key, p in kind.nonlinear.items():
            if p.text or key == "phase" or f"{effect.name}.{key}" in state.fixed:
                continue
            grid = self._grid(key, p.low, p.high, p.log)
            trials = [
                replace(t, values={**t.values, key: float(value)}) for t in trials for value in grid
            ]
        if "phase" in kind.nonlinear:
            trials = [
                replace(t, values={**t.values, "phase": phase, kind.usual[0]: 1e-9})
                for t in trials
                for phase in (0.0, np.pi / 2)
            ]
        if len(trials) == 1:
            return state
        variance, sds = self.variance, list(self.error_sds)
        held = frozenset(f"{effect.name}.{key}" for key in kind.nonlinear)
        best, chosen = np.inf, state
        for trial in trials:
            listed = (*state.model.effects[:-1], trial)
            tried = FitState(
                replace(state.model, effects=listed), state.exteriors, held | state.fixed
            )
            self.variance, self.error_sds = variance, list(sds)
            step, _ = self.step(tried)
            # what is left with the variances held: comparable between trials
            if self.cost < best:
                best, chosen = self.cost, replace(tried.moved(step), fixed=state.fixed)
        self.variance, self.error_sds = variance, list(sds)
        return chosen

    def _grid(self, key: str, low: float, high: float, log: bool) -> Array:
        times = np.concatenate([s.history.times for s in self.series])
        temperatures = np.concatenate([s.history.temperature() for s in self.series])
        if key == "time":
            frames = np.unique(times)
            return np.asarray(0.5 * (frames[1:] + frames[:-1]))
        if key == "T_k":
            low, high = np.quantile(temperatures, [0.05, 0.95])
        if key == "half_width":
            high = min(high, 0.5 * float(np.ptp(temperatures)))
        if key == "P":
            span = float(np.ptp(times))
            # equal steps in frequency, fine enough that no period is jumped over
            frequencies = np.arange(1.5 / span, 1.0 / (2.2 * _interval(times)), 0.4 / span)
            return np.asarray(1.0 / frequencies)
        if key == "tau":
            high = min(high, float(np.ptp(times)))
        grid: Array = np.geomspace(low, high, _GRID) if log else np.linspace(low, high, 2 * _GRID)
        return grid

    def defocus(self, state: FitState) -> FitState:
        """The noise factor per kelvin from each epoch's own misfit, by weighted least squares."""
        rise, spread, count = [], [], []
        for k, s in enumerate(self.series):
            warm = s.history.temperature() - state.model.T0
            delta = s.corrections(state.of_series(k).predict(s.history, s.field))
            # each epoch's own parameters take up what the temperature's error does
            rest = s.b - np.einsum("eij,ej->ei", s.N, delta)
            N, own = s.N[:, :3, :3], rest[:, :3]
            cost = s.lPl - 2 * np.sum(s.b * delta, 1) + np.einsum("ei,eij,ej->e", delta, s.N, delta)
            cost -= np.einsum("ei,ei->e", own, np.linalg.solve(N, own[..., None])[..., 0])
            rise.append(warm)
            variance = np.maximum(cost, 0.0) / (2.0 * s.count - 3.0)
            # the targets' offsets, an average over the epochs, took this much of each
            known = self.noise[k]
            factors = np.ones(len(s)) if known is None else known
            variance += self.variance / np.sum(factors**-2.0)
            spread.append(np.sqrt(variance))
            count.append(2.0 * s.count - 3.0)
        x, y, n = np.concatenate(rise), np.concatenate(spread), np.concatenate(count)
        A = np.stack([np.ones_like(x), x], axis=1)
        factor = np.ones_like(x)
        for _ in range(5):
            w = 2.0 * n / (y.mean() * factor) ** 2
            cofactor = np.linalg.inv(A.T @ (w[:, None] * A))
            level, slope = cofactor @ (A.T @ (w * y))
            factor = np.maximum(1.0 + slope / level * x, 0.1)
            w = 2.0 * n / (level * factor) ** 2
        cofactor = np.linalg.inv(A.T @ (w[:, None] * A))
        lever = np.array([-slope / level**2, 1.0 / level])
        sd = float(np.sqrt(lever @ cofactor @ lever))
        found = ModelEffect("defocus", {"factor": float(slope / level)}, {"factor": sd})
        ends = np.cumsum([len(s) for s in self.series])
        self.noise = list(np.split(factor, ends[:-1]))
        listed = tuple(found if e.name == "defocus" else e for e in state.model.effects)
        return replace(state, model=replace(state.model, effects=listed))

    def result(self, state: FitState) -> FittedModel:
        """The model with standard deviations, the test field's coordinates included."""
        names = state.names
        covariance = self.Q + self._field_covariance(state)
        sd = dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))
        listed = tuple(_with_sds(e, sd, self.series) for e in state.model.effects)
        kept = [i for i, n in enumerate(names) if not n.startswith("exterior.")]
        sigma = float(np.sqrt(self.variance))
        stated = np.concatenate([s.grid.weights[s.grid.observed][:, 0] for s in self.series])
        fits = tuple(
            SeriesFit(s.name, len(s), _rms(s, state.of_series(k)), self.error_sds[k])
            for k, s in enumerate(self.series)
        )
        channels = dict.fromkeys(c for s in self.series for c in s.history.readings)
        model = replace(
            state.model,
            effects=listed,
            exterior=ExteriorOrientation.from_array(state.exteriors[0]),
            image_sigma=sigma / float(np.sqrt(np.median(stated))),
            sds={n: s for n, s in sd.items() if n.split(".")[0] in ("interior", "rates")},
            covariance_names=tuple(names[i] for i in kept),
            covariance=tuple(tuple(row) for row in covariance[np.ix_(kept, kept)].tolist()),
            validity={c: _span(self.series, c) for c in channels},
            fitted_on=tuple(
                {"series": s.name, "recording": s.source, "epochs": len(s),
                 "rms_px": round(f.rms_px, 5), "thermometer_sd_K": round(f.thermometer_sd, 5)}
                for s, f in zip(self.series, fits, strict=True)
            ),
            version=1,
        )  # fmt: skip
        return FittedModel(model, tuple(names), covariance, sigma, fits)

    def _field_covariance(self, state: FitState) -> Array:
        """Q K Σ Kᵀ Q: what errors of the targets' coordinates do to the level.

        A coordinate is as wrong in the first epoch as in the last: it cannot look like a drift, and
        since the targets' constant offsets are taken off, it cannot by being hidden now and then.
        Interior at T₀ and exterior orientation take it all.
        """
        field = self.series[0].field
        p = len(state.names)
        lever = np.zeros((p, len(field) * 3))
        for k, (s, part) in enumerate(zip(self.series, self.shares, strict=True)):
            at = linearise(s.sensor, s.field, s.start[:10], s.start[10:])
            weight = s.grid.weights[..., 0] / self.variance
            if self.noise[k] is not None:
                weight = weight / self.noise[k][:, None] ** 2  # type: ignore[index]
            J = part.J[:, :16]
            sums = np.tensordot(weight, J, axes=(0, 0))  # (T, 16, q)
            A = np.einsum("tcp,tpq->tcq", at.A, sums)
            lever[state.columns(k)] += np.einsum("tcq,tcx->qtx", A, at.B).reshape(J.shape[2], -1)
        level = np.array([n.startswith(("interior.", "exterior.")) for n in state.names])
        drift = ~level
        Q = self.Q[np.ix_(level, level)]
        mixed = self.Q[np.ix_(level, drift)]
        Q = Q - mixed @ np.linalg.solve(self.Q[np.ix_(drift, drift)], mixed.T)
        moved = np.zeros((p, lever.shape[1]))
        moved[level] = Q @ (lever[level] * field.sigmas.ravel())
        result: Array = moved @ moved.T
        return result


def _thermometer_noise(series: ModelSeries) -> float:
    """Standard deviation K of a reading: of its distance from the line between its neighbours.

    Robust, so that bends of the temperature do not count; not below what quantisation makes.
    """
    history = series.history
    values = history.readings[history.reference]
    good = np.isfinite(values)
    t, T = history.reading_times[good], values[good]
    step = series.resolution.get(history.reference, 0.0) / np.sqrt(12.0)
    if len(t) < 5:
        return float(max(step, _NOISE_K))
    share = (t[1:-1] - t[:-2]) / np.maximum(t[2:] - t[:-2], 1e-9)
    rest = T[1:-1] - (1.0 - share) * T[:-2] - share * T[2:]
    rest /= np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
    return float(max(1.4826 * np.median(np.abs(rest)), step, 1e-3))


def _interval(times: Array) -> float:
    steps = np.diff(np.unique(times))
    return float(np.median(steps[steps > 1e-3]))


def _span(series: list[ModelSeries], channel: str) -> tuple[float, float]:
    readings = [s.history.readings[channel] for s in series if channel in s.history.readings]
    values = np.concatenate(readings)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return float(np.floor(low * 10) / 10), float(np.ceil(high * 10) / 10)


def _rms(series: ModelSeries, model: ThermalModel) -> float:
    residuals = series.residuals(model.predict(series.history, series.field))
    return float(np.sqrt(np.nanmean(residuals**2)))


def _with_sds(effect: ModelEffect, sd: dict[str, float], series: list[ModelSeries]) -> ModelEffect:
    if effect.name == "defocus":
        return effect
    found = {k: sd[f"{effect.name}.{k}"] for k in effect.values if f"{effect.name}.{k}" in sd}
    values = dict(effect.values)
    if "phase" in values:
        values["phase"] = float(np.angle(np.exp(1j * values["phase"])))
    if "time" in values:
        # an instant between two frames: uniform over the interval
        found["time"] = _interval(series[0].history.times) / np.sqrt(12.0)
    return ModelEffect(effect.name, values, found)


def _inverse(M: Array) -> Array:
    """The inverse of a normal matrix whose unknowns differ by powers of ten."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    scaled = M * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    # directions that the data do not fix stay where they are
    inverse = np.where(values > 1e-13 * values.max(), 1.0 / np.maximum(values, 1e-300), 0.0)
    result: Array = (vectors * inverse) @ vectors.T * np.outer(scale, scale)
    return result
