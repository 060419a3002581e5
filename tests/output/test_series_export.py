"""Exports for people: units in the columns' names, and back through `import` to the last digit."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

from thermocald.cli import application
from thermocald.errors import UsageError
from thermocald.output.series_export import style_of
from thermocald.simulation.presets import preset_simulation
from thermocald.simulation.testfields import corner_field
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.reader import read_recording


def run(*arguments):
    result = CliRunner().invoke(application(), [str(a) for a in arguments])
    assert result.exit_code == 0, (result.output, result.exception)
    return result


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    from dataclasses import replace

    place = tmp_path_factory.mktemp("export")
    s = preset_simulation("rpi-v2.1-heating", seed=1, field=corner_field("circles", 4, 150.0))
    replace(s, programme=replace(s.programme, epochs=10)).write(place / "M1")
    return place / "M1"


def rows_of(text, separator=","):
    return list(csv.DictReader(text.splitlines(), delimiter=separator))


def test_units_are_named_and_true(recording):
    plain = rows_of(run("export", recording).stdout)
    german = rows_of(
        run("export", recording, "--units", "px,um,deg", "--time", "iso", "--separator", ";",
            "--decimal", ",").stdout, ";",
    )  # fmt: skip
    pitch = read_recording(recording).camera.sensor.pixel_pitch
    assert len(german) == len(plain) == 10
    for a, b in zip(plain, german, strict=True):

        def number(name, row=b):
            return float(row[name].replace(",", "."))

        assert number("c_px") * pitch == pytest.approx(float(a["c"]), rel=1e-14)
        assert number("sd_x0_px") * pitch == pytest.approx(float(a["sd_x0"]), rel=1e-14)
        assert number("X0_um") == pytest.approx(1000 * float(a["X0"]), rel=1e-14)
        assert number("omega_deg") == pytest.approx(np.degrees(float(a["omega"])), rel=1e-14)
        assert b["frame_time"].endswith("Z")
        assert "c" not in b
        assert b["status"] == a["status"] == "ok"


def test_what_is_exported_is_imported_the_same(recording, tmp_path):
    out = tmp_path / "M1.csv"
    run("export", recording, "--time", "iso", "--separator", ";", "--decimal", ",", "-o", out)
    log = read_log(out)  # no time zone needed: the times say UTC
    columns = read_recording(recording).columns
    assert log.times == pytest.approx(columns.frame_time, abs=2e-6)
    for name in columns.temperatures:
        assert log.channels[f"temperature {name}"].tolist() == columns.at_frame(name).tolist()


def test_parquet_is_bit_for_bit(recording, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "new" / "M1.parquet"
    run("export", recording, "--format", "parquet", "-o", out)
    table = parquet.read_table(out)
    plain = rows_of(run("export", recording).stdout)
    for name in ("c", "sd_c", "omega", "sigma0"):
        assert table[name].to_pylist() == [float(row[name]) for row in plain]
    channels = read_recording(recording).columns.temperatures
    assert {f"temperature {n}" for n in channels} <= set(table.column_names)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("mm", "seconds", ",", "."), "--units mm"),
        (("", "local", ",", "."), "--time local"),
        (("", "iso", "x", "."), "--separator x"),
        (("", "iso", ",", ","), "needs another --separator"),
    ],
)
def test_styles_that_there_are_not_are_refused(options, reason):
    with pytest.raises(UsageError, match=reason):
        style_of(*options)
