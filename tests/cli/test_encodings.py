"""Every command that prints, in the encodings of terminals, with names that are not text."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys

import pytest

from tests.daemon.conftest import make_recording

COMMANDS = """
--help
simulate --list
simulate --preset rpi-v2.1-heating --out «S»
check «M1»
replay «M1»
replay «M1» --json -
replay «M1» --store «M1».db
export «M1»
export «M1» -o «M1».csv
export «M1».db --format json
export «M1».db --format parquet -o «M1».parquet
check «M1».db
status --store «M1».db
backup «M1».db «copy».db
archive «M1».db --to «archived»
convert «M1» --to parquet --keep
study «M1» --sets 200 --report «s».html --json «s».json
fit «M1» -o «c».yaml --code «c» --json -
predict --model «c».yaml --temperature 30
predict --model «c».yaml --temperature 95
predict --model «c».yaml --log «M1»/epochs.csv
discover «M1»
devices
doctor
testfield import --chessboard 9x6 --square 30 --out «t».csv
testfield check «t».csv
testfield print --help
camera convert «t».csv --to opencv
check «nothing».yaml
run --config «nothing».yaml
session --help
fleet postgresql://u:pw@127.0.0.1:1/«x»
forward --help
calibrate «photos»
measure «nothing».jpg
correct «nothing».csv --model «c».yaml --temperature 30
import «nothing»
reprocess «nothing»
"""
ALL = r"""
import os, shlex, sys, traceback
from thermocald.cli import main
for line in os.fsdecode(sys.stdin.buffer.read()).split("\n"):
    sys.argv = ["thermocald", *shlex.split(line)]
    try:
        main()
        status = 0
    except SystemExit as ended:
        status = ended.code or 0
    except BaseException:
        traceback.print_exc()
        status = 9
    sys.stdout.flush()
    print(f"== {status} {line!a}", file=sys.stderr, flush=True)
"""
NO_UTF8 = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
CASES = [
    pytest.param({"PYTHONIOENCODING": "ascii"}, b"M\xe9 ", id="ascii, names in Latin-1"),
    pytest.param({**NO_UTF8, "LANG": "C"}, "Größe·".encode() + b"\xc3", id="C locale"),
    pytest.param({"PYTHONIOENCODING": "utf-16"}, b"\xff\xfe", id="utf-16"),
    pytest.param({"PYTHONIOENCODING": "cp437:strict"}, "a\tb'温".encode(), id="cp437"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("environment", "name"), CASES)
def test_no_command_breaks_on_what_a_terminal_cannot_show(tmp_path, environment, name):
    make_recording(tmp_path / "M1", 24)
    os.rename(tmp_path / "M1", os.fsencode(tmp_path) + b"/" + name + b"M1")
    quoted = shlex.quote(os.fsdecode(name))
    lines = COMMANDS.strip().replace("«", quoted).replace("»", "")
    done = subprocess.run(
        [sys.executable, "-c", ALL], input=os.fsencode(lines), capture_output=True, check=False,
        cwd=tmp_path, env={**os.environ, **environment}, timeout=400,
    )  # fmt: skip
    encoding = environment.get("PYTHONIOENCODING", "utf-8").partition(":")[0]
    said = done.stderr.decode(encoding, errors="replace")
    print(said)
    assert "Traceback" not in said
    assert "Error: " not in said.replace("Error: No such", "").replace("Error: Missing", "")
    statuses = [line.split()[1] for line in said.splitlines() if line.startswith("== ")]
    assert len(statuses) == len(lines.splitlines())
    assert set(statuses) <= {"0", "1", "2", "3"}
    assert statuses.count("0") >= 20
