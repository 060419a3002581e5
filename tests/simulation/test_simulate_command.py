"""The command `thermocald simulate`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.commands import answer
from thermocald.errors import ThermocaldError
from thermocald.physics.presets import PRESETS, preset_simulation
from thermocald.store.recording.reader import read_recording


def run(*arguments):
    return answer("simulate", *arguments)


def test_the_list_as_a_document():
    listed = json.loads(run("--list", "--json", "-").stdout)
    assert {one["preset"] for one in listed["presets"]} == set(PRESETS)
    assert len(listed["effects"]) == 20


def test_preset_to_recording_and_json(tmp_path):
    result = run("--preset", "nexus5-cold", "--out", tmp_path / "r", "--seed", 5, "--json", "-",
                 "--model-out", tmp_path / "m.yaml")  # fmt: skip
    assert result.exit_code == 0
    summary = json.loads(result.stdout)
    assert summary["epochs"] == 150
    assert round(summary["drift"]["principal_point_px"]) == 16
    recording = read_recording(tmp_path / "r")
    expected = next(preset_simulation("nexus5-cold", seed=5).observations())
    np.testing.assert_allclose(recording.epochs[0].observations.points, expected.points, atol=1e-5)
    # the written model gives the same recording
    again = run("--preset", "nexus5-cold", "--model", tmp_path / "m.yaml", "--out", tmp_path / "s",
                "--seed", 5)  # fmt: skip
    assert again.exit_code == 0
    files = [(tmp_path / n / "observations.csv").read_bytes() for n in "rs"]
    assert files[0] == files[1]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--preset", "nexus6", "--out", "r"], "unknown preset"),
        (["--preset", "nexus5-cold"], "--out is missing"),
        (["--out", "r"], "give --preset"),
        (["--model", "none.yaml", "--programme", "p.yaml", "--out", "r"], "cannot be read"),
    ],
)
def test_wrong_usage(tmp_path, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert isinstance(result.exception, ThermocaldError)
    assert result.exception.exit_status == 2
    assert reason in str(result.exception)
    assert not (tmp_path / "r").exists()


def test_existing_recording_is_not_overwritten(tmp_path):
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "mine.txt").write_text("mine")
    result = run("--preset", "nexus5-cold", "--out", tmp_path / "r")
    assert isinstance(result.exception, ThermocaldError)
    assert "exists already" in str(result.exception)
    assert [p.name for p in tmp_path.iterdir()] == ["r"]
