"""A camera from its device to the store; its series may change while the device stays open.

    device loop ─► frame ─► the pipeline of a `SeriesRun`
                      └───► or the check before a session

While neither needs frames, the device is closed, so that a phone cools down for a cold start.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.device_loop import DeviceLoop, Link
from thermocald.acquisition.pipeline import check_frame
from thermocald.daemon.series_run import SeriesRun

if TYPE_CHECKING:
    from thermocald.acquisition.device_loop import OutputLoop
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.thermometers import Thermometers
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.series_run import Runtime

log = logging.getLogger(__name__)

_SWITCH_GRACE_S = 20.0
_VIRTUAL_PATIENCE_S = 60.0  # real seconds that a tick of a virtual clock waits for room
_FROZEN = 2  # repeats from which a camera counts as frozen


@dataclass(eq=False)
class CameraLine:
    """A camera and the series it takes; only the service's thread changes the series."""

    plan: CameraPlan
    runtime: Runtime
    thermometers: Thermometers
    frames: FrameFolder
    outputs: list[OutputLoop]
    begin: float
    preview: bool

    def __post_init__(self) -> None:
        plan, runtime = self.plan, self.runtime
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
            self.link, self._capture, runtime.clock, plan.config.period_s, self.begin,
            runtime.free_running, lambda: not self.taking,
        )  # fmt: skip
        self.take(plan.config.series, runtime.start_condition)

    def identity(self) -> dict[str, Any]:
        """Return the identities that the camera and its thermometers report."""
        names = self.plan.config.thermometers
        thermometers = {name: self.thermometers.links[name].identity() for name in names}
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
            run = SeriesRun(
                plan, self.runtime, self.thermometers, self.frames, self.outputs, self.identity,
                self.preview, start, limit,
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
        patience_s = 1.0 if runtime.free_running else _VIRTUAL_PATIENCE_S
        if run is not None and (
            run.full or (runtime.fast and not run.pipeline.wait_for_room(patience_s))
        ):
            return
        frame = self.plan.camera.capture()
        mark, last = frame.fingerprint, self._fingerprint
        self._fingerprint = mark
        self._repeats = self._repeats + 1 if mark is not None and mark == last else 0
        if self._repeats == _FROZEN:  # noise makes identical frames impossible
            text = f"camera {self.plan.name}: {self._frozen()[0]}"
            log.warning(text, extra={"event": "frozen"})
            self._event(frame.utc, "frozen", text)
        self.thermometers.read_up_to(self.plan.config.thermometers, frame.monotonic)
        if self._checking:
            found = check_frame(self.plan.name, self.plan.calibrator_of_check(), frame)
            if self._checking:
                self._checking, self.checked = False, found
            return
        with self._swap:
            run = self.run
            if run is None or run.full:
                return
            run.pipeline.submit(frame, runtime.clock.trusted())
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

    def busy_s(self) -> float:
        """Return how long the pipeline has been working on one step, s."""
        run = self.run
        return 0.0 if run is None else run.pipeline.busy_s()

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
            "frames_kept": 0 if run is None else run.kept_frames,
            "last": {} if run is None else run.last,
        }
