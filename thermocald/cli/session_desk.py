"""A session without a daemon: this process takes the epochs itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.cli.common import say
from thermocald.cli.session_progress import Progress
from thermocald.errors import ConfigurationError, DataError, DeviceError

if TYPE_CHECKING:
    from thermocald.cli.session_separate import Watch
    from thermocald.config import Config
    from thermocald.daemon.session import Session
    from thermocald.daemon.station import Station

__all__ = ["take_on_the_desk"]


def take_on_the_desk(config: Config, session: Session, watch: Watch | None = None) -> Config:
    """Check, then take the epochs that are missing; returns the configuration that was used.

    watch: ends the session when it has seen enough.
    """
    from thermocald.daemon.journal import set_up_logging
    from thermocald.daemon.service import Service

    done, epochs = _stored(config, session), session.epochs
    read = _prepare(config, session, done)
    set_up_logging("warning")
    if done < epochs:
        if session.check:
            _check(read)
        if done:
            say(f"series {session.series} has {done} epochs; {epochs - done} are still to be taken")
        progress = Progress(epochs, done)
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


def _check(config: Config) -> None:
    """One frame and one reading; DataError says what is to be mended first."""
    from thermocald.acquisition.frame_check import check_frame
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
