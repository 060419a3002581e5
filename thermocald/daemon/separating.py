"""`session start --until-separated A,B`: the programme that separates them, and when it has."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError, ThermocaldError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from concurrent.futures import Future
    from pathlib import Path

    from thermocald.config import Config
    from thermocald.daemon.session import Session
    from thermocald.discovery.experiment import Experiment, Limits, Separation
    from thermocald.thermal.series import SeriesInput

_EVERY = 15  # epochs between two looks
_FEWEST = 45  # before anything can be seen
_BELOW_LIMIT_K = 1.0  # the thermostat overshoots


@dataclass(frozen=True)
class Heating:
    """What the user allows: highest temperature °C or None (the output's limit decides), fastest
    rise K/min, largest share of time with heat.
    """

    max_c: float | None
    max_rate: float
    max_duty: float


def separating(
    config: Config, session: Session, text: str, known: SeriesInput | None, heating: Heating,
    say: Callable[[str], None],
) -> tuple[str, Session, Watch]:  # fmt: skip
    """Return the programme that separates two effects, in words, and the session with it.

    known: an earlier series of the camera, None without one.
    """
    from thermocald.discovery.experiment import read_alternatives

    if session.programme:
        raise UsageError("--until-separated plans the programme: leave --programme out")
    names = read_alternatives(text)
    found = _experiments(config, session, names, heating, known)
    watch = Watch(config.store.path, session, names, known, say)
    return _described(found, names), _with_programme(session, found[0]), watch


def _experiments(
    config: Config, session: Session, names: tuple[str, str], heating: Heating,
    evidence: SeriesInput | None,
) -> list[Experiment]:  # fmt: skip
    """The programmes within all limits, the best first; evidence: tells how the camera warms."""
    from thermocald.discovery.experiment import Body, estimate_body, rank_experiments

    body = Body()
    if evidence is not None:
        there = np.isfinite(readings := next(iter(evidence.readings.values())))
        there &= np.isfinite(evidence.reading_times)
        body = estimate_body(evidence.reading_times[there], readings[there])
    camera = next(c for c in config.cameras if c.name == session.camera)
    return rank_experiments(
        *names, _limits(config, heating), body, session.epochs, camera.period_s
    )  # fmt: skip


def _limits(config: Config, heating: Heating) -> Limits:
    """The tightest of the user's limits and those of the outputs that heat."""
    from thermocald.discovery.experiment import Limits
    from thermocald.hal import load_driver

    heaters = [o for o in config.outputs if load_driver("output", o.driver).heats]
    if not heaters:
        raise ConfigurationError("--until-separated: no output of the configuration heats")
    own = [float(o.options["limit_c"]) - _BELOW_LIMIT_K for o in heaters]
    highest = min([*own, *([] if heating.max_c is None else [heating.max_c])])
    return Limits(highest, heating.max_rate, heating.max_duty)


def _described(found: list[Experiment], names: tuple[str, str]) -> str:
    """The programme as a file that `--programme` takes; what is expected of it as comments."""
    best = found[0]
    others = ", ".join(f"{e.name} {e.sigmas:.0f}" for e in found[1:])
    hottest = best.temperature.max()
    lines = [
        f"# to separate {names[0]} and {names[1]}: {best.name}",
        f"# expected: up to {hottest:.1f} °C, heat in {best.duty:.0%} of the time",
        f"# effects of 0.1 px differ by {best.sigmas:.0f} sd at the end",
        f"# sd of the other programmes: {others}",
        "programme:",
    ]
    for seconds, hold in best.steps:
        held = "null" if hold is None else f"{hold:.1f}"
        lines.append(f"  - {{seconds: {seconds:.0f}, hold_c: {held}}}")
    return "\n".join(lines)


class Watch:
    """Looks at the epochs taken so far, in a thread of its own, until two effects are separated."""

    def __init__(
        self, store: Path, session: Session, names: tuple[str, str],
        evidence: SeriesInput | None, say: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._store, self._session, self._names = store, session, names
        self._evidence = evidence
        self._say = say
        self._pool = ThreadPoolExecutor(1, "separation")
        self._pending: Future[Separation] | None = None
        self._seen = 0
        self.found: Separation | None = None

    @property
    def ended(self) -> bool:
        """Whether they are separated."""
        return self.found is not None and self.found.separated

    def look(self, taken: int) -> bool:
        """Whether it is enough; taken: epochs so far. Never waits."""
        if self._pending is not None and self._pending.done():
            self._conclude(self._pending)
            self._pending = None
        if self._pending is None and taken >= max(_FEWEST, self._seen + _EVERY) and not self.ended:
            self._seen = taken
            self._pending = self._pool.submit(self._compare)
        return self.ended

    def close(self) -> None:
        """Let the thread end, and say what was reached."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        if not self.ended:
            reached = self.found.sentence if self.found else "too few epochs"
            self._say(f"not separated: {reached}")

    def _conclude(self, done: Future[Separation]) -> None:
        try:
            self.found = done.result()
        except ThermocaldError as error:
            self._say(f"after {self._seen} epochs: {error}")
            return
        self._say(f"after {self._seen} epochs: {self.found.sentence}")

    def _compare(self) -> Separation:
        from thermocald.discovery.experiment import compare_effects
        from thermocald.store.sources import open_source
        from thermocald.thermal.reduce import reduce_together
        from thermocald.thermal.source import epochs_input

        with open_source(self._store) as store:
            found = store.find_series(self._session.camera, self._session.series)
            epochs = [s.epoch for s in store.epochs(found)]
            now = epochs_input(found.head, found.testfield, epochs, self._session.series)
        before = [] if self._evidence is None else [replace(self._evidence, camera=now.camera)]
        return compare_effects(reduce_together([*before, now]), *self._names)


def _with_programme(session: Session, best: Experiment) -> Session:
    """The session with the programme of an experiment."""
    document: Mapping[str, Any] = {
        **session.model_dump(mode="python"), "programme": best.programme()
    }  # fmt: skip
    return type(session).model_validate(document)
