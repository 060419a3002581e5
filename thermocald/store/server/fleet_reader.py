"""Read from a server what an overview of a whole fleet needs, without reading every epoch.

Of each camera, the last epochs are read through the index on (series, frame_time), and the summary
that the server has of every series in slots of six hours. The cost grows with cameras and days, not
with epochs. Of a series too short for the summary, epochs spread evenly over it are read instead.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from thermocald.store.database.epochs import number_or_nan, parse_numbers
from thermocald.store.recording.head import parse_head
from thermocald.store.server.connection import Connected

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.arrays import Array
    from thermocald.store.recording.head import Head


RECENT = 60
_COMPARED = 12  # of these, compared with other epochs of the same number
SPREAD = 120
FEWEST = 6
"""Numbers of epochs read at a camera's end, spread over all its series, and per series at least."""

_FIRST, _DAY_S = 946_684_800.0, 86400.0  # a time before 2000 is of a clock that was not set
_SLOTS = "slot BETWEEN thermocald_slot(%s) AND thermocald_slot(%s)"


class RecentEpoch(NamedTuple):
    """One of the last epochs; times in s UTC; received: by the server's clock, NaN if unknown."""

    frame_time: float
    received: float
    status: str
    temperatures: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class StationState:
    """A station's state as it reported it; all None if it never did.

    contact: s UTC, by the server's clock; clock: s, the station's minus the server's; waiting,
    refused: numbers of rows; stores: number of stores that reported under its name within an hour.
    """

    JSON: ClassVar = {"contact": "", "clock": "clock_s", "refused": "", "stores": ""}

    contact: float | None = None
    clock: float | None = None
    waiting: int | None = None
    refused: int | None = None
    version: str | None = None
    stores: int = 1


@dataclass(frozen=True, slots=True)
class Rate:
    """A change with temperature, mm/K, and its standard deviation."""

    value: float
    sd: float
    unit: str = "mm/K"


@dataclass(slots=True, eq=False)
class FleetCamera:
    """A camera of a station: its data on a server and, from `state` on, its overview.

    head, identity: of its last series; epochs, results: numbers over all series; last_ok: s UTC, of
    the last epoch with a result, NaN without one; temperature_range: °C of the reference in all
    epochs with a result; recent: the last epochs, newest first; samples (n, 9): series, frame_time,
    °C of the reference, c, sd, x0, sd, y0, sd (mm) of epochs with a result, spread over all;
    copied: whether one of the last epochs has two times, as two copies of one store give.

    lag_s: time since the last epoch, by the server's clock; on_the_way_s: median time of the last
    epochs' transfer, NaN if unknown; ok: fraction of the last epochs with a result; temperature:
    °C, the last of the reference, NaN without; shift_px: recent deviation of c, x0 or y0 from its
    own line; shift_sds: the same in standard deviations; odd: the probability that a camera of this
    type differs as much from the others, NaN if unknown; findings for the user: kind, one word, see
    `fleet.overview`, and text, a sentence.
    """

    JSON: ClassVar = {
        "head": "", "identity": "", "last_time": "last_epoch", "last_ok": "", "copied": "",
        "recent": "", "samples": "", "state": "*", "shift_sds": "", "odd": "odd_p",
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
    temperature_range: tuple[float, float] | None
    copied: bool = False
    recent: list[RecentEpoch] = field(default_factory=list)
    samples: Array = field(default_factory=lambda: np.empty((0, 9)))
    type: str = ""
    state: StationState = StationState()
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
    def now(self) -> float:
        """The clock of the camera's server when it was read, s UTC."""
        return self.last_time + self.lag_s


class FleetReader(Connected):
    """A server, to read the state of all cameras that its address selects."""

    def now(self) -> float:
        """Return the server's clock, s UTC."""
        ((now,),) = self._query("SELECT extract(epoch FROM clock_timestamp())::float8", ())
        return float(now)

    def stations(self) -> dict[str, StationState]:
        """Return the states that stations reported, by name."""
        rows = self._query(
            "SELECT DISTINCT ON (name) name, contact, clock - contact, waiting, refused, version, "
            "(SELECT count(*) FROM station other WHERE other.name = station.name "
            "AND other.contact > station.contact - 3600) FROM station "
            "WHERE name = coalesce(%s, name) ORDER BY name, contact DESC",
            (self.address.station,),
        )
        return {name: StationState(*state) for name, *state in rows}

    def cameras(self, now: float) -> list[FleetCamera]:
        """Return all cameras, by station and name."""
        from psycopg.rows import namedtuple_row

        wanted = self.address
        # an epoch of a wrong clock in the future must not hide today's
        sane = (_FIRST, now + _DAY_S)
        # first, last: s UTC, of a series' epochs; sampled: number of its slots with a sample
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
        heads = {one.key: parse_head(json.loads(one.head), str(wanted)) for one in series}
        owned: list[tuple[FleetCamera, list[Any]]] = []
        for _, found in groupby(series, key=lambda one: (one.station, one.camera)):
            every = list(found)
            newest = every[-1]
            low = min((one.low for one in every if one.low is not None), default=math.nan)
            high = max((one.high for one in every if one.high is not None), default=math.nan)
            camera = FleetCamera(
                newest.station, newest.camera, newest.name, heads[newest.key],
                json.loads(newest.identity), newest.last,
                sum(one.epochs for one in every), sum(one.results for one in every),
                max((one.last_ok for one in every if one.last_ok is not None), default=math.nan),
                (low, high) if math.isfinite(low) else None,
            )  # fmt: skip
            owned.append((camera, every))
        self._read_recent({every[-1].key: camera for camera, every in owned})
        self._read_samples(owned, heads, sane)
        return [camera for camera, _ in owned]

    def _read_recent(self, current: Mapping[Any, FleetCamera]) -> None:
        """Read the last epochs; the summary gives their slots, and so the months to search.

        A series is copied if one of its newest epochs has two times: those of two stores.
        """
        rows = self._query(
            "SELECT s.key, e.frame_time, e.received, e.status, e.temperatures, "
            "CASE WHEN e.place <= %s THEN EXISTS (SELECT FROM epoch o WHERE o.series = s.key "
            "AND o.number = e.number AND o.revision = e.revision "
            "AND o.frame_time <> e.frame_time) ELSE false END "
            "FROM unnest(%s::uuid[], %s::float8[]) s(key, last) "
            "CROSS JOIN LATERAL (SELECT min(first) AS t FROM (SELECT first, "
            "sum(epochs) OVER (ORDER BY slot DESC) - epochs AS later FROM summary "
            "WHERE series = s.key AND slot <= thermocald_slot(s.last) ORDER BY slot DESC LIMIT %s) "
            "counted WHERE later < %s) since CROSS JOIN LATERAL (SELECT *, "
            "row_number() OVER (ORDER BY frame_time DESC) AS place FROM epoch "
            "WHERE series = s.key AND frame_time BETWEEN since.t AND s.last "
            "ORDER BY frame_time DESC LIMIT %s) e "
            "ORDER BY s.key, e.frame_time DESC, e.revision DESC",
            (_COMPARED, [*current], [r.last_time for r in current.values()], *[RECENT] * 3),
        )
        for key, frame_time, received, status, temperatures, copied in rows:
            camera = current[key]
            camera.copied |= copied
            # an older revision follows
            if not camera.recent or camera.recent[-1].frame_time != frame_time:
                values = parse_numbers(temperatures)
                read = RecentEpoch(frame_time, number_or_nan(received), status, values)
                camera.recent.append(read)

    def _read_samples(
        self,
        owned: Sequence[tuple[FleetCamera, list[Any]]],
        heads: Mapping[Any, Head],
        sane: tuple[float, float],
    ) -> None:
        """Read epochs with a result, spread over each series: from its slots if these suffice."""
        counted = [(o, max(FEWEST, SPREAD // len(every))) for _, every in owned for o in every]
        long = [(one, count) for one, count in counted if one.sampled >= count]
        short = [(one, count) for one, count in counted if one.sampled < count]
        # an odd step visits all four slots of a day
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
            # ordered by the index only; to order by revision too, whole intervals would be sorted
            "CROSS JOIN LATERAL (SELECT frame_time AS t FROM epoch "
            "WHERE series = s.key AND frame_time >= s.first + (s.last - s.first) * k / s.count "
            "AND frame_time <= s.first + (s.last - s.first) * (k + 1) / s.count "
            "ORDER BY frame_time LIMIT 1) first CROSS JOIN LATERAL (SELECT * FROM epoch "
            "WHERE series = s.key AND frame_time = first.t ORDER BY revision DESC LIMIT 1) e "
            "WHERE e.status = 'ok'",
            (
                [one.key for one, _ in short],
                [next(iter(heads[one.key].channels), "") for one, _ in short],
                *([getattr(one, end) for one, _ in short] for end in ("first", "last")),
                [count for _, count in short],
            ),
        )
        samples: dict[Any, dict[float, list[float]]] = defaultdict(dict)
        for key, (frame_time, _, *numbers) in found:  # adjacent intervals may share an epoch
            samples[key][frame_time] = [frame_time, *numbers]
        for camera, every in owned:
            rows = [
                [i, *s] for i, one in enumerate(every) for _, s in sorted(samples[one.key].items())
            ]
            camera.samples = np.array(rows, dtype=float).reshape(-1, 9)
