"""What a fleet looks like: of each camera how far behind it is, how it moves with temperature.

The rates of c, x0 and y0 come from epochs that are spread over all that a camera has measured. They
hold no effect but a straight line: they compare specimens, a model to correct with is made by
`thermocald fit`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.dependence import dependence
from thermocald.analysis.statistics.random_effects import odd_specimens, population
from thermocald.store.server.fleet_reader import FleetReader

if TYPE_CHECKING:
    from collections.abc import Sequence
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
        sum(e.status == "ok" for e in recent) / len(recent) if recent else math.nan,
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
    scatter = 1.4826 * float(np.median(np.abs(before - np.median(before))))
    sd = 1.2533 * scatter * math.sqrt(1 / len(before) + 1 / last)
    return size, size / sd if sd > 0 else math.inf if size > 0 else 0.0
