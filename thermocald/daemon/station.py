"""All that one configuration names, at work: device loops, pipelines, outputs, retention.

    thermometer loops ─► readings ─┐
    camera loops ─► pipelines ─────┴─► keepers ─► store ─► outputs, live state

Cameras and thermometers begin at the same time: with equal periods, frame and temperature are taken
together.
"""

from __future__ import annotations

import logging
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.calibrator import Calibrator
from thermocald.acquisition.device_loop import DeviceLoop, Link
from thermocald.acquisition.frame_folder import FrameFolder
from thermocald.acquisition.pipeline import Readings, require_columns
from thermocald.daemon.camera_line import CameraLine, link_status
from thermocald.daemon.output_loop import OutputLoop
from thermocald.daemon.plan import plan_cameras, require_thermometer_columns
from thermocald.errors import ConfigurationError, WrongDevice
from thermocald.hal import load_driver, open_device
from thermocald.store.series import Event, LoggedReading

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from thermocald.acquisition.device_loop import LinkEvent
    from thermocald.acquisition.steady_clock import SteadyClock
    from thermocald.config import Config, OutputConfig
    from thermocald.daemon.epoch_keeper import EpochKeeper
    from thermocald.daemon.live_state import LiveState
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.hal import Reading, Thermometer
    from thermocald.store.series import StoredSeries


log = logging.getLogger(__name__)

_RETENTION_EVERY_S = 600.0
_RETENTION_WHEN_FULL_S = 10.0
_LEAD_S = 0.1


class Station:
    """Built from a configuration, started, stopped; raises ConfigurationError when built.

    fast: a recording is played as fast as it can be calibrated; virtual: so are the ticks of a
    virtual clock; epochs: after how many new ones
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
        virtual: bool = False,
        epochs: int = 0,
        hang_after_s: float = 60.0,
        start_condition: str = "",
    ) -> None:
        self.config = config
        self.guard = guard
        self.clock = clock
        self.live = live
        self.fast = fast
        self.virtual = virtual
        self.epochs = epochs
        self.hang_after_s = hang_after_s
        self.start_condition = start_condition
        self.preview = config.dashboard.enabled
        self.frames = FrameFolder(config.frames)
        self.readings = Readings({t.name: t.period_s for t in config.thermometers})
        self.last_readings: dict[str, dict[str, float]] = {}
        self.logged = 0  # readings kept apart from epochs
        self._stop = threading.Event()
        self._started = False
        self.cameras: list[CameraLine] = []
        begin = clock.monotonic() + _LEAD_S
        self._thermometers: dict[str, tuple[Thermometer, Link]] = {}
        self._channels: dict[str, tuple[str, ...]] = {}  # as named, then as read
        for one in config.thermometers:
            thermometer = open_device("thermometer", one.driver, one.options, clock)
            link = Link(
                "thermometer", one.name, thermometer, clock,
                period_s=one.period_s, on_event=self.on_link_event,
            )  # fmt: skip
            self._thermometers[one.name] = (thermometer, link)
            self._channels[one.name] = tuple(thermometer.named_channels())
        require_thermometer_columns(config, self._channels, ConfigurationError)
        self.outputs = [self._output(o, o.options) for o in config.outputs]
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
            camera.start()
        self._started = True

    def stop(self, grace_s: float) -> bool:
        """Finish the current epochs; False if a device or an output does not let go."""
        deadline = time.monotonic() + grace_s
        self._stop.set()
        for loop in self._all_loops():
            loop.stop()
        done = True
        for loop in self._all_loops():
            done &= loop.join(max(0.1, deadline - time.monotonic() - 0.5 * grace_s))
        for camera in self.cameras:
            if camera.run is not None:
                done &= camera.run.pipeline.stop(max(0.1, deadline - time.monotonic()))
        for output in self.outputs:
            done &= output.stop(max(0.1, min(2.0, deadline - time.monotonic())))
        if self.fast:
            for _, link in self._thermometers.values():
                link.close()
        self._retention.join(1.0)
        return done

    def read_now(self, names: Sequence[str]) -> None:
        """Read thermometers in the caller's thread: a recording's come with its frames."""
        for name in names:
            self._thermometers[name][1].call(partial(self._read, name))

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
            if camera.busy_s() > self.hang_after_s
        ]
        return found

    @property
    def finished(self) -> bool:
        """Whether no camera will give another epoch and all is kept."""
        return bool(self.cameras) and all(
            not camera.loop.alive and not camera.waiting() for camera in self.cameras
        )

    def on_link_event(self, event: LinkEvent) -> None:
        """A device went away or came back: into the store, with the series it concerns."""
        line = next((c for c in self.cameras if c.plan.name == event.device), None)
        if line is None:
            self.guard.event(Event(event.utc, event.kind, event.text))
        else:
            self.guard.event(line.event(event.utc, event.kind, event.text))

    def line(self, camera: str) -> CameraLine | None:
        """The camera of that name; None if the configuration has none."""
        return next((line for line in self.cameras if line.plan.name == camera), None)

    def identity_of(self, line: CameraLine) -> Callable[[], dict[str, Any]]:
        """What a camera and its thermometers say they are, asked when a series begins."""

        def identity() -> dict[str, Any]:
            names = line.plan.config.thermometers
            told = {name: self._thermometers[name][1].identity() for name in names}
            return {**line.link.identity(), **({"thermometers": told} if told else {})}

        return identity

    def heaters(self, programme: Sequence[Mapping[str, Any]]) -> dict[int, OutputLoop]:
        """{place among the outputs: a heating output with another programme}, not started.

        Raises ConfigurationError if nothing heats, or the programme is not theirs.
        """
        found = {
            i: self._output(one, {**one.options, "programme": list(programme)})
            for i, one in enumerate(self.config.outputs)
            if load_driver("output", one.driver).heats
        }
        if not found:
            raise ConfigurationError("programme: no output of the configuration heats")
        return found

    def heat(self, programme: Sequence[Mapping[str, Any]]) -> None:
        """Give the heating outputs another programme, from its beginning; raises as `heaters`."""
        for i, output in self.heaters(programme).items():
            old, self.outputs[i] = self.outputs[i], output
            if self._started:
                old.stop(2.0)
                output.start()

    def _output(self, one: OutputConfig, options: Mapping[str, Any]) -> OutputLoop:
        device = open_device("output", one.driver, options, self.clock)
        return OutputLoop(one.name, device, self.clock, self.on_link_event)

    def make_observer(self, plan: CameraPlan, keeper: EpochKeeper) -> Any:
        """The online estimate of a camera; None if it is only acquired."""
        if plan.sensor is None or plan.testfield is None or plan.calibrator is None:
            return None

        def tell(kind: str, text: str, utc: float, epoch: int) -> None:
            series: StoredSeries | None = keeper.series
            log.warning("camera %s: %s", plan.name, text, extra={"event": kind})
            self.guard.event(Event(utc, kind, text, None if series is None else series.id, epoch))

        if isinstance(plan.calibrator, Calibrator):
            from thermocald.analysis.online.observer import OnlineObserver

            return OnlineObserver(plan.sensor, plan.testfield, tell)
        from thermocald.analysis.thermal.gauge import GaugeObserver

        plan.calibrator.remember(keeper.latest())
        return GaugeObserver(plan.calibrator, tell)

    def status(self) -> dict[str, Any]:
        """For `thermocald status`, JSON-able but for NaN."""
        return {
            "cameras": {camera.plan.name: camera.status() for camera in self.cameras},
            "thermometers": {
                name: {
                    **link_status(link, self._busy_s(link), self.hang_after_s),
                    "last": self.last_readings.get(name, {}),
                }
                for name, (_, link) in self._thermometers.items()
            },
            "outputs": {
                output.link.name: {
                    **link_status(output.link, 0.0, self.hang_after_s),
                    "emitted": output.emitted,
                    "lost": output.lost,
                }
                for output in self.outputs
            },
            "readings_logged": self.logged,
            "frames": {
                "keep": self.config.frames.keep,
                "paused": self.frames.paused,
                "ages_known": self.clock.settled(),
            },
        }

    def _all_loops(self) -> list[DeviceLoop]:
        return [*self.loops, *(camera.loop for camera in self.cameras)]

    def _busy_s(self, link: Link) -> float:
        return next((loop.busy_s() for loop in self.loops if loop.link is link), 0.0)

    def _reader(self, name: str) -> Callable[[], None]:
        def read() -> None:
            reading = self._read(name)
            self.last_readings[name] = dict(reading.values)
            if not self._in_epochs(name):
                trusted = self.clock.trusted()
                self.guard.reading(LoggedReading(name, reading.utc, reading.values, trusted))
                self.logged += 1

        return read

    def _read(self, name: str) -> Reading:
        reading: Reading = self._thermometers[name][0].read()
        if new := [c for c in reading.values if c not in self._channels[name]]:
            channels = {**self._channels, name: (*self._channels[name], *new)}
            require_thermometer_columns(self.config, channels, WrongDevice)
            self._channels = channels
        self.readings.add(name, reading)
        return reading

    def columns_of(self, plan: CameraPlan) -> list[str]:
        """The columns of a camera's temperatures, the reference first, as far as known."""
        channels = {name: self._channels[name] for name in plan.config.thermometers}
        return require_columns(channels, ConfigurationError)

    def _in_epochs(self, thermometer: str) -> bool:
        """Whether a camera that gives frames takes the thermometer's readings into its epochs."""
        return any(
            thermometer in line.plan.config.thermometers
            and line.run is not None
            and line.link.state == "open"
            for line in self.cameras
        )

    def retain(self) -> list[str]:
        """Delete the frames that may go; sentences about what was deleted."""
        now = self.clock.utc() if self.clock.settled() else None
        told = [deleted.text for deleted in self.frames.enforce(now)]
        for text in told:
            self.guard.event(Event(self.clock.utc(), "frames_deleted", text))
        return told

    def clock_stepped(self, seconds: float) -> None:
        """Time stamps have followed a step: frames on disk follow too."""
        self.frames.restamp(seconds)

    def _retain(self) -> None:
        while True:
            self.retain()
            pause = _RETENTION_WHEN_FULL_S if self.frames.paused else _RETENTION_EVERY_S
            if self._stop.wait(pause):
                return
