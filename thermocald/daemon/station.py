"""All that one configuration names, at work: device loops, pipelines, outputs, retention.

    thermometer loops ─► readings ─┐
    camera loops ─► pipelines ─────┴─► keepers ─► store ─► outputs, live state

Cameras and thermometers begin at one instant: with equal periods, frame and temperature are taken
together.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.device_loop import DeviceLoop
from thermocald.acquisition.frame_folder import FrameFolder
from thermocald.acquisition.link import Link
from thermocald.acquisition.live_pipeline import LivePipeline
from thermocald.acquisition.pairing import Readings
from thermocald.daemon.epoch_keeper import EpochKeeper
from thermocald.daemon.output_loop import OutputLoop
from thermocald.daemon.plan import plan_cameras
from thermocald.hal import open_device
from thermocald.store.row import Event

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.acquisition.link import LinkEvent
    from thermocald.acquisition.live_pipeline import AcquiredEpoch
    from thermocald.acquisition.steady_clock import SteadyClock
    from thermocald.config import Config
    from thermocald.daemon.live_state import LiveState
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.hal import Thermometer
    from thermocald.store.row import StoredSeries

__all__ = ["CameraLine", "Station"]

log = logging.getLogger(__name__)

_RETENTION_EVERY_S = 600.0
_RETENTION_WHEN_FULL_S = 10.0
_LEAD_S = 0.1
_PREVIEW_EVERY_S = 5.0
_SHOW_EVERY_S = 0.5


class CameraLine:
    """One camera from its loop to the store."""

    def __init__(self, plan: CameraPlan, station: Station, begin: float) -> None:
        self.plan = plan
        self._station = station
        self._device = plan.camera
        self.link = Link(
            "camera",
            plan.name,
            plan.camera,
            station.clock,
            period_s=plan.config.period_s,
            on_event=station.on_link_event,
        )
        self.keeper = EpochKeeper(
            plan,
            station.guard,
            station.frames,
            self._kept,
            self.link.identity,
            start=station.start_condition,
        )
        self.observer = station.make_observer(plan, self.keeper)
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
        self.loop = DeviceLoop(
            self.link, self._capture, station.clock, plan.config.period_s, begin,
            free_running=station.fast,
        )  # fmt: skip
        self.last: dict[str, Any] = {}
        self._shown = self._previewed = float("-inf")

    def _capture(self) -> None:
        station = self._station
        if station.fast and not self.pipeline.wait_for_room(1.0):
            return
        frame = self._device.capture()
        if station.fast:
            station.read_now(self.plan.config.thermometers)
        self.pipeline.submit(frame)
        if station.epochs and self.pipeline.next_number - self.first >= station.epochs:
            self.loop.stop()

    def _observe(self, calibrated: CalibratedEpoch) -> dict[str, float]:
        return {} if self.observer is None else self.observer.observe(calibrated)

    def _kept(self, acquired: AcquiredEpoch, row: dict[str, Any]) -> None:
        """Tell outputs and the live state; the epoch is in the store already."""
        report = {} if self.observer is None else self.observer.report()
        row["state"] = report.get("state", "unknown")
        self.last = {**row, "online": report}
        for output in self._station.outputs:
            output.put(row)
        now = time.monotonic()
        if now - self._shown >= _SHOW_EVERY_S:
            self._shown = now
            live = self._station.live
            live.write_epoch(self.plan.name, self.last, acquired.calibrated, self.plan.testfield)
            if self._station.preview and now - self._previewed >= _PREVIEW_EVERY_S:
                self._previewed = now
                live.write_frame(self.plan.name, acquired.frame)

    def status(self) -> dict[str, Any]:
        """For `thermocald status`."""
        rhythm = self.loop.schedule.rhythm()
        return {
            "series": self.plan.config.series,
            "period_s": self.plan.config.period_s,
            **_link_status(self.link, self.loop.busy_s(), self._station.hang_after_s),
            "ticks": rhythm.ticks,
            "skipped": rhythm.skipped,
            "late_p99_s": rhythm.late_p99_s,
            "late_max_s": rhythm.late_max_s,
            "lost": self.loop.lost + self.pipeline.lost,
            "waiting": self.pipeline.waiting(),
            "put_off": self.pipeline.dropped,
            "caught_up": self.pipeline.caught_up,
            "stored": self.keeper.stored,
            "frames_kept": self.keeper.kept_frames,
            "last": self.last,
        }


class Station:
    """Built from a configuration, started, stopped; raises ConfigurationError when built.

    fast: a recording is played as fast as it can be calibrated; epochs: after how many new ones
    a camera stops, 0 for never; start_condition: kept with a series that begins.
    """

    def __init__(
        self,
        config: Config,
        guard: StoreGuard,
        clock: SteadyClock,
        live: LiveState,
        *,
        fast: bool = False,
        epochs: int = 0,
        hang_after_s: float = 60.0,
        start_condition: str = "",
    ) -> None:
        self.config = config
        self.guard = guard
        self.clock = clock
        self.live = live
        self.fast = fast
        self.epochs = epochs
        self.hang_after_s = hang_after_s
        self.start_condition = start_condition
        self.preview = config.dashboard.enabled
        self.frames = FrameFolder(config.frames)
        self.readings = Readings({t.name: t.period_s for t in config.thermometers})
        self._stop = threading.Event()
        begin = clock.monotonic() + _LEAD_S
        self._thermometers: dict[str, tuple[Thermometer, Link]] = {}
        for one in config.thermometers:
            thermometer = open_device("thermometer", one.driver, one.options, clock)
            link = Link(
                "thermometer", one.name, thermometer, clock,
                period_s=one.period_s, on_event=self.on_link_event,
            )  # fmt: skip
            self._thermometers[one.name] = (thermometer, link)
        self.outputs = [
            OutputLoop(
                o.name, open_device("output", o.driver, o.options, clock), clock, self.on_link_event
            )
            for o in config.outputs
        ]
        self.cameras = [CameraLine(plan, self, begin) for plan in plan_cameras(config, clock)]
        self.loops = [
            DeviceLoop(link, self._reader(name), clock, one.period_s, begin)
            for one, (name, (_, link)) in zip(
                config.thermometers, self._thermometers.items(), strict=True
            )
            if not fast
        ]
        self._retention = threading.Thread(target=self._retain, name="retention", daemon=True)

    def start(self) -> None:
        """Start all threads."""
        self._retention.start()
        for output in self.outputs:
            output.start()
        for loop in self.loops:
            loop.start()
        for camera in self.cameras:
            camera.pipeline.start()
            camera.loop.start()

    def stop(self, grace_s: float) -> bool:
        """Finish the epochs in hand; False if a device or an output does not let go."""
        deadline = time.monotonic() + grace_s
        self._stop.set()
        for loop in self._all_loops():
            loop.stop()
        done = True
        for loop in self._all_loops():
            done &= loop.join(max(0.1, deadline - time.monotonic() - 0.5 * grace_s))
        for camera in self.cameras:
            done &= camera.pipeline.stop(max(0.1, deadline - time.monotonic()))
        for output in self.outputs:
            done &= output.stop(max(0.1, min(2.0, deadline - time.monotonic())))
        if self.fast:
            for _, link in self._thermometers.values():
                link.close()
        self._retention.join(1.0)
        return done

    def read_now(self, names: tuple[str, ...]) -> None:
        """Read thermometers in the caller's thread: a recording's come with its frames."""
        for name in names:
            thermometer, link = self._thermometers[name]
            reading = link.call(thermometer.read)
            if reading is not None:
                self.readings.add(name, reading)

    def stalled(self) -> list[str]:
        """Threads that have not come back for too long, or are gone."""
        found = [
            f"{loop.link.kind} {loop.link.name} hangs"
            for loop in self._all_loops()
            if loop.busy_s() > self.hang_after_s
        ]
        found += [
            f"pipeline of {camera.plan.name} hangs"
            for camera in self.cameras
            if camera.pipeline.busy_s() > self.hang_after_s
        ]
        return found

    @property
    def finished(self) -> bool:
        """Whether no camera will give another epoch and all is kept."""
        return bool(self.cameras) and all(
            not camera.loop.alive and not camera.pipeline.waiting() for camera in self.cameras
        )

    def on_link_event(self, event: LinkEvent) -> None:
        """A device went away or came back: into the store, with the series it concerns."""
        series = next(
            (c.keeper.series for c in self.cameras if c.plan.name == event.device), None
        ) if hasattr(self, "cameras") else None  # fmt: skip
        self.guard.event(
            Event(event.utc, event.kind, event.text, None if series is None else series.id)
        )

    def make_observer(self, plan: CameraPlan, keeper: EpochKeeper) -> Any:
        """The online estimate of a camera; None if it is only acquired."""
        if plan.sensor is None or plan.testfield is None:
            return None
        from thermocald.analysis.online_observer import OnlineObserver

        def tell(kind: str, text: str, utc: float, epoch: int) -> None:
            series: StoredSeries | None = keeper.series
            log.warning("camera %s: %s", plan.name, text, extra={"event": kind})
            self.guard.event(Event(utc, kind, text, None if series is None else series.id, epoch))

        return OnlineObserver(plan.sensor, plan.testfield, tell)

    def status(self) -> dict[str, Any]:
        """For `thermocald status`, JSON-able but for NaN."""
        return {
            "cameras": {camera.plan.name: camera.status() for camera in self.cameras},
            "thermometers": {
                name: _link_status(link, self._busy_s(link), self.hang_after_s)
                for name, (_, link) in self._thermometers.items()
            },
            "outputs": {
                output.link.name: {
                    **_link_status(output.link, 0.0, self.hang_after_s),
                    "emitted": output.emitted,
                    "lost": output.lost,
                }
                for output in self.outputs
            },
            "frames": {"keep": self.config.frames.keep, "paused": self.frames.paused},
        }

    def _all_loops(self) -> list[DeviceLoop]:
        return [*self.loops, *(camera.loop for camera in self.cameras)]

    def _busy_s(self, link: Link) -> float:
        return next((loop.busy_s() for loop in self.loops if loop.link is link), 0.0)

    def _reader(self, name: str) -> Callable[[], None]:
        thermometer, _ = self._thermometers[name]

        def read() -> None:
            self.readings.add(name, thermometer.read())

        return read

    def _retain(self) -> None:
        while True:
            for deleted in self.frames.enforce(self.clock.utc()):
                self.guard.event(Event(self.clock.utc(), "frames_deleted", deleted.text))
            pause = _RETENTION_WHEN_FULL_S if self.frames.paused else _RETENTION_EVERY_S
            if self._stop.wait(pause):
                return


def _link_status(link: Link, busy_s: float, hang_after_s: float) -> dict[str, Any]:
    return {
        "device": "hung" if busy_s > hang_after_s else link.state,
        "why": link.why,
        "faults": link.faults,
    }
