"""`thermocald fleet` reports the faults of a fleet and nothing else."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace

import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from benchmarks.generated_fleet import STORE, GeneratedCamera, add_camera
from tests.commands import succeed
from thermocald.fleet.overview import fleet_lines, render_fleet
from thermocald.store.server.connection import ServerAddress
from thermocald.store.server.reader import ServerWriter

# an epoch in two minutes for two days: temperatures of 16 K
BASE = GeneratedCamera("", epochs=1440, interval=120.0)
RATES = [(3.0e-4 + 2e-5 * (i % 5 - 2), -4.0e-4 + 3e-5 * (i % 4 - 1.5), 2.0e-4 + 1e-5 * (i % 3))
         for i in range(10)]  # fmt: skip


def run(*arguments):
    return succeed(*arguments).stdout


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
    with psycopg.connect(server.address(name="thermocald")) as connection:
        connection.execute("SELECT setseed(0.21)")
        for camera in cameras:
            add_camera(connection, camera)
    address = ServerAddress.parse(server.address(name="thermocald"))
    for camera in cameras:
        with ServerWriter(address, camera.station, STORE) as writer:
            late = camera.station == "late"
            writer.report(25 if late else 0, 0, time.time() + (90 if camera == cameras[3] else 0))
    return server.address(name="thermocald")


def test_faults_are_named_and_sound_cameras_are_not(fleet, tmp_path):
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


def test_a_clock_that_was_years_ahead_hides_nothing(server):
    place = server.address(name="thermocald")
    assert "no epochs there yet" in run("fleet", place)
    with psycopg.connect(place) as connection:
        add_camera(connection, replace(BASE, station="a", end=time.time() - 30, epochs=300))
        connection.execute(
            "CREATE TEMP TABLE copied AS SELECT * FROM epoch ORDER BY number DESC LIMIT 1"
        )
        connection.execute("UPDATE copied SET frame_time = frame_time + 3e8, number = number + 1")
        connection.execute("INSERT INTO epoch SELECT * FROM copied")
    document = json.loads(run("fleet", place, "--json", "-"))
    assert 0 < document["cameras"][0]["lag_s"] < 600
