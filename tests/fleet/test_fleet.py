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
    found = {c["station"]: {f["kind"] for f in c["findings"]} for c in document["cameras"]}
    assert found.pop("odd") == {"odd"}
    assert found.pop("late") == {"late"}
    assert found.pop("dead") == {"sensor"}
    assert found.pop("stuck") >= {"sensor"}
    assert found.pop("cold") == {"calibrate"}
    assert found.pop("moved") >= {"calibrate"}
    assert found.pop("narrow") == {"calibrate"}
    assert found.pop("gauge3") == {"clock"}
    assert {*found} == {f"gauge{i}" for i in range(10) if i != 3}
    assert all(kinds == set() for kinds in found.values()), found
    summary = document["summary"]
    assert (summary["cameras"], summary["stations"], summary["sound"]) == (17, 17, 9)
    texts = {c["station"]: " ".join(f["text"] for f in c["findings"]) for c in document["cameras"]}
    assert re.search(r"c drifts by \+0\.(89|90)\d µm/K", texts["odd"])
    assert "25 rows wait" in texts["late"]
    assert "21.5 °C for" in texts["stuck"]
    assert "90 s ahead of" in texts["gauge3"]
    assert "no_targets" in texts["cold"]
    assert "outside its calibrated range" in texts["cold"]
    html = page.read_text()
    drawn = [html.count(f">{name}<") for name in document["types"][0]["cameras"]]
    assert len(drawn) >= 14
    assert min(drawn) >= 3  # a row in each rate's drawing
    assert "secret" not in html
    rates = {c["station"]: c["rates"] for c in document["cameras"]}
    for i, true in enumerate(RATES):
        for name, value in zip(("c", "x0", "y0"), true, strict=True):
            rate = rates[f"gauge{i}"][name]
            assert abs(rate["value"] - value) < 4.5 * rate["sd"]
    (kind,) = document["types"]
    assert kind["type"] == "imx219 3280×2464"
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


def test_an_empty_server_is_said(server):
    assert "no epochs there yet" in run("fleet", server.address(name="thermocald"))


def test_a_clock_that_was_years_ahead_hides_nothing(server):
    now = time.time()
    camera = replace(BASE, station="a", end=now - 30, epochs=300)
    with psycopg.connect(server.address(name="thermocald")) as connection:
        add_camera(connection, camera)
        connection.execute(
            "CREATE TEMP TABLE copied AS SELECT * FROM epoch ORDER BY number DESC LIMIT 1"
        )
        connection.execute("UPDATE copied SET frame_time = frame_time + 3e8, number = number + 1")
        connection.execute("INSERT INTO epoch SELECT * FROM copied")
    document = json.loads(run("fleet", server.address(name="thermocald"), "--json", "-"))
    assert 0 < document["cameras"][0]["lag_s"] < 600


def test_a_name_from_right_to_left_has_a_cell_of_its_own(server, tmp_path):
    """In one cell, the browser put the camera before its station, and the mark behind both."""
    with psycopg.connect(server.address(name="thermocald")) as connection:
        add_camera(connection, replace(BASE, station="محطة-2", epochs=300, end=time.time()))
    run("fleet", server.address(name="thermocald"), "--report", tmp_path / "fleet.html")
    row = re.search(r"<tbody><tr>(.*?)</tr>", (tmp_path / "fleet.html").read_text())[1]
    cells = re.findall("<td[^>]*>([^<]*)</td>", row)
    assert cells[:2] == ["\u2068محطة\u2069-2", "cam"]
