"""Commands read a server's address like a file, with the same results."""

from __future__ import annotations

import json

import numpy as np
import pytest

import thermocald as tc
from tests.commands import answer, succeed
from thermocald.fleet.forward import Forwarder
from thermocald.physics.presets import preset_simulation
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import open_recording
from thermocald.store.server.connection import ServerAddress


def run(*arguments):
    return succeed(*arguments).stdout


@pytest.fixture
def places(server, tmp_path):
    """The same series in a file and on a server."""
    preset_simulation("rpi-v2.1-heating", 3, "M1").write(tmp_path / "M1")
    run("replay", tmp_path / "M1", "--store", tmp_path / "k.db", "--json", tmp_path / "r.json")
    address = ServerAddress.parse(server.address(name="thermocald"))
    Forwarder(tmp_path / "k.db", address, "bank").send_waiting()
    return tmp_path / "k.db", server.address("?station=bank&series=M1", name="thermocald")


@pytest.mark.slow
def test_a_server_gives_what_the_file_gives(places):
    file, server = places
    assert run("export", file) == run("export", server)
    here, there = (
        json.loads(run("fit", place, "-o", file.with_name("m.yaml"), "--json", "-"))
        for place in places
    )
    assert here["rates"] == there["rates"]
    here, there = (json.loads(run("study", place, "--json", "-"))["cameras"] for place in places)
    sources = [one.pop("source") for camera in (*here, *there) for one in camera["series"]]
    assert len(set(sources)) == 2
    assert "secret" not in str(sources)
    assert here == there


@pytest.mark.slow
def test_discover_and_correct_read_a_server_too(places, tmp_path):
    # discovery depends only on these
    here, there = (tc.open(place).observed() for place in places)
    assert there.name.startswith("postgresql://")
    assert "secret" not in there.name
    assert np.array_equal(here.frame_times, there.frame_times)
    assert np.array_equal(here.grid.points, there.grid.points, equal_nan=True)
    assert np.array_equal(here.grid.weights, there.grid.weights)
    assert here.readings.keys() == there.readings.keys()
    file, server = places
    run("fit", file, "-o", tmp_path / "m.yaml")
    rows = "".join(f"{t!r},1000,{100 + i}\n" for i, t in enumerate(here.frame_times[5:40].tolist()))
    (tmp_path / "points.csv").write_text(f"time,x,y\n{rows}")
    command = ("correct", tmp_path / "points.csv", "--model", tmp_path / "m.yaml", "--log")
    assert run(*command, file) == run(*command, server)


def test_several_series_at_an_address_are_said(server, tmp_path):
    for name in ("M1", "M2"):
        preset_simulation("rpi-v2.1-heating", 3, name).write(tmp_path / name)
        recording = open_recording(tmp_path / name)
        with Store.open(tmp_path / "k.db", "append") as store:
            series = store.create_series(recording.head, recording.testfield)
            store.append(series, next(iter(recording.iter_epochs())))
    Forwarder(
        tmp_path / "k.db", ServerAddress.parse(server.address(name="thermocald")), "bank"
    ).send_waiting()
    for place, words in (
        (server.address(name="thermocald"), "in the address"),
        (tmp_path / "k.db", "thermocald archive"),
    ):
        result = answer("discover", place)
        assert "several series fit" in str(result.exception)
        assert str(result.exception).startswith(("postgresql://", str(tmp_path)))
        assert words in str(result.exception)
        assert "secret" not in str(result.exception)


def test_a_wrong_address_is_one_line():
    result = answer("study", "postgresql://127.0.0.1:1/none")
    assert result.exit_code == 1
    assert "cannot be reached" in str(result.exception)
