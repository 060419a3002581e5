"""What a fleet looks like: of each camera how far behind it is, how it moves with temperature, and
what a person should look at.

The rates of c, x0 and y0 come from epochs that are spread over all that a camera has measured. They
hold no effect but a straight line: they compare specimens, a model to correct with is made by
`thermocald fit`.

A finding is one word and one sentence. `late`: no epoch for a while, because of the station, its
network, or its daemon; `sensor`: a thermometer that gives nothing, the same for hours, or what
cannot be; `calibrate`: no result, an old one, a temperature outside what was calibrated, a camera
that moved; `odd`: rates unlike those of the other cameras of its type; `clock`: a station whose
clock is not that of the server; `refused`: rows that the server does not take; `twins`: two
stations of one name, or with copies of one store.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.dependence import dependence
from thermocald.analysis.statistics.random_effects import odd_specimens, population
from thermocald.names import WITH_VALUES
from thermocald.numbers import short_duration
from thermocald.photogrammetry.linalg import MAD_TO_SD
from thermocald.store.server.fleet_reader import FleetReader

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.store.server.connection import ServerAddress
    from thermocald.store.server.fleet_reader import CameraRecord, StationState

RATED = ("c", "x0", "y0")
ODD = 0.01
"""Probability below which a camera is called unlike its type."""
_FEWEST_SAMPLES = 6
_FEWEST_SPECIMENS = 4
_RESOLUTION = 0.02  # K, of a thermometer that does not state one
_LEAST_RANGE_K = 2.0


@dataclass(frozen=True, slots=True)
class Rate:
    """A change with temperature, mm/K, and its standard deviation."""

    value: float
    sd: float


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that a person should look at: one word of `findings`, and a sentence."""

    kind: str
    text: str


@dataclass(slots=True)
class CameraOverview:
    """One camera of the fleet.

    lag_s: since its last epoch, by the server's clock; on_the_way_s: the median time that its last
    epochs took to the server, NaN if not known; ok: fraction of its last epochs with a result;
    temperature: °C, the last of the reference, NaN without; range: °C, of its epochs with a result;
    shift_px: how far c, x0 or y0 has left its own line lately, and in standard deviations; odd:
    the probability that a camera of this type is as unlike the others, NaN where that is not known.
    """

    record: CameraRecord
    type: str
    state: StationState | None
    lag_s: float
    on_the_way_s: float
    ok: float
    last_ok: float
    temperature: float
    range: tuple[float, float]
    rates: dict[str, Rate]
    shift_px: float
    shift_sds: float
    odd: float = math.nan
    findings: list[Finding] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"{self.record.station}/{self.record.camera}"


@dataclass(frozen=True, slots=True)
class TypeOverview:
    """A type: its cameras, and mean, sd between specimens and sd of the mean of each rate, mm/K."""

    name: str
    cameras: tuple[str, ...]
    mean: dict[str, float]
    between: dict[str, float]
    sd_mean: dict[str, float]


def read_overview(address: ServerAddress, path: Path) -> tuple[float, list[CameraOverview]]:
    """The server's time (s UTC) and all cameras that an address selects; path: for messages.

    Raises ServerGone, ServerError, StoreVersionError.
    """
    with FleetReader(address) as reader:
        now = reader.now()
        stations = reader.stations()
        records = reader.cameras(now, path)
    return now, [_camera(record, stations.get(record.station), now) for record in records]


def camera_types(cameras: Sequence[CameraOverview]) -> list[TypeOverview]:
    """The types of which enough specimens are known; sets `odd` of their cameras."""
    groups: dict[str, list[CameraOverview]] = defaultdict(list)
    for camera in cameras:
        if len(camera.rates) == len(RATED):
            groups[camera.type].append(camera)
    found = []
    for name, group in sorted(groups.items()):
        if len(group) < _FEWEST_SPECIMENS:
            continue
        values = np.array([[c.rates[p].value for p in RATED] for c in group])
        sds = np.array([[c.rates[p].sd for p in RATED] for c in group])
        covariances = np.einsum("ij,jk->ijk", sds**2, np.eye(len(RATED)))
        for camera, odd in zip(group, odd_specimens(values, covariances), strict=True):
            camera.odd = float(odd)
        # what is odd is not of the type: it would hide behind a scatter of its own making
        like = np.array([c.odd >= ODD for c in group])
        if like.sum() < _FEWEST_SPECIMENS:
            like[:] = True
        people = population(values[like], covariances[like])
        between = np.sqrt(np.diag(people.between))
        sd_mean = np.sqrt(np.diag(people.mean_covariance))
        found.append(
            TypeOverview(
                name,
                tuple(c.name for c in group),
                dict(zip(RATED, people.mean.tolist(), strict=True)),
                dict(zip(RATED, between.tolist(), strict=True)),
                dict(zip(RATED, sd_mean.tolist(), strict=True)),
            )
        )
    return found


def _camera(record: CameraRecord, state: StationState | None, now: float) -> CameraOverview:
    recent = record.recent
    reference = next(iter(record.head.channels), "")
    read = [e.temperatures.get(reference, math.nan) for e in recent]
    known = [t for t in read if math.isfinite(t)]
    on_the_way = [e.received - e.frame_time for e in recent if math.isfinite(e.received)]
    rates, shift_px, shift_sds = _rates(record)
    return CameraOverview(
        record,
        _type(record),
        state,
        now - record.last_time,
        float(np.median(on_the_way)) if on_the_way else math.nan,
        sum(e.status in WITH_VALUES for e in recent) / len(recent) if recent else math.nan,
        record.last_ok,
        known[0] if known else math.nan,
        record.range,
        rates,
        shift_px,
        shift_sds,
    )


def _type(record: CameraRecord) -> str:
    """What the camera says that it is, else what its images are like."""
    identity, camera = record.identity, record.head.camera
    model = str(identity.get("model") or identity.get("card") or "").strip()
    size = f"{camera.sensor.width}×{camera.sensor.height}"
    return f"{model} {size}" if model else f"{size}, {camera.sensor.pixel_pitch * 1000:g} µm"


def _rates(record: CameraRecord) -> tuple[dict[str, Rate], float, float]:
    """Rates by parameter; the largest recent departure from their lines, px and in sds."""
    samples = [
        s
        for s in record.samples
        if math.isfinite(s.temperature) and all(map(math.isfinite, (*s.values, *s.sds)))
    ]
    pitch = record.head.camera.sensor.pixel_pitch
    if len(samples) < _FEWEST_SAMPLES:
        return {}, math.nan, math.nan
    temperature = np.array([s.temperature for s in samples])
    of = np.array([s.series for s in samples])
    centred = _about_series_means(temperature, of)
    if np.ptp(centred) < _LEAST_RANGE_K:
        return {}, math.nan, math.nan
    resolution = next(iter(record.head.channels.values())).resolution or _RESOLUTION
    rates: dict[str, Rate] = {}
    shift = (0.0, 0.0)
    for j, name in enumerate(RATED):
        values = _about_series_means(np.array([s.values[j] for s in samples]), of)
        sds = np.array([s.sds[j] for s in samples])
        if not np.ptp(values) > 0:
            return {}, math.nan, math.nan
        line = dependence(values, sds, centred, resolution / math.sqrt(12))
        rates[name] = Rate(line.slope, line.sd_slope)
        shift = max(shift, _shift(values - line.slope * centred), key=lambda s: s[1])
    return rates, shift[0] / pitch, shift[1]


def _about_series_means(values: Array, of: NDArray[np.int64]) -> Array:
    """Values (n,) minus the mean of their series: another set-up has another level."""
    centred = values.copy()
    for one in np.unique(of):
        centred[of == one] -= values[of == one].mean()
    return centred


def _shift(residual: Array) -> tuple[float, float]:
    """How far the last tenth of the residuals (n,) is from the others: size, and in its sds.

    Robust against single errors: medians, and the scatter from the median absolute deviation.
    """
    last = max(3, len(residual) // 10)
    before, after = residual[:-last], residual[-last:]
    size = abs(float(np.median(after) - np.median(before)))
    scatter = MAD_TO_SD * float(np.median(np.abs(before - np.median(before))))
    sd = 1.2533 * scatter * math.sqrt(1 / len(before) + 1 / last)
    return size, size / sd if sd > 0 else math.inf if size > 0 else 0.0


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
    if camera.record.copied:
        yield Finding(
            "twins",
            "epochs of one number were taken at two times: its store runs at two stations, or a "
            "backup was restored; move the store of a copied card away, and it makes its own",
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
        failed = [e.status for e in recent if e.status not in WITH_VALUES]
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
