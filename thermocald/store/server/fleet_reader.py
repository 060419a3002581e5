"""What an overview of a whole fleet needs of a server, and no more: it must not read every epoch.

Of each camera the last epochs, through the index on (series, frame_time), and the summary that the
server keeps of every series in slots of six hours: the cost grows with cameras and days, not with
epochs. Of a series too short for the summary, epochs spread evenly over it are read instead.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from thermocald.store.recording.head import parse_head
from thermocald.store.server.connection import Connected

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from thermocald.arrays import Array
    from thermocald.store.recording.head import Head


RECENT = 60
_COMPARED = 12  # of them, with others of the same number
SPREAD = 120
FEWEST = 6
"""Epochs that are read of the end of a camera's last series, spread over all, and at least each."""

_FIRST, _DAY_S = 946_684_800.0, 86400.0  # before 2000 a clock was not set
_SLOTS = "slot BETWEEN thermocald_slot(%s) AND thermocald_slot(%s)"


class RecentEpoch(NamedTuple):
    """One of the last epochs: times in s UTC (received: the server's clock, NaN if not known)."""

    frame_time: float
    received: float
    status: str
    temperatures: Mapping[str, float]


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


@dataclass(frozen=True, slots=True)
class Rate:
    """A change with temperature, mm/K, and its standard deviation."""

    value: float
    sd: float
    unit: str = "mm/K"


@dataclass(slots=True, eq=False)
class FleetCamera:
    """A camera at a station, as a server knows it, and from `state` on its overview.

    head, identity: of its last series; epochs, results: of all; last_ok: s UTC, of the last epoch
    with a result; range: °C of the reference in all epochs with a result; both NaN without; recent:
    the last epochs, newest first; samples (n, 9): series, frame_time, °C of the reference, c, its
    sd, x0, sd, y0, sd (mm) of epochs with a result spread over all; copied: whether one of the last
    epochs was taken at two times, as two copies of one store take them.

    lag_s: since its last epoch, by the server's clock; on_the_way_s: the median time that its last
    epochs took to the server, NaN if not known; ok: fraction of its last epochs with a result;
    temperature: °C, the last of the reference, NaN without; shift_px: how far c, x0 or y0 has left
    its own line lately, and in standard deviations; odd: the probability that a camera of this type
    is as unlike the others, NaN where that is not known; findings: what a person should look at:
    kind, one word, see `fleet.overview`, and text, a sentence.
    """

    JSON: ClassVar = {
        "head": "", "identity": "", "last_time": "last_epoch", "last_ok": "", "range": "",
        "copied": "", "recent": "", "samples": "", "state": "", "calibrated_range":
        "temperature_range", "shift_sds": "", "odd": "odd_p", "waiting": "waiting",
        "clock_s": "clock_s", "version": "version",
    }  # fmt: skip

    station: str
    camera: str
    series: str
    head: Head
    identity: Mapping[str, Any]
    last_time: float
    epochs: int
    results: int
    last_ok: float
    range: tuple[float, float]
    copied: bool = False
    recent: list[RecentEpoch] = field(default_factory=list)
    samples: Array = field(default_factory=lambda: np.empty((0, 9)))
    type: str = ""
    state: StationState | None = None
    lag_s: float = math.nan
    on_the_way_s: float = math.nan
    ok: float = math.nan
    temperature: float = math.nan
    rates: dict[str, Rate] = field(default_factory=dict)
    shift_px: float = math.nan
    shift_sds: float = math.nan
    odd: float = math.nan
    findings: list[dict[str, str]] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"{self.station}/{self.camera}"

    @property
    def calibrated_range(self) -> tuple[float, float] | None:
        """`range`, None without a result."""
        return self.range if math.isfinite(self.range[0]) else None

    @property
    def waiting(self) -> int | None:
        """How many rows wait at its station."""
        return None if self.state is None else self.state.waiting

    @property
    def clock_s(self) -> float | None:
        """Its station's clock minus the server's."""
        return None if self.state is None else self.state.clock

    @property
    def version(self) -> str | None:
        """Its station's program."""
        return None if self.state is None else self.state.version


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

    def cameras(self, now: float, path: Path) -> list[FleetCamera]:
        """All cameras by station and name; path: of the server, for messages."""
        from psycopg.rows import namedtuple_row

        wanted = self.address
        # an epoch from the future is of a wrong clock: it must not hide those of today
        sane = (_FIRST, now + _DAY_S)
        # first, last: s UTC, of a series' epochs; sampled: how many of its slots have a sample
        statement = (
            "SELECT s.key, station, camera, name, head, identity, min(first) AS first, "
            "max(last) AS last, sum(epochs)::bigint AS epochs, sum(ok)::bigint AS results, "
            "max(last_ok) AS last_ok, min(low) AS low, max(high) AS high, "
            "count(sample) AS sampled FROM series s JOIN summary ON series = s.key "
            f"WHERE {_SLOTS} AND station = coalesce(%s, station) "
            "AND camera = coalesce(%s, camera) AND name = coalesce(%s, name) "
            "GROUP BY s.key ORDER BY station, camera, max(last)"
        )
        values = (*sane, wanted.station, wanted.camera, wanted.series)
        with (
            self._transaction("it cannot be read") as connection,
            connection.cursor(row_factory=namedtuple_row) as cursor,
        ):
            series: list[Any] = cursor.execute(statement, values).fetchall()
        heads = {one.key: parse_head(json.loads(one.head), path) for one in series}
        owned: list[tuple[FleetCamera, list[Any]]] = []
        for _, found in groupby(series, key=lambda one: (one.station, one.camera)):
            every = list(found)
            newest = every[-1]
            camera = FleetCamera(
                newest.station, newest.camera, newest.name, heads[newest.key],
                json.loads(newest.identity), newest.last,
                sum(one.epochs for one in every), sum(one.results for one in every),
                _extreme(max, (one.last_ok for one in every)),
                (_extreme(min, (o.low for o in every)), _extreme(max, (o.high for o in every))),
            )  # fmt: skip
            owned.append((camera, every))
        self._read_recent({every[-1].key: camera for camera, every in owned})
        self._read_samples(owned, heads, sane)
        return [camera for camera, _ in owned]

    def _read_recent(self, current: Mapping[Any, FleetCamera]) -> None:
        """The last epochs; the summary says in which slots they are, so in which month.

        A series is copied where one of the newest was taken at two times: by two stores.
        """
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
        owned: Sequence[tuple[FleetCamera, list[Any]]],
        heads: Mapping[Any, Head],
        sane: tuple[float, float],
    ) -> None:
        """Epochs with a result of every series, spread over it: its slots', where they suffice."""
        counted = [(o, max(FEWEST, SPREAD // len(every))) for _, every in owned for o in every]
        long = [(one, count) for one, count in counted if one.sampled >= count]
        short = [(one, count) for one, count in counted if one.sampled < count]
        # odd: with four slots a day, every time of day has its turn
        steps = [(one.sampled // count) | 1 for one, count in long]
        found = self._query(
            "SELECT series, sample FROM (SELECT series, sample, step, "
            "row_number() OVER (PARTITION BY series ORDER BY slot DESC) AS place "
            "FROM unnest(%s::uuid[], %s::int[]) s(key, step) JOIN summary ON series = s.key "
            f"WHERE sample IS NOT NULL AND {_SLOTS}) counted WHERE (place - 1) %% step = 0",
            ([one.key for one, _ in long], steps, *sane),
        )
        # one epoch in each of equal intervals of a short series
        found += self._query(
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
                [one.key for one, _ in short],
                [next(iter(heads[one.key].channels), "") for one, _ in short],
                [one.first for one, _ in short],
                [one.last for one, _ in short],
                [count for _, count in short],
            ),
        )
        samples: dict[Any, dict[float, list[float]]] = defaultdict(dict)
        for key, (frame_time, _, *numbers) in found:  # neighbouring intervals may share one
            samples[key][frame_time] = [frame_time, *numbers]
        for camera, every in owned:
            rows = [
                [i, *s] for i, one in enumerate(every) for _, s in sorted(samples[one.key].items())
            ]
            camera.samples = np.array(rows, dtype=float).reshape(-1, 9)


def _extreme(of: Callable[[list[float]], float], values: Iterable[float | None]) -> float:
    known = [v for v in values if v is not None and not math.isnan(v)]
    return of(known) if known else math.nan


def _nan(value: float | None) -> float:
    return math.nan if value is None else float(value)
