"""A configuration at work: its device loops, pipelines, outputs and retention of frames.

    thermometer loops ─► readings ─┐
    camera loops ─► pipelines ─────┴─► keepers ─► store ─► outputs, live state

Cameras and thermometers start at the same time: with equal periods, frames and temperatures are
taken together.
"""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.device_loop import DeviceLoop, OutputLoop
from thermocald.acquisition.frame_folder import FrameFolder
from thermocald.acquisition.thermometers import Thermometers
from thermocald.daemon.camera_line import CameraLine
from thermocald.daemon.plan import plan_cameras
from thermocald.errors import ConfigurationError
from thermocald.hal import load_driver, open_device
from thermocald.store.series import LoggedReading

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.config import Config, OutputConfig
    from thermocald.daemon.series_run import Runtime


_RETENTION_EVERY_S = 600.0
_RETENTION_WHEN_FULL_S = 10.0
_LEAD_S = 0.1


class Station:
    """The devices of a configuration; the constructor raises ConfigurationError."""

    def __init__(self, config: Config, runtime: Runtime) -> None:
        self.config, self.runtime = config, runtime
        clock = runtime.clock
        self.frames = FrameFolder(config.frames)
        self.logged = 0  # readings stored apart from epochs
        self._stop = threading.Event()
        self._started = False
        begin = clock.monotonic() + _LEAD_S
        self.thermometers = Thermometers(config, clock, runtime.guard.event, fast=runtime.fast)
        self.outputs = [self._output(one, one.options) for one in config.outputs]
        self.cameras = [
            CameraLine(
                plan, runtime, self.thermometers, self.frames, self.outputs, begin,
                config.dashboard.enabled,
            )
            for plan in plan_cameras(config, clock)
        ]  # fmt: skip
        self._readers = {
            one.name: DeviceLoop(
                self.thermometers.links[one.name], partial(self._read, one.name), clock,
                one.period_s, begin,
            )
            for one in config.thermometers
            if one.name not in self.thermometers.with_frames
        }  # fmt: skip
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

    def stop(self, grace_s: float) -> bool:
        """Finish the current epochs and stop; return False if a device or output hangs."""
        deadline = time.monotonic() + grace_s
        self._stop.set()
        for loop in self._loops:
            loop.stop()
        done = True
        for loop in self._loops:
            done &= loop.join(max(0.1, deadline - time.monotonic() - 0.5 * grace_s))
        for camera in self.cameras:
            if camera.run is not None:
                done &= camera.run.pipeline.stop(max(0.1, deadline - time.monotonic()))
        for output in self.outputs:
            done &= output.stop(max(0.1, min(2.0, deadline - time.monotonic())))
        for name in self.thermometers.with_frames:
            self.thermometers.links[name].close()
        self._retention.join(1.0)
        return done

    @property
    def stopped(self) -> bool:
        """Whether it was told to stop; it cannot be started again."""
        return self._stop.is_set()

    def stalled(self) -> list[str]:
        """Return a sentence for each device and pipeline that hangs."""
        busy = [(loop.link.called, loop.busy_s()) for loop in self._loops]
        busy += [(f"pipeline of {camera.plan.name}", camera.busy_s()) for camera in self.cameras]
        return [f"{name} hangs" for name, busy_s in busy if busy_s > self.runtime.hang_after_s]

    @property
    def failed(self) -> bool:
        """Whether a device failed, which this station does not open again."""
        links = [*self.thermometers.links.values(), *(output.link for output in self.outputs)]
        links += [camera.link for camera in self.cameras]
        return any(link.state == "failed" for link in links)

    @property
    def finished(self) -> bool:
        """Whether no camera will take another epoch and all epochs are stored."""
        return bool(self.cameras) and all(
            camera.loop.join(0.0) and not camera.waiting() for camera in self.cameras
        )

    def line(self, camera: str) -> CameraLine | None:
        """Return the camera of this name; None if the configuration has none."""
        return next((line for line in self.cameras if line.plan.name == camera), None)

    def heaters(self, programme: Sequence[Mapping[str, Any]]) -> dict[int, OutputLoop]:
        """Return {index in `outputs`: a heating output with another programme}, not started.

        Raises ConfigurationError if no output heats or an output rejects the programme.
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
        return {
            "cameras": {camera.plan.name: camera.status() for camera in self.cameras},
            "thermometers": {
                name: self._thermometer_status(name) for name in self.thermometers.links
            },
            "outputs": {
                output.link.name: {
                    **output.link.status(0.0, hang_after_s),
                    "emitted": output.emitted,
                    "lost": output.lost,
                }
                for output in self.outputs
            },
            "readings_logged": self.logged,
            "frames": {
                "keep": self.config.frames.keep,
                "paused": self.frames.paused,
                "ages_known": self.runtime.clock.settled(),
            },
        }

    def _thermometer_status(self, name: str) -> dict[str, Any]:
        busy_s = self._readers[name].busy_s() if name in self._readers else 0.0
        link = self.thermometers.links[name].status(busy_s, self.runtime.hang_after_s)
        values, missing = self.thermometers.last(name)
        return {**link, "warnings": link["warnings"] + missing, "last": dict(values)}

    def _read(self, name: str) -> None:
        """Read a thermometer; store the reading if no epoch will contain it."""
        reading = self.thermometers.read(name)
        in_epochs = any(
            name in line.plan.config.thermometers
            and line.run is not None
            and line.link.state == "open"
            for line in self.cameras
        )
        if not in_epochs:
            trusted = self.runtime.clock.trusted()
            self.runtime.guard.reading(LoggedReading(name, reading.utc, reading.values, trusted))
            self.logged += 1

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
            if self._stop.wait(pause):
                return
