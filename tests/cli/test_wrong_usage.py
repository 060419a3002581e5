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

from tests.commands import call, every_command
from thermocald import cli
from thermocald.cli import application, commands
from thermocald.errors import OutputError
from thermocald.files import check_output


def _typed(*words: object, folder=None) -> tuple[int, list[str]]:
    """Exit status and lines on standard error."""
    done = call(*words, folder=folder)
    return done.returncode, done.stderr.splitlines()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("replya", "M1"), r"error: no such command 'replya'. Did you mean 'replay'\? See 'thermo"),
        (("replay",), r"error: missing argument '(?i:recording)'; see 'thermocald replay --help'"),
        (("replay", "M1", "M1"), "see 'thermocald replay --help'"),
        (("study", "M1", "--distance", "-3"), "error: .*--distance"),
        (("predict", "--model", "m", "--temperature", "nan"), "--temperature: nan is no finite"),
        (("testfield", "check", "--from", "0", "inf", "0"), "--from: inf is no finite number"),
        (("testfield", "print", "--out", "f", "--square", "30"), "--square, --marker: give --char"),
        (
            ("predict", "--model", "m", "--log", "l", "--separator", "abc"),
            "--separator abc: must be one character",
        ),
        # options that would do nothing
        (("fit", "a", "-o", "o", "--separator", ";"), "error: --separator needs --log"),
        (("replay", "p", "--timezone", "UTC"), "error: --timezone needs --model"),
        (
            ("replay", "p", "--model", "m", "--log", "l", "--store", "s"),
            "error: --store does nothing with --model",
        ),
        (("discover", "M1", "--plan", "--report", "r"), "--report does nothing with --plan"),
        (("camera", "at", "m", "--temperature", "9", "--frame", "f"), "--frame needs --renew"),
        (("camera", "at", "m", "--temperature", "9", "--to", "ros"), "--to needs --out"),
        (("fit", "a", "-o", "o", "--timezone", "UTC"), "--timezone needs --log"),
        (("predict", "--model", "m", "--log", "l", "--distance", "5"), "--distance does nothing"),
        (("testfield", "check", "f.csv", "--paper", "A4"), "--paper does nothing with FIELD"),
        (("testfield", "check", "--pixel-pitch", "0.001"), "--pixel-pitch needs --camera"),
        (("testfield", "print", "-o", "f", "--dictionary", "D"), "--dictionary needs --charuco"),
        (("testfield", "print", "-o", "f", "--chessboard", "9x6", "--light"), "--light does noth"),
        (("testfield", "import", "b.pdf", "--diameter", "9"), "--diameter needs --rings"),
        (("reprocess", "a", "-o", "o", "--do", "study", "--free", "c"), "--free needs --do calib"),
        # the names are those of the help
        (("correct", "p", "--size", "9", "--model"), "error: option '--model' requires"),
        (("measure", "--model", "/dev/null/m"), r"error: missing argument 'POINTS\.csv'"),
        (("study", "M1", "--seed", "x"), "error: .*--seed"),
        (("predict", "--temperature", "20"), "error: missing option '--model'"),
        (("export", "M1", "--format", "xlsx"), "one of csv, json, parquet"),
        (
            ("simulate", "--preset", "rpi-v2.1-heating", "--out", "o", "--series", "a/b"),
            "series: 'a/b' cannot be part of a file's name",
        ),
        (("run", "--config", "idle.yaml", "--epochs", "2"), "--epochs: no camera of the config"),
        (("doctor", "--root", "/nowhere"), "--root /nowhere: there is no such folder"),
        (("doctor", "--root", "/y" * 300), "--root (/y){100}…y(/y){99}: there is no such folder"),
        (("camera", "foo"), "error: no such command 'foo'; see 'thermocald camera --help'"),
        (("replay", "M1", "--exteriorr", "series"), "no such option: --exteriorr"),
        (("import", "p", "--log", "l"), "error: --testfield is missing: give it, or --dry-run"),
        (("study", "M1", "--report", "a.html", "--json", "./a.html"), r"would be \./a\.html"),
        (("fit", "1", "-o", "c.yaml", "--code", "a", "--json", "a.h"), "--json: both would be a"),
        # its `--report / --no-report` shares its name with files of other commands
        (("session", "start", "--camera", "a", "--config", "no.yaml"), r"error: no\.yaml: "),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, tuple) else "",
)
def test_it_is_one_line(words, said, tmp_path):
    (tmp_path / "idle.yaml").write_text("cameras: [{name: a, driver: mock, series: null}]")
    status, lines = _typed(*words, folder=tmp_path)
    assert status == 2
    assert len(lines) == 1
    assert re.search(said, lines[0])


def test_nothing_typed_is_answered_by_the_help():
    status, lines = _typed("camera")
    assert status == 2
    assert not [line for line in lines if line.startswith("error")]


PROGRAM = typer.main.get_command(application())
COMMANDS = {name: command.params for name, command in every_command(PROGRAM)}


def _kind(name: str, option: str) -> str | None:
    return commands._OUTPUTS.get(f"{name} {option}", commands._OUTPUTS.get(option))


OUTPUTS = [
    (name, parameter.name)
    for name, parameters in COMMANDS.items()
    for parameter in parameters
    if _kind(name, parameter.name) and not parameter.secondary_opts  # `--report / --no-report`
]


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
    for name in ("recording.yaml", "observations.parquet"):
        (tmp_path / "M1" / name).touch()
    (tmp_path / "file").touch()
    with closing(socket.socket(socket.AF_UNIX)) as server:
        server.bind(str(tmp_path / "s"))
    with suppress(PermissionError):
        os.mknod(tmp_path / "disk", 0o666 | stat.S_IFBLK, os.makedev(240, 200))
    return {what: tmp_path / place for what, place in places.items()}


TAKEN = {
    "file": {"a folder", "a store", "a link to a store", "a store's other name", "its -wal",
             "a recording", "its head", "its Parquet", "within a file", "the kernel's", "a socket",
             "a disk"},
    "folder": {"a file", "within a file", "the kernel's", "a store", "a socket"},
}  # fmt: skip
TAKEN["recording"] = TAKEN["folder"] | {"a recording"}
TAKEN["either"] = TAKEN["file"] - {"a folder", "a recording"}


@pytest.mark.parametrize(("name", "option"), OUTPUTS)
def test_what_may_not_be_replaced_is_refused_before_the_work(
    name, option, occupied, tmp_path, monkeypatch
):
    """The command's other inputs do not exist: it must not have read them yet."""
    monkeypatch.chdir(tmp_path)
    words = name.split()
    for other in COMMANDS[name]:
        if other.required and other.name != option:
            words += [o for o in other.opts[:1] if o.startswith("-")] + ["1"]
    (given,) = (p.opts[0] for p in COMMANDS[name] if p.name == option)
    if option == "code":  # FILE.h and FILE.py are written
        for place in occupied.values():
            if place.is_relative_to(tmp_path) and place.parent.is_dir():
                place.with_suffix(".py").mkdir(exist_ok=True)
    before = sorted(tmp_path.rglob("*"))
    for what in sorted(TAKEN[_kind(name, option)]):
        place = occupied[what]
        if what == "a disk" and not place.exists():
            continue
        why = "cannot be written" + (": .*file is a file$" if what == "within a file" else "")
        with pytest.raises(OutputError, match=why):
            PROGRAM.main([*words, given, str(place)], standalone_mode=False)
        assert sorted(tmp_path.rglob("*")) == before


def test_every_option_that_says_that_it_writes_is_looked_at():
    for name, parameters in COMMANDS.items():
        assert not [p for p in parameters if set(p.metavar or "") & set("[]…")]  # typer adds these
        for one in parameters:
            told = getattr(one, "help", None) or ""
            if re.match(r"(Also )?[Ww]rite|The .* to write", told):
                assert (name, one.name) in OUTPUTS


def test_outputs_that_can_be(tmp_path):
    (tmp_path / "there").touch()
    for path in (tmp_path / "there", tmp_path / "new" / "deep" / "a.csv", "/dev/null"):
        check_output(tmp_path / path)
    for kind in ("folder", "recording", "either"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        check_output(tmp_path / "empty", kind)
        check_output(tmp_path / "new" / "deep", kind)
    assert not (tmp_path / "new").exists()
    with pytest.raises(
        OutputError, match="the folder belongs to the kernel; choose another folder"
    ):
        check_output(tmp_path / "/proc/a.csv")


@pytest.mark.parametrize(("file", "said"), [("notes.txt", "is not a"), ("no.db", "does not exist")])
def test_what_is_no_store_gets_no_page(tmp_path, file, said):
    (tmp_path / "notes.txt").write_text("a gauge")
    status, lines = _typed("dashboard", "--store", tmp_path / file)
    assert (status, len(lines)) == (1, 1)
    assert f"{file}: {said}" in lines[0]


@pytest.mark.parametrize(
    ("is_open", "why"), [(False, "read: Permission denied"), (True, "written")]
)
def test_an_input_in_a_closed_folder_cannot_be_read(monkeypatch, is_open, why):
    """The tests may run as root, to whom no folder is closed."""

    def denied(*_):
        raise PermissionError(13, "Permission denied", "closed/recording.yaml")

    monkeypatch.setattr(cli, "application", denied)
    monkeypatch.setattr(cli.os, "access", lambda *_: is_open)
    out, err = io.StringIO(), io.StringIO()
    monkeypatch.setattr(cli.sys, "stdout", out)
    monkeypatch.setattr(cli.sys, "stderr", err)
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert f"error: closed/recording.yaml: cannot be {why}" in err.getvalue()
