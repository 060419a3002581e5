"""The commands read a server's address as they read a file, and give the same."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from thermocald.cli import application
from thermocald.fleet.forward import Forwarder
from thermocald.simulation.presets import preset_simulation
from thermocald.store.server.address import ServerAddress


def run(*arguments):
    result = CliRunner().invoke(application(), [str(a) for a in arguments])
    assert result.exit_code == 0, result.exception
    return result.stdout


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


def test_a_wrong_address_is_one_line():
    result = CliRunner().invoke(application(), ["study", "postgresql://127.0.0.1:1/none"])
    assert result.exit_code == 1
    assert "cannot be reached" in str(result.exception)
