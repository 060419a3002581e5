"""A camera from its device to the store; its series may change while the device stays open.

    device loop ─► frame ─► a series: pipeline ─► keeper ─► store, outputs, live state
                      └───► or the check before a session

While neither needs frames, the device is closed, so that a phone cools down for a cold start.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.calibrator import CalibratedEpoch, Calibrator
from thermocald.acquisition.device_loop import DeviceLoop, Link
from thermocald.acquisition.pipeline import Pipeline, check_frame
from thermocald.daemon.epoch_keeper import EpochKeeper, result_row
from thermocald.daemon.plan import check_series, running_series
from thermocald.names import UNEVENTFUL
from thermocald.photogrammetry.camera.camera_model import IOP, PARAMETER_NAMES, PRINCIPAL
from thermocald.photogrammetry.camera.conversions import opencv_terms

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.acquisition.device_loop import OutputLoop
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.pipeline import AcquiredEpoch
    from thermocald.acquisition.steady_clock import SteadyClock
    from thermocald.acquisition.thermometers import Thermometers
    from thermocald.daemon.live_state import LiveState
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.store_guard import StoreGuard

START_EPOCHS = 10
"""The start of a series is the mean of this many first epochs with a result."""
_NAMES = PARAMETER_NAMES[PRINCIPAL]


def drift_columns(
    row: Mapping[str, Any], start: Sequence[Mapping[str, Any]], pixel_pitch: float
) -> dict[str, float]:
    """Return the columns `drift_c_px`, `sd_drift_c_px` … for an epoch's row.

    start: the rows of the first epochs of the series with a result, pixel_pitch: mm. NaN without a
    result and until the start is complete. The standard deviation assumes independent epochs: an
    error that they share cancels in the difference, so that it is too large rather than too small.
    """
    known = row["status"] == "ok" and len(start) == START_EPOCHS
    result = {"pixel_pitch": pixel_pitch}
    for name in _NAMES:
        drift = sd = math.nan
        if known:
            mean = sum(s[name] for s in start) / START_EPOCHS
            variance = sum(s[f"sd_{name}"] ** 2 for s in start) / START_EPOCHS**2
            drift = (row[name] - mean) / pixel_pitch
            sd = math.sqrt(row[f"sd_{name}"] ** 2 + variance) / pixel_pitch
        result |= {f"drift_{name}_px": drift, f"sd_drift_{name}_px": sd}
    return result


@dataclass(frozen=True)
class Runtime:
    """The store, clock and run options, which stay the same when the configuration is reloaded.

    fast: take epochs as fast as they can be calibrated, at the ticks of a virtual clock, or
    free_running: of a recording, without ticks and pauses; epochs: the number of new epochs after
    which a camera stops, 0 for never; start_condition: stored with a new series.
    """

    guard: StoreGuard
    clock: SteadyClock
    live: LiveState
    fast: bool = False
    free_running: bool = False
    epochs: int = 0
    hang_after_s: float = 60.0
    start_condition: str = ""


log = logging.getLogger(__name__)

_PREVIEW_EVERY_S = 5.0
_SHOW_EVERY_S = 0.5
_SWITCH_GRACE_S = 20.0
_VIRTUAL_PATIENCE_S = 60.0  # real seconds that a tick of a virtual clock waits for room
_FAILED = 20  # epochs in a row without a result, which are reported
_FROZEN = 2  # repeats from which a camera counts as frozen
_REMEMBERED = 200  # epochs, as many as a `RunningSeries` holds
_LATEST = 4000  # epochs whose readings still act on effects with a memory
_DETAILED = 100


class SeriesRun:
    """A series that is being taken: its keeper, online estimate and pipeline.

    limit: the number of its last epoch, 0 for no limit.
    """

    def __init__(self, line: CameraLine, series: str, start: str, limit: int) -> None:
        runtime, plan = line.runtime, replace(line.plan, series=series)
        self.plan = plan
        self.limit = limit
        self._line = line
        self.keeper = EpochKeeper(
            plan, runtime.guard, line.frames, self._kept, line.identity, start=start
        )
        if (stored := self.keeper.series) is not None:
            check_series(plan, stored, line.thermometers.named_columns(plan.config.thermometers))
        calibrator = plan.calibrator
        self._calibrator = calibrator if isinstance(calibrator, Calibrator) else None
        self.observer = self._make_observer()
        self.running = running_series(plan)
        self._remembered = False
        self.first = self.keeper.first_number
        self.pipeline = Pipeline(
            plan.name,
            plan.calibrator,
            line.thermometers,
            plan.config.thermometers,
            self.keeper,
            runtime.clock,
            first=self.first,
            period_s=plan.config.period_s,
            patience_s=0.0 if runtime.fast else None,
            trusted=runtime.clock.trusted,
            observe=self._observe,
            on_lost=runtime.guard.lose,
        )
        self._start: list[dict[str, Any]] | None = None  # rows of the first good epochs
        self.last: dict[str, Any] = {}
        self._failed = 0  # latest epochs in a row without a result
        self._shown = self._previewed = float("-inf")

    @property
    def taken(self) -> int:
        """The number of the last epoch that entered the pipeline, 0 for none."""
        return self.pipeline.next_number - 1

    @property
    def full(self) -> bool:
        """Whether all epochs up to the limit were taken."""
        return bool(self.limit) and self.taken >= self.limit

    def _make_observer(self) -> Any:
        """Return the camera's online estimate; None if the camera is not calibrated."""
        plan = self.plan
        if plan.sensor is None or plan.testfield is None or plan.calibrator is None:
            return None
        if isinstance(plan.calibrator, Calibrator):
            from thermocald.analysis.online.observer import OnlineObserver

            return OnlineObserver(plan.sensor, plan.testfield, self._record)
        from thermocald.analysis.thermal.gauge import GaugeObserver

        # the readings of many, since effects have a memory; the details of the most recent
        detailed = max(0, self.keeper.first_number - 1 - _DETAILED)
        earlier = self.keeper.read(detailed - _LATEST, detailed, details=False)
        plan.calibrator.remember([*earlier, *self.keeper.read(detailed + 1)])
        return GaugeObserver(plan.calibrator, self._record)

    def _record(self, kind: str, text: str, utc: float, epoch: int) -> None:
        log.warning("camera %s: %s", self.plan.name, text, extra={"event": kind})
        self.keeper.record(utc, kind, text, epoch)

    def _observe(self, calibrated: CalibratedEpoch, in_order: bool) -> CalibratedEpoch:
        """Adjust an epoch together with its series, then test it against the earlier epochs."""
        seen = calibrated.epoch.observations
        adjusted = calibrated.adjustment
        columns: dict[str, float] = {}
        if self.running is not None and self._calibrator is not None and seen is not None:
            if in_order and self.first > 1 and not self.running.epochs:
                self._remember()
            hurried = self.pipeline.waiting() > 1 and not self._line.runtime.fast
            try:
                adjusted, columns = self.running.refine(
                    calibrated, self._calibrator.weighed(seen), hurried=hurried
                )
            except Exception:
                # an error in the series must not lose an epoch that has a result of its own
                log.exception("camera %s: the series cannot be adjusted", self.plan.name)
                self.running.reset()
                adjusted, columns = calibrated.adjustment, {"series_restarted": 1.0}
            if "series_restarted" in columns:
                self._record(
                    "series_restarted",
                    "several epochs in a row contradict the camera and targets of the earlier "
                    "epochs of their series; the common adjustment starts again",
                    calibrated.epoch.frame_time,
                    calibrated.epoch.number,
                )
        if self.observer is not None and in_order:
            running = self.running
            noise = () if running is None else (running.tremble, running.field_variance)
            columns |= self.observer.observe(calibrated, adjusted, *noise)
        return replace(calibrated, adjustment=adjusted, extra={**calibrated.extra, **columns})

    def _remember(self) -> None:
        """Fill the running series with the last stored epochs, after a restart."""
        if self._remembered:
            return
        self._remembered = True
        assert self.running is not None
        assert self._calibrator is not None
        for stored in self.keeper.read(max(1, self.first - _REMEMBERED)):
            epoch = stored.epoch
            if epoch.observations is None or stored.result.status != "ok":
                continue
            if "series_restarted" in stored.extra:
                self.running.reset()
                continue
            seen = self._calibrator.weighed(epoch.observations)
            alone = CalibratedEpoch(epoch, self._calibrator.adjust(seen), {})
            self.running.remember(alone, seen, stored.result.values)

    def _kept(self, acquired: AcquiredEpoch, row: dict[str, Any]) -> None:
        """Pass a stored epoch on to the outputs and the live state."""
        line, name = self._line, self.plan.name
        report = {} if self.observer is None else self.observer.report()
        report |= {} if self.running is None else self.running.report()
        row["state"] = report.get("state", "unknown")
        self._failed = 0 if row["status"] in UNEVENTFUL else self._failed + 1
        if self._failed == _FAILED and self.plan.calibrator is not None:
            why = f"its last {_FAILED} epochs have no result; {row['status']}: {row['reason']}"
            self._record("no_result", why, row["frame_time"], row["epoch"])
        if self.plan.sensor is not None:
            if self._start is None:
                first = self.keeper.read(1, min(20 * START_EPOCHS, row["epoch"] - 1))
                good = [s for s in first if s.result.status == "ok"][:START_EPOCHS]
                self._start = [result_row(self.plan, s.epoch, s.result, {}) for s in good]
            if row["status"] == "ok" and len(self._start) < START_EPOCHS:
                self._start.append(dict(row))
            row |= drift_columns(row, self._start, self.plan.sensor.pixel_pitch)
            result = None if acquired.calibrated is None else acquired.calibrated.adjustment
            if result is not None and result.interior is not None:
                values, covariance = result.interior.as_array(), result.covariance[IOP, IOP]
                row["opencv"] = opencv_terms(self.plan.sensor, values, covariance)
        self.last = {**row, "online": report}
        for output in line.outputs:
            output.put(row)
        now = time.monotonic()
        if now - self._shown >= _SHOW_EVERY_S:
            self._shown = now
            live = line.runtime.live
            live.write_epoch(name, self.last, acquired.calibrated, self.plan.testfield)
            if line.preview and now - self._previewed >= _PREVIEW_EVERY_S:
                self._previewed = now
                live.write_frame(name, acquired.frame)


class CameraLine:
    """A camera and the series it takes; only the service's thread changes the series."""

    def __init__(
        self,
        plan: CameraPlan,
        runtime: Runtime,
        thermometers: Thermometers,
        frames: FrameFolder,
        outputs: list[OutputLoop],
        begin: float,
        *,
        preview: bool = False,
    ) -> None:
        self.plan, self.runtime, self.preview = plan, runtime, preview
        self.thermometers, self.frames, self.outputs = thermometers, frames, outputs
        self.checked: tuple[list[str], str] | None = None  # the result of `check_frame`
        self.run: SeriesRun | None = None
        self._checking = False
        self._started = False
        self._fingerprint: int | None = None  # of the last frame
        self._repeats = 0  # frames since then that are identical to it
        self._swap = threading.Lock()
        self.link = Link(
            "camera", plan.name, plan.camera, runtime.clock,
            period_s=plan.config.period_s,
            on_event=self._event, free_running=runtime.free_running,
        )  # fmt: skip
        self.loop = DeviceLoop(
            self.link, self._capture, runtime.clock, plan.config.period_s, begin,
            free_running=runtime.free_running, idle=lambda: not self.taking,
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
        run = None if series is None else SeriesRun(self, series, start, limit)
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
                self.plan.calibrator.seen = run.keeper.last_seen()
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
            run.pipeline.submit(frame)
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
            self.run.keeper.record(utc, kind, text)

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
            "stored": 0 if run is None else run.keeper.stored,
            "frames_kept": 0 if run is None else run.keeper.kept_frames,
            "last": {} if run is None else run.last,
        }
