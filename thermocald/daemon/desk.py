"""A session as it is asked for and looked on at: taken here, or by a daemon that runs."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError, DataError, DeviceError, UsageError
from thermocald.numbers import with_sd

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from thermocald.config import Config
    from thermocald.daemon.separating import Watch
    from thermocald.daemon.session import Session
    from thermocald.daemon.station import Station

_LOOK_EVERY_S = 0.5
_WAIT_FOR_DAEMON_S = 300.0
_LINE_EVERY_S = 10.0


def take_on_the_desk(
    config: Config, session: Session, say: Callable[[str], None], watch: Watch | None = None
) -> Config:
    """Check, then take the epochs that are missing; returns the configuration that was used.

    watch: ends the session when it has seen enough.
    """
    from thermocald.daemon.service import Service
    from thermocald.daemon.systemd import set_up_logging

    done, epochs = _stored(config, session), session.epochs
    read = _prepare(config, session, done)
    set_up_logging("warning")
    if done < epochs:
        if session.check:
            _check(read, say)
        if done:
            say(f"series {session.series} has {done} epochs; {epochs - done} are still to be taken")
        progress = Progress(epochs, say, done)
        service = Service(
            read,
            epochs=epochs - done,
            until_finished=True,
            start_condition=session.start,
            on_turn=lambda station: _turn(station, progress, watch),
        )
        service.run()
        done = _stored(config, session)
    if done < epochs and not (watch and watch.ended):
        raise DataError(
            f"series {session.series} has {done} of {epochs} epochs; the same command goes on "
            "from there"
        )
    return read


def _turn(station: Station, progress: Progress, watch: Watch | None) -> bool:
    camera = station.cameras[0]
    if camera.link.error is not None and camera.link.state == "failed":
        raise DeviceError(f"camera {camera.plan.name}: {camera.link.why}")
    last = {} if camera.run is None else camera.run.last
    progress.show(last, camera.link.why if camera.link.state == "out" else "")
    return watch is not None and watch.look(last.get("epoch", 0))


def _prepare(config: Config, session: Session, done: int) -> Config:
    """The configuration with one camera, its thermometers, and the series' name."""
    from thermocald.config import parse_config

    document = config.model_dump(mode="python", by_alias=True)
    chosen = next(c for c in document["cameras"] if c["name"] == session.camera)
    chosen["series"] = session.series
    document["cameras"] = [chosen]
    document["thermometers"] = [
        t for t in document["thermometers"] if t["name"] in chosen["thermometers"]
    ]
    if session.programme:
        _use_programme(document["outputs"], session.steps(done * chosen["period_s"]))
    return parse_config(document, Path("config.yaml"))


def _use_programme(outputs: list[dict[str, Any]], steps: list[dict[str, Any]]) -> None:
    from thermocald.hal import load_driver

    takers = [o for o in outputs if load_driver("output", o["driver"]).heats]
    if not takers:
        raise ConfigurationError("--programme: no output of the configuration heats")
    for taker in takers:
        taker["programme"] = steps


def _stored(config: Config, session: Session) -> int:
    from thermocald.store.database.store import Store

    if not config.store.path.exists():
        return 0
    with Store.open(config.store.path) as store:
        for found in store.all_series():
            if (found.camera, found.name) == (session.camera, session.series):
                return store.last_epoch(found) or 0
    return 0


def _check(config: Config, say: Callable[[str], None]) -> None:
    """One frame and one reading; DataError says what is to be mended first."""
    from thermocald.acquisition.pipeline import check_frame
    from thermocald.daemon.plan import plan_cameras
    from thermocald.hal import SystemClock, open_device

    clock = SystemClock()
    for one in config.thermometers:
        with open_device("thermometer", one.driver, one.options, clock) as thermometer:
            values = thermometer.read().values
        say(f"{one.name}: " + ", ".join(f"{k} {v:.2f} °C" for k, v in values.items()))
    plan = plan_cameras(config, clock)[0]
    if plan.calibrator is None:
        raise ConfigurationError(f"camera {plan.name!r}: a session needs its `testfield`")
    with plan.camera as camera:
        frame = camera.capture()
    found = check_frame(plan.name, plan.calibrator, frame)
    for sentence in found.found:
        say(sentence)
    if found.failed:
        raise DataError(f"the check failed: {found.failed}")


def take_in_the_daemon(
    folder: Path, session: Session, wait: bool, say: Callable[[str], None],
    watch: Watch | None = None,
) -> None:  # fmt: skip
    """Have a running daemon take the session, and look on."""
    from thermocald.daemon.control import DaemonBusy, ask

    told = ask(folder, "session start", session=session.model_dump(mode="json"))
    if told is None:
        raise DataError("the daemon ended just now; give the command again")
    say(f"{session.camera}/{session.series}: taken by the daemon; Ctrl-C leaves it to that")
    if not wait:
        return
    progress, seen, away_since = Progress(session.epochs, say), 0, 0.0
    while True:
        time.sleep(_LOOK_EVERY_S)
        try:
            told = ask(folder, "session status")
        except DaemonBusy:
            told = None
        if told is None:
            if not away_since:
                away_since = time.monotonic()
                say("the daemon does not answer; it goes on when it is back")
            if time.monotonic() - away_since > _WAIT_FOR_DAEMON_S:
                raise DataError("the daemon is gone; when it runs again the session goes on")
            continue
        away_since = 0.0
        one = told["sessions"].get(session.camera, {})
        if one.get("series") != session.series:
            raise DataError("the daemon ended before the session began; give the command again")
        for sentence in one["found"][seen:]:
            say(sentence)
        seen = max(seen, len(one["found"]))
        progress.show(one.get("last", {}), one["why"] if one["state"] == "paused" else "")
        if watch is not None and watch.look(one["taken"]):
            ask(folder, "session stop", camera=session.camera)
            return
        if one["state"] == "done":
            return
        if one["state"] in ("refused", "stopped"):
            raise DataError(f"{one['taken']} of {one['epochs']} epochs: {one['why']}")


def only_camera(config: Config) -> str:
    """Return the one camera of a configuration; UsageError where there are others."""
    names = [c.name for c in config.cameras]
    if len(names) != 1:
        raise UsageError(f"which camera? give --camera, one of: {', '.join(names) or 'none'}")
    return names[0]


def session_of(
    config: Config, camera: str | None, series: str, condition: str, epochs: int,
    programme: Path | None, check: bool,
) -> Session:  # fmt: skip
    """Return the session that is asked for; UsageError, ConfigurationError for what cannot be."""
    from pydantic import ValidationError

    from thermocald.daemon.session import Session

    names = [c.name for c in config.cameras]
    if camera is None:
        camera = only_camera(config)
    if camera not in names:
        raise UsageError(f"there is no camera {camera!r}; there are: {', '.join(names) or 'none'}")
    steps = [] if programme is None else _steps(programme)
    asked = {"camera": camera, "series": series, "start": condition, "epochs": epochs}
    try:
        return Session.model_validate({**asked, "programme": steps, "check": check})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"--{key}: {first['msg']}") from error


def _steps(path: Path) -> list[Any]:
    from thermocald.files import read_yaml

    steps = read_yaml(path, ConfigurationError).get("programme")
    if not isinstance(steps, list) or not steps:
        raise ConfigurationError(f"{path}: must hold `programme:`, a list of steps")
    return [
        {key: float(v) if isinstance(v, int) else v for key, v in step.items()}
        if isinstance(step, dict)
        else step
        for step in steps
    ]


def listening_daemon(config: Config) -> Path | None:
    """Return the live folder of the daemon that listens for this store, None without."""
    from thermocald.daemon.control import ask
    from thermocald.daemon.live_state import find_state

    folder = find_state(config.store.path)
    return None if ask(folder, "session status") is None else folder


class Progress:
    """Told a few times a second how a camera is doing; total: epochs, done: of an earlier run."""

    def __init__(self, total: int, say: Callable[[str], None], done: int = 0) -> None:
        self._total = total
        self._say = say
        self._shown = done
        self._told = float("-inf")
        self._paused = False

    def show(self, last: Mapping[str, Any], paused: str = "") -> None:
        """last: the last epoch's row, as outputs get it; paused: why there are none, if so."""
        if paused and not self._paused:
            self._say(f"paused: {paused}")
        if self._paused and not paused:
            self._say("the camera is back")
        self._paused = bool(paused)
        if not last or last["epoch"] <= self._shown:
            return
        self._shown = last["epoch"]
        temperature = last.get("temperature")
        line = f"epoch {last['epoch']} of {self._total}: "
        line += "" if temperature is None else f"{temperature:.2f} °C, "
        if last["status"] == "ok":
            line += f"c {with_sd(last['c'], last['sd_c'], 'mm')}, sigma0 {last['sigma0']:.2f}"
            line += f", {last['online'].get('sentence', '')}"
        else:
            line += f"{last['status']}: {last['reason']}"
        now = time.monotonic()
        if sys.stderr.isatty():
            # a longer line would leave its beginning on the screen
            room = shutil.get_terminal_size().columns - 1
            sys.stderr.write(f"\r\x1b[K{line[:room]}")
            sys.stderr.flush()
        elif now - self._told >= _LINE_EVERY_S or self._shown == self._total:
            self._told = now
            self._say(line)
