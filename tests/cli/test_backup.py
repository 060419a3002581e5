"""`thermocald backup` and what `check` says of a store, as a user runs them."""

from __future__ import annotations

import json
import sqlite3

import numpy as np
import pytest

from thermocald.cli import application
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.series import EpochResult


@pytest.fixture
def store_path(tmp_path):
    head = Head("a", "M1", 10.0, CameraSpec("rpi", Sensor(640, 480, 0.001)), {"t": Channel()})
    path = tmp_path / "s.db"
    with Store.open(path, "append", durable=False) as store:
        series = store.create_series(head, TestField.build(["a"], np.zeros((1, 3))))
        for k in (1, 2, 5):
            result = EpochResult("ok", "", np.full(16, float(k)), np.eye(16), 1.0, 5, 9)
            store.append(series, Epoch(k, 1.6e9 + k, 1.6e9 + k, {"t": 20.0}), result)
    return path


@pytest.fixture
def run(capsys):
    def call(*arguments) -> tuple[int, str, str]:
        from thermocald.errors import ThermocaldError

        code = 0
        try:
            application()([str(a) for a in arguments], standalone_mode=False)
        except ThermocaldError as error:
            code = error.exit_status
            print(f"error: {error}")
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


def test_a_backup_is_made_beside_a_writer_verified_and_old_ones_go(run, store_path, tmp_path):
    folder = tmp_path / "backups"
    folder.mkdir()
    for stamp in ("20200101T000000Z", "20210101T000000Z"):
        (folder / f"s-{stamp}.db").write_bytes(b"older")
    (folder / "s-mine.db").write_bytes(b"not ours to delete")
    with Store.open(store_path, "append") as writer:
        series = writer.find_series()
        writer.append(series, Epoch(6, 1.6e9 + 6, 1.6e9 + 6, {"t": 20.0}))  # in the -wal file
        code, out, _ = run("backup", store_path, folder, "--keep", "2", "--json", "-")
    assert code == 0
    document = json.loads(out)
    assert document["epochs"] == 4
    assert [p.rsplit("/", 1)[1] for p in document["deleted"]] == ["s-20200101T000000Z.db"]
    assert len(list(folder.glob("*.db"))) == 3
    with Store.open(folder / document["backup"].rsplit("/", 1)[1]) as copy:
        assert copy.last_epoch(copy.find_series()) == 6
    with Store.open(folder / document["backup"].rsplit("/", 1)[1], "append") as restored:
        assert restored._db.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_damaged_store_is_not_backed_up_and_check_names_the_place(run, store_path, tmp_path):
    database = sqlite3.connect(store_path)
    database.execute("DROP TRIGGER epoch_update")
    database.execute("UPDATE epoch SET c = c * 1.0001 WHERE number = 2")
    database.commit()
    database.close()
    code, out, _ = run("backup", store_path, tmp_path / "copy.db")
    assert code == 1
    assert "epoch 2" in out
    assert not (tmp_path / "copy.db").exists()
    assert not list(tmp_path.glob(".*partial"))
    code, out, _ = run("check", store_path)
    assert code == 1
    assert "damaged: rpi/M1, epoch 2" in out
    assert "rpi/M1: epochs 3 to 4 are missing (2)" in out


def test_a_backup_is_never_written_over(run, store_path, tmp_path):
    (tmp_path / "there.db").write_text("mine")
    assert run("backup", store_path, tmp_path / "there.db")[0] == 1
    assert (tmp_path / "there.db").read_text() == "mine"
    assert run("backup", store_path, tmp_path / "away/there.db")[0] == 2


def test_a_sound_store_with_gaps_is_sound(run, store_path):
    code, out, _ = run("check", store_path, "--json", "-")
    document = json.loads(out)
    assert (code, document["damaged"], document["epochs"]) == (0, [], 3)
    assert document["gaps"] == [{"camera": "rpi", "series": "M1", "first": 3, "last": 4}]
