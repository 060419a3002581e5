"""What an overview of a whole fleet needs of a server, and no more: it must not read every epoch.

Of each camera the last epochs, and epochs spread evenly over what it has measured: both are read
through the index on (series, frame_time), at a cost that does not grow with the table.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from thermocald.store.recording.head import parse_head
from thermocald.store.server.connection import Connected

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from thermocald.store.recording.head import Head

__all__ = ["CameraRecord", "FleetReader", "RecentEpoch", "Sample", "StationState"]

RECENT = 60
SPREAD = 120
FEWEST = 6
"""Epochs that are read of the end of a camera's last series, spread over all, and at least each."""

_FIRST, _DAY_S = 946_684_800.0, 86400.0  # before 2000 a clock was not set


@dataclass(frozen=True, slots=True)
class RecentEpoch:
    """One of the last epochs: times in s UTC (received: the server's clock, NaN if not known)."""

    frame_time: float
    received: float
    status: str
    temperatures: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Sample:
    """An epoch with a result: °C of the reference, c, x0, y0 in mm and their sds; its series."""

    series: int
    frame_time: float
    temperature: float
    values: tuple[float, float, float]
    sds: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class StationState:
    """What a station said of itself.

    contact: s UTC, by the server's clock; clock: s, the station's minus the server's; waiting,
    refused: rows.
    """

    contact: float
    clock: float
    waiting: int
    refused: int
    version: str


@dataclass(slots=True)
class CameraRecord:
    """A camera at a station: its last series' head, last epochs (newest first), spread samples."""

    station: str
    camera: str
    series: str
    head: Head
    identity: Mapping[str, Any]
    last_time: float
    recent: list[RecentEpoch] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)


class FleetReader(Connected):
    """A server that is asked about all cameras which its address selects."""

    def now(self) -> float:
        """The server's clock, s UTC."""
        ((now,),) = self._query("SELECT extract(epoch FROM clock_timestamp())::float8", ())
        return float(now)

    def stations(self) -> dict[str, StationState]:
        """What the stations said of themselves, by name."""
        rows = self._query(
            "SELECT name, contact, clock - contact, waiting, refused, version FROM station "
            "WHERE name = coalesce(%s, name)",
            (self.address.station,),
        )
        return {name: StationState(*state) for name, *state in rows}

    def cameras(self, now: float, path: Path) -> list[CameraRecord]:
        """All cameras by station and name; path: of the server, for messages."""
        wanted = self.address
        # an epoch from the future is of a wrong clock: it must not hide those of today
        rows = self._query(
            "SELECT s.key, station, camera, name, head, identity, first.t, last.t FROM series s "
            "CROSS JOIN LATERAL (SELECT frame_time AS t FROM epoch WHERE series = s.key "
            "AND frame_time <= %s ORDER BY frame_time DESC LIMIT 1) last "
            "CROSS JOIN LATERAL (SELECT frame_time AS t FROM epoch WHERE series = s.key "
            "AND frame_time >= %s ORDER BY frame_time LIMIT 1) first "
            "WHERE station = coalesce(%s, station) AND camera = coalesce(%s, camera) "
            "AND name = coalesce(%s, name) ORDER BY station, camera, last.t",
            (now + _DAY_S, _FIRST, wanted.station, wanted.camera, wanted.series),
        )
        records: dict[tuple[str, str], CameraRecord] = {}
        current: dict[Any, CameraRecord] = {}
        spans: list[tuple[Any, str, float, float]] = []
        for key, station, camera, name, head, identity, first, last in rows:
            parsed = parse_head(json.loads(head), path)
            record = CameraRecord(station, camera, name, parsed, json.loads(identity), last)
            if older := records.get((station, camera)):
                current = {k: r for k, r in current.items() if r is not older}
            records[station, camera] = current[key] = record
            spans.append((key, next(iter(parsed.channels), ""), first, max(first, last)))
        owner = {row[0]: records[row[1], row[2]] for row in rows}
        self._read_recent(current, now)
        self._read_samples(spans, owner)
        return list(records.values())

    def _read_recent(self, current: Mapping[Any, CameraRecord], now: float) -> None:
        rows = self._query(
            "SELECT s.key, e.frame_time, e.received, e.status, e.temperatures "
            "FROM unnest(%s::uuid[]) s(key) CROSS JOIN LATERAL (SELECT * FROM epoch "
            "WHERE series = s.key AND frame_time <= %s ORDER BY frame_time DESC LIMIT %s) e "
            "ORDER BY s.key, e.frame_time DESC, e.revision DESC",
            ([*current], now + _DAY_S, RECENT),
        )
        for key, frame_time, received, status, temperatures in rows:
            recent = current[key].recent
            if not recent or recent[-1].frame_time != frame_time:  # an older revision follows
                values = {n: _nan(v) for n, v in json.loads(temperatures).items()}
                recent.append(RecentEpoch(frame_time, _nan(received), status, values))

    def _read_samples(
        self, spans: Sequence[tuple[Any, str, float, float]], owner: Mapping[Any, CameraRecord]
    ) -> None:
        """One epoch of each of equal intervals of every series, where it has one."""
        series_of = Counter((owner[key].station, owner[key].camera) for key, *_ in spans)
        counts = [
            max(FEWEST, SPREAD // series_of[owner[key].station, owner[key].camera])
            for key, *_ in spans
        ]
        keys, channels, firsts, lasts = zip(*spans, strict=True) if spans else ((), (), (), ())
        rows = self._query(
            "SELECT s.key, e.frame_time, (e.temperatures::json->>s.channel)::float8, "
            'e."c", e."x0", e."y0", e."sd_c", e."sd_x0", e."sd_y0" '
            "FROM unnest(%s::uuid[], %s::text[], %s::float8[], %s::float8[], %s::int[]) "
            "s(key, channel, first, last, count) "
            "CROSS JOIN LATERAL generate_series(0, s.count - 1) k "
            # ordered by the index alone: with the revision too, whole intervals would be sorted
            "CROSS JOIN LATERAL (SELECT frame_time AS t FROM epoch "
            "WHERE series = s.key AND frame_time >= s.first + (s.last - s.first) * k / s.count "
            "AND frame_time <= s.first + (s.last - s.first) * (k + 1) / s.count "
            "ORDER BY frame_time LIMIT 1) first CROSS JOIN LATERAL (SELECT * FROM epoch "
            "WHERE series = s.key AND frame_time = first.t ORDER BY revision DESC LIMIT 1) e "
            "WHERE e.status = 'ok' ORDER BY s.first, s.key, e.frame_time",
            ([*keys], [*channels], [*firsts], [*lasts], counts),
        )
        place = {key: i for i, key in enumerate(keys)}
        for key, frame_time, temperature, *numbers in rows:
            c, x0, y0, sd_c, sd_x0, sd_y0 = map(_nan, numbers)
            samples = owner[key].samples
            if not samples or samples[-1].frame_time != frame_time:
                samples.append(
                    Sample(
                        place[key], frame_time, _nan(temperature), (c, x0, y0), (sd_c, sd_x0, sd_y0)
                    )
                )


def _nan(value: float | None) -> float:
    return math.nan if value is None else float(value)
