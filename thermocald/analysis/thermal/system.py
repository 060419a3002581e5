"""The linear algebra behind the fit of a thermal model: one series' share of the normal equations.

Per epoch e the parameters are p_e(θ) + G_e ε: θ the model's unknowns, ε the errors of the readings.
With the epochs' normal matrices N_e the unknowns ε, which have a prior, are eliminated:

    M = Σ Jᵀ N J - C H⁻¹ Cᵀ,   H = Gᵀ N G + I/σ²,   C = Jᵀ N G

H has as many rows as there are readings and is sparse, since a reading touches few epochs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.series import N_PARAMETERS, ModelSeries
from thermocald.analysis.thermal.state import own_of, unknowns_of
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, IOP_NAMES, PARAMETER_NAMES
from thermocald.simulation import effects
from thermocald.simulation.drive import drive_matrix
from thermocald.simulation.model import RATED, ThermalModel

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.simulation.effects.influence import Influence
    from thermocald.simulation.history import History

    Array = NDArray[np.float64]

__all__ = ["Share", "error_operators", "jacobian", "share", "weights_of"]

_PROBES = 24  # random vectors that tell a trace
_NEGLIGIBLE = 1e-3
_DENSE = 3000  # readings
_FILLED = 0.05  # share of entries from which a dense factor is the faster one
_SCALE_NAMES = ("X", "Y", "Z")
_SHIFT_NAMES = ("dX", "dY", "dZ")


@dataclass(frozen=True, eq=False)
class Share:
    """One series' part. J (E, 22, q); M (q, q), g (q,): reduced normal equations; delta (E, 22):
    parameters minus the linearisation point; back: what ε̂ is computed with after the step.
    """

    J: Array
    M: Array
    g: Array
    delta: Array
    operators: tuple[tuple[Array, csr_array], ...]
    series: ModelSeries
    inverse: Callable[[Array], Array] | None
    h: Array
    C: Array
    variance: float
    error_sd: float
    before: Array

    def settle(
        self, step: Array, Q: Array, noise: Array | None = None
    ) -> tuple[float, Array, float]:
        """After the step (q,) with covariance Q: image cost, ε̂ (R,), redundancy of the readings."""
        if self.inverse is None:
            return self._image_cost(self.delta + self.J @ step, noise), np.zeros(0), 0.0
        solve = self.inverse
        change = solve(self.h - self.C.T @ step)
        errors = self.before + change
        delta = self.delta + self.J @ step
        for c, S in self.operators:
            delta = delta + (S @ change)[:, None] * c
        probes = np.random.default_rng(0).choice(np.array([-1.0, 1.0]), (len(self.h), _PROBES))
        back = solve(probes)
        trace = float(np.sum(probes * back)) / _PROBES
        lever = solve(np.ascontiguousarray(self.C.T))
        trace += float(np.sum((lever @ Q) * lever))
        redundancy = max(len(self.h) - trace / self.error_sd**2, 0.0)
        return self._image_cost(delta, noise), errors, redundancy

    def _image_cost(self, delta: Array, noise: Array | None) -> float:
        s = self.series
        quadratic = np.sum(delta * (s.N @ delta[:, :, None])[:, :, 0], axis=1)
        cost = s.lPl - 2.0 * np.sum(s.b * delta, axis=1) + quadratic
        return float(np.sum(cost if noise is None else cost / noise**2))


def _packed(change: Influence) -> Array:
    """What an influence adds to the 22 parameters, (E, 22)."""
    d = np.zeros((len(change.iop), N_PARAMETERS))
    d[:, :10], d[:, 10:16], d[:, 16:19] = change.iop, change.eop, change.scale - 1.0
    for displacement in change.displacements:
        d[:, 19:22] += displacement.active[:, None] * displacement.vector
    return d


def jacobian(
    series: ModelSeries,
    model: ThermalModel,
    free: tuple[str, ...],
    fixed: frozenset[str] = frozenset(),
) -> tuple[list[str], Array]:
    """Names (q,) and derivatives (E, 22, q) of the parameters by the unknowns of one series.

    In the order of `FitState.columns`: common ones, the series' own, the exterior orientation.
    """
    history, field = series.history, series.field
    epochs = len(series)
    names: list[str] = []
    columns: list[Array] = []

    def add(name: str, position: int, course: Array | float) -> None:
        column = np.zeros((epochs, N_PARAMETERS))
        column[:, position] = course
        names.append(name)
        columns.append(column)

    for n in free:
        if f"interior.{n}" not in fixed:
            add(f"interior.{n}", IOP_NAMES.index(n), 1.0)
    warming = model.drive(history) - model.T0
    for n in RATED:
        if f"rates.{n}" not in fixed:
            add(f"rates.{n}", IOP_NAMES.index(n), warming)
    for keys_of in (unknowns_of, own_of):
        for place, effect in enumerate(model.effects):
            kind = effects.get(effect.name)
            for key in keys_of(effect):
                name = f"{effect.name}.{key}"
                if name in fixed:
                    continue
                names.append(name)
                if key in kind.linear:
                    nonlinear, _ = kind.split(effect.values)
                    unit = kind.influence(history, {**nonlinear, key: 1.0}, field)
                    columns.append(_packed(unit))
                else:
                    columns.append(_difference(series, model, place, key))
    for i, n in enumerate(EOP_NAMES):
        add(f"exterior.{n}", 10 + i, 1.0)
    return names, np.stack(columns, axis=2)


def _difference(series: ModelSeries, model: ThermalModel, place: int, key: str) -> Array:
    """The derivative by a non-linear parameter, by central differences of the whole prediction."""
    effect = model.effects[place]
    parameter = effects.get(effect.name).nonlinear[key]
    value = float(effect.values[key])
    step = 1e-3 * abs(value) if parameter.log else 1e-3 * max(abs(value), 1.0)
    sides = []
    for sign in (1.0, -1.0):
        moved = replace(effect, values={**effect.values, key: value + sign * step})
        listed = (*model.effects[:place], moved, *model.effects[place + 1 :])
        prediction = replace(model, effects=listed).predict(series.history, series.field)
        sides.append(series.corrections(prediction))
    difference: Array = (sides[0] - sides[1]) / (2.0 * step)
    return difference


def error_operators(
    series: ModelSeries, model: ThermalModel
) -> tuple[tuple[Array, csr_array], ...]:
    """How the readings' errors reach the parameters: pairs of weights (22,) and operator (E, R).

    R runs over the readings of all channels that are used, one after the other.
    """
    from scipy.sparse import csr_array, hstack

    history = series.history
    found: list[tuple[Array, str, csr_array]] = []
    rates = np.zeros(N_PARAMETERS)
    rates[:10] = model.rate_vector
    if np.any(rates):
        found.append((rates, history.reference, _drive_operator(history, model)))
    for effect in model.effects:
        kind = effects.get(effect.name)
        nonlinear, coefficients = kind.split(effect.values)
        if kind.is_drive or kind.seen_in == "noise" or not any(coefficients.values()):
            continue
        S = kind.sensitivity(history, **nonlinear)
        if S.nnz == 0:
            continue
        found.append((weights_of(coefficients), kind.channel(history, **nonlinear), S))
    # every channel has its place, used or not: errors found in one step are the next one's start
    channels = list(history.readings)
    empty = csr_array((len(series), len(history.reading_times)))
    return tuple(
        (c, hstack([S if channel == other else empty for other in channels]).tocsr())
        for c, channel, S in found
    )


def weights_of(coefficients: Mapping[str, float]) -> Array:
    """An effect's coefficients as a direction (22,) of the parameters."""
    weights = np.zeros(N_PARAMETERS)
    for key, value in coefficients.items():
        if key in PARAMETER_NAMES:
            weights[PARAMETER_NAMES.index(key)] = value
        elif key in _SCALE_NAMES:
            weights[16 + _SCALE_NAMES.index(key)] = value
        else:
            weights[19 + _SHIFT_NAMES.index(key)] = value
    return weights


def _drive_operator(history: History, model: ThermalModel) -> csr_array:
    """∂ drive / ∂ readings (E, R), through all drives of the model one after the other."""
    whole = drive_matrix(history, model.drives)
    assert whole is not None
    if not model.drives:
        return whole
    # a thousandth of a reading's error is nobody's business, and the far past costs time
    whole.data[np.abs(whole.data) < _NEGLIGIBLE] = 0.0
    whole.eliminate_zeros()
    return whole


def _factorised(H: csr_array) -> Callable[[Array], Array]:
    """Solves H x = b: banded where readings touch near epochs alone, else sparse or dense."""
    from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

    entries = H.tocoo()
    rows, columns = entries.coords
    n = H.shape[0]
    width = int(np.max(rows - columns, initial=0))
    if width < n // 4:
        band = np.zeros((width + 1, n))
        lower = rows >= columns
        np.add.at(band, (rows[lower] - columns[lower], columns[lower]), entries.data[lower])
        factor = cholesky_banded(band, lower=True)
        return lambda b: np.asarray(cho_solve_banded((factor, True), b))
    if n <= _DENSE and H.nnz > _FILLED * n * n:
        dense = cho_factor(H.toarray(), lower=True, overwrite_a=True)
        return lambda b: np.asarray(cho_solve(dense, b))
    from scipy.sparse.linalg import splu

    sparse = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return lambda b: np.asarray(sparse.solve(b))


def share(
    series: ModelSeries,
    model: ThermalModel,
    J: Array,
    variance: float,
    error_sd: float,
    noise: Array | None = None,
    errors: Array | None = None,
) -> Share:
    """The normal equations of one series at the present model.

    variance: of unit weight of the image points; error_sd K: of a reading; noise (E,): factor of
    the image noise of each epoch; errors (R,) K: what the series' readings were corrected by so
    far, channel after channel. A course of noisy readings, and most of all its rate, is too rough:
    coefficients would come out too small if it were not corrected.
    """
    from scipy.sparse import diags_array, eye_array

    delta = series.corrections(model.predict(series.history, series.field))
    weight = np.full(len(series), 1.0 / variance) if noise is None else 1.0 / (variance * noise**2)
    N = series.N * weight[:, None, None]
    gradient = series.b * weight[:, None] - (N @ delta[:, :, None])[:, :, 0]
    NJ = N @ J
    q = J.shape[2]
    flat = J.reshape(-1, q)
    M = flat.T @ NJ.reshape(-1, q)
    g = flat.T @ gradient.ravel()
    operators = error_operators(series, model)
    if not operators:
        return Share(J, M, g, delta, (), series, None, np.zeros(0), np.zeros((q, 0)),
                     variance, error_sd, np.zeros(0))  # fmt: skip
    readings = operators[0][1].shape[1]
    H = eye_array(readings, format="csc") / error_sd**2
    C, h = np.zeros((q, readings)), np.zeros(readings)
    for c, S in operators:
        C += (S.T @ (c @ NJ)).T
        h += S.T @ (gradient @ c)
        for d, R in operators:
            H = H + S.T @ diags_array((N @ d) @ c) @ R
    before = np.zeros(readings) if errors is None else errors
    h -= before / error_sd**2
    inverse = _factorised(H)
    solved = inverse(np.column_stack([h, C.T]))
    M = M - C @ solved[:, 1:]
    g = g - C @ solved[:, 0]
    return Share(J, M, g, delta, operators, series, inverse, h, C, variance, error_sd, before)
