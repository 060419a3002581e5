"""Wrong usage is answered by one line (what, where, what to do), before any work is done."""

from __future__ import annotations

import io
import os
import re
import socket
import sqlite3
import stat
from contextlib import closing, suppress

import pytest
import typer

from tests.commands import call, every_command, refuse
from thermocald import cli
from thermocald.cli import commands

LOG = "--log M3/epochs.csv --model model.yaml"
TOO_SMALL, NO_NUMBER = (
    "is '-3'; must be at least 0.01",
    "is '35,5'; must be a number, without a unit",
)
if not hasattr(typer, "_click"):  # older versions: in Click's words
    TOO_SMALL, NO_NUMBER = "-3.0 is not in the range x>=0.01", "'35,5' is not a valid float"
SCALE = "--scale R65 R71 100 -o s.csv"
ONE_LINE = [
    (
        "replya M1",
        "error: no such command 'replya'. Did you mean 'replay'? See 'thermocald --help'",
    ),
    ("replay", "error: missing argument 'RECORDING'; see 'thermocald replay --help'"),
    ("study M1 --distance -3", f"error: --distance: {TOO_SMALL}; see"),
    ("predict --temperature 35,5", f"error: --temperature: {NO_NUMBER}; s"),
    ("fit M1 -o", "error: option '-o' requires an argument; see 'thermocald fit --help'"),
    ("predict --model m --temperature nan", "--temperature: nan is not a finite"),
    ("testfield check --from 0 inf 0", "--from: inf is not a finite number"),
    ("testfield print --out f --square 30", "--square, --marker: give --char"),
    ("predict --model m --log l --separator abc", "--separator abc: must be one character"),
    # options that would do nothing
    ("fit a -o o --separator ;", "error: --separator needs --log"),
    ("replay p --timezone UTC", "error: --timezone needs --model"),
    ("replay p --model m --log l --store s", "error: --store has no effect with --model"),
    ("discover M1 --plan --report r", "--report has no effect with --plan"),
    ("camera at m --temperature 9 --to ros", "--to needs --out"),
    ("testfield check f.csv --paper A4", "--paper has no effect with FIELD"),
    ("testfield print -o f --dictionary D", "--dictionary needs --charuco"),
    ("reprocess a -o o --do study --free c", "--free needs --do calib"),
    # the names are those of the help
    ("correct p --size 9 --model", "error: option '--model' requires"),
    ("measure --model /dev/null/m", "error: missing argument 'POINTS.csv'"),
    ("export M1 --format xlsx", "one of csv, json, parquet"),
    ("simulate --preset rpi-v2.1-heating --out o --series a/b", "series: 'a/b' cannot be part"),
    ("run --config idle.yaml --epochs 2", "--epochs: no camera of the config"),
    pytest.param(f"doctor --root {'/y' * 300}", "/y/y…y/y/y", id="a long path"),
    ("camera foo", "error: no such command 'foo'; see 'thermocald camera --help'"),
    ("replay M1 --exteriorr series", "no such option: --exteriorr"),
    ("--json - replay M1", "--json: write a command's options after its name; see 'thermocald"),
    ("import p --log l", "error: --testfield is missing: give it, or --dry-run"),
    ("study M1 --report a.html --json ./a.html", "would be ./a.html"),
    ("fit 1 -o c.yaml --code a --json a.h", "--json: both would be a"),
    (f"correct p.csv {LOG} --out ./p.csv", "POINTS.csv and --out: both would be ./p.csv"),
    ("export M3 -o M3/testfield.csv", "SOURCE and --output: both would be M3/testfield.csv"),
    ("fit M3 -o -", "--output -: cannot be standard output"),
    # its `--report / --no-report` shares its name with files of other commands
    ("session start --camera a --config no.yaml", "error: no.yaml: "),
    ("dashboard --store notes.txt", "notes.txt: is not a"),
    ("dashboard --store no.db", "no.db: does not exist"),
    ("archive postgresql://u@h/db", "postgresql://h/db: is a server; this command needs a store's"),
    ("status --store postgresql://u@h/db", "postgresql://h/db: is a server; this command needs"),
    ("check postgresql://u@h/db", "postgresql://h/db: is a server; this command needs a store's"),
    ("study", "give recordings or stores"),
    ("study nowhere", "nowhere: does not exist"),
    ("study --reference x", "give no recordings with it"),
    ("study =M1", "the label before = is empty"),
    ("study M1=", "M1=: the recording or store after = is empty"),
    ("study M1 --exterior both", "one of per_epoch, series"),
    ("study M1 --free c,z0", "'z0' is not a parameter"),
    ("fit 20=cold.json 20.3=warm.json -o c.yaml", "at least two temperatures"),
    ("fit warm=cold.json 50=warm.json -o c.yaml", "'warm' is not a temperature"),
    ("fit 20=cold.json 50=free.json -o c.yaml", "calibrate both with the same --free"),
    ("fit 20=cold.json M1 -o c.yaml", "fit series and calibrations separately"),
    ("fit 20=cold.json 50=none.json -o c.yaml", "no covariance"),
    ("fit 20=cold.json 50=list.json -o c.yaml", "not a camera file of any format"),
    ("fit M3 -o c.yaml --effect thermal_lagg", "did you mean 'thermal_lag'?"),
    ("fit M3 -o c.yaml --effect thermal_lag:taw=3", "no parameter 'taw'; did you mean 'tau'?"),
    ("fit M3 -o c.yaml --effect thermal_lag:tau=fast", "tau=fast is not a number"),
    ("fit M3 -o c.yaml --effect thermal_lag:", "no parameter after the colon; there are: tau"),
    ("fit M3 -o c.yaml --effect thermal_lag:tau", "tau has no value; give tau=VALUE"),
    ("fit M3 -o c.yaml --effect thermal_lag:tau=-3", "not above 0"),
    ("fit M3 -o c.yaml --effect second_heat_source", "as in --effect second_heat_source:channel="),
    (
        "fit M3 -o c.yaml --effect second_heat_source:channel=bord_temperature",
        "'board_temperature'?",
    ),
    ("fit M3 -o c.yaml --effect target_displacement:targets=x33+y521", "did you mean 'y52'?"),
    ("fit M3 -o c.yaml --effect radial_distortion_drift:A4", "has no parameter 'A4'"),
    ("fit M3 -o c.yaml --effect creep --effect creep:x0", "given twice"),
    ("fit M1 other -o c.yaml", "belongs to one camera"),
    ("fit M1 swapped -o c.yaml", "put the same one first"),  # another thermometer is the reference
    ("fit M1 binned -o c.yaml", "fit series of one resolution"),
    ("testfield survey photos -o s.csv", "the scale is missing"),
    ("testfield survey photos --scale R65 R65 100 -o s.csv", "is not a distance"),
    (f"testfield survey no.jpg {SCALE}", "no such file"),
    (f"testfield survey photos {SCALE} --hold-camera", "needs --camera"),
    ("testfield survey photos --distances d.csv -o s.csv", "d.csv, line 3, column length"),
    ("calibrate photos --testfield M1/testfield.csv --camera colmap.txt", "--pixel-pitch"),
    ("calibrate photos --testfield M1/testfield.csv --pixel-pitch 0.001", "no photograph has a"),
    ("predict --model model.yaml", "give one of"),
    ("predict --model model.yaml --temperature 30 --channel board", "write NAME=°C"),
    ("predict --model model.yaml --temperature 305", "if it is in kelvin, convert it"),
    ("predict --model model.yaml --temperature -40", "set `extrapolate`"),
    ("predict --model model.yaml --test nothing", "does not exist"),
    ("predict --model model.yaml --test other", "belongs to one camera"),
    ("predict --model model.yaml --test crop", "a crop"),
    ("predict --model model.yaml --test board_only", "has no temperature column 'temperature'"),
    ("predict --model model.yaml --log other/epochs.csv", "the images are of other"),
    ("correct p.csv --model model.yaml --log other/epochs.csv", "the images are of other"),
    (f"correct p.csv {LOG} --size 1920x1080", "a crop"),
    (f"correct p.csv {LOG} --size big", "WIDTHxHEIGHT"),
    (f"correct images.csv {LOG}", "--out is missing"),
    (f"correct no_y.csv {LOG}", "no column 'y'"),
    (f"correct unzoned.csv {LOG}", "--timezone"),
    ("correct p.csv --model model.yaml --log fahrenheit.csv", "89 looks like fahrenheit"),
    ("correct p.csv --model model.yaml --log hot.csv", "set `extrapolate`"),
    ("correct p.csv --model model.yaml --log one_reading.csv", "readings at 1 time"),
    ("correct p.csv --model model.yaml --log no_time.csv", "rows with a time"),
]
ROWS_TOO = [
    (f"testfield survey p.csv {SCALE}", "is not an image"),
    (f"correct images.csv {LOG} --out NEW", "has 640×480 px"),
    (f"correct late.csv {LOG} --out NEW", "outside the temp"),
    (f"correct elsewhere.csv {LOG}", "of another camera, or binned"),
    (f"correct five.csv {LOG}", "line 2: column x: 'five' is not a n"),
    ("correct p.csv --model model.yaml --log backwards.csv", "outside the temperature log"),
]


@pytest.mark.parametrize(("words", "said"), [*ONE_LINE, *ROWS_TOO])
def test_what_cannot_be_done_is_said_in_one_line_and_writes_nothing(misfits, tmp_path, words, said):
    """Where rows or images are left out, each has a line before it."""
    before = sorted(misfits.iterdir())
    done = call(*words.replace("NEW", str(tmp_path / "new")).split(), folder=misfits)
    assert done.returncode in (1, 2)
    assert said in done.stderr
    assert len(re.findall("^error: ", done.stderr, re.MULTILINE)) == 1
    assert done.stderr.count("\n") == 1 or (words, said) in ROWS_TOO
    assert sorted(misfits.iterdir()) == before


def test_nothing_typed_is_answered_by_the_help():
    assert "error" not in refuse("camera")


@pytest.fixture
def occupied(tmp_path):
    """Places that must not be replaced, by their kind."""
    places = {
        "a folder": "folder", "a store": "k.db", "its -wal": "k.db-wal", "a recording": "M1",
        "a link to a store": "link", "a store's other name": "hard.csv",
        "its head": "M1/recording.yaml", "its Parquet": "M1/observations.parquet",
        "within a file": "file/a", "a file": "file", "the kernel's": "/proc/x", "a socket": "s",
        "a disk": "disk",
    }  # fmt: skip
    (tmp_path / "folder").mkdir()
    with closing(sqlite3.connect(tmp_path / "k.db")) as database:
        database.execute("CREATE TABLE x (y)")
    (tmp_path / "link").symlink_to("k.db")
    os.link(tmp_path / "k.db", tmp_path / "hard.csv")
    (tmp_path / "k.db-wal").write_bytes(b"\x37\x7f\x06\x82 and more")
    (tmp_path / "M1").mkdir()
    for name in ("M1/recording.yaml", "M1/observations.parquet", "file"):
        (tmp_path / name).touch()
    with closing(socket.socket(socket.AF_UNIX)) as server:
        server.bind(str(tmp_path / "s"))
    with suppress(PermissionError):
        os.mknod(tmp_path / "disk", 0o666 | stat.S_IFBLK, os.makedev(240, 200))
    return {what: tmp_path / place for what, place in places.items()}


FOLDER = {"a file", "within a file", "the kernel's", "a store", "a socket"}
EITHER = {"a store", "a link to a store", "a store's other name", "its -wal", "its head",
          "its Parquet", "within a file", "the kernel's", "a socket", "a disk"}  # fmt: skip


@pytest.mark.parametrize(
    ("command", "taken"),
    [
        ("check M1 --json", EITHER | {"a folder", "a recording"}),
        ("fit M1 --output c.yaml --code", {"a folder"}),  # FILE.h and FILE.py are written
        ("study M1 --figures", FOLDER),
        ("simulate --out", FOLDER | {"a recording"}),
        ("correct p.csv --model m --log l --out", EITHER),
    ],
)
def test_what_may_not_be_replaced_is_refused_before_the_work(command, taken, occupied, tmp_path):
    """The command's other inputs do not exist: it must not have read them yet."""
    for name in ("k.py", "folder.py"):
        (tmp_path / name).mkdir()
    before = sorted(tmp_path.rglob("*"))
    for what in sorted(taken):
        done = call(*command.split(), occupied[what])
        assert done.returncode in (2, 3)
        assert "cannot be written" in done.stderr
        assert what != "within a file" or done.stderr.endswith("file is a file\n")
        assert sorted(tmp_path.rglob("*")) == before


def test_every_option_that_says_that_it_writes_is_looked_at():
    for name, command in every_command():
        assert not [p for p in command.params if set(p.metavar or "") & set("[]…")]  # typer's
        for one in command.params:
            if re.match(r"(Also )?[Ww]rite|The .* to write", getattr(one, "help", None) or ""):
                assert {one.name, f"{name} {one.name}"} & set(commands._OUTPUTS)


@pytest.mark.parametrize(
    ("is_open", "why"), [(False, "read: Permission denied"), (True, "written")]
)
def test_an_input_in_a_closed_folder_cannot_be_read(monkeypatch, is_open, why):
    """The tests may run as root, to whom no folder is closed."""

    def denied(*_):
        raise PermissionError(13, "Permission denied", "closed/recording.yaml")

    monkeypatch.setattr(cli, "application", denied)
    monkeypatch.setattr(cli.os, "access", lambda *_: is_open)
    monkeypatch.setattr(cli.sys, "stdout", io.StringIO())  # will be closed
    monkeypatch.setattr(cli.sys, "stderr", io.StringIO())
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert f"error: closed/recording.yaml: cannot be {why}" in cli.sys.stderr.getvalue()
