"""A session as the command requests and follows it: in this process or by a running daemon.

For `--until-separated A,B` it also plans the programme that separates two effects, and stops the
session once they are separated.
"""

from __future__ import annotations

import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from thermocald.config import in_words
from thermocald.daemon.control import DaemonBusy, ask
from thermocald.daemon.plan import heating_outputs
from thermocald.daemon.session import Session
from thermocald.daemon.systemd import set_up_logging
from thermocald.errors import (
    ConfigurationError,
    DataError,
    DeviceError,
    ThermocaldError,
    UsageError,
)
from thermocald.files import read_yaml
from thermocald.numbers import counted, percent, with_sd

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from concurrent.futures import Future
    from pathlib import Path

    from thermocald.config import Config
    from thermocald.discovery.experiment import Experiment, Separation
    from thermocald.thermal.series import SeriesInput

_LOOK_EVERY_S = 0.5
_WAIT_FOR_DAEMON_S = 300.0
_LINE_EVERY_S = 10.0
_EVERY = 15  # epochs between two comparisons
_FEWEST = 45  # epochs before the first comparison
_BELOW_LIMIT_K = 1.0  # the thermostat overshoots


def take_on_the_desk(
    config: Config, session: Session, say: Callable[[str], None], watch: Watch | None = None
) -> None:
    """Take the missing epochs by a daemon in this process, which stops afterwards.

    watch: ends the session when its effects are separated. Raises DeviceError if the camera or,
    at the check, a thermometer fails; DataError if epochs are missing.
    """
    from thermocald.daemon.service import Service

    done, epochs = _stored(config, session), session.epochs
    if done >= epochs:
        return
    if done:
        taken, left = counted(done, "epoch"), epochs - done
        say(f"series {session.series} has {taken}; {left} of {epochs} remain to be taken")
    set_up_logging("warning")
    # the session's devices alone; the camera has no other series to return to
    own = next(c for c in config.cameras if c.name == session.camera)
    used = [t for t in config.thermometers if t.name in own.thermometers]
    chosen = own.model_copy(update={"series": None})
    config = config.model_copy(update={"cameras": (chosen,), "thermometers": tuple(used)})
    follower = Follower(session, say, watch, done)

    def turn(service: Service) -> bool:
        one = service.sessions.status()[session.camera]
        camera, links = service.station.cameras[0], service.station.thermometers.links
        checks = camera.run is None and one["state"] not in ("done", "stopped")
        for link in (camera.link, *(links.values() if checks else ())):
            if link.state == "failed" or (link.state == "out" and checks):
                raise DeviceError(f"{link.called}: {link.why}")
        return follower.follow(one)

    Service(config, session=session, on_turn=turn).run()
    done = _stored(config, session)
    if done < epochs and not (watch and watch.ended):
        raise DataError(
            f"series {session.series} has {done} of {epochs} epochs; repeat the command to continue"
        )


def _stored(config: Config, session: Session) -> int:
    from thermocald.store.database.store import Store

    if not config.store.path.exists():
        return 0
    with Store.open(config.store.path) as store:
        found = store.series_of(session.camera, session.series)
        return 0 if found is None else store.last_epoch(found) or 0


def take_in_the_daemon(
    folder: Path, session: Session, wait: bool, say: Callable[[str], None],
    watch: Watch | None = None,
) -> None:  # fmt: skip
    """Let a running daemon take the session, and report its progress if `wait`."""
    answer = ask(folder, "session start", session=session.model_dump(mode="json"))
    if answer is None:
        raise DataError("the daemon was just stopped; repeat the command")
    say(f"{session.camera}/{session.series}: taken by the daemon, also after Ctrl-C")
    if not wait:
        return
    follower, away_since = Follower(session, say, watch), 0.0
    while True:
        time.sleep(_LOOK_EVERY_S)
        try:
            answer = ask(folder, "session status")
        except DaemonBusy:
            answer = None
        if answer is None:
            if not away_since:
                away_since = time.monotonic()
                say("the daemon does not answer; waiting for it")
            if time.monotonic() - away_since > _WAIT_FOR_DAEMON_S:
                raise DataError("the daemon does not run; start it, and it continues the session")
            continue
        away_since = 0.0
        one = answer["sessions"].get(session.camera, {})
        if one.get("series") != session.series:
            raise DataError("the daemon stopped before the session began; repeat the command")
        if follower.follow(one):
            if one["state"] != "done":
                ask(folder, "session stop", camera=session.camera)
            return


def only_camera(config: Config, camera: str | None = None) -> str:
    """Return the requested camera's name, or that of the only camera in a configuration.

    Raises UsageError if there is no such camera, or none is given and there are several.
    """
    names = [c.name for c in config.cameras]
    if not names:
        raise UsageError("the configuration has no camera; add one under `cameras`")
    there = ", ".join(names)
    if camera is None and len(names) != 1:
        raise UsageError(f"which camera? give --camera, one of: {there}")
    if camera is not None and camera not in names:
        raise UsageError(f"there is no camera {camera!r}; there are: {there}")
    return camera or names[0]


def session_of(
    config: Config, camera: str | None, series: str, condition: str, epochs: int,
    programme: Path | None, check: bool,
) -> Session:  # fmt: skip
    """Return the requested session; raises UsageError or ConfigurationError."""
    request: dict[str, Any] = {"camera": only_camera(config, camera), "series": series}
    request |= {"start": condition, "epochs": epochs, "check": check}
    if programme is not None:
        steps = read_yaml(programme, ConfigurationError).get("programme")
        if not isinstance(steps, list) or not steps:
            raise ConfigurationError(f"{programme}: must contain `programme:`, a list of steps")
        request["programme"] = steps
    try:
        return Session.model_validate(request)
    except ValidationError as error:
        raise UsageError(f"--{in_words('', error)}") from error


@dataclass(eq=False)
class Follower:
    """Prints a session's progress; shown: the last epoch printed or stored before."""

    session: Session
    say: Callable[[str], None]
    watch: Watch | None = None
    shown: int = 0

    def __post_init__(self) -> None:
        self._found = 0
        self._printed_at = float("-inf")
        self._paused = False

    def follow(self, one: Mapping[str, Any]) -> bool:
        """Print what is new in the session's status; return whether it has come to its end.

        Called a few times a second; DataError if the session was refused or stopped.
        """
        for sentence in one["found"][self._found :]:
            self.say(sentence)
        self._found = max(self._found, len(one["found"]))
        self._show(one["last"], one["why"] if one["state"] == "paused" else "")
        if self.watch is not None and self.watch.look(one["taken"]):
            return True
        if one["state"] in ("refused", "stopped"):
            raise DataError(f"{one['taken']} of {one['epochs']} epochs: {one['why']}")
        return bool(one["state"] == "done")

    def _show(self, last: Mapping[str, Any], paused: str) -> None:
        if paused and not self._paused:
            self.say(f"paused: {paused}")
        if self._paused and not paused:
            self.say("the camera is back")
        self._paused = bool(paused)
        if not last or last["epoch"] <= self.shown:
            return
        self.shown = last["epoch"]
        temperature = last.get("temperature")
        line = f"epoch {last['epoch']} of {self.session.epochs}: "
        line += "" if temperature is None else f"{temperature:.2f} °C, "
        if last["status"] == "ok":
            line += f"c {with_sd(last['c'], last['sd_c'], 'mm')}, sigma0 {last['sigma0']:.2f}"
            line += f", {last['online'].get('sentence', '')}"
        else:
            line += f"{last['status']}: {last['reason']}"
        now = time.monotonic()
        if sys.stderr.isatty():
            # a line that wraps could not be erased
            room = shutil.get_terminal_size().columns - 1
            sys.stderr.write(f"\r\x1b[K{line[:room]}")
            sys.stderr.flush()
        elif now - self._printed_at >= _LINE_EVERY_S or self.shown == self.session.epochs:
            self._printed_at = now
            self.say(line)


def plan_separation(
    config: Config, session: Session, text: str, known: SeriesInput | None,
    say: Callable[[str], None], max_c: float | None, max_rate: float, max_duty: float,
) -> tuple[str, Session, Watch]:  # fmt: skip
    """Return the programme that separates two effects, as text, with its session and watch.

    text: the two effects; known: an earlier series of the camera, from which its warming is
    estimated, or None; max_c: the highest temperature allowed, °C, None for the output's limit;
    max_rate: the fastest rise, K/min; max_duty: the largest share of time with heat.
    """
    from thermocald.discovery import experiment

    if session.programme:
        raise UsageError("--until-separated plans the programme; omit --programme")
    names = experiment.read_alternatives(text)
    heaters = [config.outputs[i] for i in heating_outputs(config, "--until-separated")]
    highest = min(float(o.options["limit_c"]) - _BELOW_LIMIT_K for o in heaters)
    hottest = highest if max_c is None else min(highest, max_c)
    limits = experiment.Limits(hottest, max_rate, max_duty)
    body = experiment.Body()
    if known is not None:
        there = np.isfinite(readings := next(iter(known.readings.values())))
        there &= np.isfinite(known.reading_times)
        body = experiment.estimate_body(known.reading_times[there], readings[there])
    camera = next(c for c in config.cameras if c.name == session.camera)
    found = experiment.rank_experiments(*names, limits, body, session.epochs, camera.period_s)
    document = {**session.model_dump(mode="python"), "programme": found[0].programme()}
    watch = Watch(config.store.path, session, names, known, say)
    return _describe(found, names), type(session).model_validate(document), watch


def _describe(found: list[Experiment], names: tuple[str, str]) -> str:
    """Return the best programme as a file for `--programme`, with its expected performance."""
    best = found[0]
    others = ", ".join(f"{e.name} {e.sigmas:.0f}" for e in found[1:])
    hottest = best.temperature.max()
    lines = [
        f"# to separate {names[0]} and {names[1]}: {best.name}",
        f"# expected: up to {hottest:.1f} °C, heat in {percent(best.duty)} of the time",
        f"# effects of 0.1 px differ by {best.sigmas:.0f} sd at the end",
        f"# sd of the other programmes: {others}",
        "programme:",
    ]
    for seconds, hold in best.steps:
        held = "null" if hold is None else f"{hold:.1f}"
        lines.append(f"  - {{seconds: {seconds:.0f}, hold_c: {held}}}")
    return "\n".join(lines)


@dataclass(eq=False)
class Watch:
    """Compares two effects by the epochs so far, in a thread, until they are separated."""

    store: Path
    session: Session
    names: tuple[str, str]
    evidence: SeriesInput | None
    say: Callable[[str], None]

    def __post_init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "separation")
        self._pending: Future[Separation] | None = None
        self._seen = 0
        self.found: Separation | None = None

    @property
    def ended(self) -> bool:
        """Whether the effects are separated."""
        return self.found is not None and self.found.separated

    def look(self, taken: int) -> bool:
        """Return whether the effects are separated; taken: epochs so far. Does not wait."""
        if self._pending is not None and self._pending.done():
            try:
                self.found = self._pending.result()
                sentence = self.found.sentence
            except ThermocaldError as error:
                sentence = str(error)
            self.say(f"after {self._seen} epochs: {sentence}")
            self._pending = None
        if self._pending is None and taken >= max(_FEWEST, self._seen + _EVERY) and not self.ended:
            self._seen = taken
            self._pending = self._pool.submit(self._compare)
        return self.ended

    def close(self) -> None:
        """Wait for the thread to end, and print the result if the effects are not separated."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        if not self.ended:
            reached = self.found.sentence if self.found else "too few epochs"
            self.say(f"not separated: {reached}")

    def _compare(self) -> Separation:
        from thermocald.discovery.experiment import compare_effects
        from thermocald.store.sources import open_source
        from thermocald.thermal.reduce import reduce_together
        from thermocald.thermal.source import epochs_input

        with open_source(self.store) as store:
            found = store.find_series(self.session.camera, self.session.series)
            epochs = [s.epoch for s in store.epochs(found)]
            now = epochs_input(found.head, found.testfield, epochs, self.session.series)
        before = [] if self.evidence is None else [replace(self.evidence, camera=now.camera)]
        return compare_effects(reduce_together([*before, now]), *self.names)
