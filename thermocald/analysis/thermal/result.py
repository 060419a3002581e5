"""A fitted hypothesis as a thermal model, with the covariance of all its parameters.

The model's residuals are tested against noise that is estimated without the model: image noise from
the residuals of a free camera per epoch, thermometer noise from the roughness of the readings.
Smooth trajectories beyond that noise mean that the model lacks an effect. They show this effect as
far as the fit has not absorbed it; as a random time series with the power that they have in each
order of cosines they enter the covariance of the unknowns and of the predicted orientation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.linalg import block_diag

from thermocald.analysis.series.course import carried_by_c
from thermocald.analysis.thermal.prediction_test import (
    AFFINITY_SD,
    average_residuals,
    estimate_level,
    image_partials,
    thermometer_noise,
)
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.photogrammetry.linalg import inverse_of_determined, scaled_inverse
from thermocald.physics import catalogue
from thermocald.physics.formula import is_formula, known_together
from thermocald.physics.model import RATED, ModelEffect, ThermalModel
from thermocald.thermal.hypothesis import coefficients_of
from thermocald.thermal.movement import detect_tremble
from thermocald.thermal.noise import find_poorly_read
from thermocald.thermal.scan import examine
from thermocald.thermal.series import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.analysis.thermal.prediction_test import Moved
    from thermocald.arrays import Array
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit, Unknowns
    from thermocald.thermal.noise import NoiseGrowth
    from thermocald.thermal.scan import Adequacy
    from thermocald.thermal.series import ReducedSeries


# fraction of the image noise: a smaller misfit, even if significant, only widens the covariance;
# the 95 % bands stay valid
_MATERIAL = 0.2
_FEWEST = 30  # epochs that the test needs, in one series or in the short ones together
_FEWEST_TO_CARRY = 6  # epochs whose misfit can be propagated into the covariance, tested or not


def examine_rest(
    fitter: HypothesisFitter, fit: Fit, free: list[int]
) -> tuple[dict[str, Any], Array, Array]:
    """Test the smooth misfit of the model in every series; short series are tested jointly.

    free: columns of the interior orientation that absorb the misfit. Returns a verdict: whether an
    effect is missing (None if a series could not be tested and no other lacks one), RMS px and
    significance of the misfit in the worst series; and what the misfit adds to the covariances of
    the fit's unknowns (K + L, K + L) and of the interior orientation (10, 10), px-scaled.
    """
    size = len(fit.covariance)
    unknowns, parameters = np.zeros((size, size)), np.zeros((len(free), len(free)))
    found, misfit, significance = False, 0.0, 0.0
    epochs = [int((e.n > 0).sum()) for e in fitter.series]
    tests = {
        s: examine(fitter, fit, s) for s, count in enumerate(epochs) if count >= _FEWEST_TO_CARRY
    }
    short = [s for s in tests if epochs[s] < _FEWEST]
    # the joint test of the short series, in standard deviations
    scores = [tests[s].scores for s in short]
    free_scores = sum(a.size for a in scores)
    total = sum(float(np.sum(a**2)) for a in scores)
    together = (total - free_scores) / float(np.sqrt(2.0 * free_scores)) if free_scores else 0.0
    examined = sum(epochs[s] for s in short) >= _FEWEST
    for s, alone in tests.items():
        a = replace(alone, significance=together) if s in short else alone
        e = fitter.series[s]
        misfit = max(misfit, a.misfit_px)
        significance = max(significance, a.significance)
        if a.adequate:
            continue
        found = found or (a.misfit_px > _MATERIAL * e.sigma_px and (examined or s not in short))
        power = _power(a)
        # what the misfit adds to the covariance of the unknowns
        X, V, places = fitter.tangent(fit, fit.searched, s)
        _, _, B = fit.weightings[s].scan(a.trajectories[:, :, None], a.directions, (X, V))
        lever = fit.covariance @ np.einsum("jdr,rk->jkd", B, np.eye(size)[places])
        unknowns += np.einsum("jkd,jde,jle->kl", lever, power, lever)
        N = e.N.mean(axis=0)
        taken = inverse_of_determined(N[np.ix_(free, free)]) @ N[free] @ a.directions
        half = np.mean(a.trajectories**2, axis=1)
        parameters += taken @ np.einsum("j,jde->de", half, power) @ taken.T / len(fitter.series)
    unseen = min(epochs) < _FEWEST and (not examined or min(epochs) < _FEWEST_TO_CARRY)
    verdict = {
        "effect_missing": None if unseen and not found else bool(found),
        "misfit_px": round(float(misfit), 5),
        "significance_sigmas": round(float(significance), 1),
    }
    return verdict, unknowns, parameters


def _power(a: Adequacy) -> Array:
    """Return second moments (ORDERS, D, D) of the misfit's amplitudes along the directions.

    An order that the fit may have absorbed is taken to be as strong as its stronger neighbour.
    """
    along = a.amplitudes @ np.linalg.pinv(a.directions).T
    own = np.sum(along**2, axis=1)
    strongest = np.array([max(own[max(j - 1, 0) : j + 2]) for j in range(len(own))])
    ratio = strongest / np.maximum(own, 1e-300)
    shape = along[int(np.argmax(own))]
    power = np.einsum("j,jd,je->jde", np.minimum(ratio, 4.0), along, along)
    rest = strongest - np.minimum(ratio, 4.0) * own
    total: Array = power + np.einsum("j,d,e->jde", rest / (shape @ shape), shape, shape)
    return total


_ROUGH = 1.25  # times the noise left over, beyond which the readings did not show the true rate
_CLEAR = 150.0  # noises of a reading that the temperature must cover to show its rate
_SELDOM = 0.05  # bias of a delay by curvature between readings, over their interval
_INTERIOR = [COLUMNS.index(n) for n in IOP_NAMES]
_EXTERIOR = [COLUMNS.index(n) for n in EOP_NAMES]


@dataclass(frozen=True, slots=True)
class SeriesFit:
    """The fit of one series, with the RMS of its image residuals.

    thermometer_sd: K; means: the number of epoch means of a long series, to which fit and RMS
    refer, else None; noise_px: the RMS expected from the noise of image and thermometer.
    """

    JSON: ClassVar = {"left_over": "left_over_in_noise"}

    name: str
    epochs: int
    rms_px: float
    thermometer_sd: float
    means: int | None = None
    noise_px: float = float("nan")

    @property
    def left_over(self) -> float:
        """The ratio of the RMS to that expected from noise alone."""
        return self.rms_px / self.noise_px


def _effect(
    e: ModelEffect, k: int, fitter: HypothesisFitter, fit: Fit, unknowns: Unknowns,
    growth: NoiseGrowth | None, moved: Sequence[Moved],
) -> ModelEffect:  # fmt: skip
    """Return an effect of the model with the values of series k."""
    kind = catalogue.get(e.name)
    if kind.seen_in == "noise":
        assert growth is not None
        (key,) = kind.linear
        return ModelEffect(e.name, {key: growth.factor}, {key: growth.sd})
    if kind.seen_in == "targets":
        return moved[k].effect(e)
    own = next(t for t in fit.terms if t.effect == e.name).values(k)
    values = {**e.values, **dict.fromkeys((n for n in kind.linear if n in e.values), 0.0)}
    for name, value in (own or {}).items():
        if kind.nonlinear[name].role == "event":  # anywhere between two frames: take the middle
            _, value, _ = fitter.series[k].locate(float(value))
        values[name] = value
    for key in dict.fromkeys((*values, *kind.nonlinear, *kind.linear)):
        name = f"{e.name}.{key}"
        if kind.is_event or key in kind.fresh:
            name = f"{name}@{k}" if k else name
            if own is None:
                continue
        if name in unknowns:
            values[key] = unknowns[name][0]
    return ModelEffect(e.name, values)


def _covariance(
    fitter: HypothesisFitter, fit: Fit, first: ReducedSeries, numbers: Unknowns, unknowns: Array,
    parameters: Array,
) -> tuple[list[str], Array]:  # fmt: skip
    """Return names and covariance of interior orientation, drifts and the first series' unknowns.

    unknowns, parameters: the covariances that `examine_rest` adds.
    """
    n, size = len(_INTERIOR), len(fit.covariance)
    Q = scaled_inverse(_joint_normal(fitter, fit))[: n + size, : n + size]
    Q[:n, :n] += parameters
    Q[n:, n:] += unknowns
    rows = {name: row for name, (_, row) in numbers.items()}
    R = np.zeros((n + len(rows), n + size))
    R[:n, :n] = first.along[np.ix_(_INTERIOR, _INTERIOR)] / first.scale[_INTERIOR, None]
    R[n:, n:] = list(rows.values())
    return [*(f"interior.{p}" for p in IOP_NAMES), *rows], R @ Q @ R.T


def _image_sigma(series: Sequence[ReducedSeries], growth: NoiseGrowth | None) -> float:
    """Return the noise of an image coordinate at T₀, px."""
    total, count = 0.0, 0
    for k, s in enumerate(series):
        ok = s.n > 0
        weights = s.weights[ok, :, :2]
        w = weights.mean(axis=(1, 2), where=weights > 0) / s.source.per_row[ok]
        rise = growth.noise[k][ok] if growth else np.ones(len(w))
        total += float(np.sum(s.n[ok] / w / rise**2))
        count += int(s.n[ok].sum())
    return float(np.sqrt(total / count))


def _assess(
    s: ReducedSeries, model: ThermalModel, sigma: float, reading_sd: float, noise: Array | None
) -> SeriesFit:
    """Assess how well the model fits a series.

    sigma px: noise of a coordinate at T₀; reading_sd K: of a row's temperature; noise (E,): the
    image noise relative to that at T₀, None if it does not grow.
    """
    averaged = float(np.sqrt(np.median(s.source.per_row)))
    variance = (sigma / averaged) ** 2 * (1.0 if noise is None else float(np.mean(noise**2)))
    A = image_partials(s, np.zeros(0, dtype=np.int64))
    for share, of_targets in thermometer_noise(s, model, A, reading_sd)[0]:
        variance += float(share.mean() * of_targets.mean())
    # the residuals less a constant per target
    left, mean, _, moved = average_residuals(s, model.predict(s.readings_history, s.source.field))
    use = (s.weights[..., :2] > 0) & ~moved[:, None]
    rms = float(np.sqrt(np.sum((left - mean)[use] ** 2) / max(int(use.sum()), 1)))
    return SeriesFit(
        s.source.series or s.source.name,
        int(s.source.per_row[s.n > 0].sum()),
        rms,
        reading_sd * averaged,
        None if s.source.counts is None else int((s.n > 0).sum()),
        float(np.sqrt(variance)),
    )


def build_camera(
    fitter: HypothesisFitter,
    fit: Fit,
    series: Sequence[ReducedSeries],
    listed: Sequence[ModelEffect],
    growth: NoiseGrowth | None,
    moved: Sequence[Moved],
    distortion_sigmas: float | None,
) -> ThermalCamera:
    """Build the thermal camera of a fit; its events and phases are those of the first series.

    series: not averaged in blocks; growth, moved: effects on noise and targets, from outside the
    fit; distortion_sigmas: significance of what the distortion follows, None if that was given.
    """
    numbers = _list_unknowns(fit, series[0].scale)
    starts = [
        ThermalModel(
            s.source.camera,
            s.source.sensor,
            s.T0,
            InteriorOrientation.from_array(series[0].at.iop),
            {n: numbers[f"rates.{n}"][0] for n in RATED},
            tuple(_effect(e, k, fitter, fit, numbers, growth, moved) for e in listed),
            ExteriorOrientation.from_array(s.at.eop),
            distortion=s.distortion,
            name=s.source.camera,
        )
        for k, s in enumerate(series)
    ]
    models, field = estimate_level(series, starts)
    verdict, unknowns, parameters = examine_rest(fitter, fit, _INTERIOR)
    # a knock of the mount is in the fit, but not in the model
    known = models[0].parameter_names()
    own = {name: number for name, number in numbers.items() if name in known}
    names, covariance = _covariance(fitter, fit, series[0], own, unknowns, parameters)
    covariance[: len(_INTERIOR), : len(_INTERIOR)] += field
    if moved:
        e = next(e for e in listed if catalogue.get(e.name).seen_in == "targets")
        names += [f"{e.name}.{key}" for key in catalogue.get(e.name).linear]
        covariance = block_diag(covariance, moved[0].covariance)
    sigma = _image_sigma(series, growth)
    stated = np.concatenate([s.source.grid.weights[s.source.grid.observed][:, 0] for s in series])
    fits = tuple(
        _assess(
            s, models[k], sigma, fitter.series[k].thermometers[s.history.reference].noise,
            None if growth is None else growth.noise[k],
        )
        for k, s in enumerate(series)
    )  # fmt: skip
    found = verdict["effect_missing"]
    verdict["left_over_in_noise"] = round(float(max(f.left_over for f in fits)), 3)
    verdict["not_examined"] = None if found is not None else f"fewer than {_FEWEST} epochs"
    if distortion_sigmas is not None:
        verdict["distortion_sigmas"] = round(float(distortion_sigmas), 1)
    if found and any(map(detect_tremble, series)):
        verdict["trembles"] = True
    first = models[0]
    values = np.array([first.value(n) for n in names])
    certain = with_covariance(first, tuple(names), values, covariance)
    other_sds = [
        {name: round(f.thermometer_sd * (known[name].noise / known[e.history.reference].noise), 5)
         for name in ThermalCamera(certain).channels if name in known}
        for e, f in zip(fitter.series, fits, strict=True) for known in [e.thermometers]
    ]  # fmt: skip
    model = replace(
        certain,
        effects=tuple(_with_event_sd(e, series[0]) for e in certain.effects),
        image_sigma=sigma,
        validity=_find_ranges(series),
        fitted_on=tuple(
            {"series": f.name, "recording": s.source.name, "epochs": f.epochs,
             "rms_px": round(f.rms_px, 5), "thermometer_sd_K": round(f.thermometer_sd, 5),
             **({"other_sds_K": sds} if sds else {})}
            for s, f, sds in zip(series, fits, other_sds, strict=True)
        ),
        evidence={"fit": verdict},
    )  # fmt: skip
    sigma0 = sigma * float(np.sqrt(np.median(stated)))
    fitted = {"sigma0": sigma0, "band": not model.misses_an_effect, "series": fits}
    rough = verdict["left_over_in_noise"] > _ROUGH
    fitted |= _find_poorly_known(fitter, fit, model, series, fits, rough)
    return ThermalCamera(model, {**fitted, "prediction_test": []})


def _find_ranges(series: Sequence[ReducedSeries]) -> dict[str, tuple[float, float]]:
    """Return the lowest and the highest reading of each thermometer, °C, to 0.1 K outwards.

    A log begins an hour before the frames, when the camera was not seen.
    """
    readings: dict[str, Array] = {}
    for s in series:
        times, frames = s.source.reading_times, s.source.frame_times
        step = float(np.median(np.diff(frames)))
        seen = (times >= frames[0] - step) & (times <= frames[-1] + step)
        for channel, read in s.source.readings.items():
            if len(finite := read[seen & np.isfinite(read)]):
                readings[channel] = np.append(readings.get(channel, finite[:0]), finite)
    return {
        c: (float(np.floor(10 * T.min()) / 10), float(np.ceil(10 * T.max()) / 10))
        for c, T in readings.items()
    }


def _find_poorly_known(
    fitter: HypothesisFitter,
    fit: Fit,
    model: ThermalModel,
    series: Sequence[ReducedSeries],
    fits: Sequence[SeriesFit],
    rough: bool,
) -> dict[str, Any]:
    """Return what the data determine poorly, as the document of a fit names it.

    rough: whether the fit left much over.
    """
    fitted: dict[str, Any] = {}
    if tied := _tied_constants(model):
        fitted["known_together"] = tied
    delays = [
        e.name
        for e in model.effects
        if any(p.role == "delay" for p in catalogue.get(e.name).nonlinear.values())
    ]
    bulge = max(s.thermometers[s.history.reference].bulge for s in fitter.series)
    if delays and bulge > _SELDOM:
        fitted["read_seldom"] = {"effects": delays, "bulge": bulge}
    poorly = find_poorly_read(fitter, fit)
    clear = any(
        np.ptp(s.history.temperature()) > _CLEAR * f.thermometer_sd
        for s, f in zip(series, fits, strict=True)
    )
    if not clear or rough:
        rated = [e.name for e in model.effects if catalogue.get(e.name).follows_rate]
        poorly += [name for name in rated if name not in poorly]
    if poorly:
        fitted["read_poorly"] = {"effects": poorly}
    share = model.sd("interior.c") / model.interior.c
    rates = {p: (r, model.sd(f"rates.{p}")) for p, r in model.rates.items() if r}
    if carried := carried_by_c(share, rates):
        fitted["rates_hang_on_c"] = {"c_known_to": share, "sds": carried}
    return fitted


def _tied_constants(model: ThermalModel) -> list[dict[str, Any]]:
    """List the formulas whose constants are correlated with each other, and what is determined."""
    low, high = next(iter(model.validity.values()))
    found = []
    for e in model.effects:
        if not is_formula(e.name):
            continue
        kind = catalogue.get(e.name)
        moved = [p for p in kind.linear if p in e.values]
        rates = {f"rates.{p}": model.rates.get(p, 0.0) for p in moved}
        own = {k: float(e.values[k]) for k in (*kind.nonlinear, *moved)}
        Q = model.covariance_of([*(f"{e.name}.{k}" for k in own), *rates])
        known = known_together(e.name, {**own, **rates}, moved, Q, (low, model.T0, high))
        if known:
            found.append({"effect": e.name, **known})
    return found


def _joint_normal(fitter: HypothesisFitter, fit: Fit) -> Array:
    """Return the normal matrix of interior (10), unknowns (K + L) and exteriors (6 each), px.

    The interior orientation is that at T₀; the thermometers' errors are eliminated.
    """
    n, K, size = len(_INTERIOR), len(fit.coefficients), len(fit.covariance)
    M = np.zeros((n + size + 6 * len(fitter.series),) * 2)
    for s in range(len(fitter.series)):
        X, V, places = fitter.tangent(fit, fit.searched, s, centred=False)
        A, _, coupling = fit.weightings[s].joint(X, V)
        R, P = len(A), len(coupling)
        T = np.zeros((R + P, len(M)))
        T[np.arange(R), n + places] = 1.0
        T[R + np.array(_INTERIOR), np.arange(n)] = 1.0
        T[R + np.array(_EXTERIOR), n + size + 6 * s + np.arange(6)] = 1.0
        own = np.block([[A, coupling.T], [coupling, fit.weightings[s].level_normal]])
        M += T.T @ own @ T
    for row, (_, information) in enumerate(fitter.prior_terms(fit), n + K):
        M[row, row] += information
    affinity = [IOP_NAMES.index("C1"), IOP_NAMES.index("C2")]
    M[affinity, affinity] += (AFFINITY_SD * fitter.series[0].scale[affinity]) ** -2
    empty = np.diag(M) <= 0
    M[empty, empty] = 1e12  # a coefficient of a series that does not take part
    return M


def _with_event_sd(effect: ModelEffect, series: ReducedSeries) -> ModelEffect:
    """Return an effect with the sd of its event, a time between two frames: it is uniform."""
    sd = float(np.median(np.diff(series.times)) / np.sqrt(12.0))
    kind = catalogue.get(effect.name)
    events = [key for key, parameter in kind.nonlinear.items() if parameter.role == "event"]
    return replace(effect, sds={**effect.sds, **dict.fromkeys(events, sd)})


def with_covariance(
    model: ThermalModel, names: tuple[str, ...], values: Array, covariance: Array
) -> ThermalModel:
    """Return the model with other values and another covariance of some numbers.

    names: as in `ThermalModel.parameter_names`.
    """
    sd = dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))
    moved = model.with_values(dict(zip(names, values.tolist(), strict=True)))
    effects = tuple(
        replace(e, sds={**e.sds, **{k: sd[f] for k in e.values if (f := f"{e.name}.{k}") in sd}})
        for e in moved.effects
    )
    return replace(
        moved,
        effects=effects,
        sds={**model.sds, **{k: v for k, v in sd.items() if k.startswith(("interior.", "rates."))}},
        covariance_names=names,
        covariance=tuple(tuple(row) for row in covariance.tolist()),
    )


def _list_unknowns(fit: Fit, scale: Array) -> Unknowns:
    """Return all parameters that have a standard deviation in the fit, the rates first.

    scale (19,): px per unit of the columns.
    """
    rates = coefficients_of(fit, fit.blocks[:1], scale)
    found = {f"rates.{name}": number for name, number in rates.items()}
    for number, term in enumerate(fit.terms):
        for place, (i, key) in enumerate(fit.searched, len(fit.coefficients)):
            if i == number:
                row = np.eye(1, len(fit.covariance), place)[0]
                found[f"{term.effect}.{key}"] = float(dict(term.nonlinear)[key]), row
        names = {term.kind.column(n): n for n in term.kind.linear}
        blocks = [b for b in fit.blocks if b.term == number]
        for key, one in coefficients_of(fit, blocks, scale).items():
            column, at, k = key.partition("@")
            found[f"{term.effect}.{names.get(column, column)}{at}{k}"] = one
    return found
