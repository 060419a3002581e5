"""Series of many cameras, made by the server itself: for benchmarks and tests of whole fleets.

A camera's temperature follows the day and the year; c, x0 and y0 follow it with the camera's own
rates, and all that a row holds is as large as of a camera that looks at 147 targets.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from uuid import UUID

import numpy as np

from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.store.database.epochs import pack_covariance, pack_observations
from thermocald.store.recording.head import CameraSpec, Channel, Head, head_document
from thermocald.store.recording.testfield_file import testfield_csv
from thermocald.store.series import StoredSeries
from thermocald.store.server.reader import series_key

if TYPE_CHECKING:
    from psycopg import Connection

PITCH = 0.00112
TARGETS = 147
STORE = "00000000-0000-0000-0000-000000000001"


@dataclass(frozen=True)
class GeneratedCamera:
    """One camera's series, ending at `end` (s UTC); rates mm/K; sql: what differs, by column.

    sql: expressions over n (epoch number), t (its time), warm (°C) and noise, each in
    place of the usual one: `temperature`, `status`, `c`, `x0`, `y0`.
    """

    station: str
    camera: str = "cam"
    model: str = "imx219"
    epochs: int = 2000
    interval: float = 10.0
    end: float = 1.8e9
    rates: tuple[float, float, float] = (3.0e-4, -4.0e-4, 2.0e-4)
    level: float = 20.0
    sql: dict[str, str] = field(default_factory=dict)
    details: bool = False

    @property
    def series(self) -> StoredSeries:
        camera = CameraSpec(self.camera, Sensor(3280, 2464, PITCH), 3.04)
        channels = {"temperature": Channel("degC", 0.0625), "board": Channel("degC")}
        head = Head("watch", "watch", self.interval, camera, channels)
        return StoredSeries(0, head, _field(), "", {"model": self.model}, {}, self.end)

    @property
    def key(self) -> UUID:
        return series_key(self.station, UUID(STORE), self.series)


def _field() -> TestField:
    rng = np.random.default_rng(1)
    names = [f"t{i}" for i in range(TARGETS)]
    return TestField.build(names, rng.uniform(0, 2000, (TARGETS, 3)), 0.02)


def details() -> tuple[bytes, bytes]:
    """Covariance and observations of an epoch, packed."""
    rng = np.random.default_rng(2)
    a = rng.normal(size=(40, 16))
    points = np.round(rng.uniform(0, 2400, (TARGETS, 2)), 5)
    seen = Observations(np.arange(TARGETS), points, np.full((TARGETS, 2), 0.04))
    return pack_covariance(a.T @ a * 1e-6), pack_observations(seen)


_INSERT = """
INSERT INTO epoch (series, number, revision, frame_time, temperature_time, clock_trusted, status,
  sigma0, redundancy, n_observations, n_rejected, measured, "c", "sd_c", "x0", "sd_x0", "y0",
  "sd_y0", temperatures, extra, rejected, frame, note, reason, covariance, observations, received)
SELECT %(key)s, n, 0, t, t, true, {status}, 1.0, 280, 294, 0, 147,
  {c}, 1.2e-4, {x0}, 3e-4, {y0}, 3e-4,
  json_build_object('temperature', {temperature}, 'board', {board})::text, '{{}}', '[]', '', '', '',
  %(covariance)s, %(observations)s, t + 4
FROM (SELECT n, t, warm, round(warm / 0.0625) * 0.0625 AS read, noise, noise2, noise3
  FROM (SELECT n, %(end)s - (%(epochs)s - n) * %(interval)s AS t,
      %(level)s + 8 * sin((%(end)s - (%(epochs)s - n) * %(interval)s) * {day})
        + 12 * sin((%(end)s - (%(epochs)s - n) * %(interval)s) * {year}) AS warm,
      {gauss} AS noise, {gauss} AS noise2, {gauss} AS noise3
    FROM generate_series(%(first)s::bigint, %(last)s::bigint) n) raw) made
"""
_SQL = {
    "temperature": "read",
    "board": "round((read + 12)::numeric, 1)::float8",
    "status": "'ok'",
    "c": "3.04 + {c} * (warm - 20) + 1.2e-4 * noise",
    "x0": "0.01 + {x0} * (warm - 20) + 3e-4 * noise2",
    "y0": "-0.02 + {y0} * (warm - 20) + 3e-4 * noise3",
}
_DAY, _YEAR = 2 * np.pi / 86400, 2 * np.pi / 31_557_600
_GAUSS = "(random() + random() + random() + random() - 2) * 1.732"


def add_camera(connection: Connection, camera: GeneratedCamera, first: int = 1) -> None:
    """Insert the series and its epochs numbered `first` on; in the caller's transaction.

    connection: psycopg's, of a role that owns the tables; months are made as a station makes them.
    """
    series = camera.series
    csv = testfield_csv(series.testfield)
    execute = connection.execute
    execute("INSERT INTO testfield VALUES ('generated', %s) ON CONFLICT DO NOTHING", (csv,))
    execute(
        "INSERT INTO series VALUES (%s, %s, %s, %s, %s, '', %s, 'generated', %s, %s, '{}') "
        "ON CONFLICT DO NOTHING",
        (
            camera.key, camera.station, STORE, series.camera, series.name, series.created_utc,
            json.dumps(head_document(series.head)), json.dumps(dict(series.identity)),
        ),
    )  # fmt: skip
    begin = camera.end - (camera.epochs - first) * camera.interval
    for at in np.arange(begin, camera.end + 28 * 86400, 28 * 86400):
        execute("SELECT thermocald_month(%s)", (float(min(at, camera.end)),))
    rates = dict(zip(("c", "x0", "y0"), map(repr, camera.rates), strict=True))
    usual = {name: text.format(**rates) for name, text in _SQL.items()}
    covariance, observations = details() if camera.details else (None, None)
    execute(
        _INSERT.format(**{**usual, **camera.sql}, day=_DAY, year=_YEAR, gauss=_GAUSS),
        {
            "key": camera.key, "end": camera.end, "epochs": camera.epochs, "first": first,
            "last": camera.epochs, "interval": camera.interval, "level": camera.level,
            "covariance": covariance, "observations": observations,
        },
    )  # fmt: skip
