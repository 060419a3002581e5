"""One camera from its device to the store; the series it takes may change, the device stays open.

    device loop ─► frame ─► a series: pipeline ─► keeper ─► store, outputs, live state
                      └───► or the check before a session

Where neither wants frames, the device is closed: a phone cools down for a cold start.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.acquisition.device_loop import DeviceLoop
from thermocald.acquisition.frame_check import check_frame
from thermocald.acquisition.link import Link
from thermocald.acquisition.live_pipeline import LivePipeline
from thermocald.daemon.drift import START_EPOCHS, SeriesDrift
from thermocald.daemon.epoch_keeper import EpochKeeper
from thermocald.daemon.plan import common_unknowns
from thermocald.errors import ConfigurationError
from thermocald.store.database.row import Event

if TYPE_CHECKING:
    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.acquisition.frame_check import FrameCheck
    from thermocald.acquisition.live_pipeline import AcquiredEpoch
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.resources import Resources
    from thermocald.hal import Frame
    from thermocald.photogrammetry.field.testfield import Observations

__all__ = ["CameraLine", "SeriesRun", "link_status"]

log = logging.getLogger(__name__)

_PREVIEW_EVERY_S = 5.0
_SHOW_EVERY_S = 0.5
_SWITCH_GRACE_S = 20.0
_REMEMBERED = 200  # epochs


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
        self.common = common_unknowns(plan)
        self._remembered = False
        self.first = self.keeper.first_number
        self.pipeline = LivePipeline(
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
        """Test the epoch against the series, then adjust it with what all its epochs share."""
        seen = calibrated.epoch.observations
        extra = self.observer.observe(calibrated) if self.observer and in_order else {}
        adjusted = calibrated.adjustment
        if self.common is not None and seen is not None:
            if in_order and self.first > 1 and not self.common.epochs:
                self._remember()
            if "event" in extra:
                self.common.reset()
            moved = extra.get("innovation_chi2", 0.0) > extra.get("innovation_bound", np.inf)
            adjusted = self.common.refine(self._weighed(seen), adjusted, moved=moved)
        return replace(calibrated, adjustment=adjusted, extra={**calibrated.extra, **extra})

    def _weighed(self, seen: Observations) -> Observations:
        assert self.plan.calibrator is not None
        return self.plan.calibrator.weighed(seen)

    def _remember(self) -> None:
        """After a restart, learn from the last epochs of the store what they share."""
        if self._remembered:
            return
        self._remembered = True
        assert self.common is not None
        assert self.plan.calibrator is not None
        for seen, event in self.keeper.recent(_REMEMBERED):
            if event:
                self.common.reset()
            self.common.refine(self._weighed(seen), self.plan.calibrator.adjust(seen))

    def _kept(self, acquired: AcquiredEpoch, row: dict[str, Any]) -> None:
        """Tell outputs and the live state; the epoch is in the store already."""
        station, name = self._line.station, self.plan.name
        report = {} if self.observer is None else self.observer.report()
        row["state"] = report.get("state", "unknown")
        row |= self._drift(row)
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
            free_running=station.fast, idle=lambda: not self.taking,
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
        if self.plan.calibrator is None:
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
        if run is not None and (run.full or (station.fast and not run.pipeline.wait_for_room(1.0))):
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
            "put_off": deferred,  # its name until the next version
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
        "warnings": link.warnings(),
        "faults": link.faults,
    }
