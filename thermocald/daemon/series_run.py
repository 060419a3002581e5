"""A series that is being taken: its epochs are adjusted together, stored and passed on.

An epoch is stored with its frame first, then its row; then outputs and the live state receive it.
"""

from __future__ import annotations

import logging
import math
import os
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.calibrator import CalibratedEpoch, Calibrator
from thermocald.acquisition.pipeline import PATIENCE_S, Pipeline
from thermocald.daemon.plan import check_series, running_series, series_head
from thermocald.daemon.store_guard import Row
from thermocald.errors import ImageError, StoreError
from thermocald.names import UNEVENTFUL
from thermocald.photogrammetry.camera.camera_model import IOP, PARAMETER_NAMES, PRINCIPAL
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.result import with_sds
from thermocald.store.series import NOT_CALIBRATED, EpochResult, StoredSeries

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from thermocald.acquisition.device_loop import OutputLoop
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.pipeline import AcquiredEpoch
    from thermocald.acquisition.steady_clock import SteadyClock
    from thermocald.acquisition.thermometers import Thermometers
    from thermocald.daemon.live_state import LiveState
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.epoch import Epoch
    from thermocald.store.series import StoredEpoch

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
    which a camera stops, 0 for never.
    """

    guard: StoreGuard
    clock: SteadyClock
    live: LiveState
    fast: bool = False
    free_running: bool = False
    epochs: int = 0
    hang_after_s: float = 60.0


log = logging.getLogger(__name__)

_PREVIEW_EVERY_S = 5.0
_SHOW_EVERY_S = 0.5
_FAILED = 20  # epochs in a row without a result, which are reported
_REMEMBERED = 200  # epochs, as many as a `RunningSeries` holds
_LATEST = 4000  # epochs whose readings still act on effects with a memory
_DETAILED = 100
_CATCH_UP_BATCH, _SEARCHED_AT_ONCE = 200, 10_000


@dataclass(eq=False)
class SeriesRun:
    """A series that is being taken, the `Keeper` of its pipeline.

    plan: with the name of this series; identity: called for that of the devices when the series
    begins; start: its condition; limit: the number of its last epoch, 0 for no limit.
    """

    plan: CameraPlan
    runtime: Runtime
    thermometers: Thermometers
    frames: FrameFolder
    outputs: Sequence[OutputLoop]
    identity: Callable[[], Mapping[str, Any]]
    preview: bool = False
    start: str = ""
    limit: int = 0

    def __post_init__(self) -> None:
        plan, names = self.plan, self.plan.config.thermometers
        self.last: dict[str, Any] = {}
        self.stored = 0
        self._guard = self.runtime.guard
        self._series = self._guard.find(plan.name, plan.series)
        self._backlog: list[Epoch] = []
        self._searched_to = 0
        self._uncorrected = ""
        self._strange: list[str] = []  # channels that are no columns of the series
        self._start: list[dict[str, Any]] | None = None  # rows of the first good epochs
        self._failed = 0  # latest epochs in a row without a result
        self._shown = self._previewed = self._observed = float("-inf")
        if (stored := self.series) is not None:
            check_series(plan, stored, self.thermometers.named_columns(names))
        self.first = 1 if stored is None else self._guard.last_epoch(stored) + 1
        self._observer = self._make_observer()
        self._running = running_series(plan)
        self._remembered = self.first == 1
        patience_s = 0.0 if self.runtime.fast else min(PATIENCE_S, 0.5 * plan.config.period_s)
        self.pipeline = Pipeline(
            plan.name, plan.calibrator, self.thermometers, names, self, self.runtime.clock,
            self.first, patience_s,
        )  # fmt: skip

    @property
    def series(self) -> StoredSeries | None:
        """The series in the store; None before its first epoch."""
        if self._series is not None:
            try:
                self._series = self._guard.series(self._series)
            except StoreError as error:
                log.debug("the series cannot be read now: %s", error)
        return self._series

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
        calibrator = self.plan.calibrator
        if calibrator is None:
            return None
        if isinstance(calibrator, Calibrator):
            from thermocald.analysis.online.observer import OnlineObserver

            return OnlineObserver(calibrator.sensor, calibrator.testfield, self._report)
        # the readings of many, since effects have a memory; the details of the most recent
        detailed = max(0, self.first - 1 - _DETAILED)
        earlier = self.read(detailed - _LATEST, detailed, details=False)
        calibrator.remember([*earlier, *self.read(detailed + 1)])
        calibrator.tell = self._report
        return calibrator

    def _report(self, kind: str, text: str, utc: float, epoch: int) -> None:
        text = f"camera {self.plan.name}: {text}"
        log.warning(text, extra={"event": kind})
        self.record(utc, kind, text, epoch)

    def record(self, utc: float, kind: str, text: str, epoch: int | None = None) -> None:
        """Store an event of the series."""
        series = self.series
        series_id = None if series is None else series.id or None
        self._guard.event(utc, kind, text, series=series_id, epoch=epoch)

    def read(self, first: int, last: int | None = None, **how: bool) -> list[StoredEpoch]:
        """Read some epochs of the series; if they cannot be read, log it and return none."""
        series = self.series
        if series is None:
            return []
        try:
            return self._guard.epochs(series, first, last, **how)
        except StoreError as error:
            log.warning("earlier epochs cannot be read: %s", error)
            return []

    def last_seen(self) -> tuple[float | None, int]:
        """Return the fingerprint of the last stored frame if it was measured, and its epoch."""
        for stored in self.read(self.first - 1, details=False):
            if stored.result.n_observations or stored.result.status == "repeated_frame":
                return stored.extra.get("fingerprint"), stored.epoch.number
        return None, 0

    def observe(self, calibrated: CalibratedEpoch, in_order: bool) -> CalibratedEpoch:
        """Adjust an epoch together with its series, then test it against the earlier epochs."""
        seen, running = calibrated.epoch.observations, self._running
        adjusted, calibrator = calibrated.adjustment, self.plan.calibrator
        columns: dict[str, float] = {}
        if running is not None and seen is not None:
            assert isinstance(calibrator, Calibrator)
            if in_order and not self._remembered and not running.epochs:
                self._remembered = True
                self._remember(calibrator)
            hurried = self.pipeline.waiting() > 1 and not self.runtime.fast
            try:
                adjusted, columns = running.refine(
                    calibrated, calibrator.weighed(seen), hurried=hurried
                )
            except Exception:
                # an error in the series must not lose an epoch that has a result of its own
                log.exception("camera %s: the series cannot be adjusted", self.plan.name)
                running.reset()
                adjusted, columns = calibrated.adjustment, {"series_restarted": 1.0}
            if "series_restarted" in columns:
                self._report(
                    "series_restarted",
                    "several epochs in a row contradict the camera and targets of the earlier "
                    "epochs of their series; the common adjustment starts again",
                    calibrated.epoch.frame_time,
                    calibrated.epoch.number,
                )
        if self._observer is not None and in_order:
            noise = () if running is None else (running.tremble, running.field_variance)
            if calibrated.epoch.frame_time < self._observed and isinstance(calibrator, Calibrator):
                self._observer.forget_course()  # the clock was set back
            self._observed = calibrated.epoch.frame_time
            columns |= self._observer.observe(calibrated, adjusted, *noise)
        return replace(calibrated, adjustment=adjusted, extra={**calibrated.extra, **columns})

    def _remember(self, calibrator: Calibrator) -> None:
        """Fill the running series with the last stored epochs, after a restart."""
        assert self._running is not None
        for stored in self.read(max(1, self.first - _REMEMBERED)):
            epoch = stored.epoch
            if epoch.observations is None or stored.result.status != "ok":
                continue
            if "series_restarted" in stored.extra:
                self._running.reset()
                continue
            seen = calibrator.weighed(epoch.observations)
            alone = CalibratedEpoch(epoch, calibrator.adjust(seen), {})
            self._running.remember(alone, seen, stored.result.values)

    def keep(self, acquired: AcquiredEpoch) -> None:
        """Store an epoch; a deferred calibration is done later from its frame."""
        assert acquired.epoch is not None
        calibrated, plan = acquired.calibrated, self.plan
        series = self._begin_series(acquired)
        epoch = acquired.epoch if calibrated is None else calibrated.epoch
        deferred = calibrated is None and plan.calibrator is not None
        eventful = calibrated is not None and (
            calibrated.adjustment.status not in UNEVENTFUL or "event" in calibrated.extra
        )
        result = None
        extra = {
            key: value
            for name, value in acquired.frame.settings.items()
            if (key := f"camera_{name}") not in epoch.temperatures  # a channel may have this name
        }
        if (mark := acquired.frame.fingerprint) is not None:
            extra["fingerprint"] = float(mark)
        path = None
        if self.frames.wanted(epoch.number, eventful) or deferred:
            path = self.frames.keep(plan.name, plan.series, epoch.number, acquired.frame)
        if calibrated is not None:
            result = EpochResult.from_adjustment(calibrated.adjustment)
            extra |= calibrated.extra
            self._correct(path, calibrated)
        elif deferred and path is None:
            result = EpochResult("frame_not_kept", "calibration deferred, but no frame stored")
            self.pipeline.dropped -= 1  # nothing is left to be done later
        elif deferred:
            result = EpochResult(NOT_CALIBRATED, "calibrated later, when there is time")
        strange = [name for name in epoch.temperatures if name not in series.head.channels]
        if strange and not self._strange:
            text = (
                f"series {plan.series} began without {', '.join(strange)}: no analysis of it shows "
                "them; begin another series"
            )
            self._report("channel_unknown", text, epoch.frame_time, epoch.number)
        self._strange = strange
        epoch = replace(epoch, frame=path)
        row = result_row(plan, epoch, result, extra)
        stored = self._guard.append(Row(series, epoch, result, extra, acquired.clock_trusted))
        self.stored += stored
        self._pass_on(acquired, {**row, "stored": stored, "lost": self._guard.lost})

    def _pass_on(self, acquired: AcquiredEpoch, row: dict[str, Any]) -> None:
        """Pass an epoch that was stored, or refused, on to the outputs and the live state."""
        plan = self.plan
        report = {} if self._observer is None else self._observer.report()
        report |= {} if self._running is None else self._running.report()
        row["state"] = report.get("state", "unknown")
        self._failed = 0 if row["status"] in UNEVENTFUL else self._failed + 1
        if self._failed == _FAILED and plan.calibrator is not None:
            why = f"its last {_FAILED} epochs have no result; {row['status']}: {row['reason']}"
            self._report("no_result", why, row["frame_time"], row["epoch"])
        if plan.sensor is not None:
            if self._start is None:
                first = self.read(1, min(20 * START_EPOCHS, row["epoch"] - 1))
                good = [s for s in first if s.result.status == "ok"][:START_EPOCHS]
                self._start = [result_row(plan, s.epoch, s.result, {}) for s in good]
            if row["status"] == "ok" and len(self._start) < START_EPOCHS:
                self._start.append(dict(row))
            row |= drift_columns(row, self._start, plan.sensor.pixel_pitch)
            result = None if acquired.calibrated is None else acquired.calibrated.adjustment
            if result is not None and result.interior is not None:
                values, covariance = result.interior.as_array(), result.covariance[IOP, IOP]
                row["opencv"] = opencv_terms(plan.sensor, values, covariance)
        self.last = {**row, "online": report}
        for output in self.outputs:
            output.put(row)
        now = time.monotonic()
        if now - self._shown >= _SHOW_EVERY_S:
            self._shown = now
            live = self.runtime.live
            live.write_epoch(plan.name, self.last, acquired.calibrated, plan.testfield)
            if self.preview and now - self._previewed >= _PREVIEW_EVERY_S:
                self._previewed = now
                live.write_frame(plan.name, acquired.frame)

    def amend(self, calibrated: CalibratedEpoch) -> None:
        """Store a deferred calibration; delete a frame that was stored only for it."""
        epoch = calibrated.epoch
        result = EpochResult.from_adjustment(calibrated.adjustment)
        try:
            if self._series is None:
                raise StoreError(f"series {self.plan.series} has not begun")
            self._guard.amend(self._series, calibrated, result)
        except StoreError as error:
            # that the store is away was logged once
            level = logging.DEBUG if self._guard.away else logging.WARNING
            log.log(level, "the calibration of epoch %d waits: %s", epoch.number, error)
            self._searched_to = min(self._searched_to, epoch.number - 1)
            return
        failed = calibrated.adjustment.status not in UNEVENTFUL
        frame = next((s.epoch.frame for s in self.read(epoch.number, epoch.number)), None)
        if frame is not None and not self.frames.wanted(epoch.number, failed):
            self.frames.delete(frame)
        else:
            self._correct(frame, calibrated)

    def _correct(self, frame: Path | None, calibrated: CalibratedEpoch) -> None:
        """Store a frame again, as a camera without drift would take it; log a failure once."""
        if frame is None or self.plan.corrector is None:
            return
        try:
            encoded = (self.frames.root / frame).read_bytes()
            jpeg = self.plan.corrector.correct(encoded, calibrated)
        except (ImageError, OSError) as error:
            if str(error) != self._uncorrected:
                log.warning("camera %s: frames cannot be corrected: %s", self.plan.name, error)
            self._uncorrected = str(error)
            return
        self._uncorrected = ""
        self.frames.keep_corrected(frame, jpeg)

    def backlog(self, below: int) -> Epoch | None:
        """Return the oldest epoch that was stored without calibration and still has its frame.

        A call searches some epochs, each once: all of a year take minutes, in which new epochs
        would wait for their calibration.
        """
        series, first = self.series, self._searched_to + 1
        if series is not None and not self._backlog and first < below:
            try:
                end = min(below - 1, self._guard.last_epoch(series, waiting=False))
                end = min(end, first + _SEARCHED_AT_ONCE - 1)
                found = self._guard.store.deferred_epochs(series, first, end, _CATCH_UP_BATCH)
                # not tried again if they cannot be read: a damaged row stays damaged
                end = found[-1] if len(found) == _CATCH_UP_BATCH else end
                self._searched_to = max(self._searched_to, end)
                for number in found:
                    for stored in self._guard.epochs(series, number, number, details=False):
                        path = self.frames.root / (stored.epoch.frame or "")
                        if os.path.isfile(path):  # False, too, in a closed folder
                            self._backlog.append(replace(stored.epoch, frame=path))
                            self.pipeline.dropped += number < self.first
            except StoreError as error:
                log.warning("epochs with a deferred calibration cannot be read: %s", error)
        return self._backlog.pop(0) if self._backlog else None

    def lose(self, why: str) -> None:
        """Count an epoch that was taken and will not be stored."""
        self._guard.lose(why)

    def _begin_series(self, acquired: AcquiredEpoch) -> StoredSeries:
        """Return the series; the store creates it with its first row, when it can be written."""
        if self._series is None:
            assert acquired.epoch is not None
            channels = acquired.epoch.temperatures
            head, field, settings = series_head(self.plan, acquired.frame, channels)
            utc, identity = acquired.frame.utc, self.identity()
            self._series = StoredSeries(0, head, field, self.start, identity, settings, utc)
            text = f"camera {self.plan.name}: series {self.plan.series} begins"
            self.record(utc, "series_begun", text, acquired.number)
        return self._series


def result_row(
    plan: CameraPlan, epoch: Epoch, result: EpochResult | None, extra: Mapping[str, float]
) -> dict[str, Any]:
    """Return an epoch's row for outputs: the CSV export's columns, `device`, `series`, channels.

    temperature: °C, the reference thermometer's at `temperature_time`; missing numbers are NaN.
    """
    kept = result or EpochResult(NOT_CALIBRATED)
    return {
        "device": plan.name,
        "series": plan.series,
        "epoch": epoch.number,
        "frame_time": epoch.frame_time,
        "temperature_time": epoch.temperature_time,
        **epoch.temperatures,
        "temperature": next(iter(epoch.temperatures.values()), math.nan),
        **with_sds(PARAMETER_NAMES, kept.values, kept.sd),
        "sigma0": kept.sigma0,
        "n_observations": kept.n_observations,
        "n_rejected": len(kept.rejected),
        "status": kept.status,
        "reason": kept.reason,
        **extra,
    }
