"""What a person should look at in a fleet: one word and one sentence for each finding.

`late`: no epoch for a while, because of the station, its network, or its daemon; `sensor`: a
thermometer that gives nothing, the same for hours, or what cannot be; `calibrate`: no result, an
old one, a temperature outside what was calibrated, a camera that moved; `odd`: rates unlike those
of the other cameras of its type; `clock`: a station whose clock is not that of the server;
`refused`: rows that the server does not take; `twins`: two stations of one name.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from thermocald.durations import short_duration
from thermocald.fleet.overview import ODD, RATED, Finding

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from thermocald.fleet.overview import CameraOverview, TypeOverview


_LATE_INTERVALS, _LATE_S = 20.0, 900.0
_SILENT_S = 600.0
_CLOCK_S = 5.0
_FUTURE_S = 60.0
_FEWEST = 10
_STUCK_S = 6 * 3600.0
_PLAUSIBLE_C = (-60.0, 125.0)
_POWER_ON_C = 85.0  # of a DS18B20 that has measured nothing
_LEAST_OK = 0.5
_OLD_S = 30 * 86400.0
_OUTSIDE_K = 2.0
_SHIFT_PX, _SHIFT_SDS = 0.3, 6.0


def add_findings(
    cameras: Sequence[CameraOverview], types: Sequence[TypeOverview], now: float
) -> None:
    """Fill `findings` of all cameras; now: s UTC, by the server's clock."""
    of_name = {name: kind for kind in types for name in kind.cameras}
    for camera in cameras:
        camera.findings = [
            *_late(camera, now),
            *_sensors(camera),
            *_calibration(camera, now),
            *_odd(camera, of_name.get(camera.name)),
            *_clock(camera),
        ]


def _late(camera: CameraOverview, now: float) -> Iterator[Finding]:
    limit = max(_LATE_INTERVALS * camera.record.head.interval, _LATE_S)
    if camera.lag_s > limit:
        since = f"no epoch for {short_duration(camera.lag_s)}"
        state = camera.state
        if state is None:
            yield Finding("late", f"{since}; its station has never reported")
        elif now - state.contact > _SILENT_S:
            yield Finding(
                "late",
                f"{since}; its station was last heard {short_duration(now - state.contact)} ago: "
                "power or network",
            )
        elif state.waiting:
            yield Finding(
                "late", f"{since}; {state.waiting} rows wait at its station and are coming"
            )
        else:
            yield Finding(
                "late", f"{since}, though its station reports: the camera or its daemon stands"
            )
    if camera.state is not None and camera.state.stores > 1:
        yield Finding(
            "twins",
            f"{camera.state.stores} stores report under its station's name: the card of one is a "
            "copy; give each station its own name (forward.station)",
        )
    if camera.state is not None and camera.state.refused:
        yield Finding(
            "refused",
            f"the server refused {camera.state.refused} rows of its station; its log names them",
        )


def _sensors(camera: CameraOverview) -> Iterator[Finding]:
    for i, channel in enumerate(camera.record.head.channels):
        read = [e.temperatures.get(channel, math.nan) for e in camera.record.recent]
        if len(read) >= _FEWEST and (trouble := _trouble(camera, read, reference=i == 0)):
            yield Finding("sensor", f"{channel}: {trouble}")


def _trouble(camera: CameraOverview, read: Sequence[float], *, reference: bool) -> str:
    """What is wrong with a thermometer's last readings (newest first); empty: nothing."""
    known = [t for t in read if math.isfinite(t)]
    if not known:
        return f"no reading in the last {len(read)} epochs"
    if not any(map(math.isfinite, read[:_FEWEST])):
        return f"has stopped, no reading in the last {_FEWEST} epochs"
    if not _PLAUSIBLE_C[0] < known[0] < _PLAUSIBLE_C[1]:
        return f"reads {known[0]:g} °C, which cannot be"
    if len(known) >= _FEWEST and {*known} == {_POWER_ON_C}:
        return "reads 85 °C, which a DS18B20 gives that has measured nothing"
    if reference and (since := _stuck_for(camera, known)) >= _STUCK_S:
        return f"has read exactly {known[0]:g} °C for {short_duration(since)}"
    return ""


def _stuck_for(camera: CameraOverview, known: Sequence[float]) -> float:
    """For how long the reference has not changed by a bit, s."""
    if len(known) < _FEWEST or len({*known}) > 1:
        return 0.0
    since = camera.record.recent[-1].frame_time
    for sample in reversed(camera.record.samples):
        if sample.temperature != known[0]:
            break
        since = min(since, sample.frame_time)
    return camera.record.last_time - since


def _calibration(camera: CameraOverview, now: float) -> Iterator[Finding]:
    recent = camera.record.recent
    if len(recent) >= _FEWEST and camera.ok < _LEAST_OK:
        failed = [e.status for e in recent if e.status != "ok"]
        often = max(sorted({*failed}), key=failed.count)
        yield Finding(
            "calibrate", f"{len(failed)} of the last {len(recent)} epochs have no result: {often}"
        )
    if not math.isfinite(camera.last_ok):
        yield Finding("calibrate", "was never calibrated")
        return
    if now - camera.last_ok > _OLD_S and camera.lag_s < _OLD_S:
        yield Finding("calibrate", f"the last result is {short_duration(now - camera.last_ok)} old")
    low, high = camera.range
    outside = max(low - camera.temperature, camera.temperature - high)
    if outside > _OUTSIDE_K:
        yield Finding(
            "calibrate",
            f"{camera.temperature:.1f} °C is {outside:.0f} K outside of {low:.0f} to {high:.0f} °C "
            "that it was calibrated at",
        )
    if not camera.rates and math.isfinite(low):
        yield Finding(
            "calibrate",
            f"calibrated from {low:.0f} to {high:.0f} °C only: how it moves with temperature is "
            "not known; warm it up, or take its type's model (fit --type)",
        )
    if camera.shift_px > _SHIFT_PX and camera.shift_sds > _SHIFT_SDS:
        yield Finding(
            "calibrate", f"has lately moved by {camera.shift_px:.1f} px from its own line"
        )


def _odd(camera: CameraOverview, kind: TypeOverview | None) -> Iterator[Finding]:
    if kind is None or not camera.odd < ODD:
        return

    def distance(name: str) -> float:
        rate = camera.rates[name]
        return abs(rate.value - kind.mean[name]) / math.hypot(rate.sd, kind.between[name], 1e-12)

    name = max(RATED, key=distance)
    yield Finding(
        "odd",
        f"{name} moves by {camera.rates[name].value * 1e3:+.3f} µm/K, the others "
        f"by {kind.mean[name] * 1e3:+.3f} ± {kind.between[name] * 1e3:.3f} (p = {camera.odd:.1g})",
    )


def _clock(camera: CameraOverview) -> Iterator[Finding]:
    state = camera.state
    if state is not None and abs(state.clock) > _CLOCK_S:
        way = "ahead of" if state.clock > 0 else "behind"
        yield Finding(
            "clock",
            f"its station's clock is {short_duration(abs(state.clock))} {way} the server's; "
            "epochs keep the station's time",
        )
    elif camera.lag_s < -_FUTURE_S:
        yield Finding("clock", f"its last epoch is {short_duration(-camera.lag_s)} in the future")
