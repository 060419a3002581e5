"""The plan: the effects that a set-up could reveal, predicted before the camera is heated.

Recordings of the set-up are simulated without effects. Each effect in turn is then added to their
normal equations with a given strength, and searched for. The confusion matrix shows which effects
would be found, which remain ambiguous, and which experiment separates them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.examination import examine_series
from thermocald.discovery.search import list_candidates
from thermocald.errors import UsageError
from thermocald.numbers import counted, percent
from thermocald.physics import catalogue
from thermocald.physics.model import ModelEffect
from thermocald.result import Result
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.series import ReducedSeries, SeriesInput, unit_directions
from thermocald.thermal.source import epochs_input

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from thermocald.arrays import Array
    from thermocald.physics.simulation import Simulation
    from thermocald.thermal.hypothesis import Candidate


@dataclass(frozen=True, repr=False)
class Plan(Result):
    """The predicted power of a set-up; found: {effect: {verdict: count}}."""

    found: dict[str, dict[str, int]]
    repetitions: int
    strength_px: float

    def power(self, effect: str) -> float:
        """Return the share of repetitions that found an effect, alone or with alternatives."""
        verdicts = self.found[effect]
        right = sum(n for name, n in verdicts.items() if effect in name.split(" or "))
        return right / max(sum(verdicts.values()), 1)

    def ambiguous(self) -> list[tuple[str, str, str]]:
        """List the pairs that the set-up does not separate, each with an experiment that does."""
        pairs: dict[tuple[str, str], str] = {}
        for effect, verdicts in self.found.items():
            for name in verdicts:
                for other in name.split(" or "):
                    if other != effect and other in catalogue.names():
                        key = (min(effect, other), max(effect, other))
                        pairs[key] = catalogue.get(effect).experiment_against(catalogue.get(other))
        return [(a, b, experiment) for (a, b), experiment in sorted(pairs.items())]

    def as_dict(self) -> dict[str, Any]:
        """Return what `discover --plan --json` writes."""
        return {
            "format": "thermocald-plan/1",
            "strength_px": self.strength_px,
            "repetitions": self.repetitions,
            "power": {name: self.power(name) for name in self.found},
            "confusion": self.found,
            "ambiguous": [
                {"effects": [a, b], "experiment": experiment}
                for a, b, experiment in self.ambiguous()
            ],
        }

    def lines(self) -> list[str]:
        """Return what `discover --plan` prints."""
        each = counted(self.repetitions, "recording")
        out = [f"effects of {self.strength_px:g} px RMS, {each} each:"]
        for name, verdicts in self.found.items():
            counts = ", ".join(f"{k} × {n}" for k, n in sorted(verdicts.items()))
            out.append(f"  {name:26s} found {percent(self.power(name)):>5}   verdicts: {counts}")
        out += [f"  ambiguous: {a} and {b}; {e}" for a, b, e in self.ambiguous()]
        return out


def set_ups(
    source: SeriesInput | None,
    model: Path | None,
    preset: str | None,
    testfield: str | None,
    programme: Path | None,
    seeds: int,
) -> list[tuple[SeriesInput, Simulation | None]]:
    """Prepare recordings of the set-up without effects but the model's, each with its simulation.

    There is one per seed. A measured series represents the set-up by its own epochs and noise,
    once.
    """
    if source is not None:
        return [(source, None)]
    if preset is None and (model is None or programme is None):
        raise UsageError(
            "--plan needs a recording of the set-up, or --preset, or --model and --programme"
        )
    from thermocald.physics.presets import given_simulation
    from thermocald.physics.testfields import load_field

    model = None if preset is not None else model
    field = load_field(testfield) if testfield is not None else None
    out: list[tuple[SeriesInput, Simulation | None]] = []
    for seed in range(seeds):
        simulation = given_simulation(preset, model, None, field, programme, seed, "plan")
        if preset is not None:  # only for its camera, without the preset's effects
            simulation = replace(simulation, model=replace(simulation.model, effects=()))
        out.append((_record(simulation), simulation))
    return out


def _record(simulation: Simulation) -> SeriesInput:
    return epochs_input(simulation.head, simulation.field, list(simulation.epochs()), "plan")


def plan_power(
    inputs: Sequence[tuple[SeriesInput, Simulation | None]],
    strength_px: float,
    advance: Callable[[int], None],
) -> Plan:
    """Add every effect to every recording of `set_ups` and search for it."""
    found: dict[str, dict[str, int]] = {}
    rng = np.random.default_rng(0)
    for source, simulation in inputs:
        given = () if simulation is None else simulation.model.effects
        evidence = reduce_series(source)
        fitter = HypothesisFitter([evidence])
        done: set[str] = set()
        for candidate in list_candidates([evidence]):
            if candidate.effect in done:
                continue
            done.add(candidate.effect)
            if candidate.kind.is_drive:
                changed = _add_drive(simulation, fitter, candidate, strength_px)
            else:
                changed = _add_effect(fitter, candidate, strength_px, rng)
            x = examine_series([changed], given=given)
            every = [x.best.names, *(r.names for r in x.rivals)]
            named = ("+".join(names[len(x.base.terms) :]) or "none" for names in every)
            verdict = " or ".join(dict.fromkeys(named)) if x.adequate else "unexplained"
            row = found.setdefault(candidate.effect, {})
            row[verdict] = row.get(verdict, 0) + 1
            advance(1)
    return Plan(found, len(inputs), strength_px)


def _add_effect(
    fitter: HypothesisFitter, candidate: Candidate, strength_px: float, rng: np.random.Generator
) -> ReducedSeries:
    """Add an effect to the normal equations; the base model leaves `strength_px` of it."""
    e, h = fitter.series[0], fitter.series[0].history
    # the readings without the evidence's smoothing, since a camera follows every kink
    readings = {n: h.readings[n] + c.deviation for n, c in e.thermometers.items()}
    seen = HypothesisFitter([replace(e, history=replace(h, readings=readings))])
    value = None  # of the non-linear parameter, with which the effect shows well
    if candidate.name and candidate.kind.nonlinear[candidate.name].role == "period":
        value = float(e.times[-1] / rng.uniform(4, 20))
    elif candidate.name:
        value = float(candidate.grid[int(len(candidate.grid) * rng.uniform(0.4, 0.6))])
    term = candidate.term(value, 1)
    if candidate.kind.is_event:
        term = Term(term.effect, term.parameters, (), (((candidate.name, value or 0.0),),))
    trajectory = seen.trajectories(term, 0, operators=False)[0][:, 0]
    direction = unit_directions(term.parameters) @ rng.normal(size=len(term.parameters))
    moved = trajectory[:, None] * direction[None]
    size = strength_px / max(_measure_left(fitter, moved), 1e-12)
    return e.with_values(e.values + moved * size)


def _add_drive(
    simulation: Simulation | None,
    fitter: HypothesisFitter,
    candidate: Candidate,
    strength_px: float,
) -> ReducedSeries:
    """Make the camera follow a drive; the base model leaves `strength_px` of it.

    A simulation is run again, since the readings do not hold the true temperatures.
    """
    base = fitter.fit(())
    rates = base.direction(base.blocks[0])[0]
    follows = fitter.drive_trajectory([], 0)
    sizes = np.abs(candidate.grid)
    trials: list[tuple[float, Term, Array]] = []
    for value in np.geomspace(max(float(sizes.min()), 0.01), float(sizes.max()), 60):
        term = candidate.term(float(value), 1)
        moved = (fitter.drive_trajectory([term], 0) - follows)[:, None] * rates[None]
        off = abs(float(np.log(max(_measure_left(fitter, moved), 1e-9) / strength_px)))
        trials.append((off, term, moved))
    _, term, moved = min(trials, key=lambda t: t[0])
    if simulation is None:
        e = fitter.series[0]
        return e.with_values(e.values + moved)
    model = simulation.model.with_effect(ModelEffect(term.effect, dict(term.nonlinear)))
    return reduce_series(_record(replace(simulation, model=model)))


def _measure_left(fitter: HypothesisFitter, moved: Array) -> float:
    """Return the RMS, px, that the fitted base model leaves of a movement (E, P) of parameters."""
    e = fitter.series[0]
    T = fitter.drive_trajectory([], 0)
    T = T - T.mean()
    r = moved - moved.mean(axis=0)
    N = e.N.mean(axis=0)
    columns = unit_directions(BASE)
    slope = (T @ r) / (T @ T)
    rates = np.linalg.solve(columns.T @ N @ columns, columns.T @ N @ slope)
    r = r - np.outer(T, columns @ rates)
    image = np.einsum("tij,ej->eti", e.columns[e.weights[..., 0].any(axis=0)], r)
    return float(np.sqrt(np.mean(image**2)))
