"""The daemon's process: signals, systemd, reload and status; the `Station` does the work.

SIGTERM and SIGINT stop the daemon after the current epoch. SIGHUP reloads the configuration; if it
is invalid, the daemon logs why and continues with the old one.

The web page of a daemon that was started by hand is a child process and cannot stop it. Under
systemd the page is a separate unit with a memory limit of its own: in the daemon's control group it
could take the memory that the daemon needs.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from thermocald import __version__
from thermocald.acquisition.pipeline import PATIENCE_S
from thermocald.acquisition.steady_clock import SteadyClock
from thermocald.config import load_config
from thermocald.daemon.control import ControlSocket
from thermocald.daemon.live_state import LiveState, status_warnings
from thermocald.daemon.series_run import Runtime
from thermocald.daemon.session import Sessions
from thermocald.daemon.station import Station
from thermocald.daemon.store_guard import StoreGuard
from thermocald.daemon.systemd import notify, watchdog_interval_s
from thermocald.errors import DataError, ThermocaldError
from thermocald.hal import load_driver
from thermocald.names import PAGE_OF, WITH_VALUES
from thermocald.numbers import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from thermocald.config import Config, DashboardConfig
    from thermocald.daemon.control import Request
    from thermocald.daemon.session import Session
    from thermocald.hal import Clock


_RESTART_PAUSE_S = 10.0
_PAGE_GRACE_S = 3.0
_WRONG_CONFIGURATION = 2  # the page's exit status if its port or token cannot be used
_REFUSED = "there is no web page: its port or token cannot be used (see the line above)"
_PRIVATE = {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"}


class DashboardProcess:
    """The child process `thermocald dashboard` for a store and a live folder."""

    def __init__(self, store: Path, live: Path) -> None:
        self._store = store.absolute()
        self._live = live.absolute()
        self._config: DashboardConfig | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._next_at = 0.0
        self.why = ""  # why the wanted page does not run, else empty

    def ensure_running(self, config: DashboardConfig) -> None:
        """Start the process if it is wanted and does not run, at most every 10 s."""
        if config != self._config:
            self.stop()
            self._config, self._child, self._next_at, self.why = config, None, 0.0, ""
        if not config.enabled or self.why == _REFUSED or os.environ.get("INVOCATION_ID"):
            return
        child = self._child
        if child is not None and child.poll() == _WRONG_CONFIGURATION:
            self.why = _REFUSED
            log.error("%s; acquisition goes on without it", self.why)
            return
        if (child is not None and child.returncode is None) or time.monotonic() < self._next_at:
            return
        if child is not None:
            self.why = f"the page exited with status {child.returncode}; it is started again"
            log.warning(self.why)
        self._next_at = time.monotonic() + _RESTART_PAUSE_S
        command = [sys.executable, "-m", "thermocald", "dashboard"]
        command += ["--store", str(self._store), "--live", str(self._live)]
        command += ["--host", config.host, "--port", str(config.port)]
        command += [word for name in config.names for word in ("--name", name)]
        if config.token_file is not None:
            command += ["--token-file", str(config.token_file)]
        environment = {k: v for k, v in os.environ.items() if k not in _PRIVATE}
        environment[PAGE_OF] = str(os.getpid())
        try:
            # a process group of its own: Ctrl-C stops the daemon, which then stops the page
            self._child = subprocess.Popen(command, env=environment, process_group=0)
        except OSError as error:
            log.error("the web page cannot be started: %s", error)

    def stop(self) -> None:
        """Stop the process."""
        child = self._child
        if child is None or child.poll() is not None:
            return
        child.terminate()
        try:
            child.wait(_PAGE_GRACE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


log = logging.getLogger(__name__)

_TURN_S = 0.25
_STATUS_EVERY_S = 1.0
_GRACE_S = 20.0
_ANSWER_S = 45.0
_SWITCH_INTERVAL_S = 0.0005  # of threads: a tick must not wait 5 ms for a calculation


class Service:
    """A daemon in this process.

    path: the configuration file, which SIGHUP reloads; with_options: changes what is read there as
    the command line demands; until_finished: stop when all recordings have been played or all
    epochs taken, instead of serving requests at the control socket; session: take only this one;
    on_turn: called in every turn, stops the service by returning True; clock: a virtual clock, on
    which rendered devices take no time. For the other arguments see `Runtime`.
    """

    def __init__(
        self,
        config: Config,
        path: Path | None = None,
        *,
        with_options: Callable[[Config], Config] = lambda config: config,
        fast: bool = False,
        epochs: int = 0,
        until_finished: bool = False,
        hang_after_s: float = 60.0,
        session: Session | None = None,
        on_turn: Callable[[Service], bool] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.config = config
        trusted = None if clock is None else lambda: True
        self.clock = SteadyClock(clock, synchronised=trusted)
        self.live = LiveState.beside(config.store.path)
        self._path = path
        self._with_options = with_options
        self._runtime_of = partial(
            Runtime, clock=self.clock, live=self.live, fast=fast or clock is not None,
            free_running=fast and clock is None, epochs=epochs, hang_after_s=hang_after_s,
        )  # fmt: skip
        self._session = session
        self._until_finished = until_finished or session is not None
        self._on_turn = on_turn
        self._started = self.clock.monotonic()
        self._wake = threading.Event()
        self._end = False
        self._reload = False
        self._stalled: list[str] = []
        self._dashboard = DashboardProcess(config.store.path, self.live.folder)
        self._turn = threading.Lock()  # free only while the service waits: for requests
        self._turn.acquire()

    def run(self) -> bool:
        """Work until stopped; return True, or False if a device hangs.

        Raises ThermocaldError if the daemon cannot start.
        """
        # already while the store is opened: a SIGHUP would end the process, and systemd takes that
        # for an exit without a fault
        with self._signals():
            return self._run()

    def _run(self) -> bool:
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        self._guard = StoreGuard(self.config.store.path, durable=self.config.store.durable)
        self._runtime = self._runtime_of(self._guard)
        done = False
        self._control = ControlSocket(self.live.folder, self._ask)
        try:
            self.station = Station(self.config, self._runtime)
            self.sessions = Sessions(self.station)
            if self._session is not None:
                self.sessions.start(self._session)
            elif not self._until_finished:
                self.sessions.recall()
                self.sessions.resume(self.station)
            self.station.start()
            if not self._until_finished:
                self._control.ensure_open()
            log.info("thermocald %s runs", __version__, extra={"event": "started"})
            self._record("started", f"thermocald {__version__} started")
            notify(f"READY=1\nSTATUS={self._line()}")
            try:
                self._loop()
            finally:
                notify("STOPPING=1")
                self._control.close()
                if self._session is not None:
                    with suppress(DataError):  # it has come to its end
                        self.sessions.stop(self._session.camera)
                # no epoch waits longer for a reading; the device is closed with the process
                done = self.station.stop(_GRACE_S, PATIENCE_S)
                self._record("stopped", "thermocald stopped")
                self._guard.flush()
                self.live.remove()  # while the page still runs and can report it
                self._dashboard.stop()
        finally:
            self._guard.close()
            self.live.remove()
        return done

    @property
    def faults(self) -> list[str]:
        """Sentences on epochs that were lost, and on cameras that were not read to their end."""
        store = self._guard.status()
        links = [line.link for line in self.station.cameras if self._until_finished]
        faults = [f"{one.name}: {one.why}" for one in links if one.state == "failed"]
        if store["lost"]:
            faults.insert(0, f"{counted(store['lost'], 'epoch')} lost: {store['lost_why']}")
        return faults

    def _loop(self) -> None:
        interval = watchdog_interval_s()
        turn_s = _TURN_S if interval is None else min(_TURN_S, interval)
        fed = written = float("-inf")
        while not self._end:
            now = time.monotonic()
            if self._reload:
                self._reload = False
                self._reload_configuration()
            self.sessions.turn()
            if (step := self.clock.check()) is not None:
                seconds, adopted, text = step
                data = {"seconds": seconds, "adopted": adopted}
                self._guard.event(self.clock.utc(), "clock_step", text, data=data)
                if adopted:
                    self.station.frames.restamp(seconds)
            self._dashboard.ensure_running(self.config.dashboard)
            stalled = self.station.stalled()
            self._report_stalled(stalled)
            if interval is not None and not stalled and now - fed >= min(interval, 1.0):
                fed = now
                notify("WATCHDOG=1")
            if now - written >= _STATUS_EVERY_S:
                written = now
                self._guard.flush()
                self.live.write_status(self.status())
                if not self._until_finished:
                    self._control.ensure_open()
                notify(f"STATUS={self._line()}")
            if self._on_turn is not None and self._on_turn(self):
                break
            if self._until_finished and self.station.finished:
                break
            self._turn.release()
            if self._wake.wait(turn_s):
                self._wake.clear()
            self._turn.acquire()

    def status(self) -> dict[str, Any]:
        """Return the document that `thermocald status` prints."""
        document = {
            "version": __version__,
            "pid": os.getpid(),
            "started": self.clock.utc() - self.clock.monotonic() + self._started,
            "utc": self.clock.utc(),
            "configuration": None if self._path is None else str(self._path.absolute()),
            "clock": {"trusted": self.clock.trusted(), "error_s": self.clock.error_s},
            "store": {**self._guard.status(), "path": self.config.store.path.absolute()},
            "stalled": self.station.stalled(),
            "sessions": self.sessions.status(),
            "dashboard": {"enabled": self.config.dashboard.enabled, "why": self._dashboard.why},
            **self.station.status(),
        }
        return {**document, "warnings": status_warnings(document)}

    def _ask(self, request: Request) -> dict[str, Any]:
        """Answer a request in the control socket's thread, between two turns of the service."""
        if not self._turn.acquire(timeout=_ANSWER_S):
            raise DataError("the daemon is busy; look at its status and try again")
        try:
            if request.session is not None:
                return {"session": self.sessions.start(request.session)}
            if request.camera is not None:
                return {"session": self.sessions.stop(request.camera)}
            if request.do == "retention":
                return {"deleted": self.station.retain()}
            return {"sessions": self.sessions.status()}
        except ThermocaldError:
            raise
        except Exception as error:
            # no request may stop the daemon
            log.exception("a request could not be answered")
            raise DataError(f"the daemon could not answer: {error}") from error
        finally:
            self._turn.release()

    def _line(self) -> str:
        """Return the status line for `systemctl status`."""
        parts = []
        for camera in self.station.cameras:
            last = {} if camera.run is None else camera.run.last
            if not camera.taking:
                text = "idle"
            elif camera.link.state != "open" or not last:
                text = camera.link.why or camera.link.state
            else:
                found = last["status"]
                if found in WITH_VALUES:
                    found = f"c {last['c']:.4f} mm, {last['state']}"
                text = f"epoch {last['epoch']}, {last['temperature']:.1f} °C, {found}"
            parts.append(f"{camera.plan.name}: {text}")
        if not parts:
            thermometers = self.station.thermometers
            parts = [
                f"{name}: " + ", ".join(f"{celsius:.1f} °C" for celsius in values.values())
                for name in thermometers.links
                if (values := thermometers.last(name)[0])
            ]
        if self._guard.away:
            parts.append(f"store: {self._guard.away}")
        return "; ".join(parts)[:500]

    def _reload_configuration(self) -> None:
        now_us = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        notify(f"RELOADING=1\nMONOTONIC_USEC={now_us}")  # READY=1 ends it
        try:
            text = self._apply_configuration()
        except (ThermocaldError, OSError) as error:
            if self.station.stopping.is_set():
                raise  # a daemon that takes nothing would look healthy: a restart may help
            text = f"the configuration cannot be reloaded, the old one stays in force: {error}"
            log.error("%s", text, extra={"event": "reload_failed"})
            self._record("reload_failed", text)
        else:
            log.info(text, extra={"event": "reloaded"})
        notify(f"READY=1\nSTATUS={self._line()}")

    def _apply_configuration(self) -> str:
        """Read the configuration again and apply it; return the result in words."""
        config = self.config
        if self._path is not None:
            config = self._with_options(load_config(self._path, load_driver))
        if config.store != self.config.store:
            log.warning("store: a change takes effect after a restart; the old store is still used")
            config = config.model_copy(update={"store": self.config.store})
        if config == self.config and not self.station.failed:
            return "the configuration has not changed"
        Station(config, self._runtime)  # raises for a fault before the old one is stopped
        if not self.station.stop(_GRACE_S):
            log.error("a device does not close; it may be unavailable for a while")
        try:
            self._switch_to(config)
        except (ThermocaldError, OSError):
            self._switch_to(self.config)
            raise
        text = "the configuration was read again"
        self._record("reloaded", text)
        return text

    def _switch_to(self, config: Config) -> None:
        """Start a new station in place of the stopped one, whose epoch numbers it continues."""
        new = Station(config, self._runtime)
        self.sessions.resume(new)
        logging.getLogger().setLevel(config.logging.level.upper())
        self.config, self.station = config, new
        gc.collect()  # the old station refers to itself: 50 MB would stay for a while
        new.start()

    def _report_stalled(self, stalled: list[str]) -> None:
        for text in set(stalled).difference(self._stalled):
            log.error(text, extra={"event": "hung"})
            self._record("hung", text)
        for text in set(self._stalled).difference(stalled):
            log.info("%s no longer", text, extra={"event": "hung_no_more"})
        self._stalled = stalled

    def _record(self, kind: str, text: str) -> None:
        self._guard.event(self.clock.utc(), kind, text)

    @contextmanager
    def _signals(self) -> Iterator[None]:
        def end(*_: object) -> None:
            self._end = True
            self._wake.set()

        def reload(*_: object) -> None:
            self._reload = True

        if threading.current_thread() is not threading.main_thread():
            yield
            return
        wanted = {signal.SIGTERM: end, signal.SIGINT: end, signal.SIGHUP: reload}
        before = {number: signal.signal(number, action) for number, action in wanted.items()}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
