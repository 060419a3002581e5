"""`thermocald backup`, and `check` of a store, as a user runs them."""

from __future__ import annotations

import sqlite3

import pytest

from tests.commands import call, document, finish
from tests.store.small import create_small_series, small_epoch, small_result
from thermocald.store.database.store import Store


@pytest.fixture
def store_path(tmp_path):
    path = tmp_path / "s.db"
    with Store.open(path, "append", durable=False) as store:
        series = create_small_series(store)
        for k in (1, 2, 5):
            store.append(series, small_epoch(k), small_result(k))
    return path


def test_a_backup_is_made_beside_a_writer_verified_and_old_ones_go(store_path, tmp_path):
    folder = tmp_path / "backups"
    folder.mkdir()
    for stamp in ("20200101T000000Z", "20210101T000000Z"):
        (folder / f"s-{stamp}.db").write_bytes(b"older")
    (folder / "s-mine.db").write_bytes(b"not ours to delete")
    with Store.open(store_path, "append") as writer:
        series = writer.find_series()
        writer.append(series, small_epoch(6))  # in the -wal file
        done = document("backup", store_path, folder, "--keep", "2")
    assert done["epochs"] == 4
    assert [p.rsplit("/", 1)[1] for p in done["deleted"]] == ["s-20200101T000000Z.db"]
    assert len(list(folder.glob("*.db"))) == 3
    with Store.open(folder / done["backup"].rsplit("/", 1)[1]) as copy:
        assert copy.last_epoch(copy.find_series()) == 6
    with Store.open(folder / done["backup"].rsplit("/", 1)[1], "append") as restored:
        assert restored._db.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_folder_is_made_for_the_store_of_a_configuration(store_path, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"thermometers: [{{name: t, driver: mock}}]\nstore: {{path: {store_path}}}\n")
    finish("backup", "--config", config, f"{tmp_path}/backups/", "--keep", "2")
    assert len(list((tmp_path / "backups").glob("s-*Z.db"))) == 1


def test_a_damaged_store_is_not_backed_up_and_check_names_the_place(store_path, tmp_path):
    database = sqlite3.connect(store_path)
    database.execute("DROP TRIGGER epoch_update")
    database.execute("UPDATE epoch SET c = c * 1.0001 WHERE number = 2")
    database.commit()
    database.close()
    done = call("backup", store_path, f"{tmp_path}/new/")
    assert done.returncode == 1
    assert list((tmp_path / "new").iterdir()) == []
    done = call("backup", store_path, tmp_path / "copy.db")
    assert done.returncode == 1
    assert "epoch 2" in done.stderr
    assert not (tmp_path / "copy.db").exists()
    assert not list(tmp_path.glob(".*partial"))
    done = call("check", store_path)
    assert done.returncode == 1
    assert "damaged: rpi/M1, epoch 2" in done.stdout
    assert "rpi/M1: epochs 3 to 4 are missing (2)" in done.stdout


def test_a_backup_is_never_written_over(store_path, tmp_path):
    (tmp_path / "there.db").write_text("mine")
    assert call("backup", store_path, tmp_path / "there.db").returncode == 1
    assert (tmp_path / "there.db").read_text() == "mine"
    assert call("backup", store_path, tmp_path / "away/there.db").returncode == 2
