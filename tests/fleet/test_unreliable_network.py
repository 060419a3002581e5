"""A whole fleet forwards to a server that is killed, through a failing network, without loss."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from tests.fleet.conftest import count
from tests.fleet.simulated_stations import station_name
from tests.fleet.unreliable_proxy import UnreliableProxy
from thermocald.store.database.store import Store

ROOT = Path(__file__).parents[2]


def forwarded(server, folder, stations, per_process, epochs, kills, cut_every_s):
    """Run a fleet through all faults; return seconds from the last recovery to the last row."""
    with UnreliableProxy(server.port, 21, cut_every_s) as proxy, ExitStack() as stack:
        address = server.address(name="thermocald").replace(f":{server.port}/", f":{proxy.port}/")
        processes = []
        for first in range(0, stations, per_process):
            process = subprocess.Popen(
                [sys.executable, "-m", "tests.fleet.simulated_stations", folder, str(first),
                 str(per_process), str(epochs), address],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
            )  # fmt: skip
            stack.callback(process.wait)
            stack.callback(process.kill)
            processes.append(process)
        deadline = time.monotonic() + 60
        while count(server, "epoch") == 0:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        for _ in range(kills):
            time.sleep(epochs / 10 / (kills + 1))
            server.stop()
            time.sleep(0.5)
            server.start()
        recovered = time.monotonic()
        # a busy machine connects late: the network fails until it has cut something
        while proxy.cuts < stations and any(process.poll() is None for process in processes):
            time.sleep(0.1)
        time.sleep(1)
        proxy.calm()
        for process in processes:
            _, errors = process.communicate(timeout=240)
            assert process.returncode == 0, errors[-3000:]
            assert "Traceback" not in errors, errors[-3000:]
        assert proxy.cuts >= stations
        return time.monotonic() - recovered


def require_equal(server, folder, stations):
    """Check that the server has exactly the rows of all stores, bit for bit."""
    epochs = """SELECT number, frame_time, temperatures, "c", "sd_x0", covariance, observations
                FROM epoch JOIN series ON key = epoch.series WHERE station = %s ORDER BY number"""
    with psycopg.connect(server.address(name="thermocald")) as connection:
        for number in range(stations):
            name = station_name(number)
            with Store.open(folder / f"{name}.db") as store:
                here = [
                    tuple(row[k] for k in ("number", "frame_time", "temperatures", "c", "sd_x0",
                                           "covariance", "observations"))
                    for row in store.rows_after("epoch", 0, 10**6)
                ]  # fmt: skip
                events = [(e.utc, e.text) for e in store.events()]
                readings = [(r.utc,) for r in store.readings()]
            assert connection.execute(epochs, (name,)).fetchall() == here
            there = connection.execute(
                "SELECT utc, text FROM event WHERE station = %s ORDER BY id", (name,)
            )
            assert there.fetchall() == events
            there = connection.execute(
                "SELECT utc FROM reading WHERE station = %s ORDER BY id", (name,)
            )
            assert there.fetchall() == readings
        (waiting,) = connection.execute("SELECT sum(waiting) FROM station").fetchone()
        assert waiting == 0


@pytest.mark.slow
def test_fifty_stations_at_a_hundred_times_speed_arrive_once(server, tmp_path, record_property):
    lag = forwarded(server, tmp_path, 50, 10, 100, kills=3, cut_every_s=0.5)
    require_equal(server, tmp_path, 50)
    assert count(server, "epoch") == 50 * 100
    record_property("lag_after_recovery_s", lag)
    print(json.dumps({"lag_after_recovery_s": round(lag, 1)}))
    assert lag < 90
