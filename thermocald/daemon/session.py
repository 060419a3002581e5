"""Sessions of a running daemon: a camera takes a series of given length, then its former series.

    requested ─► checking (one frame) ─► running ─► done | stopped
                     └─► refused            └─ while the device is away: paused

The store's events record when a session begins and ends, so that a daemon that was killed continues
its sessions when it is started again.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from thermocald.config import Name  # noqa: TC001 - pydantic reads it at run time
from thermocald.errors import ConfigurationError, DataError, ThermocaldError, UsageError
from thermocald.hal import HeatingStep  # noqa: TC001
from thermocald.numbers import counted

if TYPE_CHECKING:
    from thermocald.daemon.station import CameraLine, Station


log = logging.getLogger(__name__)

State = Literal["checking", "running", "done", "stopped", "refused"]

_NO_HEAT = ({"seconds": 1.0, "hold_c": None},)


class Session(BaseModel):
    """A request: a camera of the configuration, a series, its start condition and its length.

    programme: steps of the heating outputs, from the first epoch on; check: check a frame first.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    camera: Name
    series: Name
    start: Annotated[str, Field(max_length=64, pattern=r"^[^\x00-\x1f\x7f]*$")] = ""
    epochs: Annotated[int, Field(ge=1, le=10_000_000)]
    programme: Annotated[list[HeatingStep], Field(max_length=1000)] = Field(default_factory=list)
    check: bool = True

    def steps(self, elapsed_s: float) -> list[dict[str, Any]]:
        """Return the rest of the programme after a time in seconds."""
        left: list[dict[str, Any]] = []
        for step in self.programme:
            seconds = step.seconds - max(0.0, elapsed_s)
            elapsed_s -= step.seconds
            if seconds > 0:
                left.append({"seconds": max(1.0, seconds), "hold_c": step.hold_c})
        return left or list(_NO_HEAT)


@dataclass
class _Progress:
    """A session and its progress; taken, last: the number and row of its last epoch at its end."""

    session: Session
    state: State
    why: str = ""
    found: list[str] = field(default_factory=list)
    taken: int = 0
    last: dict[str, Any] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        request = self.session.model_dump(mode="json", exclude={"programme", "check"})
        return {
            **request, "state": self.state, "why": self.why, "found": self.found,
            "taken": self.taken, "last": self.last,
        }  # fmt: skip


class Sessions:
    """The sessions of a daemon, at most one per camera; used by one thread at a time."""

    def __init__(self, station: Station) -> None:
        self.station = station
        self._guard = station.runtime.guard
        self._active: dict[str, _Progress] = {}
        self._ended: dict[str, _Progress] = {}

    def recall(self) -> None:
        """Read the sessions of earlier daemons from the store's events."""
        for event in self._guard.store.events():
            if event.kind not in ("session_begun", "session_ended"):
                continue
            try:
                data = event.data
                session = Session.model_validate(data["session"])
                if event.kind == "session_begun":
                    self._active[session.camera] = _Progress(session, "running")
                elif self._active.pop(session.camera, None) is not None:
                    self._ended[session.camera] = _Progress(
                        session, data["state"], data["why"], taken=int(data["taken"])
                    )
            except (ValidationError, KeyError, TypeError) as error:
                log.warning("an event of a session cannot be read: %s", error)

    def resume(self, station: Station) -> None:
        """Continue the sessions with a station that was just built."""
        self.station = station
        for active in list(self._active.values()):
            try:
                if active.state == "checking":
                    self._check(active)
                else:
                    self._take(active.session)
            except ThermocaldError as error:
                self._end(active, "stopped", f"it cannot continue: {error}")

    def start(self, session: Session) -> dict[str, Any]:
        """Begin a session, or continue a stopped one; return its status.

        Raises UsageError, ConfigurationError or DataError if it cannot begin.
        """
        line = self._line(session.camera)
        if session.camera in self._active:
            running = self._active[session.camera].session
            if running == session:
                return self.status()[session.camera]
            raise DataError(
                f"camera {session.camera!r} is taking series {running.series!r} already; stop it "
                f"first: thermocald session stop --camera {session.camera}"
            )
        if session.series == line.plan.config.series:
            raise UsageError(
                f"camera {session.camera!r} takes series {session.series!r} all the time, by its "
                "configuration; choose another --series"
            )
        if (stored := self._guard.find(session.camera, session.series)) is not None:
            if session.start not in ("", was := stored.start):
                given = f"with --start {was!r}; give" if was else "without --start; omit"
                raise UsageError(
                    f"series {stored.name!r} was begun {given} it, or choose another --series"
                )
            if (taken := self._guard.last_epoch(stored)) >= session.epochs:
                raise DataError(
                    f"series {stored.name!r} has {counted(taken, 'epoch')}; choose another --series"
                )
        if session.programme:
            for other in self._active.values():
                if other.session.programme:
                    raise DataError(
                        f"series {other.session.series!r} uses the heating; wait until it ends"
                    )
            for i in self.station.heaters(session.steps(0.0)):  # raises for wrong steps
                if (link := self.station.outputs[i].link).state == "failed":
                    raise DataError(f"output {link.name}: {link.why}")
        active = _Progress(session, "checking")
        if session.check:
            self._check(active)
        else:
            self._begin(active)
        self._active[session.camera] = active
        return self.status()[session.camera]

    def stop(self, camera: str) -> dict[str, Any]:
        """Stop a camera's session early; return its status; DataError if it has none."""
        if camera not in self._active:
            raise DataError(f"camera {camera!r} has no session")
        self._end(self._active[camera], "stopped", "it was stopped by hand")
        return self.status()[camera]

    def turn(self) -> None:
        """Advance each session whose check is done or whose series is complete."""
        for name, active in list(self._active.items()):
            line = self.station.line(name)
            if line is None:
                continue  # `resume` reported its end
            if active.state == "checking":
                self._finish_check(line, active)
            elif line.run is not None and line.run.full and not line.waiting():
                self._end(active, "done", f"complete: {counted(active.session.epochs, 'epoch')}")
            elif line.link.state == "finished":
                self._end(active, "stopped", line.link.why)

    def status(self) -> dict[str, dict[str, Any]]:
        """Return {camera: its current session, else the last one that ended}."""
        documents = {name: one.document() for name, one in self._ended.items()}
        for name, active in self._active.items():
            line, document = self.station.line(name), active.document()
            if line is not None and line.link.state in ("out", "failed"):
                document.update(state="paused", why=line.link.why)
            if line is not None and line.run is not None and active.state == "running":
                document.update(taken=line.run.taken, last=line.run.last)
            documents[name] = document
        return documents

    def _finish_check(self, line: CameraLine, active: _Progress) -> None:
        why = line.link.why
        if line.checked is not None:
            (found, why), thermometers = line.checked, self.station.thermometers
            active.found = list(found)
            for name in line.plan.config.thermometers:
                link, values = thermometers.links[name], thermometers.last(name)[0]
                if not (link.why or values):
                    return  # it is being read
                read = ", ".join(f"{channel} {c:.2f} °C" for channel, c in values.items())
                active.found.append(f"{name}: {link.why or read}")
                why = why or (link.why and f"{link.called}: {link.why}")
        elif not line.link.ended:
            return
        try:
            if not why:
                self._begin(active)
        except ThermocaldError as error:
            why = str(error)
        if why:
            self._end(active, "refused", f"the check failed: {why}")

    def _check(self, active: _Progress) -> None:
        active.state = "checking"
        self._line(active.session.camera).check()
        if active.session.programme:
            self.station.heat(_NO_HEAT)

    def _begin(self, active: _Progress) -> None:
        session = active.session
        self._take(session)
        active.state = "running"
        self._record("session_begun", active, f"begins: {counted(session.epochs, 'epoch')}")

    def _take(self, session: Session) -> None:
        line = self._line(session.camera)
        line.take(session.series, session.start, session.epochs)
        if session.programme and line.run is not None:
            # by epochs, not by the clock: the programme pauses with the camera
            elapsed_s = (line.run.first - 1) * line.plan.config.period_s
            self.station.heat(session.steps(elapsed_s))

    def _end(self, active: _Progress, state: State, why: str) -> None:
        session, line = active.session, self.station.line(active.session.camera)
        self._active.pop(session.camera, None)
        if active.state == "running" and line is not None and line.run is not None:
            active.taken, active.last = line.run.taken, line.run.last
        active.state, active.why = state, why
        self._ended[session.camera] = active
        try:
            if line is not None:
                line.take(line.plan.config.series)
            if session.programme:
                self.station.heat(_NO_HEAT)
            stored = self._guard.find(session.camera, session.series)
            if not active.taken and stored is not None:
                active.taken = self._guard.last_epoch(stored)
        except ThermocaldError as error:
            log.error("camera %s: %s", session.camera, error)
        kind = "session_refused" if state == "refused" else "session_ended"
        self._record(kind, active, why)

    def _record(self, kind: str, one: _Progress, text: str) -> None:
        session = one.session
        about = f"camera {session.camera}, series {session.series}: {text}"
        log.info(about, extra={"device": session.camera, "event": kind})
        data = {
            "session": session.model_dump(mode="json"), "state": one.state, "taken": one.taken,
            "why": one.why,
        }  # fmt: skip
        self._guard.event(self.station.runtime.clock.utc(), kind, about, data=data)

    def _line(self, camera: str) -> CameraLine:
        line = self.station.line(camera)
        if line is None:
            there = ", ".join(c.plan.name for c in self.station.cameras) or "none"
            raise ConfigurationError(f"there is no camera {camera!r}; there are: {there}")
        return line
