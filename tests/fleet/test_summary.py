"""The server's summary is exactly that of a scan of all epochs."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from benchmarks.generated_fleet import GeneratedCamera, add_camera
from tests.fleet.conftest import address, execute
from thermocald.store.server.fleet_reader import SPREAD, FleetReader
from thermocald.store.server.reader import ServerWriter

SLOT_S = 21600.0
VALUES = ("c", "sd_c", "x0", "sd_x0", "y0", "sd_y0")


def summary(server):
    return {row[:2]: row[2:] for row in execute(server, "SELECT * FROM summary")}


def scanned(server):
    """Return the summary from every row of the table of epochs."""
    rows = execute(
        server, "SELECT series, number, revision, frame_time, status, temperatures, "
        "c, sd_c, x0, sd_x0, y0, sd_y0 FROM epoch"
    )  # fmt: skip
    latest = {}
    for series, number, revision, *_ in rows:
        latest[series, number] = max(revision, latest.get((series, number), 0))
    slots = {}
    for series, number, revision, frame_time, *rest in rows:
        # the first calibrations are all kept where a restored store used a number again
        if revision == latest[series, number]:
            slot = int(min(max(frame_time, 0), 4102444800) // SLOT_S)
            slots.setdefault((series, slot), []).append((frame_time, number, *rest))
    found = {}
    for key, epochs in slots.items():
        times = [t for t, *_ in epochs]
        good = [(t, n, json.loads(read)["temperature"], *values)
                for t, n, status, read, *values in epochs if status == "ok"]  # fmt: skip
        read = [g for g in good if g[2] is not None]
        found[key] = (
            len(epochs), len(good), min(times), max(times), max((g[0] for g in good), default=None),
            min((g[2] for g in read), default=None), max((g[2] for g in read), default=None),
            [*min(read)] if read else None,
        )  # fmt: skip
    return found


def generated_rows(store, series, rng, count):
    """Make rows as from a store: late, revised, with a wrong clock, without readings."""
    usual = store.rows_after("epoch", 0, 1)[0]
    usual.pop("damage")
    rows = []
    for number in range(1, count + 1):
        at = 1.7e9 + float(rng.uniform(0, 4 * SLOT_S))
        at = float(rng.choice([at, at, at, at, at, at, at, at, -5.0, 1e13, 4102444800.0]))
        for revision in range(int(rng.choice([1, 1, 1, 1, 2, 3]))):
            read = rng.choice([None, float(np.round(rng.normal(20, 5), 2))])
            values = {name: float(v) for name, v in zip(VALUES, rng.normal(size=6), strict=True)}
            rows.append(usual | values | {
                "number": number, "revision": revision, "frame_time": at,
                "status": str(rng.choice(["ok", "ok", "no_targets"])),
                "temperatures": json.dumps({"temperature": read, "board": 3.0}),
            })  # fmt: skip
    return rows


def test_late_repeated_and_revised_rows_count_exactly_once(server, filled):
    store, series = filled
    rng = np.random.default_rng(21)
    rows = generated_rows(store, series, rng, 150)
    known, identity = {series.id: series}, store.identity

    def send(seed):
        order = np.random.default_rng(seed).permutation(len(rows))
        with ServerWriter(address(server), "bank", identity) as writer:
            for batch in np.array_split(order, 12):
                # in the order of the store, as a forwarder sends them
                writer.write("epoch", [rows[i] for i in np.sort(batch)], known)

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(send, range(3)))  # none fails
    expected = scanned(server)
    assert sum(found[0] for found in expected.values()) == 150
    assert len(expected) >= 6
    assert summary(server) == expected
    again = "SELECT thermocald_summarise(series, array_agg(DISTINCT thermocald_slot(frame_time))) "
    execute(server, "DELETE FROM summary")
    execute(server, f"{again} FROM epoch GROUP BY series")
    assert summary(server) == expected


@pytest.mark.parametrize("days", [20, 100])
def test_an_overview_reads_the_summary_of_a_long_series(server, days):
    """Of 100 days it reads only the last epochs, and samples at every time of day."""
    camera = GeneratedCamera("a", epochs=days * 24, interval=3600.0)
    with psycopg.connect(server.address(name="thermocald")) as connection:
        add_camera(connection, camera)
        # a scan needs these rows, the summary does not
        connection.execute("DELETE FROM epoch WHERE frame_time < %s", (camera.end - 86400 * 5,))
    assert summary(server) != scanned(server)
    with FleetReader(address(server)) as reader:
        (record,) = reader.cameras(camera.end)
    assert (record.epochs, record.results) == (days * 24, days * 24)
    assert record.last_time == record.last_ok == camera.end
    assert len(record.recent) == 60
    times = record.samples[:, 1]
    if days == 100:
        assert SPREAD / 1.5 <= len(times) <= 2 * SPREAD
        assert times[0] < camera.end - 98 * 86400
        assert (np.bincount((times // SLOT_S % 4).astype(int)) > len(times) / 5).all()
    else:
        assert times[0] >= camera.end - 86400 * 5
    assert np.isfinite(record.samples[:, 2]).all()
