"""The experiment that separates two effects best, and the test whether it has separated them.

Several kinds of programme (a long hold, two cycles, a staircase, slow and fast, pulses) are
simulated for a body with one time constant that a relay with a thermostat heats. The size of an
effect is what the base model and the other effect, with any of its constants, leave of it, relative
to the noise of an epoch.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.search import Search, by_score
from thermocald.errors import DataError, UsageError
from thermocald.physics import catalogue
from thermocald.physics.history import History
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import trial_values
from thermocald.thermal.noise import calibrate_thermometers, weight_slow_noise
from thermocald.thermal.scan import scan_candidate
from thermocald.thermal.series import in_blocks

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from thermocald.arrays import Array
    from thermocald.thermal.series import ReducedSeries


@dataclass(frozen=True)
class Separation:
    """The comparison of two alternatives in the recorded series.

    difference: between their scores; needed: the difference from which the worse one is excluded;
    detected: whether the better one explains more than the base model.
    """

    better: str
    worse: str
    difference: float
    needed: float
    detected: bool

    @property
    def separated(self) -> bool:
        """Whether one of the two is excluded."""
        return self.detected and self.difference > self.needed

    @property
    def sentence(self) -> str:
        """The comparison as a sentence."""
        if not self.detected:
            return f"neither {self.better} nor {self.worse} is detected yet"
        if self.separated:
            return (
                f"{self.better}: {self.worse} is excluded, its score is {self.difference:.0f} "
                f"worse ({self.needed:.0f} needed)"
            )
        return (
            f"{self.better} scores {self.difference:.0f} better than {self.worse}; "
            f"{self.needed:.0f} needed"
        )


def read_alternatives(text: str) -> tuple[str, str]:
    """Read the two effects of `A,B`; raises UsageError unless trajectories can show both."""
    names = [n.strip() for n in text.split(",")]
    if len(names) != 2 or names[0] == names[1]:
        raise UsageError(f"--until-separated {text}: give two different effects, as A,B")
    for name in names:
        if catalogue.get(name).seen_in != "trajectory":
            raise UsageError(
                f"--until-separated {text}: {name} shows in the image and not in the time series "
                "of the camera's parameters; no heating programme separates it"
            )
    return names[0], names[1]


def compare_effects(series: Sequence[ReducedSeries], first: str, second: str) -> Separation:
    """Compare two effects, each with the constants that fit it best, on all series together."""
    ready = [in_blocks(weight_slow_noise(e)) for e in calibrate_thermometers(series)]
    search = Search(HypothesisFitter(ready))
    base = search.base()
    drives = all(catalogue.get(name).is_drive for name in (first, second))
    found = []
    for name in (first, second):
        own = [c for c in search.candidates if c.effect == name]
        scans = [scan_candidate(search.fitter, c, base.fit) for c in own]
        promises = [search.promise(c, s) for c, s in zip(own, scans, strict=True)]
        if not promises:
            raise UsageError(
                f"{name} cannot be tested in this series: it needs a quantity that was not recorded"
            )
        best = max(promises, key=lambda p: p.net)  # of the sets of parameters that it can act on
        found.append(search.refine((*base.terms, best.term), (*base.penalties, best.penalty)))
    better, worse = sorted(found, key=by_score)
    return Separation(
        better.names[-1], worse.names[-1], worse.score - better.score,
        criteria.DRIVES_BAND if drives else criteria.BAND, better.score < base.score,
    )  # fmt: skip


_STEP_S = 60.0  # steps by which a thermostat follows a ramp
_FINE_S = 2.0
_NOISE_PX = 0.01  # of an epoch: its image points, and a thermometer with 0.02 K
_STRENGTH_PX = 0.1
_HYSTERESIS_K = 0.5
_LEAST_S = 900.0
_LEAST_K = 5.0  # least warming that shows effects
_KINDS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "one long hold": ((0.08, 0.09, 1.0), (0.62, 0.63, 0.0)),
    "two equal cycles": (
        (0.06, 0.07, 1.0), (0.3, 0.31, 0.0), (0.53, 0.54, 1.0), (0.77, 0.78, 0.0)),
    "a staircase up and down": (
        (0.06, 0.07, 0.35), (0.2, 0.21, 0.7), (0.35, 0.36, 1.0), (0.5, 0.51, 0.6),
        (0.68, 0.69, 0.3), (0.84, 0.85, 0.0)),
    "once slowly, once fast": (
        (0.05, 0.5, 1.0), (0.5, 0.51, 0.0), (0.72, 0.73, 1.0), (0.85, 0.86, 0.0)),
    "three short pulses": (
        (0.06, 0.07, 1.0), (0.17, 0.18, 0.0), (0.38, 0.39, 1.0), (0.49, 0.5, 0.0),
        (0.7, 0.71, 1.0), (0.81, 0.82, 0.0)),
    "a small loop, then a large one": (
        (0.05, 0.06, 0.5), (0.22, 0.23, 0.0), (0.43, 0.44, 1.0), (0.7, 0.71, 0.0)),
}  # fmt: skip
"""Each kind's ramps: (start and end as shares of the time, share of the highest warming at the
end, which is then held); it begins with 0.
"""


@dataclass(frozen=True)
class Limits:
    """The limits of heating: highest temperature °C, its rate K/min, share of time with heat."""

    max_c: float
    max_rate: float = 3.0
    max_duty: float = 0.8


@dataclass(frozen=True)
class Body:
    """A camera's warming: ambient temperature °C, final rise K, time constant s."""

    ambient: float = 22.0
    rise: float = 35.0
    tau: float = 500.0


@dataclass(frozen=True, eq=False)
class Experiment:
    """A heating programme.

    steps: (seconds, °C to hold or None) for the heating output; temperature: expected at the
    epochs, °C; duty: share of time with heat; sigmas: standard deviations by which it separates the
    effects.
    """

    name: str
    steps: tuple[tuple[float, float | None], ...]
    times: Array
    temperature: Array
    duty: float
    sigmas: float

    def programme(self) -> list[dict[str, Any]]:
        """Return the steps in the form that a session takes."""
        return [{"seconds": s, "hold_c": h} for s, h in self.steps]


def estimate_body(times: Array, temperature: Array) -> Body:
    """Estimate a camera's warming from a recording; typical values if its temperature was steady.

    times (R,) s, temperature (R,) °C.
    """
    usual = Body(ambient=float(np.min(temperature)))
    rate = np.gradient(temperature, times)
    falling = (rate < 0.3 * rate.min()) if rate.min() < 0 else np.zeros(len(rate), dtype=bool)
    falling[1:] &= falling[:-1]  # without the reading at which the heat was switched off
    if np.ptp(temperature) < _LEAST_K or falling.sum() < 8:
        return usual
    slope, _ = np.polyfit(temperature[falling], rate[falling], 1)
    tau = float(np.clip(-1.0 / slope if slope < 0 else usual.tau, 60.0, 5000.0))
    fastest = float(np.quantile(rate, 0.97))
    return Body(usual.ambient, max(fastest * tau, float(np.ptp(temperature))), tau)


def rank_experiments(
    first: str,
    second: str,
    limits: Limits,
    body: Body,
    epochs: int,
    interval: float,
) -> list[Experiment]:
    """Rank the programmes within the limits, the one that separates best first.

    The base model leaves 0.1 px of each effect under two equal cycles. Raises DataError if the
    limits allow too little heating.
    """
    highest = min(limits.max_c - _HYSTERESIS_K, body.ambient + 0.9 * body.rise)
    if highest - body.ambient < _LEAST_K:
        raise DataError(
            f"the limits allow {max(highest - body.ambient, 0.0):.1f} K of warming above "
            f"{body.ambient:.1f} °C; {_LEAST_K:g} K are needed to separate effects"
        )
    if epochs * interval < _LEAST_S:
        raise DataError(
            f"{epochs} epochs of {interval:g} s are {epochs * interval / 60:.0f} min; heat needs "
            f"{_LEAST_S / 60:.0f} min or more to separate effects: take more epochs"
        )
    times = interval * np.arange(epochs, dtype=np.float64)
    runs = {}
    for name in _KINDS:  # the hottest programme of each kind within the duty
        most = highest
        while True:
            steps = tuple(_steps(name, limits, body, float(times[-1]), most))
            temperature, duty = _simulate(steps, body, times)
            if duty <= limits.max_duty or most - body.ambient < _LEAST_K + 1.0:
                break
            most -= 1.0
        runs[name] = steps, temperature, duty
    usual = runs["two equal cycles"]
    history = _history(times, usual[1], body)
    sizes = {n: _measure_left(n, None, history) / _STRENGTH_PX for n in (first, second)}
    out = []
    for name, (steps, temperature, duty) in runs.items():
        history = _history(times, temperature, body)
        sigmas = min(
            _measure_left(a, b, history) / max(sizes[a], 1e-300)
            for a, b in ((first, second), (second, first))
        )
        sigmas *= np.sqrt(epochs) / _NOISE_PX
        out.append(Experiment(name, steps, times, temperature, duty, float(sigmas)))
    return sorted(out, key=lambda e: -e.sigmas)


# -- heating -----------------------------------------------------------------------------------


def _steps(
    name: str, limits: Limits, body: Body, duration: float, highest: float
) -> Iterator[tuple[float, float | None]]:
    """Yield a kind's profile as steps of a thermostat, none of which exceeds the limit's rate."""
    changes = np.array(_KINDS[name])
    shares, levels = changes[:, :2].ravel(), np.repeat([0.0, *changes[:, 2]], 2)[1:-1]
    at = np.arange(0.0, duration + _STEP_S, _STEP_S)
    wanted = np.interp(at, shares * duration, body.ambient + levels * (highest - body.ambient))
    held: list[float] = [float(body.ambient)]
    for value in wanted[1:]:
        held.append(min(float(value), held[-1] + limits.max_rate * _STEP_S / 60.0))
    holds = (round(value, 1) if value > body.ambient + 0.5 else None for value in held)
    for hold, run in groupby(holds):
        yield _STEP_S * len(list(run)), hold


def _simulate(
    steps: tuple[tuple[float, float | None], ...], body: Body, times: Array
) -> tuple[Array, float]:
    """Simulate a thermostat: temperature (E,) °C at `times`, and share of time with heat."""
    fine = np.arange(0.0, times[-1] + _FINE_S, _FINE_S)
    ends = np.cumsum([s for s, _ in steps])
    which = np.minimum(np.searchsorted(ends, fine, side="right"), len(steps) - 1)
    holds = [h for _, h in steps]
    T, on, heated, out = body.ambient, False, 0, []
    decay = 1.0 - np.exp(-_FINE_S / body.tau)
    for i in which.tolist():
        hold = holds[i]
        if hold is None or hold + _HYSTERESIS_K / 2 <= T:
            on = False
        elif hold - _HYSTERESIS_K / 2 >= T:
            on = True
        heated += on
        T += (body.ambient + body.rise * on - T) * decay
        out.append(T)
    return np.interp(times, fine, out), heated / len(fine)


# -- effects -----------------------------------------------------------------------------------


def _history(times: Array, temperature: Array, body: Body) -> History:
    other = body.ambient + 8.0 + 4.0 * np.sin(times / 211.0)
    readings = {"temperature": temperature, "other": other}
    return History(times, times, readings, "temperature", body.ambient)


def _trajectories(name: str, history: History) -> list[Array]:
    """Return an effect's trajectories (E, m), one for each of its trial constants."""
    effect = catalogue.get(name)
    trials: list[dict[str, Any]] = [{}]
    for key, parameter in effect.nonlinear.items():
        if parameter.text:
            trials = [{**t, key: "other"} for t in trials]
        elif parameter.role != "phase":
            values = trial_values(parameter, history.times, history.temperature())
            trials = [{**t, key: float(v)} for t in trials for v in values]
    if effect.is_drive:
        T = history.temperature()
        return [(effect.drive(history, **t) - T)[:, None] for t in trials]
    return [effect.signal(history, **t) for t in trials]


def _measure_left(name: str, other: str | None, history: History) -> float:
    """Return the RMS that the base model leaves of an effect with medium constants.

    other: another effect beside the base model, with the constants that leave least.
    """
    every = _trajectories(name, history)
    y = every[2 * len(every) // 3][:, 0]  # of the delays, a positive one
    base = np.column_stack([np.ones(len(history.times)), history.temperature()])
    beside = [np.zeros((len(y), 0))] if other is None else _trajectories(other, history)
    left = []
    for trajectory in beside:
        columns = np.hstack([base, trajectory])
        columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
        rest = y - columns @ np.linalg.lstsq(columns, y, rcond=1e-9)[0]
        left.append(float(np.std(rest)))
    return min(left)
