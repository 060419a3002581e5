"""The plan: what an experiment would show, before anything is heated.

Recordings of the set-up are simulated without any effect; each effect in turn is then put into
their normal equations at a given strength and looked for. The confusion matrix says which
effects would be found, which stay ambiguous with which, and what to do to tell them apart.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.search.candidates import candidates
from thermocald.discovery.search.examination import examine_series
from thermocald.discovery.verdict.found import terms_of
from thermocald.errors import UsageError
from thermocald.reduction.fit import HypothesisFitter
from thermocald.reduction.hypothesis import Term
from thermocald.reduction.reduce import reduce_series
from thermocald.reduction.series import COLUMNS, ReducedSeries, SeriesInput
from thermocald.reduction.source import series_input
from thermocald.simulation import effects as catalogue
from thermocald.simulation.model import ModelEffect

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array
    from thermocald.reduction.candidate import Candidate
    from thermocald.simulation.history import History
    from thermocald.simulation.observations import Simulation

__all__ = ["Plan", "SetUp", "plan_power", "set_ups"]


@dataclass(frozen=True)
class Plan:
    """found: {effect: {what was said: how often}}; repetitions; strength px."""

    found: dict[str, dict[str, int]]
    repetitions: int
    strength_px: float

    def power(self, effect: str) -> float:
        """Share of repetitions in which an effect was found, alone or with others not excluded."""
        said = self.found[effect]
        right = sum(n for name, n in said.items() if effect in name.replace("?", "").split(" or "))
        return right / max(sum(said.values()), 1)

    def ambiguous(self) -> list[tuple[str, str, str]]:
        """Pairs that this set-up leaves open, with the experiment that would tell them apart."""
        pairs: dict[tuple[str, str], str] = {}
        for effect, said in self.found.items():
            for name in said:
                for other in name.split(" or "):
                    if other != effect and other in catalogue.names():
                        key = (min(effect, other), max(effect, other))
                        pairs[key] = catalogue.get(effect).experiment_against(catalogue.get(other))
        return [(a, b, experiment) for (a, b), experiment in sorted(pairs.items())]

    def as_json(self) -> dict[str, Any]:
        """The plan as a document."""
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
        """The plan for people."""
        out = [f"effects of {self.strength_px:g} px RMS, {self.repetitions} recordings each:"]
        for name, said in self.found.items():
            words = ", ".join(f"{k} × {n}" for k, n in sorted(said.items()))
            out.append(f"  {name:26s} found {self.power(name):4.0%}   said: {words}")
        out += [f"  ambiguous: {a} and {b}; {e}" for a, b, e in self.ambiguous()]
        return out


@dataclass(frozen=True, eq=False)
class SetUp:
    """One recording without any effect but the model's, and the simulation that it came from."""

    source: SeriesInput
    simulation: Simulation | None = None

    @property
    def given(self) -> list[tuple[str, dict[str, Any]]]:
        """The effects that the model has already."""
        return [] if self.simulation is None else terms_of(self.simulation.model)

    def following(self, term: Term) -> SeriesInput | None:
        """The recording as it is when the camera follows a drive; None where nothing simulates."""
        if self.simulation is None:
            return None
        model = self.simulation.model
        effect = ModelEffect(term.effect, dict(term.nonlinear))
        changed = replace(model, effects=(*model.effects, effect))
        return _recorded(replace(self.simulation, model=changed))


def set_ups(
    recording: Path | None,
    model: Path | None,
    preset: str | None,
    testfield: str | None,
    programme: Path | None,
    seeds: int,
) -> list[SetUp]:
    """Recordings of the set-up with no effect but the model's, one per seed.

    A recording may stand for the set-up: then its own epochs and noise are used, once.
    """
    from thermocald.store.recording.reader import read_recording

    if recording is not None:
        return [SetUp(series_input(read_recording(recording)))]
    if preset is None and (model is None or programme is None):
        raise UsageError(
            "--plan needs a recording of the set-up, or --preset, or --model and --programme"
        )
    out = []
    for seed in range(seeds):
        simulation = _simulation(model, preset, testfield, programme, seed)
        out.append(SetUp(_recorded(simulation), simulation))
    return out


def _recorded(simulation: Simulation) -> SeriesInput:
    from thermocald.store.recording.reader import read_recording

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan"
        simulation.write(path)
        return series_input(read_recording(path))


def _simulation(
    model: Path | None, preset: str | None, testfield: str | None, programme: Path | None, seed: int
) -> Simulation:
    from thermocald.simulation.demonstration import load_field
    from thermocald.simulation.device import CameraDevice, default_heat
    from thermocald.simulation.model_file import read_model
    from thermocald.simulation.observations import Simulation
    from thermocald.simulation.presets import preset_simulation
    from thermocald.simulation.programme import read_programme

    field = load_field(testfield) if testfield is not None else None
    if preset is not None:
        simulation = preset_simulation(preset, seed, "plan", field)
        bare = simulation.model.without(*(e.name for e in simulation.model.effects))
        simulation = replace(simulation, model=bare)
        return replace(simulation, programme=read_programme(programme)) if programme else simulation
    assert model is not None
    assert programme is not None
    thermal = read_model(model)
    network, thermometers = default_heat()
    device = CameraDevice(thermal.camera, thermal.sensor, network, thermometers)
    chosen = field if field is not None else load_field("circles")
    return Simulation(thermal, device, chosen, read_programme(programme), seed)


def plan_power(inputs: Sequence[SetUp], strength_px: float, advance: Callable[[], None]) -> Plan:
    """Put every effect into every simulated recording and look for it."""
    found: dict[str, dict[str, int]] = {}
    rng = np.random.default_rng(0)
    for set_up in inputs:
        evidence = reduce_series(set_up.source)
        fitter = HypothesisFitter([evidence])
        done: set[str] = set()
        for candidate in candidates([evidence]):
            if candidate.effect in done:
                continue
            done.add(candidate.effect)
            if candidate.kind.is_drive:
                changed = _with_drive(set_up, fitter, candidate, strength_px)
            else:
                changed = _with_effect(fitter, candidate, strength_px, rng)
            said = _said(changed, set_up.given)
            row = found.setdefault(candidate.effect, {})
            row[said] = row.get(said, 0) + 1
            advance()
    return Plan(found, len(inputs), strength_px)


def _said(evidence: ReducedSeries, given: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """What an examination says beyond the effects that the model has."""
    x = examine_series([evidence], given=given)
    if not x.adequate:
        return "unexplained"
    known = len(x.base.terms)
    every = [x.best.names, *(r.names for r in x.rivals)]
    return " or ".join(dict.fromkeys("+".join(names[known:]) or "none" for names in every))


def _with_effect(
    fitter: HypothesisFitter, candidate: Candidate, strength_px: float, rng: np.random.Generator
) -> ReducedSeries:
    """The series with one effect in its normal equations, scaled to what the base leaves over."""
    e = fitter.series[0]
    seen = HypothesisFitter([replace(e, history=_as_read(e))])
    value = _place(candidate, e, rng)
    term = candidate.term(value, 1)
    if candidate.kind.is_event:
        term = Term(term.effect, term.parameters, (), (((candidate.name, value or 0.0),),))
    trajectory = seen.trajectories(term, 0, operators=False)[0][:, 0]
    direction = np.zeros(len(COLUMNS))
    direction[[COLUMNS.index(p) for p in term.parameters]] = rng.normal(size=len(term.parameters))
    moved = trajectory[:, None] * direction[None]
    return _moved(e, moved * (strength_px / max(_left_over(fitter, moved), 1e-12)))


def _moved(e: ReducedSeries, moved: Array) -> ReducedSeries:
    """The series with its parameters moved (E, P), px-scaled."""
    b = e.b + np.einsum("epq,eq->ep", e.N, moved)
    values = e.values + moved
    return replace(e, b=b, values=values, yy=np.einsum("ep,ep->e", values, b))


def _as_read(evidence: ReducedSeries) -> History:
    """The readings themselves, where the evidence has them smoothed: a camera feels every kink."""
    h = evidence.history
    readings = {n: h.readings[n] + c.deviation for n, c in evidence.thermometers.items()}
    return replace(h, readings=readings)


def _with_drive(
    set_up: SetUp, fitter: HypothesisFitter, candidate: Candidate, strength_px: float
) -> ReducedSeries:
    """The series when the camera follows a drive, at the value that leaves the strength.

    Simulated again where that can be: the truth behind the readings is not in them.
    """
    base = fitter.fit(())
    rates = base.direction(base.blocks[0])[0]
    follows = fitter.drive_trajectory([], 0)
    sizes = np.abs(candidate.grid)
    trials: list[tuple[float, Term, Array]] = []
    for value in np.geomspace(max(float(sizes.min()), 0.01), float(sizes.max()), 60):
        term = candidate.term(float(value), 1)
        moved = (fitter.drive_trajectory([term], 0) - follows)[:, None] * rates[None]
        off = abs(float(np.log(max(_left_over(fitter, moved), 1e-9) / strength_px)))
        trials.append((off, term, moved))
    _, term, moved = min(trials, key=lambda t: t[0])
    source = set_up.following(term)
    return _moved(fitter.series[0], moved) if source is None else reduce_series(source)


def _place(candidate: Candidate, e: ReducedSeries, rng: np.random.Generator) -> float | None:
    """A non-linear parameter where the effect is well seen, None where there is none."""
    if not len(candidate.grid):
        return None
    if candidate.kind.nonlinear[candidate.name].role == "period":
        return float(e.times[-1] / rng.uniform(4, 20))
    return float(candidate.grid[int(len(candidate.grid) * rng.uniform(0.4, 0.6))])


def _left_over(fitter: HypothesisFitter, moved: Array) -> float:
    """RMS px that the base model, fitted, leaves of a movement (E, P) of the parameters."""
    e = fitter.series[0]
    T = fitter.drive_trajectory([], 0)
    T = T - T.mean()
    r = moved - moved.mean(axis=0)
    N = e.N.mean(axis=0)
    columns = [COLUMNS.index(p) for p in ("c", "x0", "y0")]
    slope = (T @ r) / (T @ T)
    take = np.linalg.solve(N[np.ix_(columns, columns)], N[columns] @ slope)
    full = np.zeros(len(COLUMNS))
    full[columns] = take
    r = r - np.outer(T, full)
    image = np.einsum("tij,ej->eti", e.columns[e.weights[..., 0].any(axis=0)], r)
    return float(np.sqrt(np.mean(image**2)))
