"""Every block has a language, every command and option exists, every stanza is a valid one."""

from __future__ import annotations

import csv
import json
import re
import shlex
import tomllib

import pytest
import typer
import yaml

from tests.docs.blocks import (
    LANGUAGES,
    NOTEBOOKS,
    PAGES,
    ROOT,
    Block,
    all_blocks,
    blocks,
    inline_commands,
    name,
)
from thermocald.cli import application
from thermocald.config import Config, parse_config
from thermocald.hal import load_driver
from thermocald.store.recording.reader import read_recording

COMMAND = typer.main.get_command(application())
STANZAS = set(Config.model_fields)


def identity(block: Block) -> str:
    return f"{block.page}:{block.line}"


def read_csv(text: str) -> None:
    rows = [row for row in csv.reader(text.splitlines()) if not row[0].startswith("#")]
    assert len({len(row) for row in rows}) == 1


READERS = {"json": json.loads, "toml": tomllib.loads, "csv": read_csv}


def test_every_block_names_its_language():
    unknown = [identity(b) for b in all_blocks() if b.language not in LANGUAGES]
    assert not unknown


def thermocald_commands() -> list[tuple[str, str]]:
    found = []
    for block in all_blocks("bash") + all_blocks("text"):
        for line in block.commands():
            parts = re.split(r"\s*(?:&&|\||;\s)\s*", line)
            found += [(identity(block), p) for p in parts if p.startswith("thermocald ")]
    for page in (*PAGES, *NOTEBOOKS):
        found += [(name(page), text) for text in inline_commands(page)]
    return found


def test_every_command_and_option_exists(capsys):
    """`… --help` is refused for unknown commands and options, and carries nothing out."""
    commands = thermocald_commands()
    assert len(commands) > 60
    wrong = []
    for where, text in dict.fromkeys(commands):
        words = shlex.split(re.sub(r"\s*[<>].*$", "", text))[1:]
        try:
            COMMAND.main([*words, "--help"], "thermocald", standalone_mode=False)
        except Exception as error:
            wrong.append(f"{where}: {text}: {error}")
    capsys.readouterr()
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("block", all_blocks("yaml"), ids=identity)
def test_yaml_is_valid(block, tmp_path):
    document = yaml.safe_load(block.text)
    if not isinstance(document, dict) or not set(document) <= STANZAS:
        return
    # a fragment stands for the whole: what it leaves out does not matter
    if not {"cameras", "thermometers"} & set(document):
        document["thermometers"] = [{"name": "any", "driver": "mock"}]
    known = {t["name"] for t in document.get("thermometers", [])}
    for camera in document.get("cameras", []):
        for thermometer in set(camera.get("thermometers", [])) - known:
            document.setdefault("thermometers", []).append({"name": thermometer, "driver": "mock"})
        for key in ("testfield", "thermal_model", "control_points", "control_reference"):
            if key in camera:
                (tmp_path / camera[key]).touch()
    parse_config(document, tmp_path / "config.yaml", load_driver)


@pytest.mark.parametrize("measured", [False, True])
def test_the_recording_of_the_how_to_is_read(tmp_path, measured):
    page = ROOT / "docs/how-to/make-a-recording.md"
    for block in blocks(page):
        name, _, content = block.text.partition("\n")
        if name.startswith("# ") and (measured or name != "# observations.csv"):
            (tmp_path / name.removeprefix("# ")).write_text(content)
    (tmp_path / "frames").mkdir()
    for i in (1, 2, 3):
        (tmp_path / "frames" / f"000{i}.jpg").touch()
    recording = read_recording(tmp_path)
    assert [e.frame.name for e in recording.epochs] == ["0001.jpg", "0002.jpg", "0003.jpg"]
    assert list(recording.head.channels) == ["housing"]
    assert recording.has_observations == measured


@pytest.mark.parametrize("block", [b for k in READERS for b in all_blocks(k)], ids=identity)
def test_json_toml_and_csv_are_valid(block):
    READERS[block.language](block.text)


def test_nothing_deeper_than_the_public_interface_is_imported():
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md"), ROOT / "README.md"]
    texts = {name(p): p.read_text() for p in (*pages, *(ROOT / "examples").rglob("*.py"))}
    for notebook in NOTEBOOKS:
        cells = json.loads(notebook.read_text())["cells"]
        texts[name(notebook)] = "\n".join("".join(cell["source"]) for cell in cells)
    for of_developers in ("docs/reference/drivers.md", "docs/reference/effects.md"):
        del texts[of_developers]

    deeper = re.compile(r"thermocald\.[a-z_]+\.[a-z]")
    assert {page: found for page, text in texts.items() if (found := deeper.findall(text))} == {}
