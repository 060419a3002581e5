"""A configuration at work: its device loops, cameras, outputs and retention of frames.

    thermometer loops ─► readings ─┐
    camera loops ─► the pipelines of `SeriesRun` ─► store ─► outputs, live state
                └─► or the check before a session

Cameras and thermometers start at the same time: with equal periods, frames and temperatures are
taken together. While a camera's frames are not needed, it is closed, so that a phone cools down for
a cold start.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.device_loop import DeviceLoop, Link, OutputLoop
from thermocald.acquisition.frame_folder import FrameFolder
from thermocald.acquisition.pipeline import check_frame
from thermocald.acquisition.thermometers import Thermometers
from thermocald.daemon.plan import heating_outputs, plan_cameras
from thermocald.daemon.series_run import SeriesRun
from thermocald.hal import open_device
from thermocald.store.series import LoggedReading

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.config import Config, OutputConfig
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.series_run import Runtime

log = logging.getLogger(__name__)

_SWITCH_GRACE_S = 20.0
_VIRTUAL_PATIENCE_S = 60.0  # real seconds that a tick of a virtual clock waits for room
_FROZEN = 2  # repeats from which a camera counts as frozen


@dataclass(eq=False)
class CameraLine:
    """A camera and the series it takes; one thread at a time changes the series."""

    plan: CameraPlan
    station: Station
    begin: float

    def __post_init__(self) -> None:
        plan, runtime = self.plan, self.station.runtime
        self.runtime = runtime
        # what waits of a recording could not be calibrated later: no frame is stored
        self.waits = runtime.fast or plan.camera.recorded
        self.checked: tuple[list[str], str] | None = None  # the result of `check_frame`
        self.run: SeriesRun | None = None
        self._checking = False
        self._started = False
        self._fingerprint: int | None = None  # of the last frame
        self._repeats = 0  # frames since then that are identical to it
        self._swap = threading.Lock()
        self.link = Link(
            "camera", plan.name, plan.camera, runtime.clock, plan.config.period_s, self._event,
            runtime.free_running,
        )  # fmt: skip
        self.loop = DeviceLoop(
            self.link, self._capture, self.begin, runtime.free_running, lambda: not self.taking
        )
        self.take(plan.config.series)

    def identity(self) -> dict[str, Any]:
        """Return the identities that the camera and its thermometers report."""
        names = self.plan.config.thermometers
        links = self.station.thermometers.links
        thermometers = {name: links[name].identity() for name in names}
        return {**self.link.identity(), **({"thermometers": thermometers} if thermometers else {})}

    @property
    def taking(self) -> bool:
        """Whether a series or a check needs frames."""
        return self.run is not None or self._checking

    def start(self) -> None:
        """Start all threads."""
        self._started = True
        if self.run is not None:
            self.run.pipeline.start()
        self.loop.start()

    def take(self, series: str | None, start: str = "", limit: int = 0) -> None:
        """Switch to another series, None for none; ConfigurationError leaves all unchanged.

        The epochs of the old series are finished first; frames that arrive meanwhile belong to the
        new one.
        """
        run = None
        if series is not None:
            plan = replace(self.plan, series=series)
            own = self.station
            run = SeriesRun(
                plan, self.runtime, own.thermometers, own.frames, own.outputs, self.identity,
                own.config.dashboard.enabled, start, limit,
            )  # fmt: skip
        self._replace(run, checking=False)
        if run is not None and self._started:
            run.pipeline.start()

    def check(self) -> None:
        """Check the next frame without storing it; `checked` then holds the result."""
        self.plan.calibrator_of_check()
        self.checked = None
        self._replace(None, checking=True)

    def _replace(self, run: SeriesRun | None, *, checking: bool) -> None:
        with self._swap:
            old, self.run, self._checking = self.run, run, False
        if old is not None and self._started and not old.pipeline.finish(_SWITCH_GRACE_S):
            log.error("camera %s: its last epochs take too long to be stored", self.plan.name)
        # only now, since all series share the calibrator
        if self.plan.calibrator is not None:
            self.plan.calibrator.reset()  # nothing repeats a frame of another series
            if run is not None:
                self.plan.calibrator.seen = run.last_seen()
        self._checking = checking

    def _capture(self) -> None:
        runtime, run = self.runtime, self.run
        # each tick of a virtual clock is an epoch, however long the earlier ones take
        virtual = runtime.fast and not runtime.free_running
        patience_s = _VIRTUAL_PATIENCE_S if virtual else 1.0
        if run is not None and (
            run.full or (self.waits and not run.pipeline.wait_for_room(patience_s))
        ):
            return
        trusted = runtime.clock.trusted()
        frame = self.plan.camera.capture()
        mark, last = frame.fingerprint, self._fingerprint
        self._fingerprint = mark
        self._repeats = self._repeats + 1 if mark is not None and mark == last else 0
        if self._repeats == _FROZEN:  # noise makes identical frames impossible
            text = f"camera {self.plan.name}: {self._frozen()[0]}"
            log.warning(text, extra={"event": "frozen"})
            self._event(frame.utc, "frozen", text)
        names = self.plan.config.thermometers
        self.station.thermometers.read_up_to(names, frame.monotonic)
        if self._checking:
            found = check_frame(self.plan.name, self.plan.calibrator_of_check(), frame)
            if self._checking:
                self._checking, self.checked = False, found
            return
        with self._swap:
            run = self.run
            if run is None or run.full:
                return
            # a step may be followed between the frame's time stamp and now
            run.pipeline.submit(frame, trusted and runtime.clock.trusted())
        if runtime.epochs and run.taken - run.first + 1 >= runtime.epochs:
            self.loop.stop()

    def _frozen(self) -> list[str]:
        """Return the warning of a camera that delivers one frame again and again, else none."""
        text = (
            f"its last {self._repeats + 1} frames are identical: it is frozen, or sees no light; "
            "they are one measurement, not many"
        )
        return [text] if self._repeats >= _FROZEN else []

    def waiting(self) -> int:
        """Return the number of epochs in the pipeline."""
        run = self.run
        return 0 if run is None else run.pipeline.waiting()

    def _event(self, utc: float, kind: str, text: str) -> None:
        """Store an event of the device, with the series being taken."""
        if self.run is None:
            self.runtime.guard.event(utc, kind, text)
        else:
            self.run.record(utc, kind, text)

    def status(self) -> dict[str, Any]:
        """Return the camera's part of the status document."""
        run = self.run
        pipeline = None if run is None else run.pipeline
        link = self.link.status(self.loop.busy_s(), self.runtime.hang_after_s)
        return {
            "series": "" if run is None else run.plan.series,
            "period_s": self.plan.config.period_s,
            **link,
            "warnings": link["warnings"] + self._frozen(),
            **self.loop.schedule.stats(),
            "lost": self.loop.lost + (0 if pipeline is None else pipeline.lost),
            "waiting": self.waiting(),
            "deferred": 0 if pipeline is None else pipeline.dropped,
            "caught_up": 0 if pipeline is None else pipeline.caught_up,
            "stored": 0 if run is None else run.stored,
            "last": {} if run is None else run.last,
        }


_RETENTION_EVERY_S = 600.0
_RETENTION_WHEN_FULL_S = 10.0
_LEAD_S = 0.1


class Station:
    """The devices of a configuration; the constructor raises ConfigurationError."""

    def __init__(self, config: Config, runtime: Runtime) -> None:
        self.config, self.runtime = config, runtime
        clock = runtime.clock
        self.frames = FrameFolder(config.frames)
        self.stopping = threading.Event()  # once set, it cannot be started again
        self._started = False
        begin = clock.monotonic() + _LEAD_S
        self.thermometers = Thermometers(config, clock, runtime.guard.event, fast=runtime.fast)
        self.outputs = [self._output(one, one.options) for one in config.outputs]
        self.cameras = [CameraLine(plan, self, begin) for plan in plan_cameras(config, clock)]
        self._readers = {
            name: DeviceLoop(link, partial(self._read, name), begin)
            for name, link in self.thermometers.links.items()
            if name not in self.thermometers.with_frames
        }
        self._loops = [*self._readers.values(), *(camera.loop for camera in self.cameras)]
        self._retention = threading.Thread(target=self._retain, name="retention", daemon=True)

    def start(self) -> None:
        """Start all threads."""
        self._retention.start()
        for output in self.outputs:
            output.start()
        for loop in self._readers.values():
            loop.start()
        for camera in self.cameras:
            camera.start()
        self._started = True

    def stop(self, grace_s: float, reading_s: float = math.inf) -> bool:
        """Finish the current epochs and stop; return False if a device or output hangs.

        reading_s: how long to wait for thermometers that are being read.
        """
        deadline = time.monotonic() + grace_s
        self.stopping.set()
        for loop in self._loops:
            loop.stop()
        done = True
        for loop in self._loops:
            hangs = loop.busy_s() > self.runtime.hang_after_s  # is not waited for
            left_s = 0.0 if hangs else deadline - time.monotonic() - 0.5 * grace_s
            if loop in self._readers.values():
                left_s = min(left_s, reading_s)
            done &= loop.join(max(0.1, left_s))
        for camera in self.cameras:
            if camera.run is not None:
                pipeline = camera.run.pipeline
                stop = pipeline.finish if camera.waits else pipeline.stop
                done &= stop(max(0.1, deadline - time.monotonic()))
        for output in self.outputs:
            done &= output.stop(max(0.1, min(2.0, deadline - time.monotonic())))
        for name in self.thermometers.with_frames:
            self.thermometers.links[name].close()
        self._retention.join(1.0)
        return done

    def stalled(self) -> list[str]:
        """Return a sentence for each device and pipeline that hangs."""
        busy = [(loop.link.called, loop.busy_s()) for loop in self._loops]
        runs = [camera.run for camera in self.cameras if camera.run is not None]
        busy += [(f"pipeline of {run.plan.name}", run.pipeline.busy_s()) for run in runs]
        return [f"{name} hangs" for name, busy_s in busy if busy_s > self.runtime.hang_after_s]

    @property
    def failed(self) -> bool:
        """Whether a device failed, which this station does not open again."""
        links = [*self.thermometers.links.values(), *(output.link for output in self.outputs)]
        links += [camera.link for camera in self.cameras]
        return any(link.state == "failed" for link in links)

    @property
    def finished(self) -> bool:
        """Whether no camera with a series will take another epoch and all epochs are stored."""
        taking = [camera for camera in self.cameras if camera.run is not None]
        return bool(taking) and all(
            camera.loop.join(0.0) and not camera.waiting() for camera in taking
        )

    def line(self, camera: str) -> CameraLine | None:
        """Return the camera of this name; None if the configuration has none."""
        return next((line for line in self.cameras if line.plan.name == camera), None)

    def heaters(self, programme: Sequence[Mapping[str, Any]]) -> dict[int, OutputLoop]:
        """Return {index in `outputs`: a heating output with another programme}, not started.

        Raises ConfigurationError if no output heats or an output rejects the programme.
        """
        outputs = self.config.outputs
        return {
            i: self._output(outputs[i], {**outputs[i].options, "programme": list(programme)})
            for i in heating_outputs(self.config, "programme")
        }

    def heat(self, programme: Sequence[Mapping[str, Any]]) -> None:
        """Start another programme on the heating outputs; raises as `heaters` does.

        An output that failed stays as it is: one that reached its limit stays off.
        """
        for i, output in self.heaters(programme).items():
            if self.outputs[i].link.state == "failed":
                continue
            old, self.outputs[i] = self.outputs[i], output
            if self._started:
                old.stop(2.0)
                output.start()

    def _output(self, one: OutputConfig, options: Mapping[str, Any]) -> OutputLoop:
        device = open_device("output", one.driver, options, self.runtime.clock)
        return OutputLoop(one.name, device, self.runtime.clock, self.runtime.guard.event)

    def status(self) -> dict[str, Any]:
        """Return the devices' part of the status document."""
        hang_after_s = self.runtime.hang_after_s
        thermometers = {}
        for name, link in self.thermometers.links.items():
            busy_s = self._readers[name].busy_s() if name in self._readers else 0.0
            status = link.status(busy_s, hang_after_s)
            values, missing = self.thermometers.last(name)
            status["warnings"] += missing
            thermometers[name] = {**status, "last": dict(values)}
        return {
            "cameras": {camera.plan.name: camera.status() for camera in self.cameras},
            "thermometers": thermometers,
            "outputs": {
                output.link.name: {
                    **output.link.status(0.0, hang_after_s),
                    "emitted": output.emitted,
                    "lost": output.lost,
                }
                for output in self.outputs
            },
            "frames": {
                "keep": self.config.frames.keep,
                "paused": self.frames.paused,
                "ages_known": self.runtime.clock.settled(),
            },
        }

    def _read(self, name: str) -> None:
        """Read a thermometer; store the reading if no epoch will contain it."""
        clock = self.runtime.clock
        trusted = clock.trusted()
        reading = self.thermometers.read(name)
        in_epochs = any(
            name in line.plan.config.thermometers
            and line.run is not None
            and line.link.state == "open"
            for line in self.cameras
        )
        if not in_epochs:
            # a step may be followed between the reading's time stamp and now
            trusted &= clock.trusted()
            self.runtime.guard.reading(LoggedReading(name, reading.utc, reading.values, trusted))

    def retain(self) -> list[str]:
        """Delete expired frames; return sentences on what was deleted."""
        clock = self.runtime.clock
        deleted = self.frames.enforce(clock.utc() if clock.settled() else None)
        for text in deleted:
            self.runtime.guard.event(clock.utc(), "frames_deleted", text)
        return deleted

    def _retain(self) -> None:
        while True:
            self.retain()
            pause = _RETENTION_WHEN_FULL_S if self.frames.paused else _RETENTION_EVERY_S
            if self.stopping.wait(pause):
                return
