"""Texts that new users read: durations, standard deviations, paths, places of files."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest

import thermocald as tc
from tests.commands import succeed as run
from thermocald.cli import common
from thermocald.daemon.desk import Follower
from thermocald.daemon.session import Session
from thermocald.errors import ThermocaldError, UsageError
from thermocald.numbers import duration, with_sd
from thermocald.physics.testfields import corner_field


@pytest.fixture(scope="module")
def minute(tmp_path_factory):
    """Seven epochs, one minute, in a folder whose name is longer than a terminal's line."""
    place = tmp_path_factory.mktemp("texts") / ("a-long-name-of-a-folder-" * 4)
    place.mkdir()
    field = corner_field("circles", 4, 150.0)
    tc.simulate("rpi-v2.1-heating", seed=1, testfield=field, epochs=7, out=place / "M1")
    return place / "M1"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 seconds"), (1, "1 second"), (42, "42 seconds"), (60, "1 minute"), (89, "1 minute"),
     (1500, "25 minutes"), (7200, "2.0 hours"), (86400 * 12, "12 days")],
)  # fmt: skip
def test_durations_are_as_a_person_says_them(seconds, text):
    """Wrong forms were `in 1 minutes` and `for 0.0 h`."""
    assert duration(seconds) == text


def test_a_standard_deviation_is_never_shown_as_nothing():
    """Wrong forms were `± 0 mm` and `-7.91883e-07 ± 3.4e-08`."""
    assert with_sd(-7.91883e-07, 3.4e-08, "mm⁻²") == "(−7.92 ± 0.34)·10⁻⁷ mm⁻²"
    rng = np.random.default_rng(0)
    for _ in range(500):
        value, sd = rng.normal() * 10 ** rng.uniform(-9, 5), 10 ** rng.uniform(-10, 3)
        text = with_sd(value, sd, "mm")
        shown = text.partition("±")[2].partition("·")[0]
        assert re.search(r"[1-9]", shown), text
        assert "e-" not in text


def test_a_study_of_a_minute_and_a_path_in_one_piece(minute, undrawn):
    report = minute.parent / "new folder" / "study.html"
    told = run("study", minute, "--report", report, COLUMNS="60")
    assert "in 1 minute the principal point" in " ".join(told.stdout.split())
    assert "1 minutes" not in told.output
    assert str(report) in told.output
    assert report.exists()


def test_the_line_of_a_session_stays_one_line(monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "80")
    sentence = "drifting 1.1085 ± 0.0015 px/min, ready in about 12.5667 ± 0.0067 min"
    last = {
        "epoch": 1, "temperature": 25.0, "status": "ok", "c": 3.04, "sd_c": 0.000031,
        "sigma0": 1.0, "online": {"sentence": sentence},
    }  # fmt: skip
    one = {"found": [], "last": last, "state": "running", "why": "", "taken": 1}
    Follower(Session(camera="a", series="M1", epochs=150), print).follow(one)
    line = terminal.getvalue().removeprefix("\r\x1b[K")
    assert len(line) == 79
    assert "c 3.040000 ± 0.000031 mm" in line


def test_the_configuration_is_looked_for_here_then_in_etc(monkeypatch, tmp_path):
    places = (tmp_path / "config.yaml", tmp_path / "etc.yaml")
    monkeypatch.setattr(common, "CONFIG_PLACES", places)
    for command, given in (
        ("status", ".* --store FILE"), ("run", "one of --config FILE, --mock"),
        ("session status", "--config FILE$"), ("session start", "--config FILE, or --mock$"),
    ):  # fmt: skip
        neither = rf"neither \./config\.yaml nor /etc/thermocald/config\.yaml; give {given}"
        with pytest.raises(UsageError, match=neither):
            run(*command.split())
    for place, store in ((places[1], "there.db"), (places[0], "here.db")):
        place.write_text(f"store: {{path: {store}}}\nthermometers: [{{name: h, driver: mock}}]\n")
        with pytest.raises(ThermocaldError, match=f"no daemon runs for .*/{store}"):
            run("status")


def test_a_flat_field_says_what_it_is_good_for():
    told = " ".join(run("testfield", "check", "--flat").stdout.split())
    assert told.startswith("NOT ENOUGH: a series of a fixed camera gets no result")
    assert "A flat sheet also gives a drift: photograph it in ten poses" in told
    assert "719" not in told
    assert "the principal distance is not determined" in told
