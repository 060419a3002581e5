"""Gauss-Newton over all series of a thermal model, with variance components.

Source: variance components: Koch, K.-R. (1999): Parameter Estimation and Hypothesis Testing in
Linear Models, 2nd ed., section 3.6.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.noise import (
    defocus_law,
    thermometer_noise,
    without_open_courses,
)
from thermocald.analysis.thermal.state import FREE_INTERIOR, FitState
from thermocald.analysis.thermal.system import Share, jacobian, share

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.analysis.thermal.series import ModelSeries

    Array = NDArray[np.float64]

__all__ = ["ModelFit"]

_ITERATIONS = 30
_CONVERGED = 1e-2  # of a standard deviation
_PRIOR_SHARE = 0.3  # of the readings: how much their own roughness counts as known


class ModelFit:
    """Some series, and what of their noise is known; lasts from step to step.

    components: whether the thermometers' noise is estimated; correcting: whether the readings are
    corrected by their errors as far as they are known.
    """

    def __init__(self, series: list[ModelSeries]) -> None:
        self.series = series
        self.variance = 1.0
        self.components = False
        self.prior_sds = [thermometer_noise(s) for s in series]
        self.error_sds = list(self.prior_sds)
        self.noise: list[Array | None] = [None] * len(series)
        self.errors: list[Array | None] = [None] * len(series)
        self.correcting = False
        self.Q = np.zeros((0, 0))
        self.shares: list[Share] = []
        self.cost = np.inf

    def step(self, state: FitState) -> tuple[Array, float]:
        """One step (p,), its largest part in standard deviations; renews the variances."""
        size = len(state.names)
        M, g = np.zeros((size, size)), np.zeros(size)
        self.shares = []
        observations = 0.0
        for k in range(len(self.series)):
            model = state.of_series(k)
            s, lost = without_open_courses(self._corrected(k), model, self.variance, self.noise[k])
            observations += 2.0 * float(s.count.sum()) - lost
            _, J = jacobian(s, model, FREE_INTERIOR, state.fixed_in(k))
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
        self._renew(state, step, observations)
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

    def _renew(self, state: FitState, step: Array, observations: float) -> None:
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
        self.variance = image / max(observations - len(step) - used, 1.0)

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

    def defocus(self, state: FitState) -> FitState:
        """The state with the noise's law as the epochs' misfits tell it."""
        models = [state.of_series(k) for k in range(len(self.series))]
        found, self.noise[:] = defocus_law(self.series, models, self.noise, self.variance)
        listed = tuple(found if e.name == found.name else e for e in state.model.effects)
        return replace(state, model=replace(state.model, effects=listed))


def _inverse(M: Array) -> Array:
    """The inverse of a normal matrix whose unknowns differ by powers of ten."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    scaled = M * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    # directions that the data do not fix stay where they are
    inverse = np.where(values > 1e-13 * values.max(), 1.0 / np.maximum(values, 1e-300), 0.0)
    result: Array = (vectors * inverse) @ vectors.T * np.outer(scale, scale)
    return result
