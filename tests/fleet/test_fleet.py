"""`thermocald fleet` reports the faults of a fleet and nothing else."""

from __future__ import annotations

import json
import re
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg
from psycopg.rows import dict_row

from benchmarks.generated_fleet import STORE, GeneratedCamera, add_camera
from tests.commands import refuse, succeed
from tests.fleet.conftest import address, execute
from thermocald.fleet.overview import (
    _calibration,
    _complete,
    _sensors,
    _shift,
    fleet_document,
    fleet_lines,
    render_fleet,
)
from thermocald.store.recording.head import Channel
from thermocald.store.server.connection import grant
from thermocald.store.server.fleet_reader import SPREAD, FleetCamera, FleetReader, RecentEpoch
from thermocald.store.server.reader import ServerWriter

# an epoch in two minutes for two days: temperatures of 16 K
BASE = GeneratedCamera("", epochs=1440, interval=120.0)
RATES = [(3.0e-4 + 2e-5 * (i % 5 - 2), -4.0e-4 + 3e-5 * (i % 4 - 1.5), 2.0e-4 + 1e-5 * (i % 3))
         for i in range(10)]  # fmt: skip


def run(*arguments):
    return succeed(*arguments).stdout


def add(server, *cameras):
    with psycopg.connect(server.address(name="thermocald")) as connection:
        connection.execute("SELECT setseed(0.21)")
        for camera in cameras:
            add_camera(connection, camera)


@pytest.fixture
def fleet(server):
    """Ten cameras of one type without faults, and cameras with one fault each, named after it."""
    now = time.time()
    base = replace(BASE, end=now - 20)
    cameras = [replace(base, station=f"gauge{i}", rates=rate) for i, rate in enumerate(RATES)]
    after = f"t > {now - 3 * 3600}"
    faults = {
        "odd": {"rates": (9.0e-4, -4.0e-4, 2.0e-4)},
        "late": {"end": now - 7200},
        "dead": {"sql": {"temperature": f"CASE WHEN {after} THEN NULL ELSE read END"}},
        "stuck": {"sql": {"temperature": f"CASE WHEN t > {now - 36000} THEN 21.5 ELSE read END"}},
        "cold": {"sql": {"temperature": f"CASE WHEN {after} THEN read - 20 ELSE read END",
                         "status": f"CASE WHEN {after} THEN 'no_targets' ELSE 'ok' END"}},
        "moved": {"sql": {"x0": f"0.01 - 4e-4 * (warm - 20) + 3e-4 * noise2 "
                          f"+ CASE WHEN t > {now - 8 * 3600} THEN 0.01 ELSE 0 END"}},
        "narrow": {"epochs": 20},
    }  # fmt: skip
    cameras += [replace(base, station=name, **fault) for name, fault in faults.items()]
    add(server, *cameras)
    for camera in cameras:
        with ServerWriter(address(server), camera.station, STORE) as writer:
            late = camera.station == "late"
            writer.report(25 if late else 0, 0, time.time() + (90 if camera == cameras[3] else 0))
    return server.address(name="thermocald")


def test_faults_are_named_and_sound_cameras_are_not(fleet, tmp_path, monkeypatch):
    page = tmp_path / "fleet.html"
    document = json.loads(run("fleet", fleet, "--json", "-", "--report", page))
    cameras = {c["station"]: c for c in document["cameras"]}
    kinds = {name: {f["kind"] for f in c["findings"]} for name, c in cameras.items()}
    assert kinds.pop("stuck") >= {"sensor"}
    assert kinds.pop("moved") >= {"calibrate"}
    one = {"odd": "odd", "late": "late", "dead": "sensor", "cold": "calibrate",
           "narrow": "calibrate", "gauge3": "clock"}  # fmt: skip
    sound = {f"gauge{i}": set() for i in range(10) if i != 3}
    assert kinds == sound | {name: {kind} for name, kind in one.items()}
    summary = document["summary"]
    assert (summary["cameras"], summary["stations"], summary["sound"]) == (17, 17, 9)
    for name, said in {
        "odd": r"c drifts by \+0\.(89|90)\d µm/K", "late": "25 rows wait", "stuck": "21.5 °C for",
        "gauge3": "90 s ahead of", "cold": "no_targets.*outside its calibrated range",
    }.items():  # fmt: skip
        assert re.search(said, " ".join(f["text"] for f in cameras[name]["findings"]))
    html = page.read_text()
    (kind,) = document["types"]
    assert kind["type"] == "imx219 3280×2464"
    assert kind["rates"]["c"]["sd_between"] < 5e-5  # without the odd one
    drawn = [html.count(f">{name}<") for name in kind["cameras"]]
    assert len(drawn) >= 14
    assert min(drawn) >= 3  # a row in each rate's drawing
    assert "secret" not in html
    for i, true in enumerate(RATES):
        for name, value in zip(("c", "x0", "y0"), true, strict=True):
            rate = cameras[f"gauge{i}"]["rates"][name]
            assert abs(rate["value"] - value) < 4.5 * rate["sd"]
    # names that differ in the middle are shortened to labels that still differ
    text = json.dumps(document).replace('"gauge', '"station-north-meadow-creek-')
    document = json.loads(re.sub(r'(["/])cam"', r'\1rpi-camera-v2.1"', text))
    for shown in (render_fleet(document), "\n".join(fleet_lines(document))):
        assert len(set(re.findall(r"station-north-[^< ]*…[^< ]*", shown))) == 10

    # the table fits a terminal, and an address narrows it
    lines = run("fleet", fleet).splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0].startswith("17 cameras at 17 stations: 9 without findings, 1 late")
    assert any(line.startswith("odd/cam") for line in lines)
    document = json.loads(run("fleet", f"{fleet}?station=gauge3", "--json", "-"))
    assert [c["station"] for c in document["cameras"]] == ["gauge3"]
    assert document["types"] == []

    # each camera by its own server's clock, not by that of the last server
    clocks = iter([time.time(), time.time() + 7200])
    monkeypatch.setattr(FleetReader, "now", lambda _: next(clocks))
    document = fleet_document([Path(f"{fleet}?station={name}") for name in ("late", "gauge1")])
    assert "25 rows wait" in document["cameras"][0]["findings"][0]["text"]


BAD = {
    "no reading in the last 20 epochs": [np.nan] * 20,
    "has stopped: no reading in the last 10 epochs": [np.nan] * 10 + [20.0] * 10,
    "reads -127 °C, which is impossible": [-127.0] + [20.0] * 19,
    "reads 85 °C, the value of a DS18B20 that has not measured": [85.0] * 20,
    "has read exactly 21.5 °C for 19 h": [21.5] * 20,
    "": [20.0, 21.5] * 10,
}


@pytest.mark.parametrize(("trouble", "readings"), BAD.items())
def test_a_thermometer_without_fault_alone_leaves_the_rates_to_a_warmer_camera(
    head, trouble, readings
):
    """A dead one was told to be mended by warming up the camera."""
    head, times = replace(head, channels={"t": Channel()}), 1.7e9 - 3600.0 * np.arange(20)
    recent = [RecentEpoch(t, t, "ok", {"t": r}) for t, r in zip(times, readings, strict=True)]
    camera = FleetCamera("s", "c", "w", head, {}, times[0], 20, 20, times[0], (21.5, 22.0), False,
                         recent)  # fmt: skip
    assert [*_sensors(camera)] == ([("sensor", f"t: {trouble}")] if trouble else [])
    warm_up = [text for _, text in _calibration(camera) if "21.5 to 22.0 °C" in text]
    assert bool(warm_up) == (not trouble)


def test_a_rate_is_that_within_the_series_which_have_levels_of_their_own(head):
    of, t = np.repeat([0, 1], 30), np.tile(np.linspace(0.0, 10.0, 30), 2)
    measured = [k + rate * t + 0.5 * of for k, rate in enumerate(RATES[0])]
    samples = np.column_stack([of, 60.0 * np.arange(60), t + 20 * of])
    for values in measured:
        samples = np.column_stack([samples, values, np.full(60, 1e-4)])
    head = replace(head, channels={"t": Channel()})
    camera = FleetCamera("s", "c", "w", head, {}, 3540.0, 60, 60, 3540.0, None, samples=samples)
    _complete(camera, 3600.0)
    rates = [rate.value for rate in camera.rates.values()]
    assert rates == pytest.approx(list(RATES[0]), rel=1e-3)


def test_a_shift_is_counted_in_its_standard_deviations():
    noise = np.random.default_rng(1).normal(0.0, 2e-4, (400, 200))
    in_sds = [_shift(residual)[1] for residual in noise]
    assert np.sqrt(np.mean(np.square(in_sds))) == pytest.approx(1.0, abs=0.12)


def test_a_station_without_a_possible_epoch_is_shown(server):
    """It was left out, and an overview of it alone said that nothing had been sent."""
    with ServerWriter(address(server), "mill", STORE) as writer:
        writer.report(0, 0, time.time())
    assert run("fleet", server.address(name="thermocald")).startswith("mill: reports, but has no")


def test_a_clock_that_was_years_ahead_hides_nothing(server):
    place = server.address(name="thermocald")
    assert "no epochs there yet" in run("fleet", place)
    add(server, replace(BASE, station="a", end=time.time() - 30, epochs=300))
    execute(
        server, "CREATE TEMP TABLE copied AS SELECT * FROM epoch ORDER BY number DESC LIMIT 1; "
        "UPDATE copied SET frame_time = frame_time + 3e8, number = number + 1; "
        "INSERT INTO epoch SELECT * FROM copied",
    )  # fmt: skip
    document = json.loads(run("fleet", place, "--json", "-"))
    assert 0 < document["cameras"][0]["lag_s"] < 600
    assert "nobody: there is no such station" in refuse("fleet", f"{place}?station=nobody")


# --- the server's summary is that of a scan of all epochs ----------------------------------


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
    add(server, camera)
    # a scan needs these rows, the summary does not
    execute(server, "DELETE FROM epoch WHERE frame_time < %s", camera.end - 86400 * 5)
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


# --- Grafana's dashboard --------------------------------------------------------------------


# the values with which Grafana's PostgreSQL source replaces its macros and variables
MACROS = {"$__interval_ms": "60000", "${station:sqlstring}": "'bank','hill'"}


@pytest.fixture(scope="module")
def dashboard():
    return json.loads(succeed("server", "dashboard").stdout)


def queries(dashboard):
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["rawSql"]


def test_every_query_runs_and_finds_something(server, dashboard):
    """As a role that may only read; no variable is missing, and none is unused."""
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])
    names = {variable["name"] for variable in dashboard["templating"]["list"]}
    used = {v for _, sql in queries(dashboard) for v in re.findall(r"\$\{(\w+)", sql)}
    assert used | {"datasource"} == names
    now = time.time()
    camera = GeneratedCamera("bank", epochs=200, end=now - 1000)
    add(server, *(replace(camera, station=station) for station in ("bank", "hill")))
    knock = "INSERT INTO event VALUES ('bank', 1, %s, 'knock', 'x', NULL, 1, '{}')"
    execute(server, knock, now - 1100)
    execute(server, "CREATE ROLE grafana LOGIN PASSWORD 'g'")
    grant(address(server), "grafana", writes=False)
    with ServerWriter(address(server), "bank", STORE) as writer:
        writer.report(0, 0, now)
    (query,) = (v["query"] for v in dashboard["templating"]["list"] if v["type"] == "query")
    macros = MACROS | {"$__unixEpochFrom()": str(now - 7200), "$__unixEpochTo()": str(now)}
    try:
        with psycopg.connect(
            server.address(user="grafana:g", name="thermocald"), row_factory=dict_row
        ) as connection:
            stations = [list(row.values()) for row in connection.execute(query)]
            assert stations == [["bank"], ["hill"]]
            for title, sql in queries(dashboard):
                for macro, value in macros.items():
                    sql = sql.replace(macro, value)
                assert "$" not in sql, title
                rows = connection.execute(sql).fetchall()
                assert rows, title
                if '"time"' in sql and "kind" not in sql:
                    assert [*rows[0]] == ["time", "metric", "value"]
                if "15 minutes" in title:
                    assert [*rows[0].values()] == [2]
    finally:
        execute(server, "DROP OWNED BY grafana; DROP ROLE grafana")
