"""One camera from its device to the store; the series it takes may change, the device stays open.

    device loop ─► frame ─► a series: pipeline ─► keeper ─► store, outputs, live state
                      └───► or the check before a session

Where neither wants frames, the device is closed: a phone cools down for a cold start.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from thermocald.acquisition.calibrator import CalibratedEpoch, Calibrator
from thermocald.acquisition.device_loop import DeviceLoop, Link
from thermocald.acquisition.pipeline import Pipeline, check_frame
from thermocald.daemon.epoch_keeper import EpochKeeper
from thermocald.daemon.plan import running_series
from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import IOP, PARAMETER_NAMES, PRINCIPAL
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.store.series import Event

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from thermocald.acquisition.device_loop import LinkEvent
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.pipeline import AcquiredEpoch, FrameCheck, Readings
    from thermocald.acquisition.steady_clock import SteadyClock
    from thermocald.daemon.live_state import LiveState
    from thermocald.daemon.output_loop import OutputLoop
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.hal import Frame
    from thermocald.photogrammetry.field.testfield import Observations

START_EPOCHS = 10
"""The start of a series is the mean of so many of its first epochs with a result."""
_NAMES = PARAMETER_NAMES[PRINCIPAL]


class SeriesDrift:
    """Columns `drift_c_px`, `sd_drift_c_px` …, `pixel_pitch` for the rows of one series.

    pixel_pitch: mm; earlier: the first epochs of the series that are stored already, as rows. The
    standard deviation takes the epochs as independent: where they share a level that cancels in
    the difference, it is too large rather than too small.
    """

    def __init__(self, pixel_pitch: float, earlier: Iterable[dict[str, Any]] = ()) -> None:
        self._pitch = pixel_pitch
        self._start: list[dict[str, float]] = []
        for row in earlier:
            self._learn(row)

    def columns(self, row: dict[str, Any]) -> dict[str, float]:
        """The columns for one epoch; NaN without a result, and until the start is known."""
        self._learn(row)
        known = len(self._start) == START_EPOCHS and row.get("status") == "ok"
        result = {"pixel_pitch": self._pitch}
        for name in _NAMES:
            drift = sd = math.nan
            if known:
                drift = (row[name] - sum(s[name] for s in self._start) / START_EPOCHS) / self._pitch
                start = sum(s[f"sd_{name}"] ** 2 for s in self._start) / START_EPOCHS**2
                sd = math.sqrt(row[f"sd_{name}"] ** 2 + start) / self._pitch
            result |= {f"drift_{name}_px": drift, f"sd_drift_{name}_px": sd}
        return result

    def _learn(self, row: dict[str, Any]) -> None:
        if len(self._start) < START_EPOCHS and row.get("status") == "ok":
            self._start.append({k: float(row[k]) for n in _NAMES for k in (n, f"sd_{n}")})


class Resources(Protocol):
    """Clock, store, frames, readings and outputs, shared by the cameras of a station.

    fast, virtual, epochs, hang_after_s, start_condition: as of `Station`; preview: whether a page
    may look.
    """

    guard: StoreGuard
    clock: SteadyClock
    live: LiveState
    frames: FrameFolder
    readings: Readings
    outputs: list[OutputLoop]
    fast: bool
    virtual: bool
    epochs: int
    hang_after_s: float
    start_condition: str
    preview: bool

    def on_link_event(self, event: LinkEvent) -> None:
        """A device went away or came back."""

    def identity_of(self, line: Any) -> Callable[[], Mapping[str, Any]]:
        """What a camera and its thermometers say they are, asked when a series begins."""

    def columns_of(self, plan: CameraPlan) -> list[str]:
        """The columns of a camera's temperatures, the reference first, as far as known."""

    def make_observer(self, plan: CameraPlan, keeper: EpochKeeper) -> Any:
        """The online estimate of a camera; None if it is only acquired."""

    def read_now(self, names: Sequence[str]) -> None:
        """Read thermometers in the caller's thread."""


log = logging.getLogger(__name__)

_PREVIEW_EVERY_S = 5.0
_SHOW_EVERY_S = 0.5
_SWITCH_GRACE_S = 20.0
_VIRTUAL_PATIENCE_S = 60.0  # real seconds that a tick of a virtual clock waits for room
_REMEMBERED = 200  # epochs, as many as a running series keeps


class SeriesRun:
    """A series being taken: its keeper, its online estimate, its pipeline.

    limit: the number of its last epoch, 0 for none.
    """

    def __init__(self, line: CameraLine, series: str, start: str, limit: int) -> None:
        station = line.station
        plan = replace(line.plan, series=series)
        self.plan = plan
        self.start_condition = start
        self.limit = limit
        self._line = line
        self.keeper = EpochKeeper(
            plan, station.guard, station.frames, self._kept, station.identity_of(line), start=start
        )
        self.observer = station.make_observer(plan, self.keeper)
        self.running = running_series(plan)
        self._remembered = False
        self.first = self.keeper.first_number
        self.pipeline = Pipeline(
            plan.name,
            plan.calibrator,
            station.readings,
            plan.config.thermometers,
            self.keeper,
            station.clock,
            first=self.first,
            period_s=plan.config.period_s,
            patience_s=0.0 if station.fast else None,
            trusted=station.clock.trusted,
            observe=self._observe,
            columns=lambda: station.columns_of(plan),
            on_lost=station.guard.lose,
        )
        self.drift: SeriesDrift | None = None
        self.last: dict[str, Any] = {}
        self._shown = self._previewed = float("-inf")

    @property
    def taken(self) -> int:
        """The number of the last epoch that was taken over, 0 for none."""
        return self.pipeline.next_number - 1

    @property
    def full(self) -> bool:
        """Whether it has all its epochs."""
        return bool(self.limit) and self.taken >= self.limit

    def finish(self, grace_s: float) -> bool:
        """Let all that was taken be calibrated and kept; False if that took too long."""
        deadline = time.monotonic() + grace_s
        self.pipeline.drain(0.5 * grace_s)
        return self.pipeline.stop(max(0.1, deadline - time.monotonic()))

    def _observe(self, calibrated: CalibratedEpoch, in_order: bool) -> CalibratedEpoch:
        """Adjust the epoch with what its series tells, then test it against those before."""
        seen = calibrated.epoch.observations
        adjusted = calibrated.adjustment
        columns: dict[str, float] = {}
        if self.running is not None and seen is not None:
            if in_order and self.first > 1 and not self.running.epochs:
                self._remember()
            hurried = self.pipeline.waiting() > 1 and not self._line.station.fast
            try:
                adjusted, columns = self.running.refine(
                    calibrated, self._weighed(seen), hurried=hurried
                )
            except Exception:
                # what breaks in the series must not cost an epoch that has a result of its own
                log.exception("camera %s: the series was not adjusted", self.plan.name)
                self.running.reset()
                adjusted, columns = calibrated.adjustment, {"series_restarted": 1.0}
            if "series_restarted" in columns:
                self._tell_restart(calibrated)
        if self.observer is not None and in_order:
            known = self.running
            told = () if known is None else (known.tremble, known.field_variance)
            columns |= self.observer.observe(calibrated, adjusted, *told)
        return replace(calibrated, adjustment=adjusted, extra={**calibrated.extra, **columns})

    def _tell_restart(self, calibrated: CalibratedEpoch) -> None:
        epoch = calibrated.epoch
        text = (
            f"camera {self.plan.name}: several epochs in a row contradict what the earlier ones of "
            "their series say of camera and targets; the common adjustment begins again"
        )
        log.warning("%s", text, extra={"event": "series_restarted"})
        series = self.keeper.series
        known = None if series is None else series.id
        self._line.station.guard.event(
            Event(epoch.frame_time, "series_restarted", text, known, epoch.number)
        )

    def _weighed(self, seen: Observations) -> Observations:
        assert isinstance(self.plan.calibrator, Calibrator)
        return self.plan.calibrator.weighed(seen)

    def _remember(self) -> None:
        """After a restart, go on with the last epochs of the store."""
        if self._remembered:
            return
        self._remembered = True
        assert self.running is not None
        assert isinstance(self.plan.calibrator, Calibrator)
        for epoch, reported, begun in self.keeper.recent(_REMEMBERED):
            if begun:
                self.running.reset()
                continue
            assert epoch.observations is not None
            seen = self._weighed(epoch.observations)
            alone = CalibratedEpoch(epoch, self.plan.calibrator.adjust(seen), {})
            self.running.remember(alone, seen, reported)

    def _kept(self, acquired: AcquiredEpoch, row: dict[str, Any]) -> None:
        """Tell outputs and the live state; the epoch is in the store already."""
        station, name = self._line.station, self.plan.name
        report = {} if self.observer is None else self.observer.report()
        report |= {} if self.running is None else self.running.report()
        row["state"] = report.get("state", "unknown")
        row |= self._drift(row)
        if (camera := self._camera(acquired.calibrated)) is not None:
            row["opencv"] = camera
        self.last = {**row, "online": report}
        for output in station.outputs:
            output.put(row)
        now = time.monotonic()
        if now - self._shown >= _SHOW_EVERY_S:
            self._shown = now
            station.live.write_epoch(name, self.last, acquired.calibrated, self.plan.testfield)
            if station.preview and now - self._previewed >= _PREVIEW_EVERY_S:
                self._previewed = now
                station.live.write_frame(name, acquired.frame)

    def _camera(self, calibrated: CalibratedEpoch | None) -> dict[str, float] | None:
        """The camera of an epoch in OpenCV's terms."""
        if calibrated is None or self.plan.sensor is None:
            return None
        result = calibrated.adjustment
        if result.interior is None:
            return None
        values = result.interior.as_array()
        return opencv_terms(self.plan.sensor, values, result.covariance[IOP, IOP])

    def _drift(self, row: dict[str, Any]) -> dict[str, float]:
        """Against the start of the series, where the size of the pixels is known."""
        if self.plan.sensor is None:
            return {}
        if self.drift is None:
            earlier = self.keeper.first_rows(START_EPOCHS)
            self.drift = SeriesDrift(self.plan.sensor.pixel_pitch, earlier)
        return self.drift.columns(row)


class CameraLine:
    """One camera; what it takes is changed by one thread, the service's."""

    def __init__(self, plan: CameraPlan, station: Resources, begin: float) -> None:
        self.plan = plan
        self.station = station
        self.checked: FrameCheck | None = None
        self._checking = False
        self._started = False
        self._swap = threading.Lock()
        self.link = Link(
            "camera", plan.name, plan.camera, station.clock,
            period_s=plan.config.period_s, on_event=station.on_link_event,
        )  # fmt: skip
        self.loop = DeviceLoop(
            self.link, self._capture, station.clock, plan.config.period_s, begin,
            free_running=station.fast and not station.virtual, idle=lambda: not self.taking,
        )  # fmt: skip
        self.run: SeriesRun | None = None
        self.take(plan.config.series, station.start_condition)

    @property
    def taking(self) -> bool:
        """Whether frames are wanted."""
        return self.run is not None or self._checking

    def start(self) -> None:
        """Start all threads."""
        self._started = True
        if self.run is not None:
            self.run.pipeline.start()
        self.loop.start()

    def take(self, series: str | None, start: str = "", limit: int = 0) -> None:
        """Go over to another series, None for none; raises ConfigurationError and changes nothing.

        The current epochs are finished first; frames that come meanwhile belong to the new one.
        """
        run = None if series is None else SeriesRun(self, series, start, limit)
        self._replace(run, checking=False)
        if run is not None and self._started:
            run.pipeline.start()

    def check(self) -> None:
        """Look at the next frame and keep none; `checked` then says what was found."""
        if not isinstance(self.plan.calibrator, Calibrator):
            raise ConfigurationError(f"camera {self.plan.name!r}: a session needs its `testfield`")
        self.checked = None
        self._replace(None, checking=True)

    def _replace(self, run: SeriesRun | None, *, checking: bool) -> None:
        with self._swap:
            old, self.run, self._checking = self.run, run, False
        if old is not None and self._started and not old.finish(_SWITCH_GRACE_S):
            log.error("camera %s: its last epochs take too long to be kept", self.plan.name)
        # only now: the calibrator is one for all series
        self._checking = checking

    def _capture(self) -> None:
        station, run = self.station, self.run
        # of a virtual clock each tick is an epoch, however long those before take
        patience_s = _VIRTUAL_PATIENCE_S if station.virtual else 1.0
        if run is not None and (
            run.full or (station.fast and not run.pipeline.wait_for_room(patience_s))
        ):
            return
        frame = self.plan.camera.capture()
        if station.fast:
            station.read_now(self.plan.config.thermometers)
        if self._checking:
            self._look_at(frame)
            return
        with self._swap:
            run = self.run
            if run is None or run.full:
                return
            run.pipeline.submit(frame)
        if station.epochs and run.taken - run.first + 1 >= station.epochs:
            self.loop.stop()

    def _look_at(self, frame: Frame) -> None:
        assert self.plan.calibrator is not None
        found = check_frame(self.plan.name, self.plan.calibrator, frame)
        if self._checking:
            self._checking, self.checked = False, found

    def waiting(self) -> int:
        """How many epochs are on their way."""
        run = self.run
        return 0 if run is None else run.pipeline.waiting()

    def busy_s(self) -> float:
        """For how long the pipeline has not finished one thing."""
        run = self.run
        return 0.0 if run is None else run.pipeline.busy_s()

    def event(self, utc: float, kind: str, text: str) -> Event:
        """An event that belongs to the series being taken."""
        run = self.run
        series = None if run is None else run.keeper.series
        return Event(utc, kind, text, None if series is None else series.id)

    def status(self) -> dict[str, Any]:
        """For `thermocald status`."""
        stats = self.loop.schedule.stats()
        run = self.run
        pipeline = None if run is None else run.pipeline
        deferred = 0 if pipeline is None else pipeline.dropped
        return {
            "series": "" if run is None else run.plan.series,
            "period_s": self.plan.config.period_s,
            **link_status(self.link, self.loop.busy_s(), self.station.hang_after_s),
            "ticks": stats.ticks,
            "skipped": stats.skipped,
            "late_p99_s": stats.late_p99_s,
            "late_max_s": stats.late_max_s,
            "lost": self.loop.lost + (0 if pipeline is None else pipeline.lost),
            "waiting": self.waiting(),
            "deferred": deferred,
            "caught_up": 0 if pipeline is None else pipeline.caught_up,
            "stored": 0 if run is None else run.keeper.stored,
            "frames_kept": 0 if run is None else run.keeper.kept_frames,
            "last": {} if run is None else run.last,
        }


def link_status(link: Link, busy_s: float, hang_after_s: float) -> dict[str, Any]:
    """A device's part of the status."""
    return {
        "device": "hung" if busy_s > hang_after_s else link.state,
        "why": link.why,
        "since": link.since,
        "warnings": link.warnings(),
        "faults": link.faults,
    }
