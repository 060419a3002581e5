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

from thermocald.discovery.candidates import Candidate, candidates
from thermocald.discovery.evidence import COLUMNS, Evidence, SeriesInput, gather
from thermocald.discovery.examination import examine_series
from thermocald.discovery.hypothesis import Laboratory, Term
from thermocald.discovery.source import series_input
from thermocald.errors import UsageError
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["Plan", "plan_power", "simulated_inputs"]


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


def simulated_inputs(
    recording: Path | None,
    model: Path | None,
    preset: str | None,
    testfield: str | None,
    programme: Path | None,
    seeds: int,
) -> list[SeriesInput]:
    """Recordings of the set-up with no effect but the model's, one per seed.

    A recording may stand for the set-up: then its own epochs and noise are used, once.
    """
    from thermocald.store.recording import read_recording

    if recording is not None:
        return [series_input(read_recording(recording))]
    if preset is None and (model is None or programme is None):
        raise UsageError(
            "--plan needs a recording of the set-up, or --preset, or --model and --programme"
        )
    out = []
    for seed in range(seeds):
        simulation = _simulation(model, preset, testfield, programme, seed)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"plan-{seed}"
            simulation.write(path)
            out.append(series_input(read_recording(path)))
    return out


def _simulation(
    model: Path | None, preset: str | None, testfield: str | None, programme: Path | None, seed: int
) -> Any:
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


def plan_power(
    inputs: Sequence[SeriesInput], strength_px: float, advance: Callable[[], None]
) -> Plan:
    """Put every effect into every simulated recording and look for it."""
    found: dict[str, dict[str, int]] = {}
    rng = np.random.default_rng(0)
    for source in inputs:
        evidence = gather(source)
        laboratory = Laboratory([evidence])
        done: set[str] = set()
        for candidate in candidates([evidence]):
            if candidate.effect in done:
                continue
            done.add(candidate.effect)
            said = _said(_with_effect(laboratory, candidate, strength_px, rng))
            row = found.setdefault(candidate.effect, {})
            row[said] = row.get(said, 0) + 1
            advance()
    return Plan(found, len(inputs), strength_px)


def _said(evidence: Evidence) -> str:
    x = examine_series([evidence])
    if not x.adequate:
        return "unexplained"
    names = ["+".join(x.best.names) or "none", *("+".join(r.names) for r in x.rivals)]
    return " or ".join(dict.fromkeys(names))


def _with_effect(
    laboratory: Laboratory, candidate: Candidate, strength_px: float, rng: np.random.Generator
) -> Evidence:
    """The series with one effect in its normal equations, scaled to what the base leaves over."""
    e = laboratory.series[0]
    base = laboratory.fit(())
    parameter = catalogue.get(candidate.effect).nonlinear.get(candidate.name)
    grid = candidate.grid
    value = None
    if len(grid):
        value = float(grid[int(len(grid) * rng.uniform(0.4, 0.6))])
        if parameter is not None and candidate.name == "P":
            value = float(e.times[-1] / rng.uniform(4, 20))
        if parameter is not None and candidate.name == "d":
            value = float(3.0 * np.median(np.diff(e.times)))
    term = candidate.term(value, 1)
    if candidate.is_event:
        term = Term(term.effect, term.parameters, (), (((candidate.name, float(value or 0.0)),),))
    if candidate.is_drive:
        rates = base.direction(base.blocks[0])[0]
        course = laboratory.drive_course([term], 0) - laboratory.drive_course([], 0)
        moved = course[:, None] * rates[None]
    else:
        course = laboratory.courses(term, 0)[0][:, 0]
        direction = np.zeros(len(COLUMNS))
        direction[[COLUMNS.index(p) for p in term.parameters]] = rng.normal(
            size=len(term.parameters)
        )
        moved = course[:, None] * direction[None]
    left = _left_over(laboratory, moved)
    moved = moved * (strength_px / max(left, 1e-12))
    b = e.b + np.einsum("epq,eq->ep", e.N, moved)
    values = e.values + moved
    return replace(e, b=b, values=values, yy=np.einsum("ep,ep->e", values, b))


def _left_over(laboratory: Laboratory, moved: Array) -> float:
    """RMS px that the base model, fitted, leaves of a movement (E, P) of the parameters."""
    e = laboratory.series[0]
    T = laboratory.drive_course([], 0)
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
