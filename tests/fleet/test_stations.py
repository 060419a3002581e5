"""Stations' identities: two of one name, one at two places, a copied store."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.fleet.conftest import address, count, execute
from tests.marks import mostly_slow
from thermocald.fleet.forward import Cursor, Forwarder
from thermocald.fleet.overview import fleet_document
from thermocald.store.database.store import Store
from thermocald.store.series import Event, LoggedReading
from thermocald.store.server.connection import ServerAddress
from thermocald.store.server.fleet_reader import FleetReader


def findings(server) -> set[str]:
    """Return the kinds of an overview's findings."""
    cameras = fleet_document([Path(server.address(name="thermocald"))])["cameras"]
    return {finding["kind"] for camera in cameras for finding in camera["findings"]}


@pytest.fixture
def two(tmp_path, head, field, make_epoch, make_result):
    """Two stores of five epochs each."""
    paths = [tmp_path / f"{name}.db" for name in ("one", "two")]
    for path in paths:
        with Store.open(path, "append", durable=False) as store:
            series = store.create_series(head, field)
            for i in range(1, 6):
                store.append(series, make_epoch(i), make_result(i))
    return paths


def test_two_stations_of_one_name_are_told_apart_and_reported(server, two):
    """After a card was replaced, or with two daemons on one host, ids begin at 1 in both."""
    place = address(server)
    for path in two:
        with Store.open(path, "append", durable=False) as store:
            (series,) = store.all_series()
            store.add_event(Event(1.6e9, "knock", path.stem, series.id, 1))
            store.add_readings([LoggedReading("air", 1.6e9 + two.index(path), {"t": 20.0})])
        for _ in range(2):
            assert Forwarder(path, place, "gauge-7").send_waiting().rows == 7
            path.with_name(f"{path.name}.forwarded").unlink()
    tables = ("series", "epoch", "event", "reading", "station")
    assert [count(server, table) for table in tables] == [2, 10, 2, 2, 2]
    with FleetReader(place) as fleet:
        assert fleet.stations()["gauge-7"].stores == 2
    assert "twins" in findings(server)


def test_neither_new_calibrations_nor_a_new_store_are_twins(server, two, make_result):
    with Store.open(two[0], "append", durable=False) as store:
        (series,) = store.all_series()
        for i in (4, 5):
            store.amend(series, i, make_result(200 + i))
    Forwarder(two[0], address(server), "gauge-7").send_waiting()
    execute(server, "UPDATE station SET contact = contact - 7200")
    Forwarder(two[1], address(server), "gauge-7").send_waiting()
    with FleetReader(address(server)) as fleet:
        assert fleet.stations()["gauge-7"].stores == 1
    assert "twins" not in findings(server)


ONE = "postgresql://owner:secret@db.example:5432/thermocald?sslmode=require&host=/run/a"
OTHERS = {
    "port": ONE.replace(":5432", ":5433"),
    "database": ONE.replace("/thermocald", "/Thermocald"),
    "user": ONE.replace("owner:", "Owner:"),
    "another socket": ONE.replace("/run/a", "/run/b"),
    "database as an option": ONE + "&dbname=other",
    "port in another form": ONE.replace(":5432", "") + "&port=5433",
}
SAME = {
    "password": ONE.replace("secret", "other"),
    "no password": ONE.replace(":secret", ""),
    "scheme": ONE.replace("postgresql:", "postgres:"),
    "order": ONE.replace("sslmode=require&host=/run/a", "host=%2Frun%2Fa&sslmode=require"),
    "a selection to read": ONE + "&camera=rpi&series=M1",
    "password as an option": ONE + "&password=other",
    "as a path": ONE.replace("//", "/"),
}


@pytest.mark.parametrize("part", [*OTHERS, *SAME])
def test_a_cursor_is_of_its_server_database_and_user(two, part):
    path = two[0].with_name("cursor")
    with Store.open(two[0]) as store:
        cursor = Cursor.read(path, store, ServerAddress.parse(ONE).place, "a")
        cursor.sent["epoch"] = 5
        cursor.write(path)
        there = ServerAddress.parse({**OTHERS, **SAME}[part]).place
        assert Cursor.read(path, store, there, "a").sent["epoch"] == (5 if part in SAME else 0)
        assert "secret" not in path.read_text()


@pytest.mark.parametrize(
    ("text", "instead", "sent"),
    [
        pytest.param("", "", 5, id="nothing, or store and cursor are renamed"),
        pytest.param('"inode": ', '"inode": 1', 0, id="a copy of the store takes its place"),
        pytest.param('"identity": "', '"identity": "x', 0, id="another store with its inode"),
        pytest.param('"station": "a"', '"station": "b"', 0, id="the station is renamed"),
        pytest.param('"epoch": 5', '"epoch": "5"', 0, id="a count is no number"),
        pytest.param('"sent"', "", 0, id="the cursor is cut"),
        pytest.param("{", "[{", 0, id="the cursor is of another kind"),
    ],
)
def test_a_cursor_is_of_its_store_and_station(two, text, instead, sent):
    path, place = two[0].with_name("cursor"), "postgresql://o@h/d"
    with Store.open(two[0]) as store:
        cursor = Cursor.read(path, store, place, "a")
        cursor.sent["epoch"] = 5
        cursor.write(path)
        written = path.read_text()
        assert text in written
        path.write_text(written.replace(text, instead, 1))
        assert Cursor.read(path, store, place, "a").sent["epoch"] == sent


CLONES = ["copied", "by backup", "with its cursor", "before the first report", "the clone first",
          "far behind", "under another name"]  # fmt: skip


@pytest.mark.parametrize("how", mostly_slow(CLONES, "with its cursor", "under another name"))
def test_a_cloned_card_loses_nothing_and_is_reported(server, two, make_epoch, make_result, how):
    """A card's image has the cursor, the store's inode and identity too: only what the two take
    afterwards tells them apart.
    """
    one, clone = two[0], two[0].with_name("clone.db")
    apart, ahead = how == "under another name", 3 if how == "far behind" else 0
    names = {one: "gauge-7", clone: "gauge-8" if apart else "gauge-7"}

    def send(path):
        cursor = path.with_suffix(".cursor")
        Forwarder(path, address(server), names[path], cursor).send_waiting()

    if how != "before the first report":
        send(one)
        assert "twins" not in findings(server)
    if how == "by backup":
        with Store.open(one) as store:
            store.copy_to(clone)
    else:
        shutil.copyfile(one, clone)
    if how == "with its cursor":
        inode = [f'"inode": {path.stat().st_ino}' for path in (one, clone)]
        copied = one.with_suffix(".cursor").read_text().replace(*inode)
        clone.with_suffix(".cursor").write_text(copied)
    for path, shift, end in ((one, 0.0, 9 + ahead), (clone, 4.0 + 10.0 * ahead, 9)):
        with Store.open(path, "append", durable=False) as store:
            (series,) = store.all_series()
            for i in range(6, end):
                epoch = make_epoch(i)
                moved = replace(epoch, frame_time=epoch.frame_time + shift)
                store.append(series, moved, make_result(i))
    order = (clone, one) if how == "the clone first" else (one, clone)
    for path in (*order, *order):
        send(path)
    assert count(server, "series") == 1 + apart
    assert count(server, "epoch") == (16 if apart else 11 + ahead)  # all are there
    assert ("twins" in findings(server)) is not apart
