"""Exports in other units, named in the columns, and read back by `import` to the last digit."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest

import thermocald as tc
from tests.commands import succeed as run
from thermocald.errors import UsageError
from thermocald.physics.testfields import corner_field
from thermocald.store.database.store import Store
from thermocald.store.logger.options import LogOptions
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.reader import read_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    place = tmp_path_factory.mktemp("export") / "M1"
    field = corner_field("circles", 4, 150.0)
    tc.simulate("rpi-v2.1-heating", seed=1, testfield=field, epochs=10, out=place)
    return place


def rows_of(*words, separator=","):
    return list(csv.DictReader(run("export", *words).stdout.splitlines(), delimiter=separator))


def test_units_are_named_and_true(recording):
    plain = rows_of(recording)
    style = ("--units", "px,um,deg", "--time", "iso", "--separator", ";", "--decimal", ",")
    german = rows_of(recording, *style, separator=";")
    pitch = read_recording(recording).camera.sensor.pixel_pitch
    units = {"c_px": 1 / pitch, "sd_x0_px": 1 / pitch, "X0_um": 1000, "omega_deg": 180 / np.pi}
    assert len(german) == len(plain) == 10
    for a, b in zip(plain, german, strict=True):
        for name, factor in units.items():
            expected = factor * float(a[name.rpartition("_")[0]])
            assert float(b[name].replace(",", ".")) == pytest.approx(expected, rel=1e-14)
        assert b["frame_time"].endswith("Z")
        assert "c" not in b
        assert b["status"] == a["status"] == "ok"


def test_parquet_is_bit_for_bit(recording, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "new" / "M1.parquet"
    run("export", recording, "--format", "parquet", "-o", out)
    table = parquet.read_table(out)
    plain = rows_of(recording)
    for name in ("c", "sd_c", "omega", "sigma0"):
        assert table[name].to_pylist() == [float(row[name]) for row in plain]
    assert table["sd_C1"].null_count == len(plain)  # held; a NaN would spoil a mean in polars
    channels = read_recording(recording).columns.temperatures
    assert {f"temperature {n}" for n in channels} <= set(table.column_names)


def test_extra_columns_of_a_store_are_exported_and_imported_the_same(recording, tmp_path):
    """Settings that the camera reported, by epoch; an epoch without them is empty."""
    opened = read_recording(recording)
    settings = {"camera_exposure_s": 0.01999, "camera_gain": 1.5, "camera_focus": -0.25}
    with Store.open(tmp_path / "t.db", "append") as store:
        series = store.create_series(opened.head, opened.testfield)
        for k, epoch in enumerate(opened.iter_epochs()):
            store.append(series, epoch, extra=settings if k != 3 else None)
    source = (tmp_path / "t.db", "--extra")
    rows = rows_of(*source)
    assert [r["camera_gain"] for r in rows] == ["1.5"] * 3 + [""] + ["1.5"] * 6
    channels = opened.columns.temperatures
    assert {f"temperature {n}" for n in channels} <= set(rows[0])
    by_json = json.loads(run("export", *source, "--format", "json").stdout)
    assert [r["camera_focus"] for r in by_json] == [-0.25] * 3 + [None] + [-0.25] * 6

    out = tmp_path / "german.csv"
    style = ("--time", "iso", "--separator", ";", "--decimal", ",", "-o", out)
    run("export", *source, *style)
    log = read_log(out, LogOptions())  # no time zone needed: the times say UTC
    assert log.times == pytest.approx(opened.columns.frame_time, abs=2e-6)
    for name in channels:
        read, stored = log.channels[f"temperature {name}"], opened.columns.at_frame(name)
        assert read.tolist() == stored.tolist()


def test_unknown_columns_of_a_recording_are_extra(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "M1")
    epochs = tmp_path / "M1" / "epochs.csv"
    head, *lines = epochs.read_text().splitlines()
    noted = [f"{line},{'lamp on' if k > 4 else ''}" for k, line in enumerate(lines)]
    epochs.write_text("\n".join([f"{head},remark", *noted]) + "\n")
    rows = rows_of(tmp_path / "M1", "--extra", "--exterior", "series")
    assert [r["remark"] for r in rows] == [""] * 5 + ["lamp on"] * 5


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("--units mm", "--units mm: must be one of"),
        ("--time local", "--time local"),
        ("--separator x", "--separator x"),
        ("--decimal ,", "needs another --separator"),
        ("--format json --time iso", "are for csv and parquet"),
    ],
)
def test_styles_that_there_are_not_are_refused(recording, options, reason):
    with pytest.raises(UsageError, match=reason):
        run("export", recording, *options.split())
