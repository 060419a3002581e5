"""The pages of the docs on recordings, configuration and store say what the program does."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import pytest
import yaml

from thermocald import config as module
from thermocald.config import CalibrationConfig, Config, parse_config
from thermocald.hal import option_names
from thermocald.store.recording import read_recording

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str, kind: str) -> list[str]:
    """Fenced code blocks of a kind, without the indentation of their list."""
    found = re.findall(rf"^( *)```{kind}\n(.*?)^ *```", (DOCS / page).read_text(), re.M | re.S)
    return [re.sub(rf"^{indent}", "", text, flags=re.M) for indent, text in found]


@pytest.mark.parametrize("measured", [False, True])
def test_the_recording_of_the_how_to_is_read(tmp_path, measured):
    for text in [
        *blocks("how-to/make-a-recording.md", "yaml"),
        *blocks("how-to/make-a-recording.md", "csv"),
    ]:
        name, content = text.split("\n", 1)
        if measured or name != "# observations.csv":
            (tmp_path / name.removeprefix("# ")).write_text(content)
    (tmp_path / "frames").mkdir()
    for i in (1, 2, 3):
        (tmp_path / "frames" / f"000{i}.jpg").touch()
    recording = read_recording(tmp_path)
    assert [e.frame.name for e in recording.epochs] == ["0001.jpg", "0002.jpg", "0003.jpg"]
    assert list(recording.channels) == ["housing"]
    assert recording.has_observations == measured


def test_the_configuration_of_the_reference_is_valid():
    (text,) = blocks("reference/config.md", "yaml")
    config = parse_config(yaml.safe_load(text), Path("/etc/config.yaml"), option_names)
    assert config.cameras[0].thermometers == ("lens", "board")


def keys(model) -> set[str]:
    found = set()
    for name, field in model.model_fields.items():
        found.add(field.alias or name)
        for inner in re.findall(r"(\w+Config)", str(field.annotation)):
            found |= keys(getattr(module, inner))
    return found


def test_every_key_is_explained():
    page = (DOCS / "reference/config.md").read_text()
    expected = keys(Config) | keys(CalibrationConfig)
    assert "snooping_alpha" in expected
    assert "width_px" in expected
    missing = {key for key in expected if not re.search(rf"\b{key}\b", page)}
    assert not missing


def test_the_sql_and_python_of_the_reference_run(filled, store_path, tmp_path, monkeypatch):
    store, _ = filled
    store.close()
    (sql,) = blocks("reference/store.md", "sql")
    with sqlite3.connect(store_path) as database:
        rows = database.execute(sql).fetchall()
    database.close()
    assert len(rows) == 20
    assert rows[0][-1] == 20.0625
    store_path.rename(tmp_path / "thermocald.db")
    monkeypatch.chdir(tmp_path)
    (code,) = blocks("reference/store.md", "python")
    namespace: dict = {}
    exec(code, namespace)
    assert len(namespace["columns"]["c"]) == 20
