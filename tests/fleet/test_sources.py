"""Commands read a server's address like a file, with the same results."""

from __future__ import annotations

import json

import numpy as np
import pytest

import thermocald as tc
from tests.commands import answer, succeed
from tests.fleet.conftest import address
from thermocald.fleet.forward import Forwarder


def run(*arguments):
    return succeed(*arguments).stdout


def send(server, folder, *names, **more):
    """Make series of a store, and send them; return the store, and the server's address."""
    for name in names:
        tc.simulate("rpi-v2.1-heating", seed=3, series=name, out=folder / name, **more)
        run("replay", folder / name, "--store", folder / "k.db")
    Forwarder(folder / "k.db", address(server), "bank").send_waiting()
    return folder / "k.db", server.address("?station=bank", name="thermocald")


@pytest.mark.slow
def test_a_server_gives_what_the_file_gives(server, tmp_path):
    """Discovery depends only on what is observed."""
    places = send(server, tmp_path, "M1")
    here, there = (tc.open(place).observed() for place in places)
    assert there.name.startswith("postgresql://")
    assert "secret" not in there.name
    assert np.array_equal(here.frame_times, there.frame_times)
    assert np.array_equal(here.grid.points, there.grid.points, equal_nan=True)
    assert np.array_equal(here.grid.weights, there.grid.weights)
    assert here.readings.keys() == there.readings.keys()

    assert run("export", places[0]) == run("export", places[1])
    rows = "".join(f"{t!r},1000,{100 + i}\n" for i, t in enumerate(here.frame_times[5:40].tolist()))
    (tmp_path / "points.csv").write_text(f"time,x,y\n{rows}")
    fits, corrected = [], []
    for place in places:
        fits.append(json.loads(run("fit", place, "-o", tmp_path / "m.yaml", "--json", "-")))
        corrected.append(
            run("correct", tmp_path / "points.csv", "--model", tmp_path / "m.yaml", "--log", place)
        )
    assert fits[0]["rates"] == fits[1]["rates"]
    assert corrected[0] == corrected[1]
    here, there = (json.loads(run("study", place, "--json", "-"))["cameras"] for place in places)
    sources = [one.pop("source") for camera in (*here, *there) for one in camera["series"]]
    assert len(set(sources)) == 2
    assert "secret" not in str(sources)
    assert here == there


def test_several_series_at_an_address_are_said(server, tmp_path):
    store, at_server = send(server, tmp_path, "M1", "M2", epochs=2)
    for place, start, words in (
        (at_server, "postgresql://", "in the address"), (store, str(store), "thermocald archive"),
    ):  # fmt: skip
        said = str(answer("discover", place).exception)
        assert "several series fit" in said
        assert said.startswith(start)
        assert words in said
        assert "secret" not in said


def test_a_wrong_address_is_one_line():
    result = answer("study", "postgresql://127.0.0.1:1/none")
    assert result.exit_code == 1
    assert "127.0.0.1:1/none: the server cannot be reached" in str(result.exception)
