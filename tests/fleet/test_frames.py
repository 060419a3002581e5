"""Chosen frames on the server: limited, resumable, checked, without effect on retention."""

from __future__ import annotations

import hashlib
from types import SimpleNamespace

import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")

from tests.fleet.conftest import address, execute
from thermocald.config import ForwardConfig
from thermocald.errors import ServerGone
from thermocald.fleet.forward import Forwarder
from thermocald.store.server.reader import ServerWriter


def forwarder(server, station, choose, **options):
    (store, folder), rule = station, ForwardConfig(frames=choose, **options)
    return Forwarder(store, address(server), "bank", frames=folder, rule=rule)


def there(server):
    rows = execute(server, "SELECT number, name, digest, data FROM frame ORDER BY number")
    return {number: (name, digest, data) for number, name, digest, data in rows}


@pytest.mark.parametrize(
    ("choose", "numbers"),
    [("events", [7, 13]), ("every_n", [5, 10, 15, 20]), ("all", list(range(1, 21)))],
)
def test_the_chosen_frames_arrive_whole(server, station, choose, numbers):
    done = forwarder(server, station, choose, every_n=5).send_waiting()
    assert done.sent["frame"] == len(numbers)
    found = there(server)
    assert [*found] == numbers
    for number, (name, digest, data) in found.items():
        assert (name, data) == (f"rpi/M1/{number:07d}.jpg", bytes([number]) * 1000)
        assert digest == hashlib.sha256(data).hexdigest()


def test_a_day_has_a_limit_and_the_next_goes_on(server, station):
    limited = forwarder(server, station, "all", frames_mb_per_day=0.0035)
    day = [1.7e9]
    limited._clock = lambda: day[0]
    assert limited.send_waiting().sent["frame"] == 3
    assert limited.send_waiting().sent["frame"] == 0
    day[0] += 86400
    assert limited.send_waiting().sent["frame"] == 3
    assert [*there(server)] == [1, 2, 3, 4, 5, 6]


def test_it_goes_on_where_the_network_failed(server, station, monkeypatch):
    send, calls = ServerWriter.write_frame, []

    def fails_twice(self, series, frame, data):
        calls.append(frame.number)
        if len(calls) in (4, 9):
            raise ServerGone("cut")
        send(self, series, frame, data)

    monkeypatch.setattr(ServerWriter, "write_frame", fails_twice)
    every = forwarder(server, station, "all")
    for _ in range(2):
        with pytest.raises(ServerGone):
            every.send_waiting()
    every.send_waiting()
    assert [*there(server)] == list(range(1, 21))
    assert len(calls) == 22  # each frame once, and the two that failed again


def test_what_retention_has_deleted_or_leads_out_of_the_folder_is_passed_over(
    server, station, tmp_path
):
    (tmp_path / "secret").write_text("key")
    frames = station[1] / "rpi/M1"
    for number in (1, 2, 3, 20):
        (frames / f"{number:07d}.jpg").unlink()
    (frames / "0000001.jpg").symlink_to(tmp_path / "secret")
    assert forwarder(server, station, "all").send_waiting().sent["frame"] == 16
    assert [*there(server)] == list(range(4, 20))


def test_the_server_refuses_a_frame_that_is_not_what_was_read(server, station, monkeypatch):
    wrong = SimpleNamespace(sha256=hashlib.md5)
    monkeypatch.setattr("thermocald.store.server.reader.hashlib", wrong)
    done = forwarder(server, station, "events").send_waiting()
    assert (done.sent["frame"], done.refused) == (0, 2)
    assert there(server) == {}
