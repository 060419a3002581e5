"""What an overview of a whole fleet needs of a server, and no more: it must not read every epoch.

Of each camera the last epochs, through the index on (series, frame_time), and the summary that the
server keeps of every series in slots of six hours: the cost grows with cameras and days, not with
epochs. Of a series too short for the summary, epochs spread evenly over it are read instead.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from thermocald.store.recording.head import parse_head
from thermocald.store.server.connection import Connected

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from thermocald.store.recording.head import Head


RECENT = 60
_COMPARED = 12  # of them, with others of the same number
SPREAD = 120
FEWEST = 6
"""Epochs that are read of the end of a camera's last series, spread over all, and at least each."""

_FIRST, _DAY_S = 946_684_800.0, 86400.0  # before 2000 a clock was not set
_SLOTS = "slot BETWEEN thermocald_slot(%s) AND thermocald_slot(%s)"


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
    refused: rows; stores: how many stores reported under its name within an hour.
    """

    contact: float
    clock: float
    waiting: int
    refused: int
    version: str
    stores: int = 1


@dataclass(slots=True)
class CameraRecord:
    """A camera at a station: its last series' head, last epochs (newest first), spread samples.

    epochs, results: of all its series; last_ok: s UTC, of the last epoch with a result; range: °C
    of the reference in all epochs with a result; both NaN without; copied: whether one of its last
    epochs was taken at two times, as two copies of one store take them.
    """

    station: str
    camera: str
    series: str
    head: Head
    identity: Mapping[str, Any]
    last_time: float
    epochs: int = 0
    results: int = 0
    last_ok: float = math.nan
    range: tuple[float, float] = (math.nan, math.nan)
    copied: bool = False
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
            "SELECT DISTINCT ON (name) name, contact, clock - contact, waiting, refused, version, "
            "(SELECT count(*) FROM station other WHERE other.name = station.name "
            "AND other.contact > station.contact - 3600) FROM station "
            "WHERE name = coalesce(%s, name) ORDER BY name, contact DESC",
            (self.address.station,),
        )
        return {name: StationState(*state) for name, *state in rows}

    def cameras(self, now: float, path: Path) -> list[CameraRecord]:
        """All cameras by station and name; path: of the server, for messages."""
        wanted = self.address
        # an epoch from the future is of a wrong clock: it must not hide those of today
        sane = (_FIRST, now + _DAY_S)
        rows = self._query(
            "SELECT s.key, station, camera, name, head, identity, min(first), max(last), "
            "sum(epochs)::bigint, sum(ok)::bigint, max(last_ok), min(low), max(high), "
            "count(sample) FROM series s JOIN summary ON series = s.key "
            f"WHERE {_SLOTS} AND station = coalesce(%s, station) "
            "AND camera = coalesce(%s, camera) AND name = coalesce(%s, name) "
            "GROUP BY s.key ORDER BY station, camera, max(last)",
            (*sane, wanted.station, wanted.camera, wanted.series),
        )
        records: dict[tuple[str, str], CameraRecord] = {}
        current: dict[Any, CameraRecord] = {}
        spans: list[_Span] = []
        for key, station, camera, name, head, identity, first, last, *found in rows:
            parsed = parse_head(json.loads(head), path)
            record = CameraRecord(station, camera, name, parsed, json.loads(identity), last)
            if older := records.get((station, camera)):
                current = {k: r for k, r in current.items() if r is not older}
                record.epochs, record.results = older.epochs, older.results
                record.last_ok, record.range = older.last_ok, older.range
            _add_up(record, *found[:-1])
            records[station, camera] = current[key] = record
            reference = next(iter(parsed.channels), "")
            spans.append(_Span(key, reference, first, last, found[-1]))
        owner = {row[0]: records[row[1], row[2]] for row in rows}
        self._read_recent(current)
        self._read_samples(spans, owner, sane)
        return list(records.values())

    def _read_recent(self, current: Mapping[Any, CameraRecord]) -> None:
        """The last epochs; the summary says in which slots they are, so in which month."""
        rows = self._query(
            "SELECT s.key, e.frame_time, e.received, e.status, e.temperatures, e.number, "
            "e.revision "
            "FROM unnest(%s::uuid[], %s::float8[]) s(key, last) "
            "CROSS JOIN LATERAL (SELECT min(first) AS t FROM (SELECT first, "
            "sum(epochs) OVER (ORDER BY slot DESC) - epochs AS later FROM summary "
            "WHERE series = s.key AND slot <= thermocald_slot(s.last) ORDER BY slot DESC LIMIT %s) "
            "counted WHERE later < %s) since CROSS JOIN LATERAL (SELECT * FROM epoch "
            "WHERE series = s.key AND frame_time BETWEEN since.t AND s.last "
            "ORDER BY frame_time DESC LIMIT %s) e "
            "ORDER BY s.key, e.frame_time DESC, e.revision DESC",
            ([*current], [r.last_time for r in current.values()], RECENT, RECENT, RECENT),
        )
        newest: list[tuple[Any, int, int, float]] = []
        for key, frame_time, received, status, temperatures, number, revision in rows:
            recent = current[key].recent
            if len(recent) < _COMPARED:
                newest.append((key, number, revision, frame_time))
            if not recent or recent[-1].frame_time != frame_time:  # an older revision follows
                values = {n: _nan(v) for n, v in json.loads(temperatures).items()}
                recent.append(RecentEpoch(frame_time, _nan(received), status, values))

        self._find_copies(current, newest)

    def _find_copies(
        self,
        current: Mapping[Any, CameraRecord],
        newest: Sequence[tuple[Any, int, int, float]],
    ) -> None:
        """Mark series of which one of the newest epochs was taken at two times: by two stores."""
        columns = [list(column) for column in zip(*newest, strict=True)] or [[]] * 4
        for (key,) in self._query(
            "SELECT DISTINCT s.key FROM unnest(%s::uuid[], %s::int8[], %s::int4[], %s::float8[]) "
            "s(key, number, revision, at) WHERE EXISTS (SELECT FROM epoch o WHERE o.series = s.key "
            "AND o.number = s.number AND o.revision = s.revision AND o.frame_time <> s.at)",
            tuple(columns),
        ):
            current[key].copied = True

    def _read_samples(
        self,
        spans: Sequence[_Span],
        owner: Mapping[Any, CameraRecord],
        sane: tuple[float, float],
    ) -> None:
        """Epochs with a result of every series, spread over it."""
        series_of = Counter(id(owner[span.key]) for span in spans)
        short: list[tuple[_Span, int]] = []
        long: list[tuple[_Span, int]] = []
        for span in spans:
            count = max(FEWEST, SPREAD // series_of[id(owner[span.key])])
            (long if span.slots >= count else short).append((span, count))
        found = [*self._from_summary(long, sane), *self._from_epochs(short)]
        place = {span.key: i for i, span in enumerate(spans)}
        for key, (frame_time, _, *numbers) in sorted(found, key=lambda f: (place[f[0]], f[1][0])):
            temperature, c, sd_c, x0, sd_x0, y0, sd_y0 = map(_nan, numbers)
            samples = owner[key].samples
            one = Sample(place[key], frame_time, temperature, (c, x0, y0), (sd_c, sd_x0, sd_y0))
            if not samples or (samples[-1].series, samples[-1].frame_time) != (
                one.series, one.frame_time,
            ):  # fmt: skip
                samples.append(one)

    def _from_summary(
        self, spans: Sequence[tuple[_Span, int]], sane: tuple[float, float]
    ) -> list[tuple[Any, Any]]:
        """(series, sample) of every so many-th slot."""
        # odd: with four slots a day, every time of day has its turn
        steps = [(span.slots // count) | 1 for span, count in spans]
        return self._query(
            "SELECT series, sample FROM (SELECT series, sample, step, "
            "row_number() OVER (PARTITION BY series ORDER BY slot DESC) AS place "
            "FROM unnest(%s::uuid[], %s::int[]) s(key, step) JOIN summary ON series = s.key "
            f"WHERE sample IS NOT NULL AND {_SLOTS}) counted WHERE (place - 1) %% step = 0",
            ([span.key for span, _ in spans], steps, *sane),
        )

    def _from_epochs(self, spans: Sequence[tuple[_Span, int]]) -> list[tuple[Any, Any]]:
        """(series, sample) of one epoch in each of equal intervals of a series."""
        return self._query(
            "SELECT s.key, ARRAY[e.frame_time, e.number, "
            "(e.temperatures::json->>s.channel)::float8, "
            'e."c", e."sd_c", e."x0", e."sd_x0", e."y0", e."sd_y0"] '
            "FROM unnest(%s::uuid[], %s::text[], %s::float8[], %s::float8[], %s::int[]) "
            "s(key, channel, first, last, count) "
            "CROSS JOIN LATERAL generate_series(0, s.count - 1) k "
            # ordered by the index alone: with the revision too, whole intervals would be sorted
            "CROSS JOIN LATERAL (SELECT frame_time AS t FROM epoch "
            "WHERE series = s.key AND frame_time >= s.first + (s.last - s.first) * k / s.count "
            "AND frame_time <= s.first + (s.last - s.first) * (k + 1) / s.count "
            "ORDER BY frame_time LIMIT 1) first CROSS JOIN LATERAL (SELECT * FROM epoch "
            "WHERE series = s.key AND frame_time = first.t ORDER BY revision DESC LIMIT 1) e "
            "WHERE e.status = 'ok'",
            (
                [span.key for span, _ in spans],
                [span.reference for span, _ in spans],
                [span.first for span, _ in spans],
                [span.last for span, _ in spans],
                [count for _, count in spans],
            ),
        )


class _Span(NamedTuple):
    """A series: key, reference temperature, first and last epoch (s UTC), slots with a sample."""

    key: Any
    reference: str
    first: float
    last: float
    slots: int


def _add_up(
    record: CameraRecord,
    epochs: int,
    results: int,
    last_ok: float | None,
    low: float | None,
    high: float | None,
) -> None:
    """Add one series of a camera to what is known of it."""
    record.epochs += epochs
    record.results += results
    record.last_ok = _extreme(max, record.last_ok, last_ok)
    record.range = _extreme(min, record.range[0], low), _extreme(max, record.range[1], high)


def _extreme(of: Callable[[list[float]], float], known: float, new: float | None) -> float:
    values = [v for v in (known, _nan(new)) if not math.isnan(v)]
    return of(values) if values else math.nan


def _nan(value: float | None) -> float:
    return math.nan if value is None else float(value)
